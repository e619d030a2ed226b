"""Selection of the windows and cells that best predict the next events.

At some times of the recording blobs are detected in two windows, and the third is predicted: each
blob goes on as it went. The criterion is the likelihood of the third's events, a Poisson process of
the blobs and the background. Windows that are too short find nothing, those that are too long
smear; between them the maximum is flat.

The density inside a blob is that of its second window, in kernels of several widths, as much as its
ellipse: an outline as one blob predicts as well as its pieces do. Of scales that predict equally
well the coarsest is taken in whose blobs smaller cells see no gaps.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.background import Background, measure_dispersions
from jaxevent.blob.search.config import CONFIG
from jaxevent.blob.search.detection import (
    Scale,
    clutter_model,
    contact_distance,
    detect,
    measure_blobs,
)
from jaxevent.blob.search.prediction import ScalePrediction, predict, sample_scored, score
from jaxevent.blob.search.stream import PixelCounts, Stream

TRIED_WINDOWS_US = 500 * 2 ** np.arange(12)
TRIED_CELLS_PX = (2, 4, 8, 16)


@dataclasses.dataclass(frozen=True)
class ScaleSelection:
    """A scale, and the gain of its predictions over the background in nats per event."""

    scale: Scale
    score: float


def select_scale(
    stream: Stream, background: Background, min_gain: float | None = None
) -> ScaleSelection | None:
    """Select the scale that predicts best.

    Args:
        stream: Events.
        background: Their background.
        min_gain: Gain (nats per event) that a scale must come to in some trials; None for a first
            pass, which compares the scales in more trials.

    Returns:
        The scale; None if the recording is too short or nothing is gained.
    """
    longest = min(stream.duration / CONFIG.min_windows, background.max_window)
    windows = np.asarray(TRIED_WINDOWS_US[TRIED_WINDOWS_US * 1e-6 <= longest] * 1e-6, np.float64)
    if not len(windows):
        return None
    number = CONFIG.scale_trials if min_gain is None else CONFIG.later_scale_trials
    trial = _ScaleTrial(stream, background, windows, number)
    first = np.arange(CONFIG.first_trial_step // 2, number, CONFIG.first_trial_step)
    trial.evaluate(first)
    most = trial.drop_worse()
    if min_gain is not None and most < min_gain:
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
    most = raw.max(0)
    sharp = raw >= most - (1 - CONFIG.sharp_score) * abs(most)
    cells = range(len(TRIED_CELLS_PX))
    longest = [trial.scales[np.flatnonzero(sharp[:, j]).max()][j] for j in cells]
    gaps, some = _GapTest(stream, background), trial.begins[::2]
    for j in cells[::-1]:
        for i in np.flatnonzero(good[:, j]):
            if not compact:
                merged = gaps.merged_share(trial.scales[i][j], some[:, i], longest[:j])
                good[i, j] = merged <= CONFIG.max_merged_share
        if good[:, j].any():
            column = np.where(good[:, j], scores[:, j], -np.inf)
            i = np.flatnonzero(column >= column.max() - CONFIG.equal_window_loss * best).max()
            break
    else:
        i, j = np.unravel_index(scores.argmax(), scores.shape)
    scale = dataclasses.replace(trial.scales[i][j], compact=compact)
    return ScaleSelection(scale, float(scores[i, j]))


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

    def drop_worse(self) -> float:
        """Drop the scales that are clearly worse than the best one of equal cells.

        Returns:
            The most that one of the scales may gain, nats per event.
        """
        most = -np.inf
        for j in range(len(TRIED_CELLS_PX)):
            scores = [score(one[j]) for one in self.predictions]
            best = max(scores, key=lambda one: one.raw)
            for i, one in enumerate(scores):
                most = max(most, _upper_bound(one.parts))
                excess = _upper_bound(one.parts - CONFIG.dropped_score * best.parts)
                self.tried[i, j] = one is best or excess >= 0
        return most

    def scores(self) -> NDArray[np.float64]:
        """Score the scales (windows, cells): raw, with penalty, by ellipses; -inf if dropped."""
        out = np.full((3, *self.tried.shape), -np.inf)
        for i, j in zip(*np.nonzero(self.tried), strict=True):
            out[:, i, j] = score(self.predictions[i][j])[:3]
        return out


def _upper_bound(parts: NDArray[np.float64]) -> float:
    """Return the sum of some parts, and standard deviations more."""
    return float(parts.sum() + CONFIG.dropped_sigmas * np.sqrt(len(parts)) * parts.std(ddof=1))


class _GapTest:
    """Test whether smaller cells see gaps in blobs of larger ones."""

    def __init__(self, stream: Stream, background: Background):
        self.stream, self.background = stream, background
        self.clusters: dict[tuple[float, float, int], tuple[PixelCounts, NDArray, int]] = {}
        self.image = np.full(stream.shape, -1, np.int32)  # of clusters, filled where needed

    def merged_share(
        self, scale: Scale, begins: NDArray[np.float64], smaller: list[Scale]
    ) -> float:
        """Compute the share of events in blobs that smaller cells separate from a larger blob.

        Args:
            scale: Scale of the blobs.
            begins: Ends of the windows in which they are detected, s.
            smaller: Scales of smaller cells in the longest windows in which their blobs are sharp:
                in shorter ones an outline has gaps by chance.
        """
        sums, w = np.zeros(2), scale.window
        for t in begins.tolist():
            pixels, labels, _ = self._detect(t, scale)
            counts = [
                self._count_apart(t, one.with_window(max(w, min(one.window, t))), pixels, labels)
                for one in smaller
            ]
            sums += max(counts, key=lambda one: one[0], default=np.zeros(2))
        return float(sums[0] / max(sums[1], 1.0))

    def _detect(self, t: float, scale: Scale) -> tuple[PixelCounts, NDArray[np.int32], int]:
        """Detect blobs in the window before t."""
        pixels = self.stream.pixel_counts(t - scale.window, t)
        clutter = clutter_model(self.background, scale, self.stream.shape, t)
        return pixels, *detect(pixels, clutter, self.stream.shape)

    def _count_apart(self, t: float, scale: Scale, pixels: PixelCounts, labels: NDArray) -> NDArray:
        """Count events of labelled blobs that are not in the blob's largest cluster, and all.

        `labels` are those of the last events of the scale's window, in some of its pixels.
        """
        key = t, scale.window, scale.cell
        if key not in self.clusters:
            self.clusters[key] = self._find_clusters(t, scale)
        wide, cluster_of, clusters = self.clusters[key]
        self.image[wide.y, wide.x] = cluster_of
        cluster = self.image[pixels.y, pixels.x]
        self.image[wide.y, wide.x] = -1
        both = (labels > 0) & (cluster >= 0)
        place = labels[both] * clusters + cluster[both]
        table = np.bincount(place, pixels.n[both], (labels.max(initial=0) + 1) * clusters)
        table = table.reshape(-1, clusters) if clusters else np.zeros((1, 1))
        return np.array([(table.sum(1) - table.max(1)).sum(), table.sum()])

    def _find_clusters(self, t: float, scale: Scale) -> tuple[PixelCounts, NDArray[np.int32], int]:
        """Find clusters of blobs in contact, among the largest of the window before t.

        Returns:
            The pixels of the window, the cluster of each or -1, and the number of clusters.
        """
        pixels, labels, number = self._detect(t, scale)
        blobs = measure_blobs(pixels, labels, number)
        large = np.argsort(-blobs.n, kind="stable")[: CONFIG.max_gap_blobs]
        large = large[blobs.n[large] >= CONFIG.min_split_events]
        p, C = blobs.p[large], blobs.C[large]
        cluster = np.full(number + 1, -1, np.int32)
        near = contact_distance(p[:, None], C[:, None], p, C) < CONFIG.contact_distance
        clusters, cluster[large + 1] = _connected_components(near)
        return pixels, cluster[labels], clusters


def _connected_components(near: NDArray[np.bool_]) -> tuple[int, NDArray[np.int32]]:
    """Return the number of components of a graph (n, n), and the component (n,) of each node.

    SciPy's function checks its input for longer than it takes here.
    """
    first = np.arange(len(near))
    while True:
        least = np.where(near, first, len(near)).min(1, initial=len(near))
        if (least == first).all():
            break
        first = least
    components, component_of = np.unique(first, return_inverse=True)
    return len(components), component_of.astype(np.int32)
