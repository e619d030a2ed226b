"""Methods compared with what is known, for every recording: images, motion or tracks.

    recordings = ["slider_depth.zip", "more/*.h5"]  # paths or globs; $NAME is expanded
                                                    # "mvsec:FOLDER": all of a data set
    protocol = "held-out"                           # or "reference", "motion" or "tracks"
    size = [240, 180]                               # only for recordings that do not tell it
    stream = "left"                                 # only for files of several cameras
    metrics = ["authors_ssim"]                      # further ones: of images those in MEASURES; of
                                                    # your own: "package.module:function"
    optional_metrics = ["lpips"]                    # those whose extra is installed
    gap = 4                                         # with "held-out": every 4th frame is given,
                                                    # the others are hidden; omitted: 2
    moving = true                                   # with "held-out": the error where something
                                                    # moves, too
    calibrate = false                               # clock and thresholds that are not given stay
                                                    # at the defaults; see below

    [[method]]
    name = "akf"                                    # a key of jaxevent.METHODS, or of your own:
                                                    # "package.module:object", an Estimator or
                                                    # a function: see jaxevent.runs.own
    params = { c_on = 0.08, clock_offset = 0.0075 } # or the path of a TOML file; omitted:
                                                    # calibrated, else defaults
                                                    # { file = "PATH", c_on = 0.08 }: both
    label = "akf, by hand"                          # in the table; omitted: the name
    grid = { c_on = [0.05, 0.1], kappa = [1, 2] }   # each combination, added to params and label
    normalise = "affine"                            # fit each image's brightness to the truth
    calibrate = false                               # as above, of this method

Clock and thresholds that a method of images does not get here, name by name, are calibrated
(`jaxevent.calibration`) from the frames and events that the protocol gives, where the method
combines both. A preset's count as given, and parameters given as an object in Python count as a
whole. A row's `params` are those that were used, and its `calibrated` names those that were found.

Each family of estimators has protocols of its own, with settings of their own beside it: images
are asked for by "held-out" and "reference", described below, the others are described in
`jaxevent.runs.egomotion` ("motion") and `jaxevent.runs.blob_scores` ("tracks").

A method of the name "external" scores images of another program: `jaxevent.runs.external`; one of
the name "published" shows numbers that were printed beside ours: `jaxevent.runs.external`. Paths
are relative to the folder of this file. The protocol "held-out" gives the methods frames 0, 2, 4,
... and asks for images where frames 1, 3, 5, ... are, at their time stamps plus the method's
`clock_offset`; with another `gap` g it gives frames 0, g, 2 g, ... and asks for all others. Images
are clipped to [0, 1], the range of the truth, before they are scored. Something moves where the
given frames before and after differ by more than 0.05 of white.

The protocol "reference" gives the whole recording and compares with HDR images that it keeps in
`Recording.extra`, float linear intensities of which 1 is the frames' white, without clipping:

    hdr      (T, H, W)  with hdr_t (T,), sorted times (us) on the events' clock
    HDR_mat  (K, H, W)  of the AKF authors' .mat files, used where there is no hdr: at the time of
                        each of the K frames plus `clock_offset`; a single (H, W) image: of the last
    clip     (2,)       what the frames record from and to; absent: 0.01, 1

Pixels that are NaN in hdr have no reference. HDR_mat counts in the frames' grey levels (255 is
white where they are uint8) and is 0 where it has no reference, as the authors' programs have it. In
the measures of whole images such pixels count as right; regions and mean errors leave them out.

Each recording with each method is a task (`jaxevent.runs.tasks`). With a folder for the results,
what is finished stays in its folder tasks, under a key made of the content of the recording,
method, parameters, protocol and metrics: an evaluation that was stopped, or to which recordings or
methods were added, computes only what is missing. The key of a method or a metric of your own holds
the content of its module's file; one that was made in a notebook has none and is computed each
time. Remove the folder tasks to compute everything again.
"""

import contextlib
import dataclasses
import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, overload

import jax.numpy as jnp

import jaxevent
from jaxevent.errors import InputError
from jaxevent.estimator import Estimator
from jaxevent.io import toml
from jaxevent.io.checks import companions
from jaxevent.io.output import values_of
from jaxevent.parameters import Parameters, read_toml
from jaxevent.precision import double_precision
from jaxevent.recording import Recording
from jaxevent.runs.calls import (
    CALL_HEADER,
    CallForms,
    PathLike,
    format_setting,
    method_name,
    methods_of,
    metrics_of,
    recordings_of,
    settings_of,
    table_with_names,
)
from jaxevent.runs.config import (
    NAME_CHECK,
    SIZE_CHECK,
    STREAM_CHECK,
    Check,
    check,
    external_name,
    files_named_in,
    find_recordings,
    read_params,
)
from jaxevent.runs.contents import FileHashes, RecordingCache, digest
from jaxevent.runs.family import Protocol, Source, family_of, find_protocol
from jaxevent.runs.own import MethodFunction, Metric, find_method, import_path, module_hash
from jaxevent.runs.results import Evaluation, check_folder, open_results, write_rows
from jaxevent.runs.tasks import ComputeResources, Outcome, Task, run
from jaxevent.show.tables import write_parquet

# Part of the keys of stored results: raised whenever the same recording, method and parameters give
# other results than before.
RESULTS_VERSION = 6
RESULT_FILES = ("report.html", "results.json", "results.md", "results.parquet", "config.toml")

_opened = RecordingCache()


@overload
def evaluate(
    config: PathLike,
    out: PathLike | None = None,
    progress: bool | None = None,
    *,
    metrics: Any = (),
    calibrate: bool | None = None,
    workers: int | None = None,
    cluster: Any = None,
    scheduler_file: PathLike | None = None,
    retries: int = 2,
    replace: bool = True,
) -> Evaluation: ...


@overload
def evaluate(
    recordings: Any,
    methods: Any,
    *,
    metrics: Any = (),
    protocol: str | None = None,
    out: PathLike | None = None,
    progress: bool | None = None,
    workers: int | None = None,
    cluster: Any = None,
    scheduler_file: PathLike | None = None,
    retries: int = 2,
    replace: bool = True,
    **settings: Any,
) -> Evaluation: ...


def evaluate(*arguments: Any, **settings: Any) -> Evaluation:
    """Compare methods with the ground truth of recordings: a row per recording and method.

        evaluate("config.toml", out)
        evaluate([recording, "file.h5"], ["akf", (aks, aks.Params(c_on=0.2))], metrics=["lpips"])

    The first form runs what a TOML file describes; its layout is in the text of this module. The
    second takes the same as Python objects.

    A row has the numbers that `score` describes. In it, `recording` is the path as it was given, or
    a `Recording`'s name, and `method` is the label. Where a method cannot be run on a recording,
    the row has only those, `params` and `error`, a sentence; and `skipped`, true, if only an extra
    of jaxevent is missing. Rows do not depend on where they are computed, but for `seconds`.

    Args:
        config: The TOML file.
        recordings: A `Recording` or a path, a list of them, what `jaxevent.datasets.open` gives, or
            a mapping from names. Of recordings with the same name the second is called "name (2)".
        methods: A method, a list of methods, or a mapping from labels. A method is a name, an
            `Estimator`, a function `method(recording, times)` (see `jaxevent.runs.own`), a pair
            (method, params), or a mapping with the keys of a [[method]].
        metrics: Further metrics, besides those of the file: names, functions
            `metric(estimate, truth)` of one's own, pairs (name, function), or a mapping from names.
        calibrate: Whether clock and thresholds that are not given are taken from the recording, as
            the file's `calibrate`; None: as the file says, or true.
        protocol: What methods are given and compared with; omitted, the first of the methods'
            family: "held-out", "tracks" or "motion".
        out: A folder for results.json ({"rows": [...]}), results.md (the table), report.html (one
            page that opens anywhere), results.parquet (a line per row; only where the extra
            "parquet" is installed), config.toml (the file as it was run, or the call) and tasks
            (finished rows, which are not computed again); made if missing. Existing results are
            replaced at the end.
        progress: Whether bars are shown; None: where somebody looks on.
        workers: Compute in so many processes instead of this one.
        cluster: Compute on a Dask cluster: the address of its scheduler, a `distributed.Client`, or
            a cluster object as `distributed.LocalCluster`. Its workers need the same version of
            jaxevent, and to find recordings by the same paths; those with one thread each serve
            best.
        scheduler_file: The same, of the scheduler that wrote this file.
        retries: How often a task is tried again whose process dies or that fails for another reason
            than bad input.
        replace: Whether files in `out` may be replaced that are not of an evaluation.
        **settings: The other settings of a configuration, as `gap=4` or `positions="*.csv"`.
            `positions` and `truth` also take a DataFrame, or a mapping from recordings' names to
            them.

    Returns:
        The rows, as a list that shows itself as a table; see `Evaluation`.

    Raises:
        InputError: The file, an argument or a parameter cannot be used, `out` not be written or
            only over other files, the cluster not be reached; or no row could be computed.
    """
    if CALL_FORMS.is_config(arguments, settings):
        return _evaluate_file(*arguments, **settings)
    return _evaluate_objects(*arguments, **settings)


# Arguments of both forms that say where rows are computed, and what may be replaced.
RESOURCE_ARGUMENTS = ("workers", "cluster", "scheduler_file", "retries", "replace")
CALL_FORMS = CallForms(
    'jaxevent.evaluate(recording, ["akf"])',
    ("config", "out", "progress", "metrics", "calibrate", *RESOURCE_ARGUMENTS),
    ("recordings", "methods", "protocol"),
)


def _evaluate_file(
    config: PathLike,
    out: PathLike | None = None,
    progress: bool | None = None,
    *,
    metrics: Any = (),
    calibrate: bool | None = None,
    **where: Any,
) -> Evaluation:
    path, further = Path(config), metrics_of(metrics)
    plan = read_plan(path, further, calibrate)
    text = path.read_bytes()
    if calibrate is not None:
        text = f"# With calibrate = {toml.text(calibrate)}.\n".encode() + text
    if further:
        names = ", ".join(table_with_names(further))
        text = f"# With the further metrics {names}.\n".encode() + text
    return _evaluate(plan, Origin(path.name, text, plan.inputs(path)), out, progress, **where)


def _evaluate_objects(
    recordings: Any = None,
    methods: Any = None,
    *,
    metrics: Any = (),
    protocol: str | None = None,
    out: PathLike | None = None,
    progress: bool | None = None,
    **settings: Any,
) -> Evaluation:
    if methods is None:
        raise InputError(
            f"no method is given; give a recording and methods, as {CALL_FORMS.example}"
        )
    where = {name: settings.pop(name) for name in RESOURCE_ARGUMENTS if name in settings}
    table = settings_of({**settings, "protocol": protocol})
    table |= {"recordings": recordings_of(recordings), "method": methods_of(methods)}
    further = metrics_of(metrics)
    if further:
        table["metrics"] = further
    plan = plan_of(table, Path())
    text = CALL_HEADER + toml.dump(table_with_names(table))
    return _evaluate(
        plan,
        Origin("evaluation", text.encode(), plan.inputs()),
        out,
        progress,
        **where,
    )


class Origin(NamedTuple):
    """Title and text of a configuration or a call, and its input files."""

    title: str
    text: bytes
    files: list[Path]


def _evaluate(
    plan: "Plan",
    source: Origin,
    out: PathLike | None,
    progress: bool | None,
    *,
    workers: int | None = None,
    cluster: Any = None,
    scheduler_file: PathLike | None = None,
    retries: int = 2,
    replace: bool = True,
) -> Evaluation:
    """Compute the rows of a plan; see `evaluate`.

    Args:
        plan: Recordings, methods and protocol.
        source: Text of the configuration, and the files it comes from.
        out: Folder for the results; None: none is written.
        progress: Whether to show progress; None: on a terminal.
        workers: Number of processes; None: this one.
        cluster: A cluster of Dask, or None.
        scheduler_file: File that names Dask's scheduler, or None.
        retries: Number of further attempts after a worker is lost.
        replace: Whether results of another evaluation may be replaced.

    Returns:
        The rows.
    """
    if out is not None:
        own = (Path(out) / "tasks").is_dir()
        check_folder(Path(out), RESULT_FILES, source.files, replace=replace, own=own)
    place = ComputeResources(
        workers, cluster, None if scheduler_file is None else Path(scheduler_file)
    )
    with contextlib.ExitStack() as stack:
        write = None if out is None else stack.enter_context(open_results(Path(out)))
        folder = None if out is None else Path(out) / "tasks"
        stack.callback(_opened.clear)
        tasks = _tasks(plan, folder, progress, place == ComputeResources())
        if place.workers is not None:
            for task in tasks:
                task.check_sendable()
        outcomes = run(_compute, tasks, folder, place, retries=retries, progress=progress)
        rows = _rows(plan, outcomes)
        if write is not None and out is not None:
            from jaxevent.show.page import page

            write("config.toml", source.text)
            write_rows(rows, write)
            pictures = [(o.result or {}).get("pictures") for o in outcomes]
            hosts = sorted({o.host for o in outcomes if o.host})
            html = page(rows, pictures, plan.name, source.text.decode(), hosts, source.title)
            write("report.html", html.encode())
            write_parquet(Path(out) / "results.parquet", rows)
    return Evaluation(rows)


def _rows(plan: "Plan", outcomes: list[Outcome]) -> list[dict[str, Any]]:
    """Name the rows as the configuration does; raise `InputError` if all are errors."""
    rows: list[dict[str, Any]] = []
    pairs = itertools.product(plan.recordings, plan.methods)
    for ((given, _), entry), outcome in zip(pairs, outcomes, strict=True):
        named = {"recording": given, "method": entry.label}
        if outcome.error is None:
            rows.append({**outcome.result["row"], **named})
        else:
            skipped = {"skipped": True} if outcome.skipped else {}
            rows.append(
                {**named, "params": entry.display_values(), "error": outcome.error, **skipped}
            )
    errors = list(dict.fromkeys(row["error"] for row in rows if "error" in row))
    if all("error" in row for row in rows):
        more = f" (and {len(errors) - 1} further errors)" if len(errors) > 1 else ""
        raise InputError(f"{errors[0]}{more}")
    return rows


def _tasks(plan: "Plan", folder: Path | None, progress: bool | None, here: bool) -> list[Task]:
    """Make a task for each recording and method; with a folder, keyed by all inputs of its row.

    Tasks that run `here` show a bar of their own.
    """
    contents = None if folder is None else FileHashes(folder / "contents", progress)
    double = jnp.result_type(float) == jnp.float64
    tasks: list[Task] = []
    for (given, recording), entry in itertools.product(plan.recordings, plan.methods):
        about = {
            "method": entry.sent,
            "params": entry.settings(),
            "protocol": plan.name,
            "options": {**plan.options, **entry.own},
            "size": plan.size,
            "stream": plan.stream,
            "double": double,
            "version": f"{jaxevent.__version__}, results {RESULTS_VERSION}",
        }
        key = None
        if contents is not None:
            # What cannot be read has no key; computing it says why.
            with contextlib.suppress(OSError, InputError):
                key = _key(plan, contents, (given, recording), entry, about)
        if isinstance(recording, Recording):
            sent: Any = dataclasses.replace(recording, name=given)
        else:
            sent = str(recording.absolute())
        arguments = {"recording": sent, **about, "progress": progress if here else False}
        tasks.append(Task(f"{given}, {entry.label}", arguments, key))
    if contents is not None:
        contents.save()
    return tasks


def _key(
    plan: "Plan",
    contents: FileHashes,
    recording: "tuple[str, Path | Recording]",
    entry: "Entry",
    about: Mapping[str, Any],
) -> str | None:
    """Hash all that a row depends on.

    Args:
        plan: The plan.
        contents: Hashes of files.
        recording: Name as given, and path or object.
        entry: The method.
        about: Arguments of the task.

    Returns:
        The key. None where a method or a metric is an object that no module holds: its results may
        change.
    """
    objects = [entry.sent, *plan.options.get("metrics", ())]
    named = [one for one in objects if isinstance(one, str)]
    if len(named) < len(objects):
        return None
    code = [module_hash(one) for one in named if ":" in one]
    if None in code:
        return None
    whole = {**about, **({"code": code} if code else {})}
    given, what = recording
    if isinstance(what, Recording):
        path = Path(given)
        whole["content"] = contents.of_object(what)
        files = plan.protocol.files(path, plan.options)
    else:
        path = what.absolute()
        whole["content"] = contents.of(path)
        files = [*companions(path), *plan.protocol.files(path, plan.options)]
    if isinstance(entry.method, Source):
        files = [*files, *entry.method.files(external_name(path))]
        whole["params"] = entry.method.values()
        # Images of other programs are found by the recording's name.
        whole |= {"name": given} if isinstance(what, Recording) else {}
    whole["files"] = [contents.of(file) for file in files]
    text = json.dumps(whole, sort_keys=True, default=digest)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _compute(
    *,
    recording: str | Recording,
    method: str | Estimator | MethodFunction,
    params: dict[str, Any],
    protocol: str,
    options: dict[str, Any],
    size: tuple[int, int] | None,
    stream: str | None,
    double: bool,
    version: str,
    progress: bool | None,
) -> dict[str, Any]:
    """Compute one task, a recording and a method, on any machine.

    Args:
        recording: Path or recording.
        method: Name or object.
        params: Parameters by name.
        protocol: Name of the protocol.
        options: Settings of the protocol.
        size: (width, height) of the sensor in px, for files that do not state it.
        stream: Name of the camera whose events are read.
        double: Whether to compute in double precision.
        version: Version of the package that made the task; another one is refused.
        progress: Whether to show progress.

    Returns:
        {"row", "pictures"}.
    """
    from jaxevent.show.page import picture

    path = recording if isinstance(recording, str) else recording.name
    mine = f"{jaxevent.__version__}, results {RESULTS_VERSION}"
    if version != mine:
        raise InputError(
            f"{path}: this worker has jaxevent {mine}, not {version}; install the same everywhere"
        )
    kind, family = find_protocol(protocol)
    source: Any = None
    if isinstance(method, str) and method in kind.sources:
        source = kind.sources[method](**params)
        known = source.row(external_name(Path(path)))
        if known is not None:
            row = {"method": method, **known, "params": source.values()}
            return {"row": row, "pictures": None}
    with double_precision(double):
        if isinstance(recording, str):
            recording = _opened.load(Path(recording), size, stream, progress)
        values, shown_params = None, {}
        if source is not None:
            shown_params = source.values()
        else:
            source = find_method(method, family)
            if isinstance(source, Estimator):
                values = source.Params.of(params)
                shown_params = values_of(values)
        row = kind.score(recording, source, values, options, progress)
        samples = row.pop("samples", ())
    row = {"recording": recording.name, "method": source.name, **row}
    row.setdefault("params", shown_params)
    return {"row": row, "pictures": [picture(sample) for sample in samples] or None}


@dataclasses.dataclass(frozen=True)
class Plan:
    """A checked configuration: recordings (as given, path), methods, and the protocol."""

    recordings: list[tuple[str, Path | Recording]]
    methods: list["Entry"]
    name: str
    protocol: Protocol
    options: dict[str, Any]  # settings of the protocol, by name
    size: tuple[int, int] | None
    stream: str | None

    def inputs(self, config: Path | None = None) -> list[Path]:
        """Return all input files that can be read."""
        found = [] if config is None else [config, *files_named_in(config)]
        for name, path in self.recordings:
            if isinstance(path, Recording):
                path = Path(name)
            else:
                found.append(path)
            with contextlib.suppress(OSError, InputError):
                found += self.protocol.files(path, self.options)
            for entry in self.methods:
                if isinstance(entry.method, Source):
                    with contextlib.suppress(OSError, InputError):
                        found += entry.method.files(external_name(path))
        return found


@dataclasses.dataclass(frozen=True)
class Entry:
    """A method of a configuration with one set of parameters; a `Source` has none."""

    label: str
    sent: str | Estimator | MethodFunction  # what any process finds the method by, else the method
    method: Estimator | MethodFunction | Source
    params: Parameters | None
    own: dict[str, Any]  # settings of the protocol that this method has for itself

    def settings(self) -> dict[str, Any]:
        """Return the settings from which `_compute` makes the method again."""
        if isinstance(self.method, Source):
            return dict(vars(self.method))
        return {} if self.params is None else self.params.values()

    def display_values(self) -> dict[str, Any]:
        """Return the parameters as a row shows them."""
        if isinstance(self.method, Source):
            return self.method.values()
        return {} if self.params is None else values_of(self.params)


def read_plan(
    config: Path, metrics: Sequence[str | Metric] = (), calibrate: bool | None = None
) -> Plan:
    """Read and check a configuration.

    Args:
        config: The TOML file.
        metrics: Metrics in addition to those of the file.
        calibrate: In place of the file's `calibrate`; None leaves it.

    Returns:
        The plan of an evaluation.

    Raises:
        InputError: A setting cannot be used; the message names file and setting.
    """
    table = read_toml(config)
    if calibrate is not None:
        table["calibrate"] = calibrate
    try:
        return plan_of(table, config.parent, metrics)
    except InputError as error:
        raise InputError(f"{config}: {error}") from None


def plan_of(table: Mapping[str, Any], folder: Path, metrics: Sequence[str | Metric] = ()) -> Plan:
    """Check the table of a configuration.

    Args:
        table: The settings.
        folder: Folder that paths are relative to.
        metrics: Metrics in addition to those of the table.

    Returns:
        The plan of an evaluation.

    Raises:
        InputError: A setting cannot be used; the message names it.
    """
    name = table.get("protocol") or _default_protocol(table)
    protocol, family = find_protocol(name)
    anything: Check = (lambda value: True, "")
    known = {
        "recordings": anything,
        "protocol": NAME_CHECK,
        "size": SIZE_CHECK,
        "stream": STREAM_CHECK,
    }
    check(table, {**known, "method": anything, **protocol.settings})
    options = {key: table[key] for key in protocol.settings if key in table}
    if metrics:
        options["metrics"] = list(dict.fromkeys([*options.get("metrics", ()), *metrics]))
    protocol.check(options)
    options = protocol.available(options)
    size = table.get("size")
    recordings = find_recordings(table.get("recordings"), folder)
    methods = _methods(table.get("method"), folder, protocol, family, options)
    options.pop("calibrate", None)  # each method has the names that it means
    size = None if size is None else (size[0], size[1])
    return Plan(recordings, methods, name, protocol, options, size, table.get("stream"))


def _default_protocol(table: Mapping[str, Any]) -> str:
    """Return the first protocol of the family of the first method that is an estimator."""
    given = table.get("method")
    for one in given if isinstance(given, list) else ():
        with contextlib.suppress(InputError):
            method = find_method(one["name"]) if isinstance(one, dict) and "name" in one else None
            if isinstance(method, Estimator):
                return next(iter(family_of(method).protocols))
    return "held-out"


def _methods(
    given: Any, folder: Path, protocol: Protocol, family: str, options: Mapping[str, Any]
) -> list[Entry]:
    if not (isinstance(given, list) and given and all(isinstance(one, dict) for one in given)):
        raise InputError(
            'no method is given; give one such as "akf", in a configuration by [[method]] with '
            'name = "akf"'
        )
    entries: list[Entry] = []
    for number, table in enumerate(given, 1):
        try:
            for entry in _entries(table, folder, protocol, family, options):
                if any(entry.label == other.label for other in entries):
                    raise InputError(f"another one is labelled {entry.label!r} too; add a label")
                entries.append(entry)
        except InputError as error:
            raise InputError(f"method {number}: {error}") from None
    return entries


def _entries(
    table: Mapping[str, Any],
    folder: Path,
    protocol: Protocol,
    family: str,
    options: Mapping[str, Any],
) -> Iterator[Entry]:
    """Make the entries of one table of a method, one for each combination of its grid.

    Args:
        table: The table.
        folder: Folder that paths are relative to.
        protocol: Protocol of the evaluation.
        family: Name of the methods' family.
        options: Settings of the protocol.

    Yields:
        The entries.

    Raises:
        InputError: The table is not valid.
    """
    rest = dict(table)
    name = rest.pop("name", None)
    label = rest.pop("label", name)
    if label is name and not isinstance(name, str) and name is not None:
        label = method_name(name)
    if name is None or not isinstance(label, str):
        raise InputError('name and label must be text; give name = "akf"')
    own = {key: rest.pop(key) for key in protocol.own if key in rest}
    check(own, protocol.own)
    calibrate = own.pop("calibrate", options.get("calibrate", True))
    ending = protocol.label({**options, **own})
    if isinstance(name, str) and name in protocol.sources:
        source = protocol.sources[name].of(rest, folder.absolute())
        yield Entry(label + ending, name, source, None, own)
        return
    anything: Check = (lambda value: True, "")
    check(rest, {**dict.fromkeys(("name", "params", "label", "grid"), anything), **protocol.own})
    method = find_method(name, family)
    sent = name if isinstance(name, str) else import_path(method) or method
    if isinstance(method, MethodFunction):
        for setting in ("params", "grid"):
            if rest.get(setting):
                raise InputError(
                    f"{method.name!r} is a function and has no {setting}; omit it, or make an "
                    "Estimator"
                )
        yield Entry(label + ending, sent, method, None, own)
        return
    protocol.check_method(method, options)
    given = rest.get("params", {})
    explicit = read_params(method, method.name, given, folder)
    params = given if isinstance(given, Parameters) else method.Params.of(explicit)
    grid = rest.get("grid", {})
    if not isinstance(grid, dict) or not all(isinstance(v, list) and v for v in grid.values()):
        raise InputError(f"grid is {grid!r}; give a table of lists, as {{ c_on = [0.05, 0.1] }}")
    if "preset" in grid:
        raise InputError("a preset cannot be in a grid; add a [[method]] for each preset")
    for combination in itertools.product(*grid.values()):
        values = dict(zip(grid, combination, strict=True))
        suffix = "".join(f", {format_setting(key, value)}" for key, value in values.items())
        chosen = method.Params.of({**params.values(), **values}) if values else params
        if "calibrate" in protocol.own:
            names = method.names_left_open({**explicit, **values}) if calibrate else ()
            own = {**own, "calibrate": names}
        yield Entry(f"{label}{suffix}{ending}", sent, method, chosen, own)
