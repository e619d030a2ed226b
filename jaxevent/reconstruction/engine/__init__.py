"""Kernels of image methods on a CPU: one set of equations, two compilers.

`Filter.run` and `Filter.read` are JAX: pure, mapped, differentiated. For images alone, on a CPU,
the same functions are traced for one pixel, translated and written as a module that numba compiles
(`filter_program`, `smoother_program`, `jaxevent.codegen`). Loops that all methods share pass over
events or frames in bands of rows (`filter_loop`, `smoother_loop`, `bands`), while a band's pixels
are in the processor's cache. `images` makes videos of them, and functions of parameters for fits.

Numbers that depend on parameters alone are computed in NumPy, and conditions among them choose what
a kernel holds. A function without translation raises `TranslationError`, and XLA serves.
"""
