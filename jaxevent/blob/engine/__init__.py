"""Tracking on a CPU by kernels that numba compiles from the trackers' own functions.

The functions of one track (`track`, `lifecycle`, and those of the `Filter`) are traced for any
number of events, become expressions (`jaxevent.codegen`), and these the functions of a module
(`program`). One loop (`loop`) for all filters passes over chunks and steps as `jaxevent.blob.run`
does, which is differentiated and serves wherever there is no kernel. `smoother_loop` reads out what
it has recorded, and `runner` calls both.
"""
