"""How JAX runs programs: on a platform that there is, and on CPUs one after another.

Kernels with derivatives are called from within JAX's programs, and use JAX for what depends on
parameters alone. While a program runs in the background and its caller begins another, such a call
waits for both, for ever: 2 of 2 runs of 60 gradients with other work between them did not end, and
2 of 2 ended when programs were run in turn.
"""

import functools
import sys

from jaxevent.errors import InputError


def run_in_turn() -> bool:
    """Have JAX finish each program before it begins the next, once JAX is imported.

    Returns False if JAX has begun to compute otherwise, or does not say.
    """
    jax = sys.modules.get("jax")
    if jax is None:
        return False
    setting = "jax_cpu_enable_async_dispatch"
    try:
        from jax._src.xla_bridge import backends_are_initialized

        if not backends_are_initialized():
            jax.config.update(setting, False)
        return jax.config.values.get(setting) is False
    except (ImportError, AttributeError):  # private: another JAX may have no such names
        return False


@functools.cache
def check_platform() -> None:
    """Raise `InputError` if JAX has no device of the platform that JAX_PLATFORMS names.

    JAX says so by errors of several kinds, where an array is made first. Starts JAX's platform.
    """
    import jax

    try:
        jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        asked = jax.config.jax_platforms  # ty: ignore[missing-attribute]
        reason = " ".join(str(error).split()).partition(" (set JAX_PLATFORMS")[0].rstrip(".")[:200]
        raise InputError(
            f"JAX_PLATFORMS is {asked!r}, and JAX finds no such device here"
            f"{f' ({reason})' if reason else ''}; unset it, or set JAX_PLATFORMS=cpu, or for an "
            "NVIDIA GPU look at what nvidia-smi says and install the extra gpu of jaxevent"
        ) from None
