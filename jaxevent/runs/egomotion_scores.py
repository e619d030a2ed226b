"""Motion compared with a known one, for `jaxevent evaluate`.

Settings beside `protocol = "motion"`:

    model = "planar"                    # or "rotation", "general"
    truth = "*.csv"                     # beside each recording, * being its name without suffix;
                                        # or "poses", "gyro" of the recording itself
    gyro_bias = [0.0, 0.0, 0.0]         # rad/s, taken off the gyro first
    settle = 0.0                        # s after the first event before errors count
    centred = false                     # compare with the motion that candidates show, `lag` ago
    smooth = false                      # a backward pass, of methods that have one
    gyro = false                        # tell the gyro to methods that take it
    seed = 0

Methods are those of `egomotion.METHODS`. A row has the errors of `truth.motion_errors` at 200 times
per second, without those at which the motion was lost: `lost`, their share of all after it was
first found, `startup` (s) later. `per_time` lists t (us) and `error`, the relative error in %, of a
general motion `heading`, degrees, too; None where lost.
"""

import dataclasses
import inspect
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion import METHODS, find_method
from jaxevent.egomotion.motion import COMPONENTS, Motion
from jaxevent.egomotion.truth import (
    Known,
    axis_error,
    from_gyro,
    known,
    motion_errors,
    relative_error,
)
from jaxevent.errors import InputError
from jaxevent.parameters import Parameters, nearest
from jaxevent.recording import Recording

RATE = 200.0  # Hz
FIGURES = {  # of `motion_errors`: their units
    "AEE": "px/s", "AEE_rel": "%", "AAE_U": "deg", "AAE_T": "deg", "AAE_Omega": "deg",
    "AME": "deg/s", "AME_rel": "%", "AME_N": "%", "vector_error": "%", "outliers": "%",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Errors:
    """How far a motion is from the truth: `figures` of `motion_errors` over `count` times.

    Left out are the `startup` (s) before the motion was first found and the times at which it was
    lost later, a share `lost` of all later ones. `truth` says in words what the truth is.
    """

    figures: Mapping[str, float]
    startup: float
    lost: float
    count: int
    truth: str

    def rows(self) -> list[tuple[str, float, str]]:
        """Names, values and units."""
        rows = [(name, value, FIGURES[name]) for name, value in self.figures.items()]
        return [*rows, ("lost", 100 * self.lost, "%"), ("startup", self.startup, "s")]

    def table(self) -> list[str]:
        """Lines to print."""
        rows = [(name, f"{value:.4g}", unit) for name, value, unit in self.rows()]
        wide = [max(len(row[i]) for row in rows) for i in range(2)]
        lines = [f"{name:{wide[0]}}  {value:>{wide[1]}} {unit}" for name, value, unit in rows[:-2]]
        return [
            *(lines or ["the motion was never found where the truth is known"]),
            f"of {self.count:,} times against {self.truth}; the first {self.startup:.3f} s and "
            f"{100 * self.lost:.2f} % lost later are left out",
        ]


def errors(
    motion: Motion, truth: Known, times: NDArray[np.int64], *, start: int | None = None,
    centred: bool = False, named: str = "the truth",
) -> Errors:  # fmt: skip
    """The errors of a motion at those of the times (us) at which the truth is known.

    `start` (us) is when the events begin, by default the first of the times.
    """
    times = times[truth.within(times)]
    states = motion(times, centred=centred)
    start = int(times[0]) if start is None and len(times) else start or 0
    found = np.flatnonzero(~states.lost)
    if not len(found):
        span = (int(times[-1]) - start) * 1e-6 if len(times) else 0.0
        return Errors({}, max(span, 0.0), 1.0, 0, named)
    lost, began = states.lost[found[0] :], int(times[found[0]])
    mean, true = states.mean[found], truth(times[found])
    pairs = {"planar": {"U": slice(0, 2)}, "rotation": {"Omega": slice(0, 3)}}.get(
        motion.model, {"T": slice(0, 3), "Omega": slice(3, 6)}
    )
    figures = motion_errors(**{name: (mean[:, c], true[:, c]) for name, c in pairs.items()})
    return Errors(figures, max(began - start, 0) * 1e-6, float(lost.mean()), len(found), named)


def _vector(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 3
        and all(type(n) in (int, float) and np.isfinite(n) for n in value)
    )


def _flag(value: Any) -> bool:
    return isinstance(value, bool)


SETTINGS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "model": (lambda value: isinstance(value, str), '"planar", "rotation" or "general"'),
    "truth": (
        lambda value: isinstance(value, str) and value != "",
        'the name of tables beside the recordings, as "*.csv", or "poses", "gyro"',
    ),
    "gyro_bias": (_vector, "three numbers, rad/s"),
    "settle": (
        lambda value: type(value) in (int, float) and 0 <= value < np.inf,
        "a number of seconds, 0 or more",
    ),
    "centred": (_flag, "true or false"),
    "smooth": (_flag, "true or false"),
    "gyro": (_flag, "true or false"),
    "seed": (lambda value: type(value) is int and value >= 0, "a whole number, 0 or more"),
}


def check(options: Mapping[str, Any]) -> None:
    """Raise `InputError` for settings that are missing or not possible together."""
    model = options.get("model", "planar")
    if model not in COMPONENTS:
        raise InputError(f"there is no motion model {model!r}; {nearest(model, COMPONENTS)}")
    if "truth" not in options:
        raise InputError(
            'the true motion is not given; add truth = "*.csv" (tables beside the recordings), '
            '"poses" or "gyro"'
        )


def find(name: str, options: Mapping[str, Any]) -> type[Parameters]:
    """The parameters of a method; raises `InputError` naming the nearest."""
    if name not in METHODS:
        raise InputError(f"there is no method {name!r} of motion; {nearest(name, METHODS)}")
    return find_method(name, options.get("model", "planar")).Params


def files(path: Path, options: Mapping[str, Any]) -> list[Path]:
    """Further files that a row of the recording depends on."""
    truth = options["truth"]
    if truth in ("poses", "gyro"):
        return []
    return [path.with_name(truth.replace("*", path.name if path.is_dir() else path.stem))]


def true_motion(recording: Recording, options: Mapping[str, Any]) -> Known:
    """What is true of the motion of a recording, whose name is its path."""
    source = (files(Path(recording.name), options) or [options["truth"]])[0]
    return known(recording, options.get("model", "planar"), source, _bias(options))


def _bias(options: Mapping[str, Any]) -> NDArray[np.float64]:
    return np.asarray(options.get("gyro_bias", (0.0, 0.0, 0.0)), np.float64)


def score(
    recording: Recording,
    name: str,
    params: Parameters,
    options: Mapping[str, Any],
    progress: bool = False,
) -> dict[str, Any]:
    """A row without the names; raises `InputError` where there is no truth or no events."""
    model, bias = options.get("model", "planar"), _bias(options)
    if not len(recording.events):
        raise InputError(f"{recording.name}: holds no events; choose another recording")
    truth = true_motion(recording, options)
    estimate = find_method(name, model).estimate
    takes = inspect.signature(estimate).parameters
    settings: dict[str, Any] = {}
    if options.get("smooth", False) and "smooth" in takes:
        settings["smooth"] = True
    if options.get("gyro", False) and "gyro" in takes:
        if recording.imu is None:
            raise InputError(f"{recording.name}: holds no IMU; leave out gyro = true")
        settings["gyro"] = from_gyro(recording.imu, bias)
    clock = time.perf_counter()
    motion = estimate(
        recording, params, model=model, seed=options.get("seed", 0), progress=progress, **settings
    )
    seconds = time.perf_counter() - clock
    first, last = int(recording.events[:1].t[0]), int(recording.events[-1:].t[0])
    begin = first + round(options.get("settle", 0.0) * 1e6)
    times = np.arange(begin, last + 1, round(1e6 / RATE))
    times = times[truth.within(times)]
    if not len(times):
        raise InputError(
            f"{recording.name}: its events and the true motion are not of one time; times are "
            "seconds on the recording's clock"
        )
    centred = options.get("centred", False)
    found = errors(motion, truth, times, start=first, centred=centred)
    mean, _, lost = motion(times, centred=centred)
    true = truth(times)

    def listed(values: Any) -> list[float | None]:
        return [
            float(f"{value:.6g}") if ok and np.isfinite(value) else None
            for value, ok in zip(values, ~lost, strict=True)
        ]

    rates = slice(3, 6) if model == "general" else slice(None)
    per_time = {"t": times.tolist()}
    if model == "general":
        per_time["heading"] = listed(axis_error(mean[:, :3], true[:, :3]))
    per_time["error"] = listed(100 * relative_error(mean[:, rates], true[:, rates]))
    return {
        "model": model,
        **{k: float(v) if np.isfinite(v) else None for k, v in found.figures.items()},
        "lost": found.lost,
        "startup": found.startup,
        "times": len(times),
        "events": len(recording.events),
        "seconds": seconds,
        "per_time": per_time,
    }
