"""Settings of JAX's dispatch: synchronous programs on CPUs, and checks of platform and threads.

Kernels with derivatives are called from within JAX's programs, and use JAX for what depends on
parameters alone. If a program runs in the background while its caller begins another, such a call
can wait for both forever. So JAX finishes each program before it begins the next.

A forked process has none of the threads that JAX computes with, and would wait for them forever.
There JAX's programs are refused; kernels work.
"""

import functools
import os
import sys
from typing import Any, NoReturn

from jaxevent.errors import InputError

_lacks_threads = False  # whether the threads of JAX stayed in the parent of this process


def use_synchronous_dispatch() -> bool:
    """Make JAX finish each program before it begins the next, once JAX is imported.

    Returns false if JAX has already begun to compute otherwise, or does not tell.
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
def check_platform_available() -> None:
    """Raise `InputError` if JAX has no device of the platform that JAX_PLATFORMS names.

    JAX raises errors of several kinds, where an array is made first. This starts JAX's platform.
    """
    import jax

    try:
        jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        requested = jax.config.jax_platforms  # ty: ignore[missing-attribute]
        reason = " ".join(str(error).split()).partition(" (set JAX_PLATFORMS")[0].rstrip(".")[:200]
        raise InputError(
            f"JAX_PLATFORMS is {requested!r}, and JAX finds no such device here"
            f"{f' ({reason})' if reason else ''}; unset it, or set JAX_PLATFORMS=cpu, or for an "
            "NVIDIA GPU look at what nvidia-smi says and install the extra gpu of jaxevent"
        ) from None


def check_not_forked() -> None:
    """Raise `InputError` in a forked process whose parent has computed with JAX."""
    if _lacks_threads:
        _refuse()


def _refuse(*_: Any, **__: Any) -> NoReturn:
    raise InputError(
        "this process was forked from one that has computed with JAX, whose threads it lacks; "
        'start it by spawn or forkserver, as multiprocessing.get_context("spawn") does'
    )


def _in_child() -> None:
    global _lacks_threads
    bridge: Any = sys.modules.get("jax._src.xla_bridge")
    compiler: Any = sys.modules.get("jax._src.compiler")
    if bridge is not None and bridge.backends_are_initialized():
        _lacks_threads = True
        if compiler is not None:  # of programs that nobody checks for
            compiler.compile_or_get_cached = _refuse


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)
