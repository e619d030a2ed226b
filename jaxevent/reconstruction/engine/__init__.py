"""One set of equations, two compilers: kernels of per-pixel filters, from their own functions.

`Filter.run` and `Filter.read` are JAX: pure, mapped, differentiated. For images alone, on a CPU,
the same functions are traced for one pixel (`pixel`), the jaxpr becomes a graph of scalar
expressions (`translate`, `expressions`), and these the text of four small functions (`source`),
which numba compiles and keeps in the user's cache folder (`kernel`). One loop (`loop`), the same
for all methods, passes over events divided into bands of rows (`bands`): recursion, what frames say
and every image while a band's pixels are in the processor's cache. `video` puts windows in a row,
as `Video` does.

What rests on parameters alone is computed in NumPy (`host`), and conditions among it choose what
the kernel holds. What has no translation raises `TranslationError`, and the scan serves.
"""
