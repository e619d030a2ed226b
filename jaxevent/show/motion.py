"""A motion written to files: tables, plots against the truth, images of warped events, its flow."""

import contextlib
import dataclasses
import functools
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import numpy as np
import pandas as pd
from jaxtyping import Array
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from jaxevent.egomotion import flow as event_flow
from jaxevent.egomotion.candidates import coordinates
from jaxevent.egomotion.flow import Flow
from jaxevent.egomotion.geometry import flow as flow_of_scene
from jaxevent.egomotion.motion import COMPONENTS, Motion, States
from jaxevent.egomotion.truth import (
    Known,
    axis_error,
    endpoint_error,
    from_poses,
    known,
)
from jaxevent.egomotion.warped import blur, contrast, splat
from jaxevent.errors import InputError, require
from jaxevent.io.output import complete, complete_hdf5
from jaxevent.recording import Events, Recording
from jaxevent.runs.egomotion_scores import Errors, errors

UNITS = {"vx": "px/s", "vy": "px/s", "wx": "rad/s", "wy": "rad/s", "wz": "rad/s"}
_PLOTTED = 4096  # most times of the plot
_PARTICLES = 30_000  # most particles of a component in the plot
_WAY, _SHORTEST, _LONGEST = 8.0, 0.02, 0.05  # px and s: of the window that is warped
_MOST = 500_000  # events that are warped or coloured
_TRUE, _ESTIMATE, _LOST, _CLOUD = "black", "#c8401e", "#bbbbbb", "#3a78b5"


def write_motion_table(
    path: str | Path, model: str, times: NDArray[np.int64], states: States
) -> None:
    """Write motion at times (us) as CSV: t (s), the components, sigma_<component>, lost (0 or 1).

    Components are those of `COMPONENTS`; a sigma is the square root of its variance.
    """
    names = COMPONENTS[model]
    variance = np.diagonal(states.covariance, axis1=1, axis2=2)
    columns: dict[str, Any] = {"t": times / 1e6}
    columns |= dict(zip(names, states.mean.T, strict=True))
    sigma = np.sqrt(np.maximum(variance, 0))
    columns |= {f"sigma_{name}": s for name, s in zip(names, sigma.T, strict=True)}
    _write_csv(path, columns | {"lost": states.lost.astype(int)})


def write_known(
    path: str | Path, model: str, times: NDArray[np.int64], values: NDArray[np.floating]
) -> None:
    """Write a known motion (times, components) at times (us) as CSV: t (s) and the components."""
    columns = dict(zip(COMPONENTS[model], values.T, strict=True))
    _write_csv(path, {"t": times / 1e6, **columns})


def _write_csv(path: str | Path, columns: Mapping[str, Any]) -> None:
    with complete(Path(path)) as partial:
        pd.DataFrame(dict(columns)).to_csv(partial, index=False)


def write_motion(path: str | Path, motion: Motion, about: Mapping[str, Any] | None = None) -> None:
    """Write the estimates as HDF5: t (us), mean, covariance, lost, lag (s), contrast, evidence.

    The attributes are model, components, units, and what `about` holds, of numbers and texts.
    """
    with complete_hdf5(Path(path)) as (file, _):
        file.attrs["format"] = "jaxevent motion"
        file.attrs["model"] = motion.model
        file.attrs["components"] = COMPONENTS[motion.model]
        file.attrs["units"] = [UNITS.get(name, "1") for name in COMPONENTS[motion.model]]
        for name, value in (about or {}).items():
            file.attrs[name] = value
        for field in dataclasses.fields(motion):
            value = getattr(motion, field.name)
            if isinstance(value, np.ndarray):
                file[field.name] = value
        file["t"].attrs["unit"] = "us on the recording's clock"
        file["lag"].attrs["unit"] = "s"


def write_errors(folder: Path, found: Errors) -> None:
    """Write errors.csv (figure, value, unit) and errors.json into a folder."""
    rows = found.rows()
    _write_csv(folder / "errors.csv", dict(zip(("figure", "value", "unit"), zip(*rows, strict=True),
                                               strict=True)))  # fmt: skip
    table = {name: {"value": _plain(value), "unit": unit} for name, value, unit in rows}
    about = {"times": found.count, "truth": found.truth}
    with complete(folder / "errors.json") as partial:
        partial.write_text(json.dumps({"figures": table, **about}, indent=2) + "\n")


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None


def fitted_velocity(recording: Recording, motion: Motion, span: float | int = 0.02) -> Known:
    """The image velocity at the principal point from poses, at the one depth that fits `motion`.

    U = f (-Omega_y - T_x / Z, Omega_x - T_y / Z): poses do not tell Z, which is found by least
    squares, so that only directions, and changes of the speed, are compared with a truth. Raises
    `InputError` without poses or calibration.
    """
    if recording.poses is None or recording.camera is None:
        raise InputError(
            f"{recording.name}: holds no {'poses' if recording.poses is None else 'calibration'}, "
            "which tell an image velocity; give --truth a table with the columns t, vx, vy"
        )
    twists = from_poses(recording.poses, span)
    f = math.sqrt(recording.camera.fx * recording.camera.fy)
    T, Omega = twists.T, twists.Omega
    assert T is not None
    turn = f * np.stack([-Omega[:, 1], Omega[:, 0]], 1)
    across = -f * T[:, :2]
    states = motion(twists.t)
    use = ~states.lost & np.isfinite(states.mean).all(1)
    square = (across[use] ** 2).sum()
    rho = ((states.mean - turn)[use] * across[use]).sum() / square if square > 0 else 0.0
    return Known("planar", twists.t, turn + max(float(rho), 0.0) * across)


def warped_events(
    recording: Recording,
    motion: Motion,
    events: Events,
    reference: int,
    moved: NDArray[np.floating] | None = None,
) -> NDArray[np.float64]:
    """Where events (n,) would be at the time `reference` (us): (n, 2) px, columns and rows.

    Rotations turn the events' rays by the integral of Omega, image velocities move them by that of
    U. Of general motion `moved` (n, 2) is the flow (px/s) due to translation at each event. Without
    a calibration coordinates are those of pixels, else undistorted ones about the principal point.
    """
    xi, f = coordinates(recording.width, recording.height, recording.camera)
    xy = xi[events.y, events.x]
    since = (events.t - reference) * 1e-6
    # The motion is smooth: its integral on a grid of 1 ms or less.
    low, high = int(events.t.min(initial=reference)), int(events.t.max(initial=reference))
    grid = np.linspace(low, high, 2 + math.ceil((high - low) / 1000))
    mean = np.asarray(motion(np.rint(grid).astype(np.int64), centred=True).mean, float)
    mean = np.nan_to_num(mean)
    steps = (mean[1:] + mean[:-1]) / 2 * np.diff(grid)[:, None] * 1e-6
    total = np.concatenate([np.zeros((1, mean.shape[1])), np.cumsum(steps, 0)])
    way = np.stack(
        [np.interp(events.t, grid, c) - np.interp(reference, grid, c) for c in total.T], 1
    )
    if motion.model == "planar":
        xy = xy - way
    else:
        # A pose is R(t), dR/dt = R [Omega]x, so X(reference) = R(reference)' R(t) X = exp(way) X.
        X = Rotation.from_rotvec(way[:, -3:]).apply(np.c_[xy, np.full(len(xy), f)])
        xy = f * X[:, :2] / np.maximum(X[:, 2:], 1e-3 * f)
    if moved is not None:
        xy = xy - moved * since[:, None]
    centre = _centre(recording)
    return xy + centre


def _centre(recording: Recording) -> NDArray[np.float64]:
    camera = recording.camera
    if camera is None:
        return np.array([(recording.width - 1) / 2, (recording.height - 1) / 2])
    return np.array([camera.cx, camera.cy])


@dataclasses.dataclass(frozen=True)
class Output:
    """What is written of a motion: `output.write(recording, motion, ...)`.

    `path` is a folder for

    - motion.csv: a row for each of `rate` times per second, see `write_motion_table`;
    - motion.h5: the estimates as they were made, see `write_motion`;
    - motion.png: the components over time, with bands of two standard deviations, particles where
      the motion has a cloud of them, and, with a truth, the truth and the errors;
    - warped.png: the events of a short window as they fell and moved back along the motion;
    - errors.csv and errors.json, with a truth: see `Errors`;
    - flow.h5 and flow.png, if `flow` is set: t (us), u, v (px/s) and valid of each event, and the
      window's events in colours of their flow.

    `truth` is "auto" (the recording's poses, else its gyro), the path of a table with the columns
    of motion.csv, or None. `centred` estimates count for the time that what they saw shows. Raises
    `InputError` for settings that are not possible, a place that cannot be written and without the
    extra "plot".
    """

    path: Path
    rate: float | int = 1000.0
    truth: str | Path | None = None
    centred: bool = False
    flow: bool = False

    def __post_init__(self) -> None:
        if not self.path.name or self.path.suffix.lower() in (".csv", ".h5", ".png", ".mp4"):
            raise InputError(
                f"{self.path}: is not a folder's name; the motion is written into a new folder"
            )
        if not 0 < self.rate <= 1e6:
            raise InputError(f"--rate {self.rate:g} is not possible; give times per s, up to 1e6")
        require("matplotlib", "plot")
        # A place that cannot be written is told before the work.
        with contextlib.suppress(_Tried), complete(self.path, directory=True):
            raise _Tried

    def known(
        self, recording: Recording, model: str, bias: NDArray[np.float64] | None = None
    ) -> tuple[Callable[[Motion], Known], str] | None:
        """The truth, given the motion, and what it is, in words; None where none is asked for.

        `bias` (rad/s) is taken off the gyro, which is looked at where there are no poses. Raises
        `InputError` for a truth that is not there.
        """
        if self.truth is None:
            return None
        if self.truth != "auto":
            table = known(recording, model, self.truth)
            return lambda motion: table, str(self.truth)
        if model == "planar" and recording.poses is not None and recording.camera is not None:
            return lambda motion: fitted_velocity(recording, motion), "poses at one fitted depth"
        truth = known(recording, model, "auto", np.zeros(3) if bias is None else bias)
        return lambda motion: truth, "the gyro" if recording.poses is None else "poses"

    def write(
        self,
        recording: Recording,
        motion: Motion,
        about: Mapping[str, Any] = MappingProxyType({}),
        truth: tuple[Callable[[Motion], Known], str] | None = None,
        progress: bool = False,
    ) -> "Written":
        """Write everything, complete or not at all; `about` are attributes of motion.h5."""
        if not len(recording.events):
            raise InputError(f"{recording.name}: holds no events; choose another recording")
        start, stop = _span(recording)
        count = math.floor((stop - start) * self.rate / 1e6 + 1e-9) + 1
        times = start + np.rint(np.arange(count) * (1e6 / self.rate)).astype(np.int64)
        states = motion(times, centred=self.centred)
        told = None if truth is None else truth[0](motion)
        found = None
        if told is not None and truth is not None:
            found = errors(
                motion, told, times, start=start, centred=self.centred, named=truth[1]
            )  # fmt: skip
        outliers = None
        with complete(self.path, directory=True) as folder:
            write_motion_table(folder / "motion.csv", motion.model, times, states)
            write_motion(folder / "motion.h5", motion, about)
            plot_motion(folder / "motion.png", motion, times, told, centred=self.centred)
            if found is not None:
                write_errors(folder, found)
            part = _window(recording, motion)
            flows = None
            if self.flow or motion.model == "general":
                flows = _flow_of(recording, motion, part)
            plot_warped(folder / "warped.png", recording, motion, part, flows)
            if self.flow:
                outliers = _write_flow(folder / "flow.h5", recording, motion, progress)
                assert flows is not None
                plot_flow(folder / "flow.png", recording, part, flows)
            files = sorted(path.name for path in folder.iterdir())
        return Written(files, times, states, motion, found, outliers)


@dataclasses.dataclass(frozen=True)
class Written:
    """What `Output.write` has written: names of files, the rows of motion.csv, errors."""

    files: list[str]
    times: NDArray[np.int64]
    states: States
    motion: Motion
    errors: Errors | None
    outliers: float | None  # percentage of events, where flow was asked for

    def summary(self) -> list[str]:
        """Lines to print: when it was found, means and spreads, errors."""
        lost = self.states.lost
        first = np.flatnonzero(~lost)
        if not len(first):
            return [f"{len(self.motion):,} estimates: the motion was never found"]
        since = (self.times[first[0]] - self.times[0]) * 1e-6
        later = lost[first[0] :].mean()
        lines = [
            f"{len(self.motion):,} estimates, found after {since:.3f} s, then lost "
            f"{100 * later:.2f} % of the time"
        ]
        mean = self.states.mean[first]
        sigma = np.sqrt(np.diagonal(self.states.covariance[first], axis1=1, axis2=2).clip(0))
        cells = [["", "mean", "least", "most", "sigma", ""]]
        for i, name in enumerate(COMPONENTS[self.motion.model]):
            column = mean[:, i]
            numbers = (column.mean(), column.min(), column.max(), np.median(sigma[:, i]))
            cells.append([name, *(f"{number:.4g}" for number in numbers), UNITS.get(name, "")])
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines += [
            "  ".join(cell.rjust(w) for cell, w in zip(line, widths, strict=True)).rstrip()
            for line in cells
        ]
        if self.outliers is not None:
            lines.append(
                f"{self.outliers:.1f} % of the events have no predecessor that it explains"
            )
        if self.errors is not None:
            lines += ["", *self.errors.table()]
        return lines


class _Tried(Exception):
    """Only to leave a block without effect."""


def plot_motion(
    path: str | Path,
    motion: Motion,
    times: NDArray[np.int64],
    truth: Known | None = None,
    *,
    centred: bool = False,
) -> None:
    """Draw the components over times (us) as PNG, against the truth and with errors where known.

    Bands are two standard deviations, grey spans those in which the motion is lost, dots some of
    the particles, where the motion has a `cloud` (estimates, particles, components).
    """
    figure = _figure(path)
    if len(times) > _PLOTTED:
        times = times[np.linspace(0, len(times) - 1, _PLOTTED).astype(int)]
    states = motion(times, centred=centred)
    names, seconds = COMPONENTS[motion.model], times * 1e-6
    general = motion.model == "general"
    judged = _judged(motion.model, times, states, truth)
    trust = np.where(states.lost, np.nan, 1.0)
    extra = judged or _contrasts(motion, times)
    rows, columns = (3, 2) if general else (len(names), 1)
    figure.set_size_inches(6.0 * columns + 2 * (columns == 1), 1.9 * rows + 1.9 * bool(extra))
    grid = figure.subplots(rows + bool(extra), columns, sharex=True, squeeze=False)
    order = [(i % 3, i // 3) for i in range(6)] if general else [(i, 0) for i in range(len(names))]
    sigma = np.sqrt(np.diagonal(states.covariance, axis1=1, axis2=2).clip(0))
    for i, name in enumerate(names):
        axis = grid[order[i]]
        value = states.mean[:, i] * trust
        _cloud(axis, motion, i, centred)
        low, high = value - 2 * sigma[:, i], value + 2 * sigma[:, i]
        axis.fill_between(seconds, low, high, color=_ESTIMATE, alpha=0.25, lw=0)
        axis.plot(seconds, value, color=_ESTIMATE, lw=1.3, label="estimate, 2 sigma")
        seen = [band[np.isfinite(band)] for band in (low, value, high)]
        seen = [np.percentile(band, [2, 98]) for band in seen if len(band)]
        if truth is not None:
            inside = truth.within(times)
            true = truth(times[inside])[:, i]
            axis.plot(seconds[inside], true, color=_TRUE, lw=1.0, ls="--", label="truth")
            seen.append(true)
        unit = UNITS.get(name)
        axis.set_ylabel(f"{name} ({unit})" if unit else name)
        if general and i < 3:
            axis.set_ylim(-1.08, 1.08)
        elif any(map(len, seen)):
            # A component that hardly changes is not enlarged until its noise fills the axis.
            low, high = np.concatenate(seen).min(), np.concatenate(seen).max()
            half = max(0.6 * (high - low), 0.08 * np.abs(states.mean[~states.lost]).max(initial=0))
            axis.set_ylim((low + high) / 2 - half - 1e-9, (low + high) / 2 + half + 1e-9)
    for k, (label, series) in enumerate(extra):
        axis = grid[rows, min(k, columns - 1)]
        axis.plot(seconds, series, color=_ESTIMATE, lw=1.1)
        axis.set_ylabel(label)
        good = series[np.isfinite(series)]
        if len(good):
            axis.set_ylim(0, 1.15 * max(np.percentile(good, 99), 1e-9))
    for axis in grid.ravel():
        _shade(axis, seconds, states.lost)
        axis.spines[["top", "right"]].set_visible(False)
        axis.set_xlim(seconds[0], max(seconds[-1], seconds[0] + 1e-6))
    for axis in grid[-1]:
        axis.set_xlabel("t (s)")
    grid[0, 0].legend(
        fontsize=8, frameon=False, ncols=4, loc="lower left", bbox_to_anchor=(0, 1), borderpad=0.2
    )
    _save(figure, path)


def _judged(
    model: str, times: NDArray[np.int64], states: States, truth: Known | None
) -> list[tuple[str, NDArray[np.float64]]]:
    """Errors over time, with the labels of their axes."""
    if truth is None:
        return []
    inside = truth.within(times) & ~states.lost
    if not inside.any():
        return []
    true, mean = truth(times[inside]), states.mean[inside]

    def spread(values: NDArray) -> NDArray[np.float64]:
        series = np.full(len(times), np.nan)
        series[inside] = values
        return series

    if model == "planar":
        return [("|error| (px/s)", spread(endpoint_error(mean, true)))]
    turned = spread(np.degrees(endpoint_error(mean[:, -3:], true[:, -3:])))
    if model == "rotation":
        return [("|error| (deg/s)", turned)]
    return [
        ("heading error (deg)", spread(axis_error(mean[:, :3], true[:, :3]))),
        ("|error of w| (deg/s)", turned),
    ]


def _contrasts(motion: Motion, times: NDArray[np.int64]) -> list[tuple[str, NDArray[np.float64]]]:
    """Without a truth: how much better than chance the motion explains the events."""
    if not np.isfinite(motion.contrast).any():
        return []
    return [("contrast", np.interp(times, motion.t, np.nan_to_num(motion.contrast)))]


def _cloud(axis: Any, motion: Motion, component: int, centred: bool) -> None:
    cloud = getattr(motion, "cloud", None)
    if cloud is None or not len(cloud):
        return
    keep = np.unique(
        np.linspace(0, len(cloud) - 1, max(1, min(len(cloud), _PARTICLES // cloud.shape[1])))
        .round().astype(int)
    )  # fmt: skip
    t = (motion.t * 1e-6 - (motion.lag if centred else 0))[keep]
    values = cloud[keep][..., component]
    axis.plot(
        np.repeat(t, values.shape[1]), values.ravel(), ".", color=_CLOUD, ms=2.5, mew=0, alpha=0.3,
        zorder=0, rasterized=True,
    )  # fmt: skip
    axis.plot([], [], ".", color=_CLOUD, label="particles")


def _shade(axis: Any, seconds: NDArray, lost: NDArray[np.bool_]) -> None:
    edges = np.flatnonzero(np.diff(np.r_[False, lost, False].astype(int)))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        last = seconds[min(end, len(seconds) - 1)]
        axis.axvspan(seconds[begin], last, color=_LOST, alpha=0.4, lw=0)


@dataclasses.dataclass(frozen=True)
class Window:
    """Rows start to stop of the events, and the time (us) to which they are moved."""

    start: int
    stop: int
    reference: int


def _span(recording: Recording) -> tuple[int, int]:
    """The times (us) of the first and the last event."""
    first, last = (recording.events[i : i + 1].t[0] for i in (0, len(recording.events) - 1))
    return int(first), int(last)


def _window(recording: Recording, motion: Motion) -> Window:
    """In the middle of the recording, or of where the motion is found: 20 to 50 ms.

    So long that the image moves by 8 px, at the median speed over the sensor. Events beyond the
    first half million are left out.
    """
    events = recording.events
    middle = sum(_span(recording)) // 2
    good = motion.t[~motion.lost]
    if len(good) and motion(middle).lost[0]:
        middle = int(good[np.argmin(np.abs(good - middle))])
    states = motion(middle)
    span = _LONGEST
    if not states.lost[0] and np.isfinite(states.mean).all():
        xi, f = coordinates(recording.width, recording.height, recording.camera)
        x, y = xi[::8, ::8].reshape(-1, 2).T
        U = np.broadcast_to(states.mean[0, :2], (len(x), 2))
        if motion.model != "planar":
            U = _turning(x, y, f, np.broadcast_to(states.mean[0, -3:], (len(x), 3)))
        speed = float(np.median(np.hypot(*U.T)))
        span = min(max(_WAY / max(speed, 1e-9), _SHORTEST), _LONGEST)
    half = round(5e5 * span)
    begin = events.index(middle - half)
    end = min(events.index(middle + half), begin + _MOST)
    return Window(begin, end, middle)


def _flow_of(recording: Recording, motion: Motion, part: Window) -> Flow:
    """The flow of a window's events, given those of the 100 ms before, which are candidates."""
    if part.start == part.stop:
        return Flow(np.zeros((0, 2), np.float32), np.zeros(0, bool), np.zeros(0, np.float32))
    begin = recording.events.index(
        int(recording.events[part.start : part.start + 1].t[0]) - 100_000
    )
    cut = dataclasses.replace(recording, events=recording.events[begin : part.stop])
    told = event_flow.flow(cut, motion)
    rows = slice(part.start - begin, None)
    return Flow(told.flow[rows], told.valid[rows], told.residual[rows])


def plot_warped(
    path: str | Path,
    recording: Recording,
    motion: Motion,
    part: Window | None = None,
    flows: Flow | None = None,
) -> None:
    """Draw the events of a window as they fell and moved back along the motion, side by side, PNG.

    Images are sums of polarities under a bilinear kernel, of one grey scale; the titles tell their
    contrast, the variance in the sensor, relative to that of the events as they fell. `flows` are
    of the window's events; general motion needs them for its translation, and events whose flow is
    not known are left out of both images.
    """
    part = part or _window(recording, motion)
    events = recording.events[part.start : part.stop]
    moved = None
    if motion.model == "general":
        flows = flows or _flow_of(recording, motion, part)
        keep = flows.valid
        events = Events(events.t[keep], events.x[keep], events.y[keep], events.p[keep])
        xi, f = coordinates(recording.width, recording.height, recording.camera)
        x, y = xi[events.y, events.x].T
        Omega = motion(events.t, centred=True).mean[:, 3:]
        moved = flows.flow[keep] - _turning(x, y, f, Omega)
    xi, _ = coordinates(recording.width, recording.height, recording.camera)
    shape = recording.height, recording.width
    sign = np.where(events.p, 1.0, -1.0)
    places = (
        xi[events.y, events.x] + _centre(recording),
        warped_events(recording, motion, events, part.reference, moved),
    )
    sign = _padded(sign)
    told = [_image(_padded(xy), sign, shape) for xy in places]
    images, sharp = [np.asarray(one[0]) for one in told], [float(one[1]) for one in told]
    limit = max(np.percentile(np.abs(images[1]), 99.7), 1e-9)
    figure = _figure(path)
    wide = 5.2
    figure.set_size_inches(2 * wide, wide * shape[0] / shape[1] + 0.8)
    span = (int(events.t[-1] - events.t[0]) * 1e-3) if len(events) else 0.0
    figure.suptitle(
        f"{len(events):,} events of {span:.0f} ms at {part.reference * 1e-6:.3f} s", fontsize=10
    )
    gain = sharp[1] / sharp[0] if sharp[0] > 0 else math.nan
    titles = (f"as they fell: contrast {sharp[0]:.3g}", f"warped: {sharp[1]:.3g}, {gain:.2f} times")
    for axis, image, title in zip(figure.subplots(1, 2), images, titles, strict=True):
        axis.imshow(image, cmap="gray", vmin=-limit, vmax=limit, interpolation="nearest")
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    _save(figure, path)


def _padded(array: NDArray) -> NDArray:
    """The rows, and zeros up to a power of two: programs are compiled for few lengths."""
    more = (1 << max(len(array) - 1, 0).bit_length()) - len(array)
    return np.concatenate([array, np.zeros((more, *array.shape[1:]), array.dtype)])


@functools.partial(jax.jit, static_argnums=2)
def _image(xy: Array, weight: Array, shape: tuple[int, int]) -> tuple[Array, Array]:
    image = splat(xy, weight, shape)
    return image, contrast(blur(image, 1))


def _turning(x: NDArray, y: NDArray, f: float, Omega: NDArray) -> NDArray[np.floating]:
    """B Omega (n, 2) at n places."""
    return np.asarray(_flow(_padded(x), _padded(y), f, np.zeros(3), _padded(Omega), 0.0))[: len(x)]


_flow = jax.jit(flow_of_scene)


def plot_flow(path: str | Path, recording: Recording, part: Window, flows: Flow) -> None:
    """Draw a window's events in colours of their flow (PNG): hue the direction, depth the speed.

    The wheel shows which. Events without flow are grey, of several at a pixel the last is drawn.
    """
    from matplotlib.colors import hsv_to_rgb

    events = recording.events[part.start : part.stop]
    speed = np.hypot(*flows.flow.T.astype(float))
    most = float(np.percentile(speed[flows.valid], 95)) if flows.valid.any() else 1.0
    most = max(most, 1e-9)

    def colours(u: NDArray, v: NDArray) -> NDArray:
        hue = (np.arctan2(v, u) / (2 * np.pi)) % 1
        depth = np.clip(np.hypot(u, v) / most, 0, 1)
        return hsv_to_rgb(np.stack([hue, depth, np.ones_like(hue)], -1))

    image = np.full((recording.height, recording.width, 3), 0.06)
    # The middle third of the window: more would smear fast edges.
    third = (events.t[-1] - events.t[0]) // 6 if len(events) else 0
    now = np.abs(events.t - part.reference) <= third
    image[events.y[now], events.x[now]] = 0.35
    ok = flows.valid & now
    image[events.y[ok], events.x[ok]] = colours(*flows.flow[ok].T.astype(float))
    figure = _figure(path)
    wide = 7.0
    figure.set_size_inches(wide + 1.7, wide * recording.height / recording.width + 0.5)
    left, right = figure.subplots(1, 2, width_ratios=(wide, 1.5))
    left.imshow(image, interpolation="nearest")
    left.set_title(f"flow at {part.reference * 1e-6:.3f} s", fontsize=10)
    left.set_axis_off()
    v, u = np.mgrid[-1:1:121j, -1:1:121j] * most
    wheel = np.where((np.hypot(u, v) <= most)[..., None], colours(u, v), 1.0)
    right.imshow(wheel, interpolation="nearest")
    right.set_title(f"{most:.3g} px/s\nat the rim", fontsize=9)
    right.set_axis_off()
    _save(figure, path)


def _write_flow(path: Path, recording: Recording, motion: Motion, progress: bool) -> float:
    """Write the flow of all events, in stretches; returns the percentage of outliers."""
    over = known_count = row = 0
    total = len(recording.events)
    params = event_flow.Params.of({})
    kinds = {"t": np.int64, "u": np.float32, "v": np.float32, "valid": np.bool_}
    with complete_hdf5(path) as (file, check):
        file.attrs["format"] = "jaxevent event flow"
        stored = {name: file.create_dataset(name, (total,), kind) for name, kind in kinds.items()}
        for part in event_flow.iterate(recording, motion, params, progress=progress):
            stop = row + len(part.valid)
            columns = {
                "t": recording.events[row:stop].t, "u": part.flow[:, 0], "v": part.flow[:, 1],
                "valid": part.valid,
            }  # fmt: skip
            for name, column in columns.items():
                stored[name][row:stop] = column
            check()
            known = ~np.isnan(part.residual)
            known_count += int(known.sum())
            over += int((part.residual[known] > float(params.limit)).sum())
            row = stop
        stored["t"].attrs["unit"] = "us on the recording's clock"
        for name in ("u", "v"):
            stored[name].attrs["unit"] = "px/s, undistorted"
        outliers = 100 * over / known_count if known_count else 0.0
        file.attrs["outliers"] = outliers
        file.attrs["limit"] = float(params.limit)
    return outliers


def _figure(path: str | Path) -> Any:
    require("matplotlib", "plot")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Any, path: str | Path) -> None:
    with complete(Path(path)) as partial:
        figure.savefig(partial, format="png", dpi=130)
