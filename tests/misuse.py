"""A table of misuse: every argument that takes data, crossed with what people give by mistake.

    python tests/misuse.py            # all cases, in child processes with limited memory
    python tests/misuse.py Events     # those whose name begins so

A case is right if it gives what the clean arrays give, or is refused by an `InputError` of one
sentence: as `Case.right` says. Children run many cases each; one that dies is a case that crashed.
"""

import argparse
import array
import dataclasses
import functools
import json
import os
import resource
import subprocess
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxevent import Events, Frames, InputError, Recording
from jaxevent.recording import Imu, Poses, Triggers

SIZE = WIDTH, HEIGHT = 64, 48
MEMORY = 1 << 30  # bytes of data that a child may have beyond what it starts with
SCALES = {"s": 1e-6, "ms": 1e-3, "us": 1.0, "ns": 1e3}
EQUAL, REFUSED, EITHER = "equal", "refused", "either"


class Case(NamedTuple):
    """One call: what is called, the argument that is unusual, how it is, and what is right."""

    name: str
    call: Callable[[], Any]
    clean: Callable[[], Any]
    right: str


@functools.cache
def clean() -> dict[str, np.ndarray]:
    """Events of a bright bar that moves to the right, and frames of it."""
    rng = np.random.default_rng(0)
    n, length = 6000, 200_000
    t = np.sort(rng.integers(0, length, n))
    on = rng.integers(0, 2, n)
    x = (t * 40 // length + 8 + 4 * on + rng.integers(0, 2, n)).astype(np.int64)
    frame_times = np.array([10_000, 70_000, 130_000, 190_000])
    frames = np.full((4, HEIGHT, WIDTH), 60, np.uint8)
    for k, at in enumerate(frame_times * 40 // length + 8):
        frames[k, :, at : at + 4] = 180
    return {
        "t": t, "x": x, "y": rng.integers(0, HEIGHT, n), "p": on, "frames": frames,
        "frame_times": frame_times, "exposure": np.full(4, 2000),
    }  # fmt: skip


class OnlyArray:
    """An array of another library, which NumPy reads by `__array__`."""

    def __init__(self, values: np.ndarray):
        self.values = values

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self.values, dtype)


class OnlyDlpack:
    """An array of another library, which NumPy reads by DLPack."""

    def __init__(self, values: np.ndarray):
        self.values = values

    def __dlpack__(self, **options: Any) -> Any:
        return self.values.__dlpack__(**options)

    def __dlpack_device__(self) -> tuple[int, int]:
        return self.values.__dlpack_device__()


class OnDevice:
    """An array that its library does not give to NumPy, as of a GPU or with a gradient."""

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        raise TypeError("Can't convert a device tensor to numpy.\nUse .cpu() first.")


def read_only(values: np.ndarray) -> np.ndarray:
    values = values.copy()
    values.flags.writeable = False
    return values


def unaligned(values: np.ndarray) -> np.ndarray:
    packed = np.zeros(len(values), [("pad", "u1"), ("it", values.dtype, values.shape[1:])])
    packed["it"] = values
    return packed["it"]


def changed(values: np.ndarray, value: Any, dtype: Any = None) -> np.ndarray:
    """A copy of which one number, in the middle, is another."""
    values = values.astype(dtype) if dtype else values.copy()
    values[len(values) // 2] = value
    return values


def frame_of(name: str, values: np.ndarray) -> Any:
    import pandas

    return pandas.Series(values, dtype=name)


def layouts() -> dict[str, Callable[[np.ndarray], Any]]:
    """Forms of an array of any shape that hold the same numbers."""
    import jax.numpy as jnp

    return {
        "as is": lambda v: v,
        "byte order": lambda v: v.astype(v.dtype.newbyteorder("S")),
        "stride 2": lambda v: np.repeat(v, 2, 0)[::2],
        "reversed stride": lambda v: v[::-1].copy()[::-1],
        "read-only": read_only,
        "unaligned": unaligned,
        "list": lambda v: v.tolist(),
        "tuple": lambda v: tuple(v),
        "jax": lambda v: jnp.asarray(v),
        "array protocol": OnlyArray,
        "DLPack": OnlyDlpack,
        "unmasked": lambda v: np.ma.array(v, mask=False),
    }


def columns(name: str) -> Iterator[tuple[str, Callable[[np.ndarray], Any], str]]:
    """Unusual forms of a column of events, and what is right."""
    whole = ["u8", "i4", "u4"] if name == "t" else ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"]
    for kind in whole:
        yield kind, lambda v, kind=kind: v.astype(kind), EQUAL
        yield f"{kind} swapped", lambda v, kind=kind: v.astype(np.dtype(kind).newbyteorder()), EQUAL
    for kind, form in layouts().items():
        # Lists of small numbers are int64, as are those of bool a list of bool.
        yield kind, form, EQUAL
    yield "pandas", lambda v: frame_of("int64", v), EQUAL
    yield "pandas nullable", lambda v: frame_of("Int64", v), EQUAL
    yield "array.array", lambda v: array.array("q", v.tolist()), EQUAL
    yield "memoryview", lambda v: memoryview(v), EQUAL
    yield "Fortran column", lambda v: np.asfortranarray(np.stack([v, v], 1))[:, 0], EQUAL
    for kind in ("f4", "f8", ">f8", "longdouble"):
        right = REFUSED if name == "t" else EQUAL
        yield kind, lambda v, kind=kind: v.astype(kind), right
    if name in "xy":
        yield "f2", lambda v: v.astype("f2"), EQUAL
        for value in (-1, 1 << 40):
            yield f"{value}", lambda v, value=value: changed(v, value), REFUSED
        for value in (0.5, np.nan, np.inf, -np.inf, 1e300):
            yield f"{value}", lambda v, value=value: changed(v, value, float), REFUSED
        yield "-1 int8", lambda v: changed(v, -1, np.int8), REFUSED
        yield "-1 wrapped", lambda v: changed(v, -1).astype(np.uint16), REFUSED
        yield "2^64 - 1", lambda v: changed(v.astype("u8"), np.iinfo("u8").max), REFUSED
        yield "bool", lambda v: v > 0, REFUSED
    if name == "p":
        yield "bool", lambda v: v > 0, EQUAL
        yield "bool swapped stride", lambda v: np.repeat(v > 0, 3)[::3], EQUAL
        yield "bytes as bool", lambda v: (v * 7).astype("u1").view(bool), EQUAL
        yield "list of bool", lambda v: (v > 0).tolist(), EQUAL
        for kind in ("i1", "i8", ">i2", "f4"):
            yield f"-1 or 1 {kind}", lambda v, kind=kind: (2 * v - 1).astype(kind), EQUAL
        yield "0 or 255", lambda v: (255 * v).astype("u1"), REFUSED
        yield "-1, 0 or 1", lambda v: changed(2 * v - 1, 0), REFUSED
        yield "1 or 2", lambda v: v + 1, REFUSED
        yield "0.5", lambda v: changed(v, 0.5, float), REFUSED
        yield "nan", lambda v: changed(v, np.nan, float), REFUSED
    if name == "t":
        yield "backwards", lambda v: v[::-1].copy(), REFUSED
        yield "one back", lambda v: changed(v, 0), REFUSED
        yield "uint64 back", lambda v: changed(v.astype("u8"), 0), REFUSED
        yield "beyond int64", lambda v: v.astype("u8") + np.uint64(1 << 63), REFUSED
        yield "near int64", lambda v: v + (1 << 62), REFUSED
        yield "nan", lambda v: changed(v, np.nan, float), REFUSED
        yield "bool", lambda v: v > 0, REFUSED
        yield "datetime64", lambda v: v.astype("M8[us]"), REFUSED
        yield "timedelta64", lambda v: v.astype("m8[us]"), REFUSED
    yield from wrong_forms()


def wrong_forms() -> Iterator[tuple[str, Callable[[np.ndarray], Any], str]]:
    """Forms of any array that are refused."""
    forms: dict[str, Callable[[np.ndarray], Any]] = {
        "short": lambda v: v[:-1],
        "five short": lambda v: v[:-5],
        "first 3": lambda v: v[:3],
        "long": lambda v: np.concatenate([v, v[-1:]]),
        "empty": lambda v: v[:0],
        "empty list": lambda v: [],
        "two columns": lambda v: np.stack([v, v], 1),
        "one column": lambda v: v[:, None],
        "one row": lambda v: v[None],
        "0-d": lambda v: v.ravel()[0],
        "Python number": lambda v: v.ravel()[0].item(),
        "0-d array": lambda v: np.array(1),
        "complex": lambda v: v.astype(complex),
        "text": lambda v: v.astype(str),
        "bytes": lambda v: v.astype("S"),
        "object": lambda v: v.astype(object),
        "object of None": lambda v: changed(v.astype(object), None),
        "record": lambda v: v.astype([("it", v.dtype)]),
        "masked": lambda v: np.ma.array(v, mask=np.arange(v.size).reshape(v.shape) == 2),
        "matrix": lambda v: np.asmatrix(v.reshape(len(v), -1)),
        "ragged": lambda v: [[1, 2], [3]],
        "list of None": lambda v: [None] * len(v),
        "list of text": lambda v: ["1"] * len(v),
        "list of 2^70": lambda v: [2**70] * len(v),
        "generator": lambda v: (one for one in v),
        "set": lambda v: {1, 2},
        "dictionary": lambda v: {"a": v},
        "str": lambda v: "events.h5",
        "Path": lambda v: Path("events.h5"),
        "bytes object": lambda v: b"0101",
        "function": lambda v: len,
        "class": lambda v: Events,
        "on a device": lambda v: OnDevice(),
        "pandas text": lambda v: frame_of("str", v.ravel().astype(str)),
        "pandas with NA": lambda v: frame_of("Int64", [None, *v.ravel()[1:].tolist()]),
    }
    for kind, form in forms.items():
        yield kind, form, REFUSED


def of_arrays(**given: Any) -> Recording:
    """A recording of the clean arrays, of which some are replaced."""
    all_of = {**clean(), "width": WIDTH, "height": HEIGHT, **given}
    events = [all_of.pop(name) for name in "txyp"]
    return Recording.from_arrays(*events, **all_of)


def kept(**given: Any) -> Recording:
    """The same by the constructors of `Events`, `Frames` and `Recording`."""
    v = {**clean(), "name": "arrays", "width": WIDTH, "height": HEIGHT, **given}
    events = given.get("events", None) or Events(v["t"], v["x"], v["y"], v["p"])
    frames = Frames(v["frame_times"], v["frames"], v["exposure"])
    return Recording(v["name"], v["width"], v["height"], events, frames)


def replaced(what: str, **given: Any) -> Recording:
    """The same by `dataclasses.replace` of a field of the events, frames or recording."""
    recording = kept()
    if what == "recording":
        return dataclasses.replace(recording, **given)
    return dataclasses.replace(
        recording, **{what: dataclasses.replace(getattr(recording, what), **given)}
    )


def images() -> Iterator[tuple[str, Callable[[np.ndarray], Any], str]]:
    """Unusual forms of frames."""
    for kind, form in layouts().items():
        # A list of small numbers is int64, of which nobody knows what is white.
        yield kind, form, REFUSED if kind == "list" else EQUAL
    yield "Fortran", np.asfortranarray, EQUAL
    yield "transposed memory", lambda v: v.transpose(0, 2, 1).copy().transpose(0, 2, 1), EQUAL
    for kind in ("i1", "i2", "i4", "u4", "i8", "?"):
        yield kind, lambda v, kind=kind: v.astype(kind), REFUSED
    yield "levels as f4", lambda v: v.astype("f4"), REFUSED
    yield "above 1", lambda v: changed(v / 255, 1.5), REFUSED
    yield "below 0", lambda v: changed(v / 255, -0.1), REFUSED
    yield "nan", lambda v: changed(v / 255, np.nan), REFUSED
    yield "one image", lambda v: v[0], REFUSED
    yield "channels first", lambda v: np.stack([v, v, v], 1), REFUSED
    yield "two channels", lambda v: np.stack([v, v], 3), REFUSED
    yield "transparency", lambda v: np.stack([v] * 4, 3), REFUSED
    yield "transposed", lambda v: v.transpose(0, 2, 1), REFUSED
    yield "smaller", lambda v: v[:, 1:, 1:], REFUSED
    yield "wrong way", lambda v: v.transpose(1, 2, 0), REFUSED
    for kind, form, right in wrong_forms():
        if kind not in ("one column", "matrix"):
            yield kind, form, right


def stamps(name: str) -> Iterator[tuple[str, Callable[[np.ndarray], Any], str]]:
    """Unusual forms of the times or exposures of frames."""
    for kind in ("i4", "u4", ">i8", "u8", "u2" if name == "exposure" else "i8"):
        yield kind, lambda v, kind=kind: v.astype(kind), EQUAL
    for kind, form in layouts().items():
        yield kind, form, EQUAL
    yield "floats", lambda v: v / 1e6, REFUSED
    yield "datetime64", lambda v: v.astype("M8[us]"), REFUSED
    yield "nan", lambda v: changed(v, np.nan, float), REFUSED
    yield "beyond int64", lambda v: v.astype("u8") + np.uint64(1 << 63), REFUSED
    if name == "frame_times":
        yield "repeated", lambda v: v // 100_000, REFUSED
        yield "backwards", lambda v: v[::-1], REFUSED
    else:
        yield "negative", lambda v: v - 3000, REFUSED
    for kind, form, right in wrong_forms():
        if name == "exposure" and kind in ("0-d", "Python number", "0-d array"):
            continue
        yield kind, form, right


NOT_NUMBERS: dict[str, Any] = {
    "None": None, "0": 0, "-1": -1, "65537": 65537, "2^70": 2**70, "True": True, "64.5": 64.5,
    "nan": float("nan"), "text": "64", "list": [64], "tuple": (64, 48), "array": np.arange(3),
    "0-d array": np.array(64), "complex": 64j, "dictionary": {},
}  # fmt: skip


class OwnSource:
    """Events of somebody's own, an `EventSource`, that may be wrong."""

    def __init__(self, events: Events, fault: str = ""):
        self.events, self.fault = events, fault

    def __len__(self) -> int:
        return len(self.events) + (self.fault == "long")

    def __getitem__(self, rows: slice) -> Any:
        part = self.events[rows]
        if self.fault == "arrays":
            return part.t, part.x, part.y, part.p
        if self.fault == "order" and rows.start:
            return Events(part.t - part.t[:1], part.x, part.y, part.p)
        if self.fault == "place":
            return Events(part.t, part.x + np.uint16(60), part.y, part.p)
        return part[1:] if self.fault == "short" and len(part) > 1 else part

    def index(self, time: int) -> int:
        return self.events.index(time) + {"index": 7, "far": 10**9}.get(self.fault, 0)


def own_source(fault: str) -> Recording:
    """A recording of such a source, of which everything is read."""
    recording = kept(events=OwnSource(kept().events, fault))
    events = recording.events[: len(recording.events)]
    later = recording.events[100:200]
    if recording.events.index(100_000) != events.index(100_000):
        raise AssertionError("the index is another")
    if fault == "order" and len(later):
        raise AssertionError("pieces out of order were accepted")
    return dataclasses.replace(recording, events=events)


def whole_arguments() -> Iterator[Case]:
    """Events given as one thing, units, sizes and the other arguments of a recording."""
    c = clean()
    table = {name: c[name] for name in "txyp"}
    other = dict(zip(("timestamp", "x", "y", "polarity"), table.values(), strict=True))

    def together(events: Any, **more: Any) -> Recording:
        rest = {name: c[name] for name in ("frames", "frame_times", "exposure")}
        return Recording.from_arrays(events, width=WIDTH, height=HEIGHT, **rest, **more)

    def frame() -> Any:
        import pandas

        return pandas.DataFrame(other)

    def record(order: str = "<") -> np.ndarray:
        kinds = [("t", f"{order}i8"), ("x", f"{order}u2"), ("y", f"{order}u2"), ("p", "?")]
        out = np.empty(len(c["t"]), kinds)
        for name in "txyp":
            out[name] = table[name]
        return out

    wholes: dict[str, tuple[Callable[[], Any], str]] = {
        "records": (record, EQUAL),
        "records swapped": (lambda: record(">"), EQUAL),
        "records strided": (lambda: np.repeat(record(), 2)[::2], EQUAL),
        "records read-only": (lambda: read_only(record()), EQUAL),
        "DataFrame": (frame, EQUAL),
        "dictionary": (lambda: other, EQUAL),
        "Events": (lambda: kept().events, EQUAL),
        "(n, 4)": (lambda: np.stack(list(table.values()), 1), REFUSED),
        "(4, n)": (lambda: np.stack(list(table.values())), REFUSED),
        "list of tuples": (lambda: list(zip(*table.values(), strict=True)), REFUSED),
        "tuple of columns": (lambda: tuple(table.values()), REFUSED),
        "DataFrame without p": (lambda: frame().drop(columns="polarity"), REFUSED),
        "dictionary of two t": (lambda: {**table, "ts": c["t"]}, REFUSED),
        "records 2-D": (lambda: record().reshape(-1, 2), REFUSED),
        "None": (lambda: None, REFUSED),
        "path": (lambda: "events.h5", REFUSED),
        "number": (lambda: 3, REFUSED),
        "Recording": (kept, REFUSED),
    }
    for kind, (make, right) in wholes.items():
        yield case("from_arrays/events", kind, lambda m=make: together(m()), right)
    for unit, scale in SCALES.items():
        floats = {name: c[name] * scale for name in ("t", "frame_times", "exposure")}
        yield case(
            "from_arrays/time_unit",
            f"{unit} floats",
            lambda f=floats, u=unit: of_arrays(**f, time_unit=u),
            EQUAL,
        )
    whole = {name: c[name] * 1000 for name in ("t", "frame_times", "exposure")}
    yield case(
        "from_arrays/time_unit", "ns integers", lambda: of_arrays(**whole, time_unit="ns"), EQUAL
    )
    small = {name: (c[name] / 1e6).astype("f4") for name in ("frame_times", "exposure")}
    late = {"t": (c["t"] / 1e6 + 1.7e9).astype("f4"), **small}
    yield case(
        "from_arrays/time_unit", "f4 of an epoch", lambda: of_arrays(**late, time_unit="s"), REFUSED
    )
    large = {name: c[name].astype("u8") << np.uint64(40) for name in whole}
    yield case(
        "from_arrays/time_unit",
        "s beyond int64",
        lambda: of_arrays(**large, time_unit="s"),
        REFUSED,
    )
    for unit in ("S", "seconds", 1e-6, b"s", ["s"], "", np.int64(1)):
        yield case(
            "from_arrays/time_unit", repr(unit), lambda u=unit: of_arrays(time_unit=u), REFUSED
        )
    yield case("from_arrays/exposure", "one number", lambda: of_arrays(exposure=2000), EQUAL)
    yield case("from_arrays/exposure", "0-d", lambda: of_arrays(exposure=np.array(2000)), EQUAL)
    yield case("from_arrays/exposure", "one float", lambda: of_arrays(exposure=0.002), REFUSED)
    yield case("from_arrays/exposure", "negative", lambda: of_arrays(exposure=-1), REFUSED)
    yield case("from_arrays/frame_times", "None", lambda: of_arrays(frame_times=None), REFUSED)
    yield case("from_arrays/frames", "None", lambda: of_arrays(frames=None), REFUSED)
    rgb = np.repeat(c["frames"][..., None], 3, 3)
    yield case("from_arrays/frames", "grey in colour", lambda: of_arrays(frames=rgb), EQUAL)
    yield case("from_arrays/frames", "one channel", lambda: of_arrays(frames=rgb[..., :1]), EQUAL)
    for side in ("width", "height"):
        for name, call in (("from_arrays", of_arrays), ("Recording", kept)):
            for kind, value in NOT_NUMBERS.items():
                # From frames, what is missing is known.
                right = EQUAL if name == "from_arrays" and value is None else REFUSED
                yield case(
                    f"{name}/{side}", kind, lambda f=call, s=side, v=value: f(**{s: v}), right
                )
        yield case(
            f"Recording/{side}",
            "uint8",
            lambda s=side: kept(**{s: np.uint8(dict(width=WIDTH, height=HEIGHT)[s])}),
            EQUAL,
        )
        yield case(f"Recording/{side}", "smaller", lambda s=side: kept(**{s: 20}), REFUSED)
        yield case(
            f"replace/{side}", "smaller", lambda s=side: replaced("recording", **{s: 20}), REFUSED
        )


def fields() -> Iterator[Case]:
    """Things given for the fields of a recording, and the columns of its companions."""
    c, t = clean(), clean()["frame_times"]
    wrong = {
        "text": "a.h5", "number": 3, "array": np.zeros((4, 3)), "list": [1, 2],
        "dictionary": {"t": t}, "Events": kept().events, "class": Events, "True": True,
    }  # fmt: skip
    for field in (
        "events",
        "frames",
        "camera",
        "poses",
        "imu",
        "triggers",
        "extra",
        "left_out",
        "name",
        "notes",
    ):
        for kind, value in wrong.items():
            fits = (field, kind) in {
                ("events", "Events"), ("extra", "dictionary"), ("left_out", "dictionary"),
                ("name", "text"), ("notes", "list"),
            }  # fmt: skip
            right = EITHER if fits else REFUSED
            yield case(
                f"Recording/{field}",
                kind,
                lambda f=field, v=value: replaced("recording", **{f: v}),
                right,
            )
    yield case("Recording/events", "None", lambda: replaced("recording", events=None), REFUSED)
    yield case(
        "Recording/events",
        "DataFrame",
        lambda: replaced("recording", events=kept().events.to_dataframe()),
        REFUSED,
    )
    for fault in ("", "arrays", "order", "place", "short", "long", "index", "far"):
        yield case(
            "Recording/events",
            f"own source, {fault or 'good'}",
            lambda f=fault: own_source(f),
            REFUSED if fault else EQUAL,
        )
    rows = {"list": [1, 2], "slice": slice(2, 5), "mask": c["x"] > 30}
    for kind, value in rows.items():
        yield case("Events/rows", kind, lambda v=value: kept().events[v], EITHER)
    for kind, value in {
        "number": 3,
        "list back": [2, 1],
        "reversed": slice(None, None, -1),
        "two": ([1], [2]),
    }.items():
        yield case("Events/rows", kind, lambda v=value: kept().events[v], REFUSED)
        yield case("Frames/rows", kind, lambda v=value: kept().frames[v], REFUSED)
    good: dict[Any, dict[str, Any]] = {
        Poses: {"t": t, "position": np.zeros((4, 3)), "quaternion": np.ones((4, 4))},
        Imu: {"t": t, "gyro": np.zeros((4, 3)), "acc": np.ones((4, 3))},
        Triggers: {"t": t, "edge": np.ones(4, int), "channel": np.zeros(4, int)},
    }
    for kind, given in good.items():
        for name in given:
            for what, form in layouts().items():
                call = lambda k=kind, n=name, f=form, g=given: k(**{**g, n: f(g[n])})  # noqa: E731
                yield Case(
                    f"{kind.__name__}/{name}/{what}", call, lambda k=kind, g=given: k(**g), EQUAL
                )
            more = [("nan", lambda v: changed(v, np.nan, float), REFUSED)]
            more += [("back", lambda v: v[::-1], REFUSED)] if name == "t" else []
            for what, form, right in (*wrong_forms(), *more):
                if name not in "t edge channel".split() and what in ("one column", "matrix"):
                    continue
                call = lambda k=kind, n=name, f=form, g=given: k(**{**g, n: f(g[n])})  # noqa: E731
                yield Case(
                    f"{kind.__name__}/{name}/{what}", call, lambda k=kind, g=given: k(**g), right
                )


def case(target: str, kind: str, call: Callable[[], Any], right: str) -> Case:
    return Case(f"{target}/{kind}", call, kept, right)


def estimates() -> Iterator[Case]:
    """What is given to one method of each family in place of its arguments."""
    import jaxevent

    recording = kept()
    wrong = {
        "None": None, "path": "a.h5", "Path": Path("a.h5"), "Events": recording.events,
        "dictionary": dataclasses.asdict(recording), "array": recording.events.to_structured(),
        "DataFrame": recording.events.to_dataframe(), "list": [recording], "class": Recording,
        "number": 3,
    }  # fmt: skip
    akf, moment, voting = jaxevent.akf, jaxevent.blob.moment, jaxevent.egomotion.voting
    given: dict[Any, dict[str, Any]] = {
        akf: {}, moment: {"seeds": [(20, 20, 4)]}, voting: {"model": "planar"},
    }  # fmt: skip
    others = {akf: moment, moment: voting, voting: akf}
    sizes = {"text": "many", "list": [1], "nan": float("nan"), "-1": -1, "dictionary": {}}
    options = {
        akf: ("window_events", "compiler"),
        moment: ("seeds", "start", "stop", "detect", "smooth", "compiler", "found"),
        voting: ("model", "camera", "seed", "smooth", "cloud", "compiler"),
    }
    for method, usual in given.items():
        name = f"{method.name}.estimate"

        def run(r: Any = recording, params: Any = None, m=method, u=usual, **more: Any) -> Any:
            result = m.estimate(r, params, **{**u, "progress": False, **more})
            return list(result([70_000, 130_000]))

        for kind, value in wrong.items():
            yield Case(f"{name}/recording/{kind}", lambda f=run, v=value: f(v), run, REFUSED)
        unfit = {
            "path": "a.toml", "Path": Path("a.toml"), "dictionary": {"c_on": 0.1}, "number": 0.1,
            "class": method.Params, "of another": others[method].Params(), "list": [0.1],
        }  # fmt: skip
        for kind, value in unfit.items():
            call = lambda f=run, v=value: f(params=v)  # noqa: E731
            yield Case(f"{name}/params/{kind}", call, run, REFUSED)
        for kind, form in layouts().items():
            call = lambda f=run, g=form: f(of_arrays(**{n: g(clean()[n]) for n in "txyp"}))  # noqa: E731
            yield Case(f"{name}/layout/{kind}", call, run, EQUAL)
        for fault in ("", "arrays", "order", "place", "short", "long", "far"):
            call = lambda f=run, k=fault: f(kept(events=OwnSource(kept().events, k)))  # noqa: E731
            yield Case(
                f"{name}/own source/{fault or 'good'}", call, run, REFUSED if fault else EQUAL
            )
        for column, value in (("x", 60_000), ("y", 60_000), ("t", 0), ("t", 1 << 50)):
            call = lambda f=run, c=column, v=value: f(mutated(c, v))  # noqa: E731
            yield Case(f"{name}/changed later/{column} {value}", call, run, REFUSED)
        yield Case(
            f"{name}/recording/empty",
            lambda f=run: f(Recording("e", *SIZE, Events.empty())),
            run,
            EITHER,
        )
        yield Case(f"{name}/option/unknown", lambda f=run: f(colour=3), run, REFUSED)
        for option in options[method]:
            for kind, value in sizes.items():
                call = lambda f=run, o=option, v=value: f(**{o: v})  # noqa: E731
                yield Case(f"{name}/{option}/{kind}", call, run, EITHER)


def mutated(column: str, value: int) -> Recording:
    """A recording whose arrays somebody changed after it was made."""
    own = {name: values.copy() for name, values in clean().items()}  # not those of other cases
    recording = kept(**own)
    getattr(recording.events, column)[1000] = value
    return recording


def constructions() -> list[Case]:
    """Cases of arrays, of events, frames and recordings."""
    found = []
    for column in "txyp":
        for kind, form, right in columns(column):
            form = functools.partial(lambda f, n: f(clean()[n]), form, column)
            found.append(
                case(
                    f"from_arrays/{column}",
                    kind,
                    lambda f=form, n=column: of_arrays(**{n: f()}),
                    right,
                )
            )
            found.append(
                case(f"Events/{column}", kind, lambda f=form, n=column: kept(**{n: f()}), right)
            )
            found.append(
                case(
                    f"replace/{column}",
                    kind,
                    lambda f=form, n=column: replaced("events", **{n: f()}),
                    right,
                )
            )
    for argument, field, forms in (
        ("frames", "images", images()),
        ("frame_times", "t", stamps("frame_times")),
        ("exposure", "exposure", stamps("exposure")),
    ):
        for kind, form, right in forms:
            form = functools.partial(lambda f, n: f(clean()[n]), form, argument)
            found.append(
                case(
                    f"from_arrays/{argument}",
                    kind,
                    lambda f=form, n=argument: of_arrays(**{n: f()}),
                    right,
                )
            )
            found.append(
                case(f"Frames/{field}", kind, lambda f=form, n=argument: kept(**{n: f()}), right)
            )
            found.append(
                case(
                    f"replace/{field}",
                    kind,
                    lambda f=form, n=field: replaced("frames", **{n: f()}),
                    right,
                )
            )
    return [*found, *whole_arguments(), *fields()]


def cases() -> list[Case]:
    """All of them, in one order."""
    return [*constructions(), *estimates()]


def leaves(thing: Any) -> list[np.ndarray]:
    """The arrays of a recording, of its parts or of an estimate."""
    if isinstance(thing, Recording):
        thing = [thing.events, thing.frames, (thing.width, thing.height)]
    if isinstance(thing, Events | Frames | Poses | Imu | Triggers):
        thing = [getattr(thing, field.name) for field in dataclasses.fields(thing)]
    if isinstance(thing, list | tuple):
        return [leaf for one in thing for leaf in leaves(one)]
    return [np.asarray(thing)]


@functools.cache
def expected(call: Callable[[], Any]) -> list[np.ndarray]:
    return leaves(call())


def outcome(one: Case) -> str:
    """What a case does: "equal", "refused: ...", or what is wrong with it."""
    try:
        found = leaves(one.call())
    except InputError as error:
        text = str(error)
        bad = "\n" in text or len(text) > 400 or text.endswith(".") or len(text) < 20
        return f"BAD SENTENCE: {text}" if bad else f"refused: {text}"
    except BaseException as error:
        return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    if one.right == EITHER:
        return "accepted"
    wanted = expected(one.clean)
    same = len(found) == len(wanted) and all(
        a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
        for a, b in zip(found, wanted, strict=True)
    )
    return "equal" if same else "DIFFERS"


def is_right(one: Case, told: str) -> bool:
    """Whether an outcome is the right one."""
    if one.right == EITHER:
        return told == "accepted" or told.startswith("refused: ")
    return told == "equal" if one.right == EQUAL else told.startswith("refused: ")


def run_child(names: list[str]) -> None:
    """Run cases by name, with a line before and after each."""
    warnings.simplefilter("ignore")
    all_of = {one.name: one for one in cases()}
    used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_DATA, (used + MEMORY, resource.RLIM_INFINITY))
    for name in names:
        print(json.dumps([name, None]), flush=True)
        print(json.dumps([name, outcome(all_of[name])]), flush=True)


def run(wanted: list[Case]) -> dict[str, str]:
    """The outcome of each case, from children of which each runs as many as it survives."""
    found: dict[str, str] = {}
    left = [one.name for one in wanted]
    while left:
        done = subprocess.run(
            [sys.executable, __file__, "--child"], input=json.dumps(left), text=True,
            capture_output=True, env={**os.environ, "PYTHONFAULTHANDLER": "1"},
        )  # fmt: skip
        lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
        if not lines:
            raise RuntimeError(done.stderr[-2000:])
        found |= {name: told for name, told in lines if told is not None}
        if lines[-1][1] is None:
            found[lines[-1][0]] = f"CRASH: exit status {done.returncode}"
        left = [name for name in left if name not in found]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("beginning", nargs="?", default="")
    parser.add_argument("--child", action="store_true")
    parser.add_argument("--all", action="store_true", help="print right cases too")
    options = parser.parse_args()
    if options.child:
        run_child(json.loads(sys.stdin.read()))
        return
    wanted = [one for one in cases() if one.name.startswith(options.beginning)]
    told = run(wanted)
    table: dict[str, Counter[str]] = {}
    for one in wanted:
        right = is_right(one, told[one.name])
        target = one.name.rpartition("/")[0]
        table.setdefault(target, Counter())["right" if right else "wrong"] += 1
        if options.all or not right:
            print(f"{'ok   ' if right else 'WRONG'} {one.name} ({one.right}): {told[one.name]}")
    print("\n| argument | cases | wrong |\n|---|---|---|")
    for target, counts in table.items():
        print(f"| {target} | {counts.total()} | {counts['wrong']} |")
    print(f"| all | {len(wanted)} | {sum(c['wrong'] for c in table.values())} |")
    raise SystemExit(1 if any(c["wrong"] for c in table.values()) else 0)


if __name__ == "__main__":
    main()
