"""How long the windows and how large the cells are: those that best predict the next events.

In some stretches of the recording blobs are detected in two windows, and the third is predicted:
each blob goes on as it went. What is compared is the likelihood of the third's events, a Poisson
process of the blobs and the background. Windows that are too short find nothing, those that are too
long smear; between them the maximum is flat.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.finding.background import Background, measure_dispersion
from jaxevent.blob.finding.detection import Blobs, Scale, detect, measure_blobs
from jaxevent.blob.finding.stream import Part, Stream

WINDOWS = 500 * 2 ** np.arange(12)  # us
CELLS = (2, 4, 8, 16)  # px
LEAST_WINDOWS = 8  # in a recording
STRETCHES = 24  # in which the scales are compared
SCORED = 2000  # most events of a window that are scored
CONTACT = 2.0  # blobs nearer than this many times the sum of their sizes touch
SPLIT = 0.1  # of the score is lost where all events are in blobs that touch another one
PLATEAU, TIE = 0.03, 0.005  # shares of the score that scales may lose as equally good


@dataclasses.dataclass(frozen=True)
class Choice:
    """A scale, and by how much it predicts events better than the background: nats per event."""

    scale: Scale
    score: float


def choose_scale(stream: Stream, background: Background) -> Choice | None:
    """The scale that predicts best; None if the recording is too short or nothing is found."""
    windows = WINDOWS[LEAST_WINDOWS * WINDOWS * 1e-6 <= stream.duration] * 1e-6
    if not len(windows):
        return None
    scores, dispersions = np.zeros((len(windows), len(CELLS))), []
    for i, w in enumerate(windows):
        dispersions.append(measure_dispersion(stream, background, w))
        begins = np.clip(stream.times(STRETCHES), 2 * w, stream.duration - w)
        windows_of = [
            [stream.window(t + k * w, t + (k + 1) * w) for k in (-2, -1, 0)] for t in begins
        ]
        for j, g in enumerate(CELLS):
            scale = Scale(float(w), g, dispersions[i])
            told = [
                _predict(parts, t, stream, background, scale)
                for parts, t in zip(windows_of, begins, strict=True)
            ]
            nats, events, touching, found = np.sum(told, axis=0)
            score = nats / max(events, 1)
            scores[i, j] = score - SPLIT * abs(score) * touching / max(found, 1e-9)
    best = scores.max()
    if best <= 0:
        return None
    # Of what is equally good the coarsest cells, and with them the longest windows.
    j = np.flatnonzero((scores >= best - PLATEAU * best).any(0)).max()
    i = np.flatnonzero(scores[:, j] >= scores[:, j].max() - TIE * best).max()
    return Choice(Scale(float(windows[i]), CELLS[j], dispersions[i]), float(best))


def _predict(
    parts: list[Part], t: float | int, stream: Stream, background: Background, scale: Scale
) -> NDArray[np.float64]:
    """Nats and events of the third window; events in touching blobs, and in all, of the second."""
    size, w = (stream.height, stream.width), scale.window
    before, last = (
        measure_blobs(part, *detect(part, background, scale, size, t)) for part in parts[:2]
    )
    third = parts[2]
    if not len(third) or not len(last.n):
        return np.array([0.0, len(third), 0.0, 0.0])
    share = max(1.0, len(third) / SCORED)
    some = slice(None)
    if share > 1:
        some = np.linspace(0, len(third) - 1, SCORED).astype(np.int64)
    x, y = third.x[some], third.y[some]
    b = background.at(x, y, t) * w
    p, S = _extrapolate(before, last)
    nats = share * (np.log(_intensity(x, y, last.n, p, S) + b) - np.log(b)).sum() - last.n.sum()
    large = last.n >= 3
    size_of = np.sqrt(np.linalg.eigvalsh(last.C[large])[:, 1])
    apart = np.hypot(*(last.p[large, None] - last.p[large]).transpose(2, 0, 1))
    near = apart < CONTACT * (size_of[:, None] + size_of)
    np.fill_diagonal(near, False)
    return np.array([nats, len(third), last.n[large][near.any(1)].sum(), last.n[large].sum()])


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
