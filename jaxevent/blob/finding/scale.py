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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from jaxevent.blob.finding.background import Background, measure_dispersion
from jaxevent.blob.finding.detection import CONTACT, Blobs, Scale, detect, measure_blobs, touching
from jaxevent.blob.finding.stream import Part, Stream
from jaxevent.kernels import Blank, compiled

_bins = Blank(np.int32)
WINDOWS = 500 * 2 ** np.arange(12)  # us
CELLS = (2, 4, 8, 16)  # px
LEAST_WINDOWS = 8  # in a recording
STRETCHES = 24  # in which the scales are compared
SCORED = 2000  # most events of a window that are scored
WIDTHS, BINS = np.array([3.0, 8.0, 20.0]), np.array([2, 4, 8])  # px, of the kernels
ROUNDS = 15  # of expectation and maximisation, for the shares of ellipses and kernels
SPLIT = 0.2  # of the score is lost where all events are in blobs that touch another one
PLATEAU, TIE = 0.03, 0.005  # shares of the score that scales may lose as equally good
MERGED = 0.3  # share of events in blobs in which smaller cells see a larger blob apart
SHARP = 0.9  # share of the most that a cell's blobs tell in windows in which they are sharp
MOST = 200  # blobs of a window in which gaps are looked for


@dataclasses.dataclass(frozen=True)
class Choice:
    """A scale, and by how much it predicts events better than the background: nats per event."""

    scale: Scale
    score: float


class _Stretch(NamedTuple):
    """What a scale predicts of some events of a stretch's third window."""

    density: NDArray[np.float64]  # (scored, 4) 1/px^2, by ellipses and by kernels
    background: NDArray[np.float64]  # (scored,) 1/px^2
    share: float | int  # events for each that is scored
    number: int  # of events
    expected: float  # events of the blobs
    large: float  # events in blobs of three and more,
    split: float  # and in those of them that touch another one


def choose_scale(stream: Stream, background: Background) -> Choice | None:
    """The scale that predicts best; None if the recording is too short or nothing is found."""
    longest = min(stream.duration / LEAST_WINDOWS, background.sharp)
    windows = WINDOWS[WINDOWS * 1e-6 <= longest] * 1e-6
    if not len(windows):
        return None
    raw, scores = np.zeros((2, len(windows), len(CELLS)))
    dispersions = []
    begins = np.clip(stream.times(STRETCHES)[:, None], 2 * windows, stream.duration - windows)
    for i, w in enumerate(windows):
        dispersions.append(measure_dispersion(stream, background, w))
        windows_of = [
            [stream.window(t + k * w, t + (k + 1) * w) for k in (-2, -1, 0)] for t in begins[:, i]
        ]
        for j, g in enumerate(CELLS):
            scale = Scale(float(w), g, dispersions[i])
            told = [
                _predict(parts, t, stream, background, scale)
                for parts, t in zip(windows_of, begins[:, i], strict=True)
            ]
            raw[i, j], scores[i, j] = _score(told)
    best = scores.max()
    if best <= 0:
        return None
    # Of what is equally good the coarsest cells, and with them the longest windows.
    good = scores >= best - PLATEAU * best
    most = raw.max(0)
    sharp = raw >= most - (1 - SHARP) * abs(most)
    longest_of = [float(windows[np.flatnonzero(column).max()]) for column in sharp.T]
    for j in range(len(CELLS))[::-1]:
        for i in np.flatnonzero(good[:, j]):
            scale = Scale(float(windows[i]), CELLS[j], dispersions[i])
            split = _merged(stream, background, scale, begins[:, i], longest_of[:j])
            good[i, j] = split <= MERGED
        if good[:, j].any():
            column = np.where(good[:, j], scores[:, j], -np.inf)
            i = np.flatnonzero(column >= column.max() - TIE * best).max()
            break
    else:
        i, j = np.unravel_index(scores.argmax(), scores.shape)
    return Choice(Scale(float(windows[i]), CELLS[j], dispersions[i]), float(scores[i, j]))


def _merged(
    stream: Stream,
    background: Background,
    scale: Scale,
    begins: NDArray[np.float64],
    longest: list[float],
) -> float:
    """Share of events in blobs in which smaller cells see another blob that is larger and apart.

    `longest` are the longest windows (s) in which the blobs of smaller cells are sharp: in shorter
    ones an outline has gaps by chance.
    """
    size, w = (stream.height, stream.width), scale.window
    told = np.zeros(2)
    for t in begins:
        part = stream.window(t - w, t)
        labels, number = detect(part, background, scale, size, t)
        shares = []
        for g, window in zip(CELLS, longest, strict=False):
            long = max(w, min(window, t))
            wide = stream.window(t - long, t)
            smaller, fragments = detect(wide, background, Scale(long, g, scale.dispersion), size, t)
            shares.append(_apart(wide, smaller, fragments, labels))
        told += max(shares, key=lambda one: one[0], default=np.zeros(2))
    return float(told[0] / max(told[1], 1.0))


def _apart(part: Part, smaller: NDArray, number: int, labels: NDArray) -> NDArray[np.float64]:
    """Events apart from the largest of `smaller` blobs in what `labels` has as one; all.

    `labels` are those of the last events of `part`.
    """
    blobs = measure_blobs(part, smaller, number)
    large = np.argsort(-blobs.n, kind="stable")[:MOST]
    large = large[blobs.n[large] >= 3]
    p, C = blobs.p[large], blobs.C[large]
    cluster = np.full(number + 1, -1)
    clusters, of_large = connected_components(touching(p[:, None], C[:, None], p, C) < CONTACT)
    cluster[large + 1] = of_large
    smaller = smaller[len(smaller) - len(labels) :]
    both = (labels > 0) & (cluster[smaller] >= 0)
    table = np.zeros((int(labels.max(initial=0)) + 1, clusters))
    np.add.at(table, (labels[both], cluster[smaller[both]]), 1)
    return np.array([(table.sum(1) - table.max(1, initial=0)).sum(), both.sum()])


def _predict(
    parts: list[Part], t: float | int, stream: Stream, background: Background, scale: Scale
) -> _Stretch:
    """Of the third window what the first two tell."""
    size, w = (stream.height, stream.width), scale.window
    first, second, third = parts
    before = measure_blobs(first, *detect(first, background, scale, size, t))
    labels, number = detect(second, background, scale, size, t)
    last = measure_blobs(second, labels, number)
    if not len(third) or not number:
        return _Stretch(np.zeros((0, 4)), np.zeros(0), 1, len(third), 0.0, 0.0, 0.0)
    share = max(1.0, len(third) / SCORED)
    some = slice(None)
    if share > 1:
        some = np.linspace(0, len(third) - 1, SCORED).astype(np.int64)
    x, y = third.x[some], third.y[some]
    p, S = _extrapolate(before, last)
    drawn = np.flatnonzero(labels > 0)
    moved = (p - last.p)[labels[drawn] - 1]
    places = second.x[drawn] + moved[:, 0], second.y[drawn] + moved[:, 1]
    density = np.empty((len(x), 1 + len(WIDTHS)))
    density[:, 0] = _intensity(x, y, last.n, p, S)
    for i, (r, g) in enumerate(zip(WIDTHS, BINS, strict=True)):
        reach = int(r / g + 0.5)
        bins = _bins(*(n // g + 2 * reach + 1 for n in size))
        density[:, 1 + i] = _smooth(x, y, *places, r, g, reach, bins)
    large = last.n >= 3
    # By ellipses: pieces along an outline touch each other, both of its sides do not.
    p, C = last.p[large], last.C[large]
    near = np.asarray(touching(p[:, None], C[:, None], p, C) < CONTACT)
    np.fill_diagonal(near, False)
    b = background.at(x, y, t) * w
    split = last.n[large][near.any(1)].sum()
    return _Stretch(density, b, share, len(third), last.n.sum(), last.n[large].sum(), split)


def _score(told: list[_Stretch]) -> tuple[float, float]:
    """Of a scale, from all stretches: nats per event, and less what is split."""
    density = np.concatenate([one.density for one in told])
    b = np.concatenate([one.background for one in told])
    weight = np.concatenate([np.full(len(one.background), one.share) for one in told])
    number, expected, large, split = (
        sum(getattr(one, name) for one in told) for name in ("number", "expected", "large", "split")
    )

    if not len(b):
        return 0.0, 0.0
    share = np.full(density.shape[1], 1 / density.shape[1])
    for _ in range(ROUNDS):
        share = share * ((weight / (density @ share + b)) @ density) + 1e-12
        share /= share.sum()
    nats = float((weight * np.log(density @ share / b + 1)).sum() - expected) / number
    return nats, nats - SPLIT * abs(nats) * split / max(large, 1e-9)


def _extrapolate(before: Blobs, last: Blobs) -> tuple[NDArray, NDArray]:
    """Where the blobs' next events are expected: means and covariances."""
    p, S = last.p.copy(), last.C * (1 + 4 / last.n)[:, None, None] + 0.1 * np.eye(2)
    if not len(before.n):
        return p, S
    apart = np.hypot(*(last.p[:, None] - before.p).transpose(2, 0, 1))
    nearest = apart.argmin(1)
    reach = 6 * np.sqrt(np.linalg.eigvalsh(last.C)[:, 1]) + 2
    moved = apart[np.arange(len(p)), nearest] < reach
    from_p, from_C = before.p[nearest], before.C[nearest]
    errors = 2 * (last.C / last.n[:, None, None] + from_C / before.n[nearest][:, None, None])
    return (
        np.where(moved[:, None], 2 * p - from_p, p),
        np.where(moved[:, None, None], S + errors, S),
    )


def _intensity(x: NDArray, y: NDArray, n: NDArray, p: NDArray, S: NDArray) -> NDArray[np.float64]:
    """Events per px^2 of some Gaussian blobs at pixels."""
    inverse, determinant = np.linalg.inv(S), np.linalg.det(S)
    ex, ey = x - p[:, :1], y - p[:, 1:]
    squared = inverse[:, 0, 0, None] * ex**2 + 2 * inverse[:, 0, 1, None] * ex * ey
    squared = squared + inverse[:, 1, 1, None] * ey**2
    peak = n / (2 * np.pi * np.sqrt(determinant))
    return (peak[:, None] * np.exp(-0.5 * squared)).sum(0)


@compiled
def _smooth(x: Any, y: Any, px: Any, py: Any, r: Any, g: Any, reach: int, counts: Any) -> Any:
    """Kernels of radius r, 3 / (pi r^2) (1 - d^2 / r^2)^2, about places, summed at pixels.

    Places are counted in bins of g px, `counts`, and lie in their middles.
    """
    out, (rows, columns) = np.zeros(len(x)), counts.shape
    for k in range(len(px)):
        row, column = int(py[k] / g + reach), int(px[k] / g + reach)
        if 0 <= row < rows and 0 <= column < columns:
            counts[row, column] += 1
    for j in range(len(x)):
        row, column = y[j] // g + reach, x[j] // g + reach
        total = 0.0
        for a in range(row - reach, row + reach + 1):
            for b in range(column - reach, column + reach + 1):
                if counts[a, b] > 0:
                    dy, dx = (a - reach + 0.5) * g - y[j], (b - reach + 0.5) * g - x[j]
                    u = 1 - (dx * dx + dy * dy) / (r * r)
                    if u > 0:
                        total += counts[a, b] * u * u
        out[j] = 3 / (np.pi * r * r) * total
    for k in range(len(px)):
        row, column = int(py[k] / g + reach), int(px[k] / g + reach)
        if 0 <= row < rows and 0 <= column < columns:
            counts[row, column] = 0
    return out
