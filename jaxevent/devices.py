"""Several devices and processes: partition of the work, and combination of the results.

On several devices of a process `jaxevent fit` and `jaxevent evaluate` need no option: they compute
along the one axis of a `jax.sharding.Mesh` of all local devices. With at least as many windows (of
a fit) or recordings (of an evaluation) as devices, each device has its own. With fewer, the pixels
of every window are partitioned, or for egomotion the runs or particles. Pixels are independent, so
images are bit-equal; sums over pixels are added in another order. To try it without a GPU:
XLA_FLAGS=--xla_force_host_platform_device_count=4.

Several processes, on one machine or many, fit together if each is started with the same arguments
and its number:

    jaxevent fit fit.toml --out fitted --coordinator HOST:PORT --processes 2 --process 0
    jaxevent fit fit.toml --out fitted --coordinator HOST:PORT --processes 2 --process 1

HOST:PORT is a free port of the machine of process 0. Under SLURM and other schedulers that JAX
knows, `srun jaxevent fit fit.toml --out fitted --distributed` finds all three. Every process
prepares and computes its windows, number p, p + N, p + 2 N, ... of N processes, so there should be
at least as many windows as processes (`window` in the configuration). Losses and gradients of all
windows are exchanged and added in the order of the windows by every process: the parameters are
those of one process, to the bit where the devices are alike. Process 0 writes.

The channel between processes protects nothing: no password, no encryption. Whoever reaches its
ports can read, replace or end the exchange, so use it in a network that you trust. Messages are
read as JSON and arrays, never run. The coordinator listens at the HOST that is given, no other
address of the machine (--distributed: where JAX has it listen, on all). On CPUs each process also
listens at the address of its host's name, for the exchange itself.
"""

import contextlib
import functools
import io
import json
import math
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxevent.errors import InputError
from jaxevent.threads import check_platform_available

DEVICE_AXIS = "devices"
JOIN_TIMEOUT_S = 300  # s that processes wait for each other at the start

Q = ParamSpec("Q")
T = TypeVar("T")


class RemoteBatch:
    """Placeholder in a list of batches for one that another process holds."""


REMOTE_BATCH = RemoteBatch()


def full_precision(function: Callable[Q, T]) -> Callable[Q, T]:
    """Make a function multiply matrices in full precision, where GPUs round factors to 11 bits."""

    @functools.wraps(function)
    def precise(*args: Q.args, **kwargs: Q.kwargs) -> T:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return precise


def double_precision(enabled: bool) -> contextlib.AbstractContextManager[Any]:
    """Compute in double precision within a `with` block, or in single precision."""
    if hasattr(jax, "enable_x64"):  # since JAX 0.8
        return jax.enable_x64(enabled)
    from jax.experimental import enable_x64  # ty: ignore[missing-module-member]

    return enable_x64(enabled)


def with_own_settings(function: Callable[Q, T]) -> Callable[Q, T]:
    """Make a function compute with this thread's precision and device on other threads, too.

    JAX keeps for each thread what `with` blocks set.
    """
    double, device = jax.config.jax_enable_x64, jax.config.jax_default_device  # ty: ignore[missing-attribute]

    @functools.wraps(function)
    def called(*args: Q.args, **kwargs: Q.kwargs) -> T:
        with double_precision(double), jax.default_device(device):
            return function(*args, **kwargs)

    return called


def has_accelerator() -> bool:
    """Return true if JAX computes on a GPU, or another device than the CPU, by default."""
    check_platform_available()
    return jax.default_backend() != "cpu"


def loop_unroll(steps: int) -> int:
    """Return how many steps of a loop to compile into one.

    GPUs launch programs anew for each step.
    """
    return steps if has_accelerator() else 1


def local_devices() -> list[Any]:
    """Return the devices to compute on: JAX's default device if set, else all of this process.

    `jax.default_device` thereby confines computations to one device.
    """
    check_platform_available()
    chosen = jax.config.jax_default_device  # ty: ignore[missing-attribute]
    if chosen is None:
        return list(jax.local_devices())
    return jax.local_devices(backend=chosen)[:1] if isinstance(chosen, str) else [chosen]


def is_process_zero() -> bool:
    """Return true in process number 0, the one that writes."""
    return jax.process_index() == 0


def is_single_device() -> bool:
    """Return true if one process computes on one device."""
    return jax.process_count() == 1 and len(local_devices()) == 1


def on_host() -> contextlib.AbstractContextManager[Any]:
    """Return a context that keeps prepared data on the host if several devices share them."""
    if len(local_devices()) == 1:
        return contextlib.nullcontext()
    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:  # JAX was told not to use the CPU
        return contextlib.nullcontext()


def make_mesh(devices: Sequence[Any], divisor: int) -> Mesh | None:
    """Make a mesh of as many devices as divide `divisor`.

    Args:
        devices: Devices to take, the first ones first.
        divisor: Length of the axis that the mesh partitions.

    Returns:
        A mesh with the axis `DEVICE_AXIS`, or None if it would hold one device.
    """
    count = max((n for n in range(1, len(devices) + 1) if divisor % n == 0), default=1)
    return Mesh(np.array(devices[:count]), (DEVICE_AXIS,)) if count > 1 else None


def shard(mesh: Mesh, tree: Any, axis: int | None = None) -> Any:
    """Partition arrays along an axis over a mesh.

    Args:
        mesh: Mesh with the axis `DEVICE_AXIS`.
        tree: Pytree of arrays.
        axis: Axis to partition; None, or an axis that the mesh does not divide, puts whole arrays
            on every device.

    Returns:
        The pytree, on the devices.
    """

    def put(leaf: Any) -> Any:
        spec: list[str | None] = [None] * np.ndim(leaf)
        if axis is not None and np.shape(leaf)[axis] % mesh.size == 0:
            spec[axis] = DEVICE_AXIS
        return jax.device_put(leaf, NamedSharding(mesh, PartitionSpec(*spec)))

    return jax.tree.map(put, tree)


def join(
    coordinator: str | None = None, processes: int | None = None, process: int | None = None
) -> None:
    """Make this process number `process` of `processes`, before JAX has computed anything.

    Without any argument JAX finds them itself (SLURM, Open MPI, Kubernetes, cloud TPUs). On CPUs
    the processes exchange data by gloo.

    Args:
        coordinator: HOST:PORT, a free port of process 0's machine.
        processes: Number of processes.
        process: Number of this process, from 0.

    Raises:
        InputError: Some are missing or make no sense, or the processes do not find each other.
    """
    given = (coordinator, processes, process)
    if any(one is not None for one in given):
        if coordinator is None or processes is None or process is None:
            raise InputError(
                "of several processes each needs the coordinator, the number of processes and its "
                "own number; give --coordinator HOST:PORT, --processes N and --process I"
            )
        host, _, port = coordinator.rpartition(":")
        if not host or not port.isdigit():
            raise InputError(f"the coordinator is {coordinator!r}; give HOST:PORT, as host1:4321")
        if not 0 <= process < processes:
            raise InputError(
                f"there is no process {process} of {processes}; number them from 0 to "
                f"{processes - 1}"
            )
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        # By default the coordinator would listen on all interfaces.
        jax.distributed.initialize(
            *given, initialization_timeout=JOIN_TIMEOUT_S, coordinator_bind_address=coordinator
        )
    except (RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"the processes did not find each other ({reason}); start all of them, with the same "
            "coordinator"
        ) from error


def partition_batches(batches: Sequence[T]) -> list[T | RemoteBatch]:
    """Return the batches of this process, every N-th of N processes; the others are remote."""
    mine, processes = jax.process_index(), jax.process_count()
    return [b if k % processes == mine else REMOTE_BATCH for k, b in enumerate(batches)]


def allgather(message: Any) -> list[Any]:
    """Gather one message from each process, in process order; every process must call it.

    Arrays are exact. Raises `InputError` for a message that `serialise` would not make.
    """
    if jax.process_count() == 1:
        return [message]
    from jax.experimental.multihost_utils import process_allgather

    text = np.frombuffer(serialise(message), np.uint8)
    lengths = np.asarray(process_allgather(np.array([len(text)], np.int32))).ravel()
    # A ladder of sizes: each one is compiled.
    room = 1 << max(10, (int(lengths.max()) - 1).bit_length())
    texts = np.asarray(process_allgather(np.pad(text, (0, room - len(text)))))
    return [deserialise(row[:n].tobytes()) for row, n in zip(texts, lengths, strict=True)]


def serialise(message: Any) -> bytes:
    """Convert numbers, text, bytes, arrays, None, and lists, tuples and dicts of them to bytes.

    The format is a line of JSON, then the arrays as .npy. Reading it runs no code.
    """
    arrays = io.BytesIO()

    def node(value: Any) -> Any:
        if isinstance(value, bytes):
            np.save(arrays, np.frombuffer(value, np.uint8), allow_pickle=False)
            return {"bytes": None}
        if isinstance(value, np.ndarray | np.generic | jax.Array):
            np.save(arrays, np.asarray(value), allow_pickle=False)
            return {"array": None}
        if isinstance(value, dict):
            return {"dict": [[node(key), node(one)] for key, one in value.items()]}
        if isinstance(value, list | tuple):
            kind = "list" if isinstance(value, list) else "tuple"
            return {kind: [node(one) for one in value]}
        return value

    return json.dumps(node(message)).encode() + b"\n" + arrays.getvalue()


def deserialise(text: bytes) -> Any:
    """Convert bytes back to the message.

    Raise `InputError` for bytes that `serialise` would not make.
    """
    arrays = io.BytesIO(text)
    made: dict[str, Callable[[Any], Any]] = {
        "bytes": lambda _: np.load(arrays, allow_pickle=False).tobytes(),
        "array": lambda _: np.load(arrays, allow_pickle=False),
        "dict": lambda items: {value(key): value(one) for key, one in items},
        "list": lambda items: [value(one) for one in items],
        "tuple": lambda items: tuple(value(one) for one in items),
    }

    def value(node: Any) -> Any:
        if not isinstance(node, dict):
            return node
        ((kind, content),) = node.items()
        return made[kind](content)

    try:
        return value(json.loads(arrays.readline()))
    except (ValueError, KeyError, TypeError, EOFError, RecursionError) as error:
        raise InputError(
            "another process said what cannot be read; start all with the same version of "
            "jaxevent, and see that no other program uses the coordinator's port"
        ) from error


def on_process_zero(compute: Callable[[], T]) -> T:
    """Compute on process 0 and broadcast to all.

    An `InputError` there is raised on all processes.
    """
    if jax.process_count() == 1:
        return compute()
    message: tuple[str, Any] = ("", None)
    if is_process_zero():
        try:
            message = ("value", compute())
        except InputError as error:
            message = ("error", str(error))
    kind, value = allgather(message)[0]
    if kind == "error":
        raise InputError(value)
    return value


def on_all_processes(compute: Callable[[], T]) -> T:
    """Compute on each process; an `InputError` on one is raised on all."""
    if jax.process_count() == 1:
        return compute()
    value: Any = None
    error = None
    try:
        value = compute()
    except InputError as raised:
        error = str(raised)
    for other in allgather(error):
        if other is not None:
            raise InputError(other)
    return value


class BatchPlacement:
    """Placement of the batches of a fit on devices, made once, when they are first used.

    With at least as many batches per step as devices, batch k is on device k mod n of n; with
    fewer, every batch that can be (by its method `over(devices)`) is partitioned over all devices.
    """

    def __init__(self, per_step: int | None):
        self.per_step = per_step
        self._given: Sequence[Any] | None = None
        self._placed: list[Any] = []

    def __call__(self, batches: Sequence[Any]) -> Sequence[Any]:
        """Return the batches on their devices; remote ones stay as they are."""
        devices = local_devices()
        if len(devices) == 1:
            return batches
        if self._given is not batches:
            self._given, self._placed = None, []  # so that two are never held at once
            mine = [b for b in batches if b is not REMOTE_BATCH]
            share = len(mine) / max(len(batches), 1)
            step = len(mine) if self.per_step is None else math.ceil(self.per_step * share)
            apart, number = min(step, len(mine)) >= len(devices), 0
            for batch in batches:
                if batch is not REMOTE_BATCH:
                    batch = _put(batch, devices, number, apart)
                    number += 1
                self._placed.append(batch)
            self._given = batches
        return self._placed


def _put(batch: Any, devices: Sequence[Any], number: int, apart: bool) -> Any:
    if not apart and hasattr(batch, "over"):
        return batch.over(devices)
    return jax.device_put(batch, devices[number % len(devices)])
