"""The result of every estimator of the camera's motion: a `MotionEstimate`, a function of time."""

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from jaxevent.camera import PinholeCamera
from jaxevent.deprecated import renamed_fields, renamed_methods, renamed_names
from jaxevent.display import HtmlRepr, format_count
from jaxevent.egomotion.models import Model, find_model
from jaxevent.estimator import Estimate
from jaxevent.recording import Recording, Times, check_times, microseconds

if TYPE_CHECKING:
    import pandas

# Standard deviation across the velocity, as a fraction of that along it, where parts of the image
# move at several speeds.
TANGENTIAL_SIGMA_RATIO = 0.1
# Relative error of a motion that a calibrated lens leaves: of a rotation, if f is off by 0.5 %, the
# centre by 1 px, k1 by 0.01 and k2 by 0.02 (tests/egomotion/test_model_selection.py).
RELATIVE_LENS_ERROR = 0.01
RELATIVE_FOCAL_ERROR = 0.05  # of a focal length that is given without a calibration
CHANGE_OVER_LAG = 1.0  # error of estimates that lag, relative to the change over twice the lag
MAX_DIRECTION_SIGMA_RAD = 0.15  # standard deviation of a direction that the data determine


def is_observable(model: str | type[Model], covariance: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which components of the motion the data determine.

    A component is not observable if it belongs to a direction whose standard deviation exceeds
    0.15 rad, 9 degrees. All other components are observable.

    Args:
        model: Motion model, or its name.
        covariance: (times, d, d) covariance of the estimates.

    Returns:
        (times, d) booleans.
    """
    observable = np.ones(covariance.shape[:2], bool)
    for part in find_model(model).parts:
        if part.direction:
            variance = np.trace(covariance[:, part.rows, part.rows], axis1=1, axis2=2)
            observable[:, part.rows] = ~(variance > MAX_DIRECTION_SIGMA_RAD**2)[:, None]
    return observable


def lens_error(camera: PinholeCamera | None) -> float:
    """Return the relative error of a motion that the calibration of a camera's lens leaves."""
    return RELATIVE_LENS_ERROR if camera is not None and camera.is_distorted else 0.0


def table_columns(
    model: str | type[Model], times: NDArray[np.int64], estimate: Estimate
) -> dict[str, NDArray]:
    """Arrange a motion as the columns of a table.

    Args:
        model: Motion model of d components, or its name.
        times: (T,) times, us.
        estimate: The motion at these times: mean (T, d), covariance (T, d, d), valid (T,).

    Returns:
        Arrays (T,) by name: t (s), each component, its standard deviation sigma_<component>, and
        lost, 0 or 1. Where the motion is lost the components and their sigmas are NaN, and those of
        a direction where it is not observable.
    """
    names = find_model(model).components
    lost = ~(estimate.valid[:, None] & is_observable(model, estimate.covariance))
    variance = np.diagonal(estimate.covariance, axis1=1, axis2=2)
    columns: dict[str, NDArray] = {"t": times / 1e6}
    columns |= dict(zip(names, np.where(lost, np.nan, estimate.mean).T, strict=True))
    sigma = np.where(lost, np.nan, np.sqrt(np.maximum(variance, 0)))
    columns |= {f"sigma_{name}": s for name, s in zip(names, sigma.T, strict=True)}
    return columns | {"lost": (~estimate.valid).astype(int)}


class CovarianceCalibration(NamedTuple):
    """Coefficients that turn the covariance C of a fit into that of the errors of a motion m.

    The calibrated covariance is

        factor C + share^2 |m|^2 + speed^2 m m' + change^2 (d d' + b b')
            + flow_change^2 (d' M d + b' M b) M^-1.

    Here d is the change of the motion within the time span of an estimate, b the deviation of its
    middle from a straight line, and v' M v the mean square of the flow of a motion v.
    `experiments/studies/predicted_errors.md` has their choice.

    Attributes:
        factor: Factor of the covariance of the fit.
        share: Relative error, the same in all directions.
        speed: Relative error of the size of the motion.
        change: Error as a fraction of the change of the motion, along that change.
        flow_change: Error of the flow as a fraction of its change, along any motion: what of a
            change one component does not follow, others with a like flow take for theirs.
    """

    factor: float = 1.0
    share: float = 0.0
    speed: float = 0.0
    change: float = 0.0
    flow_change: float = 0.0

    def with_lens(self, camera: PinholeCamera | None) -> "CovarianceCalibration":
        """Return the coefficients with the error that the camera's calibration leaves."""
        return self._replace(share=float(np.hypot(self.share, lens_error(camera))))


@renamed_fields(held="n_extended")
@renamed_methods(
    of="from_arrays",
    nothing="empty",
    calibrated="with_calibrated_covariance",
    with_layers="with_flow_consistency",
    within="with_recording",
    reaching="extended_to",
)
@dataclasses.dataclass(frozen=True)
class MotionEstimate(HtmlRepr):
    """An estimated motion, a function of time: `mean, covariance, valid = motion(times)`.

    The components are those of its `model`. Planar motion has the image velocity (px/s), and a
    rotation the camera's angular velocity (rad/s). General motion has the heading, a unit vector,
    then the angular velocity. Axes are the camera's: x to the right, y down, z forward. The
    covariance of a heading is that of small steps across it.

    Attributes:
        model: The motion model, of d components.
        t: (n,) times of the estimates, us, rising.
        mean: (n, d) motions.
        covariance: (n, d, d) covariances of their errors.
        valid: (n,) false during a search and where no event determines the motion.
        lag: (n,) time by which the motion that was observed precedes `t`, s.
        contrast: (n,) agreement of events with the motion, relative to chance; about 1 where the
            motion explains nothing, NaN where the method has no such measure.
        evidence: (n,) log-likelihood of the events since the estimate before; NaN likewise.
        cloud: (n, particles, d) particles drawn by weight, or None.
        agreement: (n,) fraction of the events that the motion explains, or None.
        recording: Name of the recording.
        span: First and last time of the recording, us; None allows all times.
        n_extended: Number of estimates that `extended_to` has added at the ends.
        causal: Whether the motion is read as it is known at a time, without later events.
        model_assumed: Whether the model is the method's first, as none was asked for.
        warning: What `with_flow_consistency` found wrong, "" if nothing; None before it.
    """

    model: type[Model]
    t: NDArray[np.int64]
    mean: NDArray[np.floating]
    covariance: NDArray[np.floating]
    valid: NDArray[np.bool_]
    lag: NDArray[np.floating]
    contrast: NDArray[np.floating]
    evidence: NDArray[np.floating]
    cloud: NDArray[np.floating] | None = None
    agreement: NDArray[np.floating] | None = None
    recording: str = "the recording"
    span: tuple[int, int] | None = None
    n_extended: int = 0
    causal: bool = False
    model_assumed: bool = False
    warning: str | None = None

    @classmethod
    def from_arrays(
        cls,
        model: str | type[Model],
        t: NDArray[np.int64],
        mean: NDArray[np.floating],
        covariance: NDArray[np.floating],
        valid: NDArray[np.bool_] | None = None,
        contrast: NDArray[np.floating] | None = None,
    ) -> "MotionEstimate":
        """Make the result of a method without lag and likelihood.

        Args:
            model: Motion model of d components, or its name.
            t: (n,) times, us, rising.
            mean: (n, d) motions.
            covariance: (n, d, d) covariances.
            valid: (n,) whether the motion was found; by default everywhere.
            contrast: (n,) agreement of events with the motion, relative to chance.

        Returns:
            The estimate.
        """
        n, missing = len(t), np.full(len(t), np.nan)
        valid = np.ones(n, bool) if valid is None else valid
        contrast = missing if contrast is None else contrast
        return cls(find_model(model), t, mean, covariance, valid, np.zeros(n), contrast, missing)

    @classmethod
    def empty(cls, model: str | type[Model]) -> "MotionEstimate":
        """Make the result for a recording without data, with no estimates."""
        n = len(find_model(model).components)
        return cls.from_arrays(model, np.zeros(0, np.int64), np.zeros((0, n)), np.zeros((0, n, n)))

    def with_calibrated_covariance(
        self,
        calibration: CovarianceCalibration,
        length: float | int | NDArray[np.floating] = 0.0,
        lone_change: NDArray[np.floating] | None = None,
        flow_metric: NDArray[np.floating] | None = None,
    ) -> "MotionEstimate":
        """Replace the covariance of the fits by that of the errors.

        Args:
            calibration: The coefficients.
            length: Time span of the data of an estimate, s; one number or (n,).
            lone_change: (d,) or (n, d) change of the motion within the time span, measured there;
                it counts where it is more than that between neighbours.
            flow_metric: (d, d) matrix M of the mean square flow, of any unit; needed where
                `flow_change` is not 0.

        Returns:
            The estimate with the calibrated covariance.
        """
        if not len(self):
            return self
        mean = np.nan_to_num(self.mean)
        half, found = 5e5 * np.broadcast_to(length, self.t.shape), self.valid
        change, bend = np.zeros_like(mean), np.zeros_like(mean)
        if found.sum() > 1:
            t = self.t[found].astype(float)
            begins, ends = self.t - half < t[0], self.t + half > t[-1]
            inner = ~(begins | ends)
            for i, column in enumerate(mean.T):
                early, now, late = (
                    np.interp(self.t + k * half, t, column[found]) for k in (-1, 0, 1)
                )
                # Beyond one end the motion is extrapolated, and bends as it did nearby.
                early = np.where(begins & ~ends, 2 * now - late, early)
                late = np.where(ends & ~begins, 2 * now - early, late)
                change[:, i], bend[:, i] = late - early, late + early - 2 * now
                if inner.any():
                    bend[:, i] = np.interp(self.t, self.t[inner], bend[inner, i])
        if lone_change is not None:
            larger = (lone_change**2).sum(-1) > (change**2).sum(1)
            change = np.where(larger[:, None], lone_change, change)
        covariance = calibration.factor * self.covariance
        for d in (change, bend):
            covariance = covariance + calibration.change**2 * d[:, :, None] * d[:, None, :]
            if flow_metric is not None:
                square = calibration.flow_change**2 * np.einsum("ti,ij,tj->t", d, flow_metric, d)
                covariance = covariance + square[:, None, None] * np.linalg.inv(flow_metric)
        eye = np.eye(mean.shape[1])
        covariance = covariance + calibration.share**2 * (mean**2).sum(1)[:, None, None] * eye
        covariance = covariance + calibration.speed**2 * mean[:, :, None] * mean[:, None, :]
        return dataclasses.replace(self, covariance=covariance)

    def with_focal_error(self) -> "MotionEstimate":
        """Add the error of a focal length without a calibration: turns are as many times wrong.

        Returns:
            The estimate with the larger covariance.
        """
        mean = np.nan_to_num(self.mean)
        for part in self.model.parts:
            if part.figure != "Omega":
                mean[:, part.rows] = 0
        added = RELATIVE_FOCAL_ERROR**2 * mean[:, :, None] * mean[:, None, :]
        return dataclasses.replace(self, covariance=self.covariance + added)

    @property
    def observed_t(self) -> NDArray[np.int64]:
        """(n,) us, times at which the events of the estimates show the motion: `t` less `lag`."""
        return self.t - np.rint(1e6 * self.lag).astype(np.int64)

    def with_flow_consistency(self, recording: Recording) -> tuple["MotionEstimate", str]:
        """Add the spread of the motions of parts of the image to the covariance.

        One velocity of the whole image is at most as certain as its parts are alike. Where they
        differ from a rotation, translation may have caused all of the motion. Where the camera may
        be static while objects move (`still`), the estimate is lost. All methods' `estimate` does
        this, but for causal ones. It is done once: then the estimate is returned as it is.

        Args:
            recording: The recording of the estimate.

        Returns:
            The estimate with the larger covariance, and its `warning`.
        """
        from jaxevent.egomotion.patches import flow_consistency
        from jaxevent.egomotion.still import MotionRows, find_undecided

        if self.warning is not None:
            return self, self.warning
        rows = MotionRows(self.model, self.observed_t, self.mean, self.covariance, self.valid)
        undecided, still = find_undecided(recording, rows)
        if undecided.any():
            unsure = self._with_full_uncertainty().covariance
            covariance = np.where(undecided[:, None, None], unsure, self.covariance)
            valid = self.valid & ~undecided
            return dataclasses.replace(
                self, valid=valid, covariance=covariance, warning=still
            ), still
        found = flow_consistency(recording, self.model) if self.valid.any() else None
        if found is None or not found.is_inconsistent:
            return dataclasses.replace(self, warning=""), ""
        mean = np.nan_to_num(self.mean)
        size2 = (mean**2).sum(1)[:, None, None]
        spread = found.spread if self.model.uniform else 1.0
        along = spread**2 * mean[:, :, None] * mean[:, None, :]
        across = (spread * TANGENTIAL_SIGMA_RATIO) ** 2 * size2 * np.eye(mean.shape[1])
        expected = "as one" if self.model.uniform else "as a rotation makes it"
        cause, other = "at several depths", "general"
        if self.model.uniform and found.both_directions:
            cause, other = "both ways if the camera rolls", "rotation"
        needs = "" if recording.camera else ", which needs the camera's focal length,"
        line = (
            f"the image does not move {expected}: parts of it move at {found.slow:.0f} to "
            f"{found.fast:.0f} px/s, as {cause}; sigmas include that, and the model {other}{needs} "
            "may explain it"
        )
        covariance = self.covariance + along + across
        return dataclasses.replace(self, covariance=covariance, warning=line), line

    def _with_full_uncertainty(self) -> "MotionEstimate":
        """Add the whole motion to the covariance: it may not be the camera's at all."""
        covariance, mean = self.covariance.copy(), np.nan_to_num(self.mean)
        for part in self.model.parts:
            m = mean[:, part.rows]
            own = m[:, :, None] * m[:, None, :]
            across = TANGENTIAL_SIGMA_RATIO**2 * (m**2).sum(1)
            own = own + across[:, None, None] * np.eye(m.shape[1])
            covariance[:, part.rows, part.rows] += np.eye(3) if part.direction else own
        return dataclasses.replace(self, covariance=covariance)

    def with_recording(self, recording: Recording) -> "MotionEstimate":
        """Set the name and the time span from a recording."""
        span = None
        if len(recording.events) or recording.frames:
            span = recording.start, recording.stop
        return dataclasses.replace(self, recording=recording.name, span=span)

    def extended_to(
        self, first: int, last: int, rate: NDArray[np.floating] | None = None
    ) -> "MotionEstimate":
        """Add estimates before and after all others, with the motion of the nearest one.

        Their covariance grows with the time in between. None is added next to a lost estimate.

        Args:
            first: Time of the added first estimate, us.
            last: Time of the added last estimate, us.
            rate: (d, d) growth of the covariance per us^2; by default the mean square change
                between the estimates.

        Returns:
            The longer estimate.
        """
        if not len(self):
            return self
        rate = self._change_rate() if rate is None else rate
        early = bool(self.valid[0] and first < self.t[0])
        late = bool(self.valid[-1] and last > self.t[-1])
        rows = np.r_[[0] * early, : len(self), [len(self) - 1] * late].astype(int)
        arrays = {
            field.name: value[rows]
            for field in dataclasses.fields(self)
            if isinstance(value := getattr(self, field.name), np.ndarray)
        }
        for row, at, added in ((0, first, early), (-1, last, late)):
            if added:
                arrays["covariance"][row] += float(at - arrays["t"][row]) ** 2 * rate
                arrays["t"][row] = at
        return dataclasses.replace(self, **arrays, n_extended=self.n_extended + early + late)

    def _change_rate(self) -> NDArray[np.float64]:
        """Return the mean square (d, d) of changes between successive estimates, per us^2."""
        found = np.flatnonzero(self.valid & np.isfinite(self.mean).all(1))
        change, dt = np.diff(self.mean[found].astype(float), axis=0), np.diff(self.t[found])
        return change.T @ change / max(float(dt.astype(float) @ dt), 1.0)

    def to_dataframe(
        self, times: Times | None = None, *, centred: bool | None = None
    ) -> "pandas.DataFrame":
        """Make a pandas table of the motion, with the columns that `jaxevent motion` writes as CSV.

        Args:
            times: Integers (us) or floats (s); by default the table holds the estimates themselves.
            centred: See the call.

        Returns:
            A row for each time. The columns are t (s), the model's components, their standard
            deviations sigma_<component>, and lost (0 or 1). The numbers are NaN where it is 1.
            `attrs["units"]` has the unit of each column.

        Raises:
            InputError: A time is not finite or outside the recording.
        """
        import pandas

        if times is None:
            us, estimate = self.t, self._without_undecided(self.mean, self.covariance, self.valid)
        else:
            us, estimate = np.atleast_1d(microseconds(times)), self(times, centred=centred)
        table = pandas.DataFrame(table_columns(self.model, us, estimate))
        units = dict(zip(self.model.components, self.model.units, strict=True))
        sigmas = {f"sigma_{name}": unit for name, unit in units.items()}
        table.attrs["units"] = {"t": "s", **units, **sigmas, "lost": "1"}
        return table

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        lost = int((~self.valid).sum())
        model = f"{self.model.name}{' assumed' if self.model_assumed else ''}"
        return f"MotionEstimate({model}, {format_count(len(self), 'estimate')}, {lost} lost)"

    def __call__(
        self, times: Times, *, centred: bool | None = None, extrapolate: bool = False
    ) -> Estimate:
        """Return the motion at some times.

        Means and covariances are interpolated linearly between the estimates before and after, and
        directions scaled to unit vectors. Before the first and after the last estimate the mean is
        constant, and the covariance grows by the mean square change of the motion in that time.

        Args:
            times: Integers (us) or floats (s).
            centred: Whether an estimate holds for the time `lag` before its own, when the motion
                was observed. This is a fixed-lag estimate, of events up to `lag` later. By default
                it does unless the estimate is causal. Without, the covariance includes the change
                of the motion meanwhile.
            extrapolate: Whether times outside the recording are allowed.

        Returns:
            An `Estimate` of mean (times, d), covariance (times, d, d) and valid (times,). Invalid
            are times next to a lost estimate, before the first one, and outside the recording.
            There the mean is NaN, and so are the components of an unobservable direction.

        Raises:
            InputError: A time is not finite, or outside the recording without `extrapolate`.
        """
        times = np.atleast_1d(microseconds(times))
        inside = np.ones(len(times), bool)
        if self.span is not None:
            if not extrapolate:
                check_times(times, *self.span, self.recording)
            inside = (times >= self.span[0]) & (times <= self.span[1])
        n, d = self.mean.shape
        if n == 0:
            missing = np.full((len(times), d), np.nan), np.full((len(times), d, d), np.nan)
            return Estimate(*missing, np.zeros(len(times), bool))
        if centred is None:
            centred = not self.causal
        at = self.t - (1e6 * self.lag if centred else 0)
        at = np.maximum.accumulate(at)
        row = np.searchsorted(at, times, "right")
        after, before = np.minimum(row, n - 1), np.maximum(row - 1, 0)
        gap = at[after] - at[before]
        fraction = np.where(gap > 0, (times - at[before]) / np.where(gap > 0, gap, 1), 0)
        fraction = np.clip(fraction, 0, 1)
        mean = self.model.interpolate(self.mean[before], self.mean[after], fraction)
        fraction = fraction[:, None, None]
        covariance = (1 - fraction) * self.covariance[before] + fraction * self.covariance[after]
        covariance = covariance + self._bend_between(at, times, before, after)
        beyond = np.maximum(at[0] - times, 0) + np.maximum(times - at[-1], 0)
        if beyond.any():
            covariance = covariance + beyond[:, None, None] ** 2 * self._change_rate()
        if not centred and self.lag.any():
            covariance = covariance + self._change_over_lag(times, mean, before)
        valid = self.valid[before] & self.valid[after] & (times >= at[0]) & inside
        valid &= np.isfinite(mean).all(1) & np.isfinite(covariance).all((1, 2))
        return self._without_undecided(mean, covariance, valid)

    def _bend_between(
        self,
        at: NDArray,
        times: NDArray[np.int64],
        before: NDArray[np.integer],
        after: NDArray[np.integer],
    ) -> NDArray[np.float64]:
        """Return the covariance of a motion that bends between estimates.

        The error of the straight line is c (t - t_before) (t_after - t) / 2, with c the mean of the
        second derivatives at both. Those of causal estimates are of the two estimates before.

        Args:
            at: (n,) times of the estimates, us.
            times: (times,) us.
            before: (times,) estimate before each time.
            after: (times,) estimate after each time.

        Returns:
            (times, d, d).
        """
        n, d = self.mean.shape
        c = np.zeros((n, d))
        late = int(self.causal)
        if n > 2:
            # Of estimates very near to each other, whose differences are noise, the next farther.
            step = maximum_filter1d(np.maximum(np.diff(at), 1.0), 3, origin=late)[:, None]
            slope = np.diff(np.nan_to_num(self.mean), axis=0) / step
            inner = np.diff(slope, axis=0) / np.maximum(step[1:], step[:-1])
            is_inner = self.valid[2:] & self.valid[1:-1] & self.valid[:-2]
            c[1 + late : n - 1 + late] = np.where(is_inner[:, None], inner, 0)
            if not self.causal:
                c[0], c[-1] = c[1], c[-2]
        reach = np.maximum(times - at[before], 0) * np.maximum(at[after] - times, 0) / 2
        off = reach[:, None] * (c[before] + c[after]) / 2
        return off[:, :, None] * off[:, None, :]

    def _change_over_lag(
        self, times: NDArray[np.int64], mean: NDArray[np.floating], row: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the covariance of the change while estimates lag.

        The filter follows what its candidates show as late as these precede it, so the change is
        that over twice the lag, as it was before.

        Args:
            times: (times,) us.
            mean: (times, d) motions at these times.
            row: (times,) estimate whose lag counts.

        Returns:
            (times, d, d).
        """
        past = times - 2e6 * self.lag[row]
        found = self.valid & np.isfinite(self.mean).all(1)
        if not found.any():
            return np.zeros((*mean.shape, mean.shape[1]))
        change = mean - np.stack([np.interp(past, self.t[found], c) for c in self.mean[found].T], 1)
        return CHANGE_OVER_LAG**2 * change[:, :, None] * change[:, None, :]

    def _without_undecided(
        self,
        mean: NDArray[np.floating],
        covariance: NDArray[np.floating],
        valid: NDArray[np.bool_],
    ) -> Estimate:
        """Make an estimate whose mean is NaN where it is lost or not observable.

        Args:
            mean: (T, d) motion.
            covariance: (T, d, d) its covariance.
            valid: (T,) false where the motion is lost.

        Returns:
            The estimate; covariance and `valid` are as given.
        """
        is_known = valid[:, None] & is_observable(self.model, covariance)
        return Estimate(np.where(is_known, mean, np.nan), covariance, valid)

    def _with_gaps(self, longest: float) -> "MotionEstimate":
        """Add a lost estimate in each pause between estimates that is longer (s).

        Nothing is known of the motion while no event comes.
        """
        at = np.flatnonzero(np.diff(self.t) > 1e6 * longest)
        if not len(at):
            return self
        rows = np.insert(np.arange(len(self)), at + 1, at)
        added = at + 1 + np.arange(len(at))
        arrays = {
            field.name: value[rows]
            for field in dataclasses.fields(self)
            if isinstance(value := getattr(self, field.name), np.ndarray)
        }
        arrays["t"][added] += round(1e6 * longest)
        arrays["valid"][added] = False
        return dataclasses.replace(self, **arrays)


__getattr__ = renamed_names(__name__)
