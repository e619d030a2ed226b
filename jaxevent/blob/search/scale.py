"""Selection of the windows and cells that best predict the next events.

At some times of the recording blobs are detected in two windows, and the third is predicted: each
blob goes on as it went. The criterion is the likelihood of the third's events, a Poisson process of
the blobs and the background. Windows that are too short find nothing, those that are too long
smear; between them the maximum is flat.

The density inside a blob is that of its second window, in kernels of several widths, as much as its
ellipse: an outline as one blob predicts as well as its pieces do, and so does a flock as one blob.
A free shape has many more parameters than an ellipse. Where ellipses alone predict nearly as well
at some scale, targets are compact and the scale is that of ellipses; else free shapes select it. Of
scales that predict equally well the coarsest is taken.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.background import Background, measure_dispersions
from jaxevent.blob.search.config import CONFIG
from jaxevent.blob.search.detection import Scale, clutter_model
from jaxevent.blob.search.prediction import ScalePrediction, predict, sample_scored, score
from jaxevent.blob.search.stream import Stream

TRIED_WINDOWS_US = 500 * 2 ** np.arange(12)
TRIED_CELLS_PX = (2, 4, 8, 16)


@dataclasses.dataclass(frozen=True)
class ScaleSelection:
    """A scale, and the gain of its predictions over the background."""

    scale: Scale
    score: float  # nats per event
    nats: float  # of a window in which it was tried, in the mean


def are_evident(score: float, nats: float, background: Background) -> bool:
    """Return whether there are blobs that gain so much over the background.

    The Bayes factor of a window decides, whatever share of the events they send. The map of a
    moving scene is inexact everywhere: there they must gain per event of all.

    Args:
        score: Gain in nats per event.
        nats: Gain in a window, nats.
        background: The background.
    """
    if background.scene is None:
        return nats >= CONFIG.log_bayes_factor
    return score >= 2 * CONFIG.min_gain


def select_scale(
    stream: Stream, background: Background, later: bool = False
) -> ScaleSelection | None:
    """Select the scale that predicts best.

    Args:
        stream: Events.
        background: Their background.
        later: True for what a pass has left: scales are compared in half of the trials, and blobs
            must be evident in some of them.

    Returns:
        The scale; None if the recording is too short or nothing is gained.
    """
    longest = min(stream.duration / (2 * CONFIG.min_motion_windows), background.max_window)
    windows = np.asarray(TRIED_WINDOWS_US[TRIED_WINDOWS_US * 1e-6 <= longest] * 1e-6, np.float64)
    if not len(windows):
        return None
    number = CONFIG.scale_trials // (2 if later else 1)
    trial = _ScaleTrial(stream, background, windows, number)
    first = np.arange(CONFIG.first_trial_step // 2, number, CONFIG.first_trial_step)
    trial.evaluate(first)
    evident = trial.drop_worse()
    if later and not evident:
        return None
    trial.evaluate(np.setdiff1d(np.arange(number), first))
    raw, scores, ellipses = trial.scores()
    # Of free shapes at the same scale and at the best one.
    free = np.maximum(raw + raw.max(), 1e-9) / 2
    compact = bool((ellipses >= (1 - CONFIG.free_shape_gain) * free).any())
    if compact:
        scores = ellipses
    best = scores.max()
    if best <= 0:
        return None
    # Of what is equally good the coarsest cells, and with them the longest windows.
    good = scores >= best - CONFIG.equal_score_loss * best
    j = int(np.flatnonzero(good.any(0)).max())
    column = np.where(good[:, j], scores[:, j], -np.inf)
    i = int(np.flatnonzero(column >= column.max() - CONFIG.equal_window_loss * best).max())
    scale = dataclasses.replace(trial.scales[i][j], compact=compact)
    predictions, best = trial.predictions[i][j], float(scores[i, j])
    number = sum(one.scored.n_window_events for one in predictions)
    return ScaleSelection(scale, best, best * number / len(predictions))


class _ScaleTrial:
    """Predictions of the scales of some windows (s) and all cells, at times of the recording."""

    def __init__(
        self, stream: Stream, background: Background, windows: NDArray[np.float64], number: int
    ):
        self.stream, self.background, self.windows = stream, background, windows
        last = stream.duration - windows
        self.begins = np.clip(stream.quantile_times(number)[:, None], 2 * windows, last)
        dispersions = measure_dispersions(stream, background, windows)
        self.scales = [
            [Scale(float(w), cell, dispersion) for cell in TRIED_CELLS_PX]
            for w, dispersion in zip(windows, dispersions, strict=True)
        ]
        self.tried = np.ones((len(windows), len(TRIED_CELLS_PX)), bool)
        self.predictions: list[list[list[ScalePrediction]]] = [
            [[] for _ in TRIED_CELLS_PX] for _ in windows
        ]

    def evaluate(self, trials: NDArray[np.int64]) -> None:
        """Predict events at some of the times, at all scales that are tried."""
        stream, background = self.stream, self.background
        for i in np.flatnonzero(self.tried.any(1)).tolist():
            w, cells = float(self.windows[i]), np.flatnonzero(self.tried[i]).tolist()
            for t in self.begins[trials, i].tolist():
                before = stream.pixel_counts(t - 2 * w, t - w), stream.pixel_counts(t - w, t)
                scored = sample_scored(stream, background, t, w)
                clutters = [
                    clutter_model(background, self.scales[i][j], stream.shape, t) for j in cells
                ]
                predictions = predict(before, scored, clutters, stream.shape)
                for j, one in zip(cells, predictions, strict=True):
                    self.predictions[i][j].append(one)

    def drop_worse(self) -> bool:
        """Drop the scales that are clearly worse than the best one of equal cells.

        Returns:
            True if blobs may be evident at one of the scales.
        """
        evident = False
        for j in range(len(TRIED_CELLS_PX)):
            scores = [score(one[j]) for one in self.predictions]
            best = max(scores, key=lambda one: one.raw)
            for i, one in enumerate(scores):
                most, number = _upper_bound(one.by_window), one.n_events / len(one.by_window)
                evident |= are_evident(most, most * number, self.background)
                excess = _upper_bound(one.by_window - CONFIG.dropped_score * best.by_window)
                self.tried[i, j] = one is best or excess >= 0
        return evident

    def scores(self) -> NDArray[np.float64]:
        """Score the scales (windows, cells): raw, with penalty, by ellipses; -inf if dropped."""
        out = np.full((3, *self.tried.shape), -np.inf)
        for i, j in zip(*np.nonzero(self.tried), strict=True):
            out[:, i, j] = score(self.predictions[i][j])[:3]
        return out


def _upper_bound(parts: NDArray[np.float64]) -> float:
    """Return the sum of some parts, and standard deviations more."""
    return float(parts.sum() + CONFIG.dropped_sigmas * np.sqrt(len(parts)) * parts.std(ddof=1))
