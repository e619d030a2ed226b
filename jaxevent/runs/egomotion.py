"""Fits of egomotion methods to known motion, and their scores.

Settings of a method of egomotion in a configuration of `jaxevent.runs.fit`:

    model = "planar"                    # or "rotation", "general", "package.module:Class"
    truth = "*.csv"                     # beside each recording, * being its name without suffix;
                                        # or "poses", "gyro" of the recording itself
    centred = true                      # compare with the motion that candidates show, `lag` ago;
                                        # false: with that at the time of an estimate
    runs = 4                            # of every window, with different random numbers
    settle = 0.05                       # s of every window before errors count
    gyro_bias = [0.0, 0.0, 0.0]         # rad/s, taken off the gyro first
    imu_rotation = "y-up"               # its axes, as --imu-rotation of `jaxevent motion`
    depth = 2.0                         # m, of the scene: poses then tell a planar motion too

A table of the true motion has the columns t (s) and the components of the model, as `jaxevent
motion` writes them (vx, vy in px/s; wx, wy, wz in rad/s; tx, ty, tz before them).

A recording is cut into windows of `window` seconds. If neither validation nor test is given, they
are shared out: with `split` = [2, 1, 1], of every 4 windows in turn 2 are to fit, 1 to validate and
1 to test; then `window` is by default an eighth of the recording. The loss is the mean over times
and runs of |estimate - truth|^2, in units of the truth's; of a general motion those of heading and
of angular velocity are added. Random numbers stay the same during the fit.

With "voting" in every window particles start around the true motion, so that no search is fitted.
The gradient goes through weights, particles and, by the carried score, resampling; ages of
candidates are held fixed. Any other method that is differentiable, as one of your own, is run
over every window from its beginning. The numbers of a method that computes on the host are
searched: every candidate is computed anew, and a window counts as at rest where it tells no motion.

Results: `error`, the mean relative error of the whole filter (search included) over the windows, %;
of a direction, as the `heading` of general motion, degrees; `lost`, the share of times at which it
was lost.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxevent.egomotion.estimator import (
    SCORE_RATE_HZ,
    MotionEstimator,
    TrainingRuns,
    TrainingSegment,
)
from jaxevent.egomotion.models import Model, find_model
from jaxevent.egomotion.scores import errors_by_part
from jaxevent.egomotion.truth import KnownMotion
from jaxevent.errors import InputError
from jaxevent.io.output import finite, values_of
from jaxevent.methods import find
from jaxevent.parameters import Parameters
from jaxevent.recording import Recording
from jaxevent.runs import egomotion_scores as scores
from jaxevent.runs.config import NATURAL_CHECK
from jaxevent.runs.family import Family, Goal, LastBatches, Shares, Sources, batches_by_split
from jaxevent.show.tables import legend, results_table
from jaxevent.splits import SPLIT_NAMES, windows
from jaxevent.tuning import Batches


@dataclasses.dataclass(frozen=True)
class MotionLoss:
    """The mean relative squared error of estimates, over runs: `loss(params, batch)`."""

    centred: bool = True

    def __call__(self, params: Any, batch: TrainingRuns) -> Float[Array, ""]:
        means, lags = batch.estimates(params)
        return jnp.mean(jax.vmap(lambda mean, lag: self.one(batch, mean, lag))(means, lags))

    def one(
        self, batch: TrainingRuns, mean: Float[Array, "T d"], lag: Float[Array, " T"]
    ) -> Float[Array, ""]:
        """Compute the loss of one run.

        Args:
            batch: A window of a recording with the true motion.
            mean: Estimated components at `batch.time`.
            lag: Lag of the estimates, s.

        Returns:
            The loss, ().
        """
        at = jnp.asarray(batch.time) - (jax.lax.stop_gradient(lag) if self.centred else 0)
        truth = jax.vmap(lambda column: jnp.interp(at, batch.grid, column), 1, 1)(
            jnp.asarray(batch.truth)
        )
        counted = jnp.asarray(batch.counted)
        total = jnp.zeros((), mean.dtype)
        for part in batch.model.parts:
            square = ((mean[:, part.rows] - truth[:, part.rows]) ** 2).sum(1)
            scale = (truth[:, part.rows] ** 2).sum(1)
            total += (square * counted).sum() / jnp.maximum((scale * counted).sum(), 1e-12)
        return total


@dataclasses.dataclass(frozen=True)
class MotionGoal(Goal):
    """The fit of a method to known motion, and its scores."""

    method: MotionEstimator
    loss: MotionLoss
    model: str
    truth: str
    runs: int
    settle: float | int
    of_truth: Mapping[str, Any]  # gyro_bias, imu_rotation, depth
    # Forwards: in reverse every candidate's vote would be kept.
    forward = True
    measure = "error"

    @property
    def kind(self) -> type[Model]:
        """The motion model."""
        return find_model(self.model)

    def files(self, recording: Path) -> list[Path]:
        return scores.files(recording, {"truth": self.truth})

    def problem(
        self, sources: Sources, split: Shares, window: float | int | None
    ) -> Callable[[Any], Batches]:
        found = [one for one in self._windows(sources, split, window) if one.split < 2]

        def acting(params: Any) -> dict[str, float]:
            acts = params.without_gradient() if self.method.differentiable else params.numbers
            return {name: float(getattr(params, name)) for name in acts}

        def make(params: Any) -> Batches:
            made = self.method.training_runs(found, params, self.kind, self.runs, self.settle)
            return batches_by_split(found, made)

        return LastBatches(acting, make)

    def score(
        self,
        sources: Sources,
        split: Shares,
        window: float | int | None,
        params: Parameters,
        progress: bool | None,
    ) -> Iterator[dict[str, Any]]:
        found = self._windows(sources, split, window)
        for place, (given, recording) in (
            (place, source) for place, name in enumerate(SPLIT_NAMES) for source in sources[name]
        ):
            mine = [p for p in found if p.recording is recording]
            if not mine:
                continue
            known = mine[0].known
            motion = self.method.estimate(recording, params, model=self.kind, progress=progress)
            t = np.arange(mine[0].start, mine[-1].stop, round(1e6 / SCORE_RATE_HZ))
            t = t[known.covers(t)]
            told = motion(t, centred=self.loss.centred)
            mean, _, valid = told
            truth = known(t)
            for k, name in enumerate(SPLIT_NAMES):
                chosen = [p for p in mine if p.split == k and (split is not None or k == place)]
                inside = np.zeros(len(t), bool)
                for p in chosen:
                    inside |= (p.start <= t) & (t < p.stop)
                if not inside.any():
                    continue
                usable = inside & valid
                row: dict[str, Any] = {"recording": given, "split": name, "error": None}
                if usable.any():
                    each = errors_by_part(self.kind, mean[usable], truth[usable])
                    row |= {
                        name: finite(float(np.nanmean(values))) for name, values in each.items()
                    }
                row["lost"] = float((~valid[inside]).mean())
                row["windows"] = len(chosen)
                yield {**row, "params": values_of(params)}

    def table(self, rows: Sequence[Mapping[str, Any]]) -> str:
        columns = [("error %", "error", 1, 2), ("lost", "lost", 1, 3), ("windows", "windows", 1, 0)]
        for part in self.kind.parts:
            if part.direction and any(part.name in row for row in rows):
                columns.insert(1, (f"{part.name} deg", part.name, 1, 2))
        return results_table(rows, columns) + legend(columns)

    def known(self, recording: Recording) -> KnownMotion:
        """Return the true motion of a recording, whose name is its path."""
        settings = {"model": self.model, "truth": self.truth, **self.of_truth}
        return scores.true_motion(recording, settings)

    def _windows(
        self, sources: Sources, split: Shares, window: float | int | None
    ) -> list[TrainingSegment]:
        """Cut all recordings with known truth into windows that hold events."""
        found = []
        for place, (_, recording) in (
            (place, source) for place, name in enumerate(SPLIT_NAMES) for source in sources[name]
        ):
            events, truth = recording.events, self.known(recording)
            if not len(events):
                raise InputError(f"{recording.name}: holds no events; choose another recording")
            first, stop = int(events[:1].t[0]), int(events[-1:].t[0]) + 1
            first, stop = max(first, int(truth.t[0])), min(stop, int(truth.t[-1]) + 1)
            if first >= stop:
                raise InputError(
                    f"{recording.name}: its events and the true motion are not of one time; times "
                    "are seconds on the recording's clock"
                )
            for begin, end, s in windows(first, stop, window, split, place):
                if events.index(begin) < events.index(end):
                    found.append(TrainingSegment(recording, begin, end, truth, s))
        return found


def find_estimator(name: str) -> MotionEstimator:
    """Return the egomotion method of a name, or of "package.module:object".

    Raises `InputError` for an unknown name, and for any other object.
    """
    found = find(name, "egomotion")
    if not isinstance(found, MotionEstimator):
        raise InputError(f"{name!r} is no jaxevent.egomotion.MotionEstimator; make it one")
    return found


class Egomotion(Family):
    """The methods that estimate the camera's motion."""

    protocols = {"motion": scores.MotionProtocol()}
    fit_settings = {
        **{
            name: scores.MOTION_SETTINGS[name]
            for name in ("model", "truth", "centred", "settle", *scores.TRUTH_SETTINGS)
        },
        "runs": NATURAL_CHECK,
    }
    own = ("model", "centred")

    def goal(
        self, method: MotionEstimator, params: Parameters, settings: Mapping[str, Any]
    ) -> MotionGoal:
        scores.check(settings)
        method.find_model(scores.model_of(settings))
        return MotionGoal(
            method,
            MotionLoss(settings.get("centred", True)),
            settings.get("model", "planar"),
            settings["truth"],
            settings.get("runs", 4),
            settings.get("settle", 0.05),
            {name: settings[name] for name in scores.TRUTH_SETTINGS if name in settings},
        )


FAMILY = Egomotion()
