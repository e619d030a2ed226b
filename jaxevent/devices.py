"""Several devices and processes: what is shared out among them, and how results come together.

On several devices of a process `jaxevent fit` and `jaxevent evaluate` need no option: what they
compute on lies along the one axis of a `jax.sharding.Mesh` of all local devices. Where there are as
many windows (of a fit) or recordings (of an evaluation) as devices, each device has its own; where
there are fewer, the pixels of every window are shared out, or, of egomotion, runs or particles.
Pixels do not touch each other, so images are the same to the bit; sums over pixels are added in
another order. To try it without a GPU: XLA_FLAGS=--xla_force_host_platform_device_count=4.

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
ports can read what is said, say something else, or end the fit, so use it in a network that you
trust. What comes is read as JSON and arrays, never run. The coordinator listens at the HOST that is
given, no other address of the machine (--distributed: where JAX has it listen, on all). On CPUs
each process listens at the address of its host's name, too, for the exchange itself.
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

from jaxevent.dispatch import check_platform
from jaxevent.errors import InputError

AXIS = "devices"
START = 300  # s that processes wait for each other at the start

Q = ParamSpec("Q")
T = TypeVar("T")


class Elsewhere:
    """Stands in a list of batches for one that another process has."""


ELSEWHERE = Elsewhere()


def full_precision(function: Callable[Q, T]) -> Callable[Q, T]:
    """Have a function multiply matrices in full precision, where GPUs round factors to 11 bits."""

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


def accelerated() -> bool:
    """Whether JAX computes on a GPU, or another device than the CPU, unless told otherwise."""
    check_platform()
    return jax.default_backend() != "cpu"


def at_once(steps: int) -> int:
    """How many steps of a loop to compile into one: a GPU starts programs anew for each step."""
    return steps if accelerated() else 1


def local() -> list[Any]:
    """The devices to compute on: JAX's default device where one is set, else all of this process.

    `jax.default_device` so confines what runs under it to one.
    """
    check_platform()
    chosen = jax.config.jax_default_device  # ty: ignore[missing-attribute]
    if chosen is None:
        return list(jax.local_devices())
    return jax.local_devices(backend=chosen)[:1] if isinstance(chosen, str) else [chosen]


def first() -> bool:
    """Whether this process is number 0, the one that writes."""
    return jax.process_index() == 0


def alone() -> bool:
    """Whether one process computes on one device."""
    return jax.process_count() == 1 and len(local()) == 1


def on_host() -> contextlib.AbstractContextManager[Any]:
    """Under it what is prepared stays in the host's memory, where several devices share it out."""
    if len(local()) == 1:
        return contextlib.nullcontext()
    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:  # JAX was told not to use the CPU
        return contextlib.nullcontext()


def mesh(devices: Sequence[Any], divisor: int) -> Mesh | None:
    """A mesh of as many of the devices as divide `divisor`; None if that is one."""
    count = max((n for n in range(1, len(devices) + 1) if divisor % n == 0), default=1)
    return Mesh(np.array(devices[:count]), (AXIS,)) if count > 1 else None


def along(mesh: Mesh, tree: Any, axis: int | None = None) -> Any:
    """Arrays shared out along an axis; without one, and where it does not divide, whole on all."""

    def put(leaf: Any) -> Any:
        spec: list[str | None] = [None] * np.ndim(leaf)
        if axis is not None and np.shape(leaf)[axis] % mesh.size == 0:
            spec[axis] = AXIS
        return jax.device_put(leaf, NamedSharding(mesh, PartitionSpec(*spec)))

    return jax.tree.map(put, tree)


def join(
    coordinator: str | None = None, processes: int | None = None, process: int | None = None
) -> None:
    """Make this process number `process` of `processes`, before JAX has computed anything.

    `coordinator` is HOST:PORT, a free port of process 0's machine. With none of the three JAX looks
    for them itself (SLURM, Open MPI, Kubernetes, cloud TPUs). On CPUs they talk by gloo.

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
            *given, initialization_timeout=START, coordinator_bind_address=coordinator
        )
    except (RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"the processes did not find each other ({reason}); start all of them, with the same "
            "coordinator"
        ) from error


def shared_out(batches: Sequence[T]) -> list[T | Elsewhere]:
    """Every how many-th batch is of this process; the others are elsewhere."""
    mine, processes = jax.process_index(), jax.process_count()
    return [b if k % processes == mine else ELSEWHERE for k, b in enumerate(batches)]


def gathered(said: Any) -> list[Any]:
    """What every process says, in their order; all of them must ask. Arrays are kept to the bit.

    Raises `InputError` if one says what none of ours would; see `packed` for what can be said.
    """
    if jax.process_count() == 1:
        return [said]
    from jax.experimental.multihost_utils import process_allgather

    text = np.frombuffer(packed(said), np.uint8)
    lengths = np.asarray(process_allgather(np.array([len(text)], np.int32))).ravel()
    # A ladder of sizes: each one is compiled.
    room = 1 << max(10, (int(lengths.max()) - 1).bit_length())
    texts = np.asarray(process_allgather(np.pad(text, (0, room - len(text)))))
    return [unpacked(row[:n].tobytes()) for row, n in zip(texts, lengths, strict=True)]


def packed(said: Any) -> bytes:
    """Numbers, text, bytes, arrays, None, and lists, tuples and dictionaries of them, as bytes.

    A line of JSON, then the arrays as .npy. Reading it runs nothing, as unpickling would.
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

    return json.dumps(node(said)).encode() + b"\n" + arrays.getvalue()


def unpacked(text: bytes) -> Any:
    """What `packed` was given; raises `InputError` for bytes that it would not make."""
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


def by_first(compute: Callable[[], T]) -> T:
    """What process 0 computes, told to all; an `InputError` there is one of all processes."""
    if jax.process_count() == 1:
        return compute()
    said: tuple[str, Any] = ("", None)
    if first():
        try:
            said = ("value", compute())
        except InputError as error:
            said = ("error", str(error))
    kind, value = gathered(said)[0]
    if kind == "error":
        raise InputError(value)
    return value


def in_step(compute: Callable[[], T]) -> T:
    """What each process computes for itself; an `InputError` of one is one of all."""
    if jax.process_count() == 1:
        return compute()
    value: Any = None
    error = None
    try:
        value = compute()
    except InputError as raised:
        error = str(raised)
    for other in gathered(error):
        if other is not None:
            raise InputError(other)
    return value


class Places:
    """Where the batches of a fit are computed: placed once, as they are asked for.

    With at least as many batches per step as devices, batch k is on device k mod n of n; with
    fewer, every batch that can be (by its method `over(devices)`) is spread over all devices.
    """

    def __init__(self, per_step: int | None):
        self.per_step = per_step
        self._given: Sequence[Any] | None = None
        self._placed: list[Any] = []

    def __call__(self, batches: Sequence[Any]) -> Sequence[Any]:
        """The same batches where they belong; those that are elsewhere as they are."""
        devices = local()
        if len(devices) == 1:
            return batches
        if self._given is not batches:
            self._given, self._placed = None, []  # so that two are never held at once
            mine = [b for b in batches if b is not ELSEWHERE]
            share = len(mine) / max(len(batches), 1)
            step = len(mine) if self.per_step is None else math.ceil(self.per_step * share)
            apart, number = min(step, len(mine)) >= len(devices), 0
            for batch in batches:
                if batch is not ELSEWHERE:
                    batch = _put(batch, devices, number, apart)
                    number += 1
                self._placed.append(batch)
            self._given = batches
        return self._placed


def _put(batch: Any, devices: Sequence[Any], number: int, apart: bool) -> Any:
    if not apart and hasattr(batch, "over"):
        return batch.over(devices)
    return jax.device_put(batch, devices[number % len(devices)])
