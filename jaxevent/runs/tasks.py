"""Tasks that survive: stored once finished, tried again when they fail, here or on many machines.

A task is a module-level function with keyword arguments that pickle; its result is what JSON holds.
With a `folder`, a finished task is the file KEY.json in it, where KEY names all that the result
depends on: whoever runs the same task with this folder again reads the file instead, whether the
first run ended, was killed, or still goes on elsewhere. log.txt in the folder has a line for every
start and end of an attempt: time (UTC), host, process, key, what happened.
"""

import collections
import contextlib
import dataclasses
import datetime
import json
import multiprocessing
import multiprocessing.connection
import os
import pickle
import signal
import socket
import threading
import traceback
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxevent import cache
from jaxevent.codegen import N_THREADS
from jaxevent.display import describe_type
from jaxevent.errors import InputError, MissingExtra, require
from jaxevent.progress import bar

CONNECT_TIMEOUT_S = 30  # s that a scheduler has to answer
EXIT_TIMEOUT_S = 5  # s that a process has to end
ENDING_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


@dataclasses.dataclass(frozen=True)
class Task:
    """A call of a function that is computed for a table.

    Tasks of equal keys are computed once. Without a key nothing is stored.

    Attributes:
        name: Name for the progress bar.
        arguments: Arguments of the function, by name.
        key: Key of the stored result.
    """

    name: str
    arguments: Mapping[str, Any]
    key: str | None = None

    def check_sendable(self) -> None:
        """Raise `InputError` if the arguments cannot be sent to another process."""
        try:
            pickle.dumps(self.arguments)
        except Exception as error:  # whatever objects raise that are not to be pickled
            reason = " ".join(str(error).split())
            raise InputError(
                f"{self.name}: cannot be sent to other processes ({reason}); give the path of a "
                "recording that stays in its file, define methods and metrics in a module, or "
                "leave out workers"
            ) from None


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Either a `result`, as JSON gives it back, computed on `host`; or an `error`, one sentence.

    `skipped` says of an error that only an extra is missing where the task was tried.
    """

    result: Any = None
    error: str | None = None
    skipped: bool = False
    host: str = ""


@dataclasses.dataclass(frozen=True)
class ComputeResources:
    """Processes or machines that run tasks: this process, `workers` processes, or a Dask cluster.

    `cluster` is the address of its scheduler, a `distributed.Client` or a cluster object;
    `scheduler_file` is the file that holds the address. Raises `InputError` if more than one is
    given, for less than one worker and without the extra.
    """

    workers: int | None = None
    cluster: Any = None
    scheduler_file: Path | None = None

    def __post_init__(self):
        given = [self.workers, self.cluster, self.scheduler_file]
        if sum(one is not None for one in given) > 1:
            raise InputError("workers, cluster and scheduler file exclude each other; give one")
        if self.workers is not None and self.workers < 1:
            raise InputError(f"{self.workers} workers cannot work; give at least 1")
        if self.remote:
            require("distributed", "cluster")
        if self.cluster is not None and not (
            isinstance(self.cluster, str)
            or hasattr(self.cluster, "submit")
            or isinstance(getattr(self.cluster, "scheduler_address", None), str)
        ):
            raise InputError(
                f"the cluster is {describe_type(self.cluster)}; give the address of a Dask "
                "scheduler, as HOST:PORT, a distributed.Client or a cluster"
            )

    @property
    def remote(self) -> bool:
        """True if tasks run on a cluster."""
        return self.cluster is not None or self.scheduler_file is not None


def run(
    function: Callable[..., Any],
    tasks: Sequence[Task],
    folder: Path | None = None,
    place: ComputeResources | None = None,
    *,
    retries: int = 2,
    progress: bool | None = None,
) -> list[Outcome]:
    """Run `function(**task.arguments)` for every task; outcomes in the order of the tasks.

    An `InputError` is the task's outcome at once. Any other exception, and the death of the process
    that computes it, costs one of 1 + `retries` attempts (on a cluster, deaths of workers are
    counted by Dask's own `allowed-failures`); what the last one said is the outcome.

    Args:
        function: Of module level, so that other processes find it; gives what JSON can hold.
        tasks: What to run it on.
        folder: Keeps results of tasks that have a key; made if missing.
        place: Where; None: in this process.
        retries: Further attempts of each task.
        progress: Whether a bar with the name of the last finished task is shown; None: where
            somebody looks on.

    Raises:
        InputError: Results cannot be stored, or the cluster does not answer.
    """
    if retries < 0:
        raise InputError(f"{retries} retries are not possible; give 0 or more")
    place = place or ComputeResources()
    folder = None if folder is None else folder.absolute()
    if folder is not None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{folder}: the folder cannot be made ({error.strerror}); choose a writable place"
            ) from None
    found: dict[int, dict[str, Any]] = {}
    same: dict[Any, list[int]] = {}  # by key, the tasks that have it
    for number, task in enumerate(tasks):
        record = _load_record(folder, task.key)
        if record is not None:
            found[number] = record
        else:
            same.setdefault(number if task.key is None else task.key, []).append(number)
    firsts = [numbers[0] for numbers in same.values()]
    todo = [tasks[number] for number in firsts]
    work = _Work(function, todo, folder, retries)
    if place.workers is not None:
        done = _in_processes(work, place.workers)
    elif place.remote:
        done = _on_cluster(work, place)
    else:
        done = ((number, work.try_task(task)) for number, task in enumerate(todo))
    with (
        bar(
            total=len(tasks), initial=len(found), desc="evaluate", unit="task", progress=progress
        ) as shown,
        contextlib.closing(done),
    ):
        for number, record in done:
            task = todo[number]
            if "result" in record and _load_record(folder, task.key) is None:
                _store_record(folder, task.key, record)
            numbers = same[firsts[number] if task.key is None else task.key]
            found.update(dict.fromkeys(numbers, record))
            shown.set_postfix_str(task.name)
            shown.update(len(numbers))
    return [Outcome(**found[number]) for number in range(len(tasks))]


# The number of a task and its record: {"result", "host"} or {"error", "skipped"}.
Records = Generator[tuple[int, dict[str, Any]], None, None]


def attempt(function: Callable[..., Any], task: Task, folder: Path | None) -> dict[str, Any]:
    """Run one task, on whichever machine.

    A stored result is read; a new one is stored if this machine sees the folder. Exceptions other
    than `InputError` are raised.

    Args:
        function: Function of the task's arguments.
        task: The task.
        folder: Folder of the results, or None.

    Returns:
        {"result", "host"}, or {"error", "skipped"} for an `InputError`; the task is skipped if that
            is
        a `MissingExtra`.
    """
    record = _load_record(folder, task.key)
    if record is not None:
        return record
    _log(folder, task.key, "started")
    try:
        record = {"result": function(**task.arguments), "host": socket.gethostname()}
        record = json.loads(json.dumps(record, allow_nan=False))
    except InputError as error:
        _log(folder, task.key, f"cannot be done: {error}")
        return {"error": str(error), "skipped": isinstance(error, MissingExtra)}
    except Exception:
        _log(folder, task.key, f"failed\n{traceback.format_exc()}")
        raise
    finally:
        cache.release_compiled()  # a data set's recordings may have a hundred shapes
    # The caller stores it again where this fails, and says why if that fails too.
    with contextlib.suppress(InputError):
        _store_record(folder, task.key, record)
    _log(folder, task.key, "finished")
    return record


def _error_record(error: BaseException) -> dict[str, Any]:
    reason = " ".join(str(error).split())
    return {"error": f"{type(error).__name__}{': ' * bool(reason)}{reason}"}


def _file(folder: Path | None, key: str | None) -> Path | None:
    return None if folder is None or key is None else folder / f"{key}.json"


def _load_record(folder: Path | None, key: str | None) -> dict[str, Any] | None:
    """Return the record of a finished task; None if there is none that can be read."""
    file = _file(folder, key)
    if file is None:
        return None
    with contextlib.suppress(OSError, ValueError):
        record = json.loads(file.read_bytes())
        if isinstance(record, dict) and {"result"} <= record.keys() <= {"result", "host"}:
            return record
    return None


def _store_record(folder: Path | None, key: str | None, record: dict[str, Any]) -> None:
    from jaxevent.io.output import complete

    file = _file(folder, key)
    if file is not None:
        with complete(file) as partial:
            partial.write_text(json.dumps(record, allow_nan=False))


def _log(folder: Path | None, key: str | None, what: str) -> None:
    if folder is None or key is None:
        return
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
    line = f"{now} {socket.gethostname()} {os.getpid()} {key} {what}\n"
    # One write of an appended line is not torn by those of other processes. A machine that does
    # not see the folder has nowhere to log.
    with contextlib.suppress(OSError):
        log = os.open(folder / "log.txt", os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        with contextlib.closing(os.fdopen(log, "wb", buffering=0)) as file:
            file.write(line.encode())


class _Work(NamedTuple):
    """Tasks that are computed.

    Attributes:
        function: The function that they call.
        tasks: The tasks.
        folder: Folder of the stored results.
        retries: Number of times that a task is tried again.
    """

    function: Callable[..., Any]
    tasks: Sequence[Task]
    folder: Path | None
    retries: int

    def try_task(self, task: Task) -> dict[str, Any]:
        """Run a task in this process, until an attempt ends it or none is left."""
        record: dict[str, Any] = {}
        for _ in range(1 + self.retries):
            try:
                return attempt(self.function, task, self.folder)
            except Exception as error:
                record = _error_record(error)
        return record


def _in_processes(work: _Work, workers: int) -> Records:
    """Run tasks in worker processes, one at a time each, so that a death has one task to blame.

    A `ProcessPoolExecutor` breaks as a whole when a process dies, does not say which task it was,
    and leaves its processes behind when this one is killed.
    """
    function, tasks, folder, retries = work
    context = multiprocessing.get_context("spawn")  # JAX has threads, which do not survive a fork
    waiting = collections.deque((number, 0) for number in range(len(tasks)))
    workers = min(workers, len(tasks))
    threads = max(1, N_THREADS // max(workers, 1))
    idle: list[tuple[Any, Any]] = []
    busy: dict[Any, tuple[Any, int, int]] = {}  # by connection: its process, task, earlier attempts

    def start() -> tuple[Any, Any]:
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, threads), daemon=True)
        with defer_signals():
            process.start()
        theirs.close()  # else the end of the process would not end the pipe
        return ours, process

    try:
        while waiting or busy:
            while waiting and len(busy) < workers:
                connection, process = idle.pop() if idle else start()
                number, tried = waiting.popleft()
                busy[connection] = process, number, tried
                with contextlib.suppress(OSError):  # it died; reading says so
                    connection.send((function, tasks[number], folder))
            ready: list[Any] = multiprocessing.connection.wait(list(busy))
            for connection in ready:
                process, number, tried = busy.pop(connection)
                try:
                    record, again = connection.recv()
                    idle.append((connection, process))
                except (EOFError, OSError):
                    process.join()
                    connection.close()
                    reason = f"its process died (exit code {process.exitcode})"
                    _log(folder, tasks[number].key, reason)
                    record, again = {"error": f"{tasks[number].name}: {reason}"}, True
                if again and tried < retries:
                    waiting.appendleft((number, tried + 1))
                else:
                    yield number, record
    finally:
        for connection, _ in idle:
            connection.close()  # which ends it
        for connection, (process, _, _) in busy.items():
            process.kill()
            connection.close()
        for process in [*(p for _, p in idle), *(p for p, _, _ in busy.values())]:
            process.join(EXIT_TIMEOUT_S)
            process.kill()
            process.join()


@contextlib.contextmanager
def defer_signals() -> Iterator[None]:
    """Hold back the signals that end a command until the block is done.

    A process that is interrupted while it is started would say so by a traceback; it inherits that
    they are blocked.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(connection: multiprocessing.connection.Connection, threads: int) -> None:
    """Run a worker process: answer tasks by (record, whether to try again)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started it ends it
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING_SIGNALS)
    os.environ["NPROC"] = str(threads)  # of XLA on the CPU, when it starts
    parent = multiprocessing.parent_process()

    def leave() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=leave, daemon=True).start()
    while True:
        try:
            function, task, folder = connection.recv()
            answer = attempt(function, task, folder), False
        except EOFError:
            return
        except Exception as error:
            answer = _error_record(error), True
        connection.send(answer)


def _on_cluster(work: _Work, place: ComputeResources) -> Records:
    distributed = require("distributed", "cluster")
    given = place.cluster
    if hasattr(given, "submit"):  # a Client stays its owner's
        yield from _by_client(given, str(given), work)
        return
    if given is not None and not isinstance(given, str):
        given = given.scheduler_address
    address = given or str(place.scheduler_file)
    if place.scheduler_file is not None and not place.scheduler_file.is_file():
        raise InputError(f"{address}: there is no such scheduler file; start a scheduler with it")
    where: dict[str, Any] = {"address": given}
    if given is None:
        where = {"scheduler_file": address}
    try:
        client = distributed.Client(**where, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{address}: no Dask scheduler answers ({reason}); start one or correct the address"
        ) from None
    with client:
        yield from _by_client(client, address, work)


def _by_client(client: Any, address: str, work: _Work) -> Records:
    distributed = require("distributed", "cluster")
    numbers = {}
    for number, task in enumerate(work.tasks):
        key = None if task.key is None else f"jaxevent-{task.key}"
        try:
            future = client.submit(
                attempt, work.function, task, work.folder,
                key=key, pure=False, retries=work.retries,
            )  # fmt: skip
        except (TypeError, pickle.PicklingError):
            task.check_sendable()
            raise
        numbers[future] = number
    for future in distributed.as_completed(list(numbers), loop=client.loop):
        if future.cancelled():
            raise InputError(
                f"{address}: the scheduler lost tasks or went away; run the same again, "
                "finished tasks are kept"
            )
        error = future.exception()
        yield numbers[future], future.result() if error is None else _error_record(error)
