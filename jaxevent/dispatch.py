"""On a CPU, JAX finishes each program before it begins the next.

Kernels with derivatives are called from within JAX's programs, and use JAX for what depends on
parameters alone. While a program runs in the background and its caller begins another, such a call
waits for both, for ever: 2 of 2 runs of 60 gradients with other work between them did not end, and
2 of 2 ended when programs were run in turn.
"""

import sys


def run_in_turn() -> bool:
    """Have JAX do so, once it is imported; returns False if it has begun to compute otherwise."""
    jax = sys.modules.get("jax")
    if jax is None:
        return False
    from jax._src.xla_bridge import backends_are_initialized

    setting = "jax_cpu_enable_async_dispatch"
    if not backends_are_initialized():
        jax.config.update(setting, False)
    return jax.config.values.get(setting) is False
