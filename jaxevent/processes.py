"""Several processes that fit together: partition of the batches, and exchange of the results.

Several processes, on one machine or many, fit together if each is started with the same arguments
and its number:

    jaxevent fit fit.toml --out fitted --coordinator HOST:PORT --processes 2 --process 0
    jaxevent fit fit.toml --out fitted --coordinator HOST:PORT --processes 2 --process 1

HOST:PORT is a free port of the machine of process 0. Under SLURM and other schedulers that JAX
knows, `srun jaxevent fit fit.toml --out fitted --distributed` finds all three. Every process
prepares and computes its windows, number p, p + N, p + 2 N, ... of N processes, so there should be
at least as many windows as processes (`window` in the configuration). Losses and gradients of all
windows are exchanged and added in the order of the windows by every process: the parameters are
those of one process, to the bit where the processors are alike. Process 0 writes.

The channel between processes protects nothing: no password, no encryption. Whoever reaches its
ports can read, replace or end the exchange, so use it in a network that you trust. Messages are
read as JSON and arrays, never run. The coordinator listens at the HOST that is given, no other
address of the machine (--distributed: where JAX has it listen, on all). On CPUs each process also
listens at the address of its host's name, for the exchange itself.
"""

import io
import json
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import numpy as np

from jaxevent.errors import InputError

JOIN_TIMEOUT_S = 300  # s that processes wait for each other at the start

T = TypeVar("T")


class RemoteBatch:
    """Placeholder in a list of batches for one that another process holds."""


REMOTE_BATCH = RemoteBatch()


def is_process_zero() -> bool:
    """Return true in process number 0, the one that writes."""
    return jax.process_index() == 0


def is_single() -> bool:
    """Return true if no other process computes with this one."""
    return jax.process_count() == 1


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
    if is_single():
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
    if is_single():
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
    if is_single():
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
