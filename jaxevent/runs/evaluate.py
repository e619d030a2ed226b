"""Methods compared with what is known, for every recording: images, motion or tracks.

    recordings = ["slider_depth.zip", "more/*.h5"]  # paths or globs; $NAME is expanded
    protocol = "held-out"                           # or "reference", "motion" or "tracks"
    size = [240, 180]                               # only for recordings that do not tell it
    metrics = ["lpips"]                             # of images; further ones, named in MEASURES

    [[method]]
    name = "akf"                                    # a key of jaxevent.METHODS, or of egomotion's
    params = { c_on = 0.08, clock_offset = 0.0075 } # or the path of a TOML file; omitted: defaults
                                                    # { file = "PATH", c_on = 0.08 }: both
    label = "akf, by hand"                          # in the table; omitted: the name
    grid = { c_on = [0.05, 0.1], kappa = [1, 2] }   # each combination, added to params and label
    normalise = "affine"                            # fit each image's brightness to the truth

The protocols "motion" and "tracks", with settings of their own beside it, are described in
`jaxevent.runs.egomotion_scores` and `jaxevent.runs.blob_scores`; the others ask for images.

A method of the name "external" scores images of another program: `jaxevent.runs.external`. Paths
are relative to the folder of this file. The protocol "held-out" gives the methods frames 0, 2, 4,
... and asks for images where frames 1, 3, 5, ... are, at their time stamps plus the method's
`clock_offset`. Images are clipped to [0, 1], the range of the truth, before they are scored.

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
methods were added, computes only what is missing. Remove the folder tasks to compute everything
again.
"""

import contextlib
import dataclasses
import hashlib
import importlib
import itertools
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import jaxevent
from jaxevent.errors import InputError
from jaxevent.io.output import values_of
from jaxevent.methods import find
from jaxevent.parameters import Parameters, nearest, read_toml
from jaxevent.reconstruction.filtering import ImageEstimator
from jaxevent.runs.config import find_recordings, read_params
from jaxevent.runs.contents import Contents, Opened
from jaxevent.runs.external import External, check_normalise
from jaxevent.runs.protocols import PROTOCOLS
from jaxevent.runs.results import results, write_rows
from jaxevent.runs.scores import check_measures, score_and_sample
from jaxevent.runs.tasks import Outcome, Place, Task, run
from jaxevent.show.report import write_parquet

# Part of the keys of stored results: raised whenever the same recording, method and parameters give
# other results than before.
RESULTS_VERSION = 1


# Protocols of other things than images: where they are described and their rows made.
OTHERS = {"motion": "jaxevent.runs.egomotion_scores", "tracks": "jaxevent.runs.blob_scores"}


class Named(NamedTuple):
    """A method of another protocol."""

    name: str
    Params: type[Parameters]


_opened = Opened()


def find_method(name: str) -> ImageEstimator:
    """The method of that name; raises `InputError` naming the nearest."""
    method = find(name, "reconstruction")
    assert isinstance(method, ImageEstimator)
    return method


def evaluate(
    config: str | Path,
    out: str | Path | None = None,
    progress: bool = False,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    scheduler_file: str | Path | None = None,
    retries: int = 2,
) -> list[dict[str, Any]]:
    """Run an evaluation that a TOML file describes: a row per recording and method, as of `score`.

    The file's layout is in the text of this module. In a row, `recording` is the path as the file
    gives it and `method` is the label. Where a method cannot be run on a recording, the row has
    only those, `params` and `error`, a sentence. Rows do not depend on where they are computed, but
    for `seconds`.

    Args:
        config: The TOML file.
        out: A folder for results.json ({"rows": [...]}), results.md (the table), report.html (one
            page that opens anywhere), results.parquet (a line per row; only where the extra
            "parquet" is installed), config.toml (the file as it was run) and tasks (finished rows,
            which are not computed again); made if missing. Existing results are replaced at the
            end.
        progress: Show bars on stderr.
        workers: Compute in so many processes instead of this one.
        cluster: Compute on the Dask cluster whose scheduler has this address. Its workers need the
            same version of jaxevent, and to find recordings by the same paths; those with one
            thread each serve best.
        scheduler_file: The same, of the scheduler that wrote this file.
        retries: How often a task is tried again whose process dies or that fails for another reason
            than bad input.

    Raises:
        InputError: The file or a parameter cannot be used, `out` not be written, the cluster not be
            reached; or not a single row could be computed.
    """
    plan = read_plan(Path(config))
    place = Place(workers, cluster, None if scheduler_file is None else Path(scheduler_file))
    with contextlib.ExitStack() as stack:
        text = Path(config).read_bytes()
        write = None if out is None else stack.enter_context(results(Path(out)))
        folder = None if out is None else Path(out) / "tasks"
        stack.callback(_opened.clear)
        tasks = _tasks(plan, folder, progress, place == Place())
        outcomes = run(_compute, tasks, folder, place, retries=retries, progress=progress)
        rows = _rows(plan, outcomes)
        if write is not None and out is not None:
            from jaxevent.show.page import page

            write("config.toml", text)
            write_rows(rows, write)
            pictures = [(o.result or {}).get("picture") for o in outcomes]
            hosts = sorted({o.host for o in outcomes if o.host})
            html = page(rows, pictures, plan.protocol, text.decode(), hosts, Path(config).name)
            write("report.html", html.encode())
            write_parquet(Path(out) / "results.parquet", rows)
    return rows


def _rows(plan: "Plan", outcomes: list[Outcome]) -> list[dict[str, Any]]:
    """The rows, named as the configuration does; raises `InputError` if all are errors."""
    rows: list[dict[str, Any]] = []
    pairs = itertools.product(plan.recordings, plan.methods)
    for ((given, _), entry), outcome in zip(pairs, outcomes, strict=True):
        named = {"recording": given, "method": entry.label}
        if outcome.error is None:
            rows.append({**outcome.result["row"], **named})
        else:
            rows.append({**named, "params": entry.shown(), "error": outcome.error})
    errors = list(dict.fromkeys(row["error"] for row in rows if "error" in row))
    if all("error" in row for row in rows):
        more = f" (and {len(errors) - 1} further errors)" if len(errors) > 1 else ""
        raise InputError(f"{errors[0]}{more}")
    return rows


def _tasks(plan: "Plan", folder: Path | None, progress: bool, here: bool) -> list[Task]:
    """A task for each recording and method; with a folder, keyed by all that its row depends on.

    Tasks that are run `here` show a bar of their own.
    """
    contents = None if folder is None else Contents(folder / "contents", progress)
    double = jnp.result_type(float) == jnp.float64
    tasks: list[Task] = []
    for (given, path), entry in itertools.product(plan.recordings, plan.methods):
        path = path.absolute()
        about = {
            "method": entry.method.name,
            "params": entry.settings(),
            "protocol": plan.protocol,
            "metrics": list(plan.metrics),
            "normalise": entry.normalise,
            "size": plan.size,
            "double": double,
            "version": f"{jaxevent.__version__}, results {RESULTS_VERSION}",
            **({} if plan.other is None else {"options": plan.options}),
        }
        key = None
        if contents is not None:
            # What cannot be read has no key; computing it says why.
            with contextlib.suppress(OSError, InputError):
                read = contents.of(path)
                whole = {**about, "content": read}
                if isinstance(entry.method, External):
                    files = entry.method.find(_name(path)).files
                    whole["images"] = [contents.of(file) for file in files]
                    whole["params"] = entry.method.values()
                elif plan.other is not None:
                    truths = plan.other.files(path, plan.options)
                    whole["truths"] = [contents.of(file) for file in truths]
                text = json.dumps(whole, sort_keys=True)
                key = hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
        arguments = {"path": str(path), **about, "progress": progress and here}
        tasks.append(Task(f"{given}, {entry.label}", arguments, key))
    if contents is not None:
        contents.save()
    return tasks


def _compute(
    path: str,
    method: str,
    params: dict[str, Any],
    protocol: str,
    metrics: list[str],
    normalise: str,
    size: tuple[int, int] | None,
    double: bool,
    version: str,
    progress: bool,
    options: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The task: {"row", "picture"} of a recording and a method, on whichever machine."""
    from jaxevent.show.page import picture

    mine = f"{jaxevent.__version__}, results {RESULTS_VERSION}"
    if version != mine:
        raise InputError(
            f"{path}: this worker has jaxevent {mine}, not {version}; install the same everywhere"
        )
    with jax.enable_x64(double):
        recording = _opened.load(Path(path), size, progress)
        if options is not None:
            kind = other(protocol)
            assert kind is not None
            chosen = kind.find(method, options).of(params)
            scores = kind.score(recording, method, chosen, options, progress)
            about = {"recording": recording.name, "method": method}
            return {"row": {**about, **scores, "params": values_of(chosen)}, "picture": None}
        source = External(**params) if method == "external" else find_method(method)
        values = None if isinstance(source, External) else source.Params.of(params)
        name = _name(Path(path))
        row, sample = score_and_sample(
            recording, source, values, protocol, metrics, normalise, progress, name
        )
    return {"row": row, "picture": None if sample is None else picture(sample)}


def _name(path: Path) -> str:
    """How other programs' results call a recording: its name without suffix."""
    return path.name if path.is_dir() else path.stem


@dataclasses.dataclass(frozen=True)
class Plan:
    """A checked configuration: recordings (as given, path) and methods."""

    recordings: list[tuple[str, Path]]
    methods: list["Entry"]
    protocol: str
    size: tuple[int, int] | None
    metrics: tuple[str, ...] = ()
    options: dict[str, Any] = dataclasses.field(default_factory=dict)  # of another protocol

    @property
    def other(self) -> ModuleType | None:
        """Of a protocol of other things than images."""
        return other(self.protocol)


def other(protocol: str) -> ModuleType | None:
    """The module of a protocol of other things than images."""
    return importlib.import_module(OTHERS[protocol]) if protocol in OTHERS else None


@dataclasses.dataclass(frozen=True)
class Entry:
    """A method of a configuration with one set of parameters; `External` has none."""

    label: str
    method: ImageEstimator | External | Named
    params: Parameters | None
    normalise: str

    def settings(self) -> dict[str, Any]:
        """What `_compute` makes it from again."""
        if isinstance(self.method, External):
            return dict(vars(self.method))
        assert self.params is not None
        return self.params.values()

    def shown(self) -> dict[str, Any]:
        """The parameters as a row shows them."""
        if isinstance(self.method, External):
            return self.method.values()
        assert self.params is not None
        return values_of(self.params)


def read_plan(config: Path) -> Plan:
    """Read and check a configuration; raises `InputError` naming the file and the setting."""
    table = read_toml(config)
    try:
        protocol = table.get("protocol", "held-out")
        if protocol not in (every := [*PROTOCOLS, *OTHERS]):
            near = nearest(str(protocol), every)
            raise InputError(f"there is no protocol {protocol!r}; {near}")
        kind = other(protocol)
        own = ("metrics",) if kind is None else tuple(kind.SETTINGS)
        _refuse_unknown(table, ("recordings", "protocol", "size", "method", *own))
        options = {name: table[name] for name in own if name in table and kind is not None}
        if kind is not None:
            for name, value in options.items():
                fits, what = kind.SETTINGS[name]
                if not fits(value):
                    raise InputError(f"{name} is {value!r}; give {what}")
            kind.check(options)
        size = table.get("size")
        if size is not None and not (
            isinstance(size, list) and len(size) == 2 and all(type(n) is int for n in size)
        ):
            raise InputError(f"size is {size!r}; give [width, height] in pixels")
        metrics = table.get("metrics", [])
        if not (isinstance(metrics, list) and all(isinstance(name, str) for name in metrics)):
            raise InputError(f'metrics is {metrics!r}; give a list of names, as ["lpips"]')
        check_measures(metrics)
        recordings = find_recordings(table.get("recordings"), config.parent)
        return Plan(
            recordings,
            _methods(table.get("method"), config.parent, kind, options),
            protocol,
            None if size is None else (size[0], size[1]),
            tuple(metrics),
            options,
        )
    except InputError as error:
        raise InputError(f"{config}: {error}") from None


def _methods(
    given: Any, folder: Path, kind: ModuleType | None, options: Mapping[str, Any]
) -> list[Entry]:
    if not (isinstance(given, list) and given and all(isinstance(one, dict) for one in given)):
        raise InputError('no method is given; add [[method]] with name = "akf"')
    entries: list[Entry] = []
    for number, table in enumerate(given, 1):
        try:
            for entry in _entries(table, folder, kind, options):
                if any(entry.label == other.label for other in entries):
                    raise InputError(f"another one is labelled {entry.label!r} too; add a label")
                entries.append(entry)
        except InputError as error:
            raise InputError(f"method {number}: {error}") from None
    return entries


def _entries(
    table: Mapping[str, Any], folder: Path, kind: ModuleType | None, options: Mapping[str, Any]
) -> Iterator[Entry]:
    """The method of one table, once for each combination of its grid."""
    own = dict(table)
    name = own.pop("name", None)
    normalise = own.pop("normalise", "none") if kind is None else "none"
    label = own.pop("label", name)
    if not isinstance(name, str) or not isinstance(label, str):
        raise InputError('name and label must be text; give name = "akf"')
    check_normalise(normalise)
    fitted = "" if normalise == "none" else ", brightness fitted"
    if name == External.name and kind is None:
        yield Entry(label + fitted, External.of(own, folder.absolute()), None, normalise)
        return
    _refuse_unknown(own, ("name", "params", "label", "grid", *(["normalise"] * (kind is None))))
    method = find_method(name) if kind is None else Named(name, kind.find(name, options))
    params = read_params(method.Params, method.name, own.get("params", {}), folder)
    grid = own.get("grid", {})
    if not isinstance(grid, dict) or not all(isinstance(v, list) and v for v in grid.values()):
        raise InputError(f"grid is {grid!r}; give a table of lists, as {{ c_on = [0.05, 0.1] }}")
    if "preset" in grid:
        raise InputError("a preset cannot be in a grid; add a [[method]] for each preset")
    for values in itertools.product(*grid.values()):
        point = dict(zip(grid, values, strict=True))
        said = "".join(
            f", {key} {value:g}"
            if isinstance(value, int | float) and not isinstance(value, bool)
            else f", {key} {value}"
            for key, value in point.items()
        )
        chosen = method.Params.of({**params.values(), **point}) if point else params
        yield Entry(f"{label}{said}{fitted}", method, chosen, normalise)


def _refuse_unknown(table: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for name in table:
        if name not in known:
            raise InputError(f"there is no setting {name!r}; {nearest(name, known)}")
