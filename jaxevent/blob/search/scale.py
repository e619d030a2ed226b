"""How long the windows and how large the cells are: those that best predict the next events.

In some stretches of the recording blobs are detected in two windows, and the third is predicted:
each blob goes on as it went. What is compared is the likelihood of the third's events, a Poisson
process of the blobs and the background. Windows that are too short find nothing, those that are too
long smear; between them the maximum is flat.

Where in a blob its events are is told by its second window, in kernels of several widths, as much
as by its ellipse: an outline as one blob predicts as well as its pieces do. Of scales that predict
equally well the coarsest is taken in whose blobs smaller cells see no gaps.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.background import Background, measure_dispersions
from jaxevent.blob.search.detection import CONTACT, Scale, detect, measure_blobs, touching
from jaxevent.blob.search.prediction import LARGE, Told, choose_scored, predict, score
from jaxevent.blob.search.stream import Pixels, Stream

WINDOWS = 500 * 2 ** np.arange(12)  # us
CELLS = (2, 4, 8, 16)  # px
LEAST_WINDOWS = 8  # in a recording
STRETCHES, FEWER = 24, 12  # in which scales are compared, and of what remains after a pass
FIRST = 4  # every fourth one tells the worse scales:
WORSE, SIGMAS = 0.85, 2.0  # of the best one's nats, and standard deviations of their difference
PLATEAU, TIE = 0.03, 0.005  # shares of the score that scales may lose as equally good
MERGED = 0.3  # share of events in blobs in which smaller cells see a larger blob apart
SHARP = 0.9  # share of the most that a cell's blobs tell in windows in which they are sharp
MOST = 200  # blobs of a window in which gaps are looked for


@dataclasses.dataclass(frozen=True)
class Choice:
    """A scale, and by how much it predicts events better than the background: nats per event."""

    scale: Scale
    score: float


def choose_scale(
    stream: Stream, background: Background, worth: float | None = None
) -> Choice | None:
    """The scale that predicts best; None if the recording is too short or nothing is found.

    None too if some of the stretches tell that no scale is `worth` it, nats per event.
    """
    longest = min(stream.duration / LEAST_WINDOWS, background.sharp)
    windows = np.asarray(WINDOWS[WINDOWS * 1e-6 <= longest] * 1e-6, np.float64)
    if not len(windows):
        return None
    number = STRETCHES if worth is None else FEWER
    trial = _Trial(stream, background, windows, number)
    first = np.arange(FIRST // 2, number, FIRST)
    trial.look(first)
    most = trial.drop()
    if worth is not None and most < worth:
        return None
    trial.look(np.setdiff1d(np.arange(number), first))
    raw, scores = trial.scores()
    best = scores.max()
    if best <= 0:
        return None
    # Of what is equally good the coarsest cells, and with them the longest windows.
    good = scores >= best - PLATEAU * best
    most = raw.max(0)
    sharp = raw >= most - (1 - SHARP) * abs(most)
    longest = [trial.scales[np.flatnonzero(sharp[:, j]).max()][j] for j in range(len(CELLS))]
    gaps, some = _Gaps(stream, background), trial.begins[::2]
    for j in range(len(CELLS))[::-1]:
        for i in np.flatnonzero(good[:, j]):
            split = gaps.split(trial.scales[i][j], some[:, i], longest[:j])
            good[i, j] = split <= MERGED
        if good[:, j].any():
            column = np.where(good[:, j], scores[:, j], -np.inf)
            i = np.flatnonzero(column >= column.max() - TIE * best).max()
            break
    else:
        i, j = np.unravel_index(scores.argmax(), scores.shape)
    return Choice(trial.scales[i][j], float(scores[i, j]))


class _Trial:
    """What the scales of some windows (s) and all cells predict in stretches of the recording."""

    def __init__(
        self, stream: Stream, background: Background, windows: NDArray[np.float64], number: int
    ):
        self.stream, self.background, self.windows = stream, background, windows
        self.begins = np.clip(stream.times(number)[:, None], 2 * windows, stream.duration - windows)
        dispersions = measure_dispersions(stream, background, windows)
        self.scales = [
            [Scale(float(w), cell, dispersion) for cell in CELLS]
            for w, dispersion in zip(windows, dispersions, strict=True)
        ]
        self.tried = np.ones((len(windows), len(CELLS)), bool)
        self.told: list[list[list[Told]]] = [[[] for _ in CELLS] for _ in windows]

    def look(self, stretches: NDArray[np.int64]) -> None:
        """Let all scales that are tried predict in some stretches."""
        stream, background = self.stream, self.background
        size = stream.height, stream.width
        for i in np.flatnonzero(self.tried.any(1)).tolist():
            w, cells = float(self.windows[i]), np.flatnonzero(self.tried[i]).tolist()
            scales = [self.scales[i][j] for j in cells]
            for t in self.begins[stretches, i].tolist():
                before, last = (stream.pixels(t + k * w, t + (k + 1) * w) for k in (-2, -1))
                scored = choose_scored(stream, background, t, w)
                told = predict(before, last, scored, background, scales, size, t)
                for j, one in zip(cells, told, strict=True):
                    self.told[i][j].append(one)

    def drop(self) -> float:
        """Try no more the scales that are clearly worse than the best ones of equal cells.

        The most, in nats per event, that one of them may come to.
        """
        most = -np.inf
        for j in range(len(CELLS)):
            told = [score(one[j]) for one in self.told]
            best = max(told, key=lambda one: one.raw)
            for i, one in enumerate(told):
                most = max(most, _most(one.parts))
                self.tried[i, j] = one is best or _most(one.parts - WORSE * best.parts) >= 0
        return most

    def scores(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(windows, cells) nats per event, and less what is split; -inf: not tried to the end."""
        out = np.full((2, *self.tried.shape), -np.inf)
        for i, j in zip(*np.nonzero(self.tried), strict=True):
            out[:, i, j] = score(self.told[i][j])[:2]
        return out[0], out[1]


def _most(parts: NDArray[np.float64]) -> float:
    """The sum of some parts, and `SIGMAS` standard deviations more."""
    return float(parts.sum() + SIGMAS * np.sqrt(len(parts)) * parts.std(ddof=1))


class _Gaps:
    """Where smaller cells see a blob apart in what larger ones take for one: `split(scale)`."""

    def __init__(self, stream: Stream, background: Background):
        self.stream, self.background = stream, background
        self.size = stream.height, stream.width
        self.clusters: dict[tuple[float, float, int], tuple[Pixels, NDArray, int]] = {}
        self.image = np.full(self.size, -1, np.int32)  # of clusters, filled where it is looked at

    def split(self, scale: Scale, begins: NDArray[np.float64], smaller: list[Scale]) -> float:
        """Share of events in blobs in which smaller cells see another blob, larger and apart.

        Of `smaller` cells in the longest windows in which their blobs are sharp: in shorter ones an
        outline has gaps by chance.
        """
        told, w = np.zeros(2), scale.window
        for t in begins.tolist():
            pixels = self.stream.pixels(t - w, t)
            labels, _ = detect(pixels, self.background, scale, self.size, t)
            shares = [
                self._apart(t, one.as_long(max(w, min(one.window, t))), pixels, labels)
                for one in smaller
            ]
            told += max(shares, key=lambda one: one[0], default=np.zeros(2))
        return float(told[0] / max(told[1], 1.0))

    def _apart(self, t: float, scale: Scale, pixels: Pixels, labels: NDArray) -> NDArray:
        """Events apart from the largest cluster in what `labels` has as one; all.

        Labels are those of the last events of the scale's window, in some of its pixels.
        """
        key = t, scale.window, scale.cell
        if key not in self.clusters:
            self.clusters[key] = self._clusters(t, scale)
        wide, cluster_of, clusters = self.clusters[key]
        self.image[wide.y, wide.x] = cluster_of
        cluster = self.image[pixels.y, pixels.x]
        self.image[wide.y, wide.x] = -1
        both = (labels > 0) & (cluster >= 0)
        place = labels[both] * clusters + cluster[both]
        table = np.bincount(place, pixels.n[both], (labels.max(initial=0) + 1) * clusters)
        table = table.reshape(-1, clusters) if clusters else np.zeros((1, 1))
        return np.array([(table.sum(1) - table.max(1)).sum(), table.sum()])

    def _clusters(self, t: float, scale: Scale) -> tuple[Pixels, NDArray[np.int32], int]:
        """Pixels of the window before t, which cluster of touching blobs each is of; how many.

        Of the largest blobs; -1: of none.
        """
        pixels = self.stream.pixels(t - scale.window, t)
        labels, number = detect(pixels, self.background, scale, self.size, t)
        blobs = measure_blobs(pixels, labels, number)
        large = np.argsort(-blobs.n, kind="stable")[:MOST]
        large = large[blobs.n[large] >= LARGE]
        p, C = blobs.p[large], blobs.C[large]
        cluster = np.full(number + 1, -1, np.int32)
        clusters, cluster[large + 1] = _components(touching(p[:, None], C[:, None], p, C) < CONTACT)
        return pixels, cluster[labels], clusters


def _components(near: NDArray[np.bool_]) -> tuple[int, NDArray[np.int32]]:
    """How many sets of things there are that are near each other (n, n), and whose each (n,) is.

    The search of SciPy checks its input for longer than it takes here.
    """
    first = np.arange(len(near))
    while True:
        least = np.where(near, first, len(near)).min(1, initial=len(near))
        if (least == first).all():
            break
        first = least
    sets, whose = np.unique(first, return_inverse=True)
    return len(sets), whose.astype(np.int32)
