"""Files of an estimated motion: tables, HDF5, and the figures of `motion_figures`."""

import dataclasses
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from jaxevent.display import format_count
from jaxevent.egomotion import flow as event_flow
from jaxevent.egomotion.live import LiveMotion
from jaxevent.egomotion.models import Model, find_model
from jaxevent.egomotion.motion import MotionEstimate, is_observable, table_columns
from jaxevent.egomotion.scores import MotionScores, find_gyro_axes, score_motion
from jaxevent.egomotion.truth import (
    KnownMotion,
    fit_gyro_bias,
    known_motion,
    twists_from_poses,
)
from jaxevent.errors import InputError, MissingExtra, require
from jaxevent.estimator import Estimate
from jaxevent.io.output import CLOCK_UNIT, check_writable, complete, complete_hdf5, finite
from jaxevent.metrics import MEASURE_MEANINGS
from jaxevent.parameters import Parameters
from jaxevent.recording import Recording
from jaxevent.show.images import save_figure
from jaxevent.show.motion_figures import (
    motion_figure,
    plot_flow,
    plot_warped,
    representative_window,
    window_flow,
)
from jaxevent.show.tables import align_cells
from jaxevent.show.track_tables import check_rate


def write_motion_table(
    path: str | Path, model: str | type[Model], times: NDArray[np.int64], estimated: Estimate
) -> None:
    """Write a motion as CSV: t (s), the components, sigma_<component>, lost (0 or 1).

    sigma is the square root of a component's variance. Where the motion is lost, both are empty.

    Args:
        path: File that is written.
        model: Motion model, or its name.
        times: (T,) us.
        estimated: The motion at these times.
    """
    _write_csv(path, table_columns(model, times, estimated))


class LiveTable:
    """Table of a live motion, made row by row, with the columns of `write_motion_table`.

    Args:
        live: The live motion.
        rate: Rows per second, from the first event on.

    Raises:
        InputError: The rate is not possible.
    """

    def __init__(self, live: LiveMotion, rate: float):
        check_rate(rate)
        self._live, self._period, self._count, self._first = live, 1e6 / rate, 0, 0

    def rows(self) -> str:
        """Return the lines of CSV that are new; the first call with lines adds the header."""
        motion = self._live.motion
        if not len(motion):
            return ""
        if not self._count:
            self._first = self._live.start
        last = math.floor((int(motion.t[-1]) - self._first) / self._period + 1e-9)
        steps = np.arange(self._count, last + 1)
        times = self._first + np.rint(steps * self._period).astype(np.int64)
        if not len(times):
            return ""
        columns = table_columns(motion.model, times, motion(times, extrapolate=True))
        text = pd.DataFrame(columns).to_csv(index=False, header=not self._count)
        self._count = last + 1
        return text


def write_known_motion(
    path: str | Path,
    model: str | type[Model],
    times: NDArray[np.int64],
    values: NDArray[np.floating],
) -> None:
    """Write a known motion as CSV: t (s) and the components.

    Args:
        path: File that is written.
        model: Motion model, or its name.
        times: (T,) us.
        values: (T, components).
    """
    columns = dict(zip(find_model(model).components, values.T, strict=True))
    _write_csv(path, {"t": times / 1e6, **columns})


def _write_csv(path: str | Path, columns: Mapping[str, Any]) -> None:
    """Write columns as CSV.

    Args:
        path: The file.
        columns: (n,) columns by name.
    """
    with complete(Path(path)) as partial:
        pd.DataFrame(dict(columns)).to_csv(partial, index=False)


def write_motion(
    path: str | Path,
    motion: MotionEstimate,
    about: Mapping[str, Any] | None = None,
    method: str | None = None,
    params: Parameters | None = None,
) -> None:
    """Write the estimates as HDF5: t (us), mean, covariance, lost, lag (s), contrast and others.

    The attributes are recording, model, components, units, and those of `jaxevent.io.output`.

    Args:
        path: File that is written.
        motion: The motion.
        about: Further attributes, numbers and texts.
        method: Name of the method that estimated the motion.
        params: Parameters of the method.
    """
    units = {
        "t": CLOCK_UNIT, "mean": "units", "covariance": "units[i] units[j]", "lost": "1",
        "lag": "s",
        "contrast": "1", "evidence": "1, of a natural logarithm", "cloud": "units",
        "agreement": "1",
    }  # fmt: skip
    with complete_hdf5(Path(path), method, params) as (file, _):
        file.attrs["format"] = "jaxevent motion"
        file.attrs["recording"] = motion.recording
        file.attrs["model"] = motion.model.name
        file.attrs["components"] = motion.model.components
        file.attrs["units"] = motion.model.units
        for name, value in (about or {}).items():
            file.attrs[name] = value
        for field in dataclasses.fields(motion):
            value = getattr(motion, field.name)
            if isinstance(value, np.ndarray) and field.name != "valid":
                file[field.name] = value
        file["lost"] = ~motion.valid
        for name, unit in units.items():
            if name not in file:
                continue
            file[name].attrs["unit"] = unit
            if unit.startswith("units"):
                file[name].attrs["columns"] = motion.model.components
                file[name].attrs["units"] = motion.model.units


def write_errors(folder: Path, errors: MotionScores) -> None:
    """Write errors.csv (figure, value, unit) and errors.json into a folder."""
    rows = errors.rows()
    _write_csv(folder / "errors.csv", dict(zip(("figure", "value", "unit"), zip(*rows, strict=True),
                                               strict=True)))  # fmt: skip
    table = {
        name: {"value": finite(value), "unit": unit, "meaning": MEASURE_MEANINGS[name]}
        for name, value, unit in rows
    }
    about = {"times": errors.count, "truth": errors.truth}
    with complete(folder / "errors.json") as partial:
        partial.write_text(json.dumps({"figures": table, **about}, indent=2) + "\n")


def motion_at_fitted_depth(
    recording: Recording, motion: MotionEstimate, span: float | int = 0.02
) -> KnownMotion:
    """Convert poses to an image velocity, at the one depth of the scene that best fits an estimate.

    Poses do not determine the depth. So only the direction of the estimate, and changes of its
    speed, are tested. See `Model.from_twists_at_fitted_depth`.

    Args:
        recording: Recording with poses and calibration.
        motion: The estimate.
        span: Time over which poses are differentiated, s.

    Raises:
        InputError: The recording has no poses or no calibration.
    """
    model = motion.model
    if recording.poses is None or recording.camera is None:
        raise InputError(
            f"{recording.name}: holds no {'poses' if recording.poses is None else 'calibration'}, "
            f"which determine an {model.parts[0].name}"
            f"{recording.describe_left_out('poses') or recording.describe_left_out('camera')}; "
            f"give --truth a table with the columns {', '.join(('t', *model.components))}"
        )
    twists = twists_from_poses(recording.poses, span)
    f = math.sqrt(recording.camera.fx * recording.camera.fy)
    mean, _, valid = motion(twists.t, extrapolate=True)
    mean = np.where(valid[:, None], mean, np.nan)
    return KnownMotion(model, twists.t, model.from_twists_at_fitted_depth(twists, f, mean))


class ReferenceMotion(NamedTuple):
    """Known motion with which an estimate is compared."""

    known: KnownMotion
    source: str  # in words, such as "poses"
    notes: tuple[str, ...] = ()  # lines to print about it


def prepare_gyro_reference(
    truth: KnownMotion, motion: MotionEstimate, unbiased: bool
) -> ReferenceMotion:
    """Prepare the angular velocity of a gyro for the comparison with an estimate.

    If the bias is unknown, the constant that best fits the estimate is subtracted. If other axes of
    the gyro fit far better, a note names them.

    Args:
        truth: Angular velocity measured by the gyro.
        motion: The estimate.
        unbiased: Whether a known bias is already subtracted.
    """
    estimated = motion(truth.t, centred=True, extrapolate=True)
    rows = estimated.valid & np.isfinite(estimated.mean).all(1)
    source, notes = "the gyro", []
    if not rows.any():
        return ReferenceMotion(truth, source)
    estimate, measured = estimated.mean[rows], truth.values[rows]
    axes = find_gyro_axes(motion, truth)
    truth = dataclasses.replace(truth, assumes_camera_axes=False)  # the note is enough
    if axes is not None:
        notes.append(
            f"the gyro is like the estimate in other axes: give --imu-rotation {axes} if they are "
            "its own"
        )
    elif not unbiased:
        bias = fit_gyro_bias(estimate, measured)
        source = "the gyro without its bias"
        notes.append(
            f"a constant of {', '.join(f'{v:+.3f}' for v in bias)} rad/s was subtracted from the "
            "gyro: its bias, or the estimate's; --still S,S distinguishes them"
        )
        truth = dataclasses.replace(truth, values=truth.values - bias)
    return ReferenceMotion(truth, source, tuple(notes))


@dataclasses.dataclass(frozen=True)
class Output:
    """Folder to which a motion is written by `output.write(recording, motion, ...)`.

    The folder `path` gets

    - motion.csv: `rate` rows per second, see `write_motion_table`;
    - motion.h5: the estimates at their own times, see `write_motion`;
    - motion.png: the components over time, see `motion_figure`;
    - warped.png: the events of a short window before and after warping along the motion;
    - errors.csv and errors.json, with a truth: see `MotionScores`;
    - flow.h5 and flow.png, if `flow` is set: t (us), u, v (px/s) and valid of each event, and the
      window's events in colours of their flow.

    `truth` is "auto" (the recording's poses, else its gyro), the path of a table with the columns
    of motion.csv, or None. `centred` estimates hold at the middle of the events that they use.
    Without the extra "plot" there are no figures. `InputError` is raised for invalid settings and
    for a path that cannot be written.
    """

    path: Path
    rate: float | int = 1000.0
    truth: str | Path | None = None
    centred: bool | None = None
    flow: bool = False

    def __post_init__(self) -> None:
        if not self.path.name or self.path.suffix.lower() in (".csv", ".h5", ".png", ".mp4"):
            raise InputError(
                f"{self.path}: is not a folder's name; the motion is written into a new folder"
            )
        check_rate(self.rate)
        check_writable(self.path, directory=True)

    def make_reference(
        self,
        recording: Recording,
        model: str | type[Model],
        bias: NDArray[np.float64] | None = None,
        rotation: NDArray[np.float64] | None = None,
        depth: float | int | None = None,
    ) -> Callable[[MotionEstimate], ReferenceMotion] | None:
        """Return a function from an estimate to the motion it is compared with; None without truth.

        A gyro is used if there are no poses, see `prepare_gyro_reference`.

        Args:
            recording: Recording of the motion.
            model: Motion model, or its name.
            bias: (3,) rad/s, bias of the gyro; None if unknown.
            rotation: (3, 3) from the gyro's axes to the camera's; None if unknown.
            depth: Depth of the scene, m.

        Raises:
            InputError: The recording does not hold the truth.
        """
        if self.truth is None:
            return None
        model = find_model(model)
        if self.truth != "auto":
            table = ReferenceMotion(known_motion(recording, model, self.truth), str(self.truth))
            return lambda motion: table
        if depth is not None:
            at = ReferenceMotion(
                known_motion(recording, model, depth=depth), f"poses at the depth {depth:g} m"
            )
            return lambda motion: at
        if model.fits_depth and recording.poses is not None and recording.camera is not None:
            source = "poses at one fitted depth"
            return lambda motion: ReferenceMotion(motion_at_fitted_depth(recording, motion), source)
        zero = np.zeros(3) if bias is None else bias
        truth = known_motion(recording, model, "auto", zero, rotation=rotation)
        if recording.poses is not None:
            return lambda motion: ReferenceMotion(truth, "poses")
        return lambda motion: prepare_gyro_reference(truth, motion, bias is not None)

    def write(
        self,
        recording: Recording,
        motion: MotionEstimate,
        about: Mapping[str, Any] = MappingProxyType({}),
        truth: Callable[[MotionEstimate], ReferenceMotion] | None = None,
        *,
        progress: bool | None = None,
        method: str | None = None,
        params: Parameters | None = None,
    ) -> "WrittenMotion":
        """Write all files; if anything fails, none is written.

        Args:
            recording: Recording of the motion.
            motion: The motion.
            about: Further attributes of motion.h5.
            truth: Function that `make_reference` returned.
            progress: Whether to show a bar; None shows it in a terminal or notebook.
            method: Name of the method that estimated the motion.
            params: Parameters of the method.
        """
        start, stop = recording.event_span()
        count = math.floor((stop - start) * self.rate / 1e6 + 1e-9) + 1
        times = start + np.rint(np.arange(count) * (1e6 / self.rate)).astype(np.int64)
        estimated = motion(times, centred=self.centred)
        true = None if truth is None else truth(motion)
        errors = None
        if true is not None:
            errors = score_motion(
                motion,
                true.known,
                times,
                start=start,
                centred=self.centred,
                description=true.source,
            )
            errors = dataclasses.replace(errors, notes=true.notes)
        outliers = None
        with complete(self.path, directory=True) as folder:
            write_motion_table(folder / "motion.csv", motion.model, times, estimated)
            write_motion(folder / "motion.h5", motion, about, method, params)
            if errors is not None:
                write_errors(folder, errors)
            if self.flow:
                outliers = _write_flow(folder / "flow.h5", recording, motion, progress)
            left_out = None
            try:
                require("matplotlib", "plot")
            except MissingExtra as missing:
                left_out = str(missing)
            else:
                shown = None if true is None else true.known
                figure = motion_figure(motion, times, shown, centred=self.centred)
                save_figure(figure, folder / "motion.png", dpi=130)
                self._draw_window(folder, recording, motion)
            files = sorted(path.name for path in folder.iterdir())
        return WrittenMotion(files, times, estimated, motion, errors, outliers, left_out)

    def _draw_window(self, folder: Path, recording: Recording, motion: MotionEstimate) -> None:
        """Draw the events of a short window before and after warping, and in colours of flow."""
        part = representative_window(recording, motion)
        flows = None
        if self.flow or motion.model.half_line:
            flows = window_flow(recording, motion, part)
        plot_warped(folder / "warped.png", recording, motion, part, flows)
        if self.flow and flows is not None:
            plot_flow(folder / "flow.png", recording, part, flows)


@dataclasses.dataclass(frozen=True)
class WrittenMotion:
    """Result of `Output.write`: names of files, the rows of motion.csv, errors."""

    files: list[str]
    times: NDArray[np.int64]  # (rows,) us
    estimated: Estimate
    motion: MotionEstimate
    errors: MotionScores | None
    outliers: float | None  # percentage of events, where flow was asked for
    left_out: str | None = None  # the reason why there are no figures

    def summary(self) -> list[str]:
        """Return a summary to print: times with a motion, components, errors, missing figures."""
        lines = self._describe_motion()
        if self.left_out is not None:
            lines += ["", f"pictures are left out: {self.left_out}"]
        return lines

    def _format_count(self) -> str:
        """Format the number of estimates, without extensions to the ends of the events."""
        number = len(self.motion) - self.motion.n_extended
        return format_count(number, "estimate")

    def _describe_motion(self) -> list[str]:
        """Return lines about the times when the motion was found, its components and its errors."""
        lost = ~self.estimated.valid
        first = np.flatnonzero(~lost)
        if not len(first):
            advice = "another --model or --method, or --params of other windows, may find it"
            said = [] if self.motion.warning else [advice]
            return [f"{self._format_count()}: the motion was never found", *said]
        since = (self.times[first[0]] - self.times[0]) * 1e-6
        later = lost[first[0] :].mean()
        lines = [
            f"{self._format_count()}, found after {since:.3f} s, "
            f"then lost {100 * later:.2f} % of the time"
        ]
        mean = self.estimated.mean[first]
        sigma = np.sqrt(np.diagonal(self.estimated.covariance[first], axis1=1, axis2=2).clip(0))
        cells = [["", "mean", "least", "most", "sigma", ""]]
        model = self.motion.model
        observable = is_observable(model, self.estimated.covariance[first])
        for i, (name, unit) in enumerate(zip(model.components, model.units, strict=True)):
            column = mean[observable[:, i], i]
            numbers = (column.mean(), column.min(), column.max()) if len(column) else ()
            texts = [f"{number:.4g}" for number in numbers] or ["unobservable", "", ""]
            usual = f"{np.median(sigma[:, i]):.4g}"
            cells.append([name, *texts, usual, "" if unit == "1" else unit])
        lines += align_cells(cells)
        lines.append(
            "mean, least and most over the times found; sigma: median of the standard deviations"
        )
        for part in model.parts:
            if part.direction:
                unknown = ~observable[:, part.rows].all(1)
                if unknown.any():
                    lines.append(
                        f"translation is not observable {100 * unknown.mean():.0f} % of the time: "
                        f"rotation alone explains the events, and the {part.name} is unknown"
                    )
        if self.outliers is not None:
            lines.append(
                f"{self.outliers:.1f} % of the events have no predecessor on the motion's path"
            )
        if self.errors is not None:
            lines += ["", *self.errors.table()]
        return lines


def _write_flow(
    path: Path, recording: Recording, motion: MotionEstimate, progress: bool | None
) -> float:
    """Write the flow of all events, and return the percentage of outliers."""
    over = known_count = row = 0
    total = len(recording.events)
    params = event_flow.Params.of({})
    kinds = {"t": np.int64, "u": np.float32, "v": np.float32, "valid": np.bool_}
    with complete_hdf5(path, "flow", params) as (file, check):
        file.attrs["format"] = "jaxevent event flow"
        stored = {name: file.create_dataset(name, (total,), kind) for name, kind in kinds.items()}
        for part in event_flow.iterate_flow(recording, motion, params, progress=progress):
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
        units = {"t": CLOCK_UNIT, "u": "px/s, undistorted", "v": "px/s, undistorted", "valid": "1"}
        for name, unit in units.items():
            stored[name].attrs["unit"] = unit
        outliers = 100 * over / known_count if known_count else 0.0
        file.attrs["outliers"] = outliers
    return outliers
