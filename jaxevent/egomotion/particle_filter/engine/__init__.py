"""Voting on a CPU by kernels that numba compiles from the filter's own functions.

What acts on one event and all particles (`likelihood`, `filtering`) is traced for any number of
particles, becomes expressions (`jaxevent.codegen`), and these the functions of a module
(`functions`). One driver (`loop`), the same for all models, passes over batches, events and
candidates as `filtering.run` does, which is differentiated and serves wherever there is no kernel.

While the cloud is narrow the driver scores a few motions that span it, and interpolates between
them.
"""
