"""What every estimator of the camera's motion gives: a `Motion`, which answers at any time."""

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.display import HtmlRepr
from jaxevent.egomotion.models import Model, find_model
from jaxevent.estimator import Estimate
from jaxevent.recording import Recording, Times, check_times, microseconds

if TYPE_CHECKING:
    import pandas

ACROSS = 0.1  # of the spread of speeds at several depths, that of the velocity across them
# Of a motion, what a lens that was calibrated leaves: of a rotation, that f is off by 0.5 %, the
# centre by 1 px, k1 by 0.01 and k2 by 0.02 (tests/egomotion/test_egomotion_patches.py).
LENS = 0.01
UNDECIDED = 1.0  # rad, standard deviation of a direction that is not told


def decided(model: str | type[Model], covariance: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether components are told, (times, d): those of a direction are not where it is any."""
    told = np.ones(covariance.shape[:2], bool)
    for part in find_model(model).parts:
        if part.direction:
            spread = np.trace(covariance[:, part.rows, part.rows], axis1=1, axis2=2)
            told[:, part.rows] = ~(spread > UNDECIDED**2)[:, None]
    return told


def left_by_lens(camera: PinholeCamera | None) -> float:
    """The share of a motion that a camera's calibration leaves: `LENS` if its lens distorts."""
    return LENS if camera is not None and camera.is_distorted else 0.0


def table_columns(
    model: str | type[Model], times: NDArray[np.int64], told: Estimate
) -> dict[str, NDArray]:
    """Arrange a motion as the columns of a table.

    Args:
        model: Its model, of d components.
        times: (T,), us.
        told: The motion at these times: mean (T, d), covariance (T, d, d), valid (T,).

    Returns:
        Arrays (T,) by name: t (s), each component, its standard deviation sigma_<component>, and
        lost, 0 or 1. Where it is lost the components and their sigmas are NaN.
    """
    names = find_model(model).components
    lost = ~told.valid[:, None]
    variance = np.diagonal(told.covariance, axis1=1, axis2=2)
    columns: dict[str, NDArray] = {"t": times / 1e6}
    columns |= dict(zip(names, np.where(lost, np.nan, told.mean).T, strict=True))
    sigma = np.where(lost, np.nan, np.sqrt(np.maximum(variance, 0)))
    columns |= {f"sigma_{name}": s for name, s in zip(names, sigma.T, strict=True)}
    return columns | {"lost": (~told.valid).astype(int)}


class Calibration(NamedTuple):
    """What errors are made of beside the covariance C of a fit of a motion m:

    factor C + share^2 |m|^2 + speed^2 m m' + change^2 (d d' + b b'),

    d the change of the motion within what an estimate sees and b by how much it bends there.
    See `experiments/studies/predicted_errors.md` for their choice. `behind` adds what a real
    lens makes.
    """

    factor: float = 1.0
    share: float = 0.0
    speed: float = 0.0  # likewise, of motions that are told too slow or too fast
    change: float = 0.0

    def behind(self, camera: PinholeCamera | None) -> "Calibration":
        """The same, with what a camera's calibration leaves."""
        return self._replace(share=float(np.hypot(self.share, left_by_lens(camera))))


@dataclasses.dataclass(frozen=True)
class Motion(HtmlRepr):
    """An estimated motion: `mean, covariance, valid = motion(times)`.

    The components are those of its `model`: of planar motion the image velocity (px/s), of a
    rotation the camera's angular velocity (rad/s), of general motion its heading, a unit vector,
    and then its angular velocity, in the camera's axes, x to the right, y down, z forward. The
    covariance of a heading is that of small steps across it.

    Arrays by estimate, n of them: `t` (us), at which it was made, of rising order; `mean`
    (n, d); `covariance` (n, d, d); `valid`, false while the motion is being searched for or no
    event tells it; `lag` (s) by which what was seen is older than `t`; `contrast`, how much better
    the motion explains the events than chance would, about 1 where it does not; `evidence`, the
    log-likelihood of the events since the estimate before. The last two are NaN where an estimator
    has none. `agreement` (n,), where an estimator tells it, is the share of the events that the
    motion explains. `cloud` (n, particles, d), where it was asked for, is some of a filter's
    particles: the likelier a motion, the more of them are near it. `recording` is the recording's
    name and `span` (us) from when to when it lasts; without a span, all times may be asked for.
    Of the estimates `held`, at the ends, repeat the one beside (`reaching`).
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
    held: int = 0

    @classmethod
    def of(
        cls,
        model: str | type[Model],
        t: NDArray[np.int64],
        mean: NDArray[np.floating],
        covariance: NDArray[np.floating],
        valid: NDArray[np.bool_] | None = None,
        contrast: NDArray[np.floating] | None = None,
    ) -> "Motion":
        """Of an estimator that has no lag and no likelihood, and by default is never lost."""
        n, none = len(t), np.full(len(t), np.nan)
        valid = np.ones(n, bool) if valid is None else valid
        contrast = none if contrast is None else contrast
        return cls(find_model(model), t, mean, covariance, valid, np.zeros(n), contrast, none)

    @classmethod
    def nothing(cls, model: str | type[Model]) -> "Motion":
        """Of a recording that tells nothing."""
        n = len(find_model(model).components)
        return cls.of(model, np.zeros(0, np.int64), np.zeros((0, n)), np.zeros((0, n, n)))

    def calibrated(
        self,
        by: Calibration,
        length: float | int | NDArray[np.floating] = 0.0,
        alone: NDArray[np.floating] | None = None,
    ) -> "Motion":
        """The same with the covariance that its errors have; an estimate sees `length` seconds.

        Estimates beside each other tell how the motion changes; of one `alone` (d,) may tell it.
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
                # Beyond one end it goes on as it comes, and bends as it did nearby.
                early = np.where(begins & ~ends, 2 * now - late, early)
                late = np.where(ends & ~begins, 2 * now - early, late)
                change[:, i], bend[:, i] = late - early, late + early - 2 * now
                if inner.any():
                    bend[:, i] = np.interp(self.t, self.t[inner], bend[inner, i])
        elif alone is not None:
            change[:] = alone
        covariance = by.factor * self.covariance
        for d in (change, bend):
            covariance = covariance + by.change**2 * d[:, :, None] * d[:, None, :]
        eye = np.eye(mean.shape[1])
        covariance = covariance + by.share**2 * (mean**2).sum(1)[:, None, None] * eye
        covariance = covariance + by.speed**2 * mean[:, :, None] * mean[:, None, :]
        return dataclasses.replace(self, covariance=covariance)

    def with_layers(self, recording: Recording) -> tuple["Motion", str]:
        """The same, with the spread of the image's parts in its covariance, and a line of warning.

        One velocity of the whole image is no better than by how much its parts differ, as those at
        several depths do; and where they differ from a rotation translation may have made all of
        it. See `layers`. Where the camera stands still and things move (`still`), nothing tells its
        motion but theirs.
        """
        from jaxevent.egomotion.layers import layers
        from jaxevent.egomotion.patches import usual_speed
        from jaxevent.egomotion.still import stands_still

        speed = usual_speed(recording) if recording.frames else None
        if self.valid.any() and stands_still(recording, speed):
            return self._of_things(), (
                "the camera seems to stand still while things move: edges that the frames show "
                "make no events; sigmas count that, and jaxevent track follows things"
            )
        found = layers(recording, self.model, speed=speed)
        if found is None or not found.several:
            return self, ""
        mean = np.nan_to_num(self.mean)
        size2 = (mean**2).sum(1)[:, None, None]
        spread = found.spread if self.model.uniform else 1.0
        along = spread**2 * mean[:, :, None] * mean[:, None, :]
        across = (spread * ACROSS) ** 2 * size2 * np.eye(mean.shape[1])
        how = "as one" if self.model.uniform else "as a rotation makes it"
        cause, other = "at several depths", "general"
        if self.model.uniform and found.both:
            cause, other = "both ways if the camera rolls", "rotation"
        needs = "" if recording.camera else " --focal PX"
        line = (
            f"the image does not move {how}: parts of it at {found.slow:.0f} to {found.fast:.0f} "
            f"px/s, as {cause}; sigmas count that, and --model {other}{needs} "
            "may explain it"
        )
        return dataclasses.replace(self, covariance=self.covariance + along + across), line

    def _of_things(self) -> "Motion":
        """The same, whose covariance counts that it may be no motion of the camera at all."""
        covariance, mean = self.covariance.copy(), np.nan_to_num(self.mean)
        for part in self.model.parts:
            m = mean[:, part.rows]
            own = m[:, :, None] * m[:, None, :]
            own = own + (ACROSS**2 * (m**2).sum(1))[:, None, None] * np.eye(m.shape[1])
            covariance[:, part.rows, part.rows] += np.eye(3) if part.direction else own
        return dataclasses.replace(self, covariance=covariance)

    def within(self, recording: Recording) -> "Motion":
        """The same, of that recording."""
        span = None
        if len(recording.events) or recording.frames:
            span = recording.start, recording.stop
        return dataclasses.replace(self, recording=recording.name, span=span)

    def reaching(self, first: int, last: int, rate: NDArray[np.floating] | None = None) -> "Motion":
        """The same, with estimates at `first` and `last` (us), before and after all others.

        They are what is told at these times: the motion held, with a covariance that grows by how
        much it usually changes, `rate` (d, d) per us^2 or as the estimates tell. None is added next
        to one that is lost.
        """
        if not len(self):
            return self
        rate = self._change() if rate is None else rate
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
        return dataclasses.replace(self, **arrays, held=self.held + early + late)

    def _change(self) -> NDArray[np.float64]:
        """The mean square (d, d) of changes from an estimate to the next, per us^2."""
        found = np.flatnonzero(self.valid & np.isfinite(self.mean).all(1))
        dt = np.diff(self.t[found]).astype(float)
        rates = np.diff(self.mean[found], axis=0)[dt > 0] / dt[dt > 0, None]
        return rates.T @ rates / max(len(rates), 1)

    def to_dataframe(
        self, times: Times | None = None, *, centred: bool = False
    ) -> "pandas.DataFrame":
        """Make a pandas table of the motion, with the columns that `jaxevent motion` writes as CSV.

        Args:
            times: Integers (us) or floats (s); by default the table holds the estimates themselves.
            centred: Whether an estimate counts for the time that what it saw shows, see the call.

        Returns:
            A row for each time. The columns are t (s), the model's components, their standard
            deviations sigma_<component>, and lost (0 or 1): where it is 1 the numbers are NaN.
            `attrs["units"]` has the unit of each column.

        Raises:
            InputError: A time is not finite or outside the recording.
        """
        import pandas

        if times is None:
            us, told = self.t, Estimate(self.mean, self.covariance, self.valid)
        else:
            us, told = np.atleast_1d(microseconds(times)), self(times, centred=centred)
        table = pandas.DataFrame(table_columns(self.model, us, told))
        units = dict(zip(self.model.components, self.model.units, strict=True))
        sigmas = {f"sigma_{name}": unit for name, unit in units.items()}
        table.attrs["units"] = {"t": "s", **units, **sigmas, "lost": "1"}
        return table

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        lost = int((~self.valid).sum())
        return f"Motion({self.model.name}, {len(self)} estimates, {lost} lost)"

    def __call__(
        self, times: Times, *, centred: bool = False, extrapolate: bool = False
    ) -> Estimate:
        """The motion at `times`: integers (us) or floats (s).

        Means and covariances are interpolated linearly between the estimates before and after the
        time; directions are made unit vectors. Before the first and after the last estimate the
        mean is held, and the covariance grows by how much the motion usually changes in that time.
        With `centred` an estimate counts for the time that what it saw shows, `lag` before its own:
        a fixed-lag estimate, which needs the events up to that much later. `valid` is false where
        either estimate is not valid, before the first, and outside the recording. Raises
        `InputError` for times that are not finite and, unless told to `extrapolate`, outside the
        recording.
        """
        times = np.atleast_1d(microseconds(times))
        inside = np.ones(len(times), bool)
        if self.span is not None:
            if not extrapolate:
                check_times(times, *self.span, self.recording)
            inside = (times >= self.span[0]) & (times <= self.span[1])
        n, d = self.mean.shape
        if n == 0:
            none = np.full((len(times), d), np.nan), np.full((len(times), d, d), np.nan)
            return Estimate(*none, np.zeros(len(times), bool))
        at = self.t - (1e6 * self.lag if centred else 0)
        at = np.maximum.accumulate(at)
        place = np.searchsorted(at, times, "right")
        after, before = np.minimum(place, n - 1), np.maximum(place - 1, 0)
        gap = at[after] - at[before]
        share = np.where(gap > 0, (times - at[before]) / np.where(gap > 0, gap, 1), 0)
        share = np.clip(share, 0, 1)
        mean = self.model.between(self.mean[before], self.mean[after], share)
        share = share[:, None, None]
        covariance = (1 - share) * self.covariance[before] + share * self.covariance[after]
        beyond = np.maximum(at[0] - times, 0) + np.maximum(times - at[-1], 0)
        if beyond.any():
            covariance = covariance + beyond[:, None, None] ** 2 * self._change()
        valid = self.valid[before] & self.valid[after] & (times >= at[0]) & inside
        valid &= np.isfinite(mean).all(1) & np.isfinite(covariance).all((1, 2))
        return Estimate(mean, covariance, valid)
