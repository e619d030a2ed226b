"""Images from events alone in the simplest strong way, which `events_only.py` compares with.

One velocity per tile by brute force over the contrast of warped events, then one sparse linear
problem per image: changes between a pixel's consecutive events along the motion, silence, and total
variation. Zhang, Yezzi and Gallego (TPAMI 2022) with tiles in place of dense flow, rows of silence
and a robust loss in place of their network.
"""

import numba
import numpy as np
import scipy.ndimage as nd
import scipy.sparse as sp
from scipy.sparse.linalg import cg

EVENTS = 10_000  # on each side of the image's time, for 240x180 pixels
TILE_PX, WIDTH_PX = 12, 28
TV, LEAK, SILENCE = 0.2, 0.02, 0.5


@numba.njit(cache=True)
def tile_scores(x, y, t, p, vx, vy, image):
    """Return the sum of squares of the image of events warped with each velocity, (vy, vx)."""
    scores, half = np.zeros((len(vy), len(vx))), len(image) / 2
    for a in range(len(vy)):
        for b in range(len(vx)):
            image[:] = 0
            for k in range(len(x)):
                u, v = x[k] - vx[b] * t[k] + half, y[k] - vy[a] * t[k] + half
                i, j = int(np.floor(u)), int(np.floor(v))
                if 0 <= i < len(image) - 1 and 0 <= j < len(image) - 1:
                    fx, fy = u - i, v - j
                    image[j, i] += p[k] * (1 - fx) * (1 - fy)
                    image[j, i + 1] += p[k] * fx * (1 - fy)
                    image[j + 1, i] += p[k] * (1 - fx) * fy
                    image[j + 1, i + 1] += p[k] * fx * fy
            scores[a, b] = (image**2).sum()
    return scores


def tile_flow(x, y, t, p, shape, fastest=(240, 240)):
    """Return the flow (height, width, 2), px/s, of events at t seconds about the time 0."""
    span = t[-1] - t[0]
    vx, vy = (np.arange(-v, v + 1, max(1.4 / span, v / 24)) for v in fastest)
    rows, columns = (np.arange(TILE_PX // 2, n, TILE_PX) for n in shape)
    scores = np.zeros((len(rows), len(columns), len(vy), len(vx)))
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            near = (abs(x - column) < WIDTH_PX / 2) & (abs(y - row) < WIDTH_PX / 2)
            if near.sum() >= 30:
                at = x[near] - float(column), y[near] - float(row), t[near], p[near]
                scores[i, j] = tile_scores(*at, vx, vy, np.zeros((64, 64)))
    scores -= scores.mean((2, 3), keepdims=True)
    scores = nd.gaussian_filter(scores, (1, 1, 0.7, 0.7))
    a, b = np.unravel_index(scores.reshape(*scores.shape[:2], -1).argmax(-1), scores.shape[2:])
    places = [(at - TILE_PX // 2) / TILE_PX for at in np.mgrid[: shape[0], : shape[1]]]
    flow = []
    for one in (vx[b], vy[a]):
        smooth = nd.gaussian_filter(nd.median_filter(one, 3), 0.7)
        flow.append(nd.map_coordinates(smooth, places, order=1, mode="nearest"))
    return np.stack(flow, -1)


def _look_up(x, y, shape):
    height, width = shape
    inside = (x >= 0) & (y >= 0) & (x <= width - 1.001) & (y <= height - 1.001)
    x, y = np.clip(x, 0, width - 1.001), np.clip(y, 0, height - 1.001)
    i, j = x.astype(int), y.astype(int)
    fx, fy = x - i, y - j
    column = np.stack(
        [j * width + i, j * width + i + 1, (j + 1) * width + i, (j + 1) * width + i + 1]
    )
    return (
        inside,
        column.T,
        np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy]).T,
    )


def solve(x, y, t, p, flow, thresholds):
    """Return the log intensity (height, width) at the time 0, from events at t seconds."""
    (height, width), (c_on, c_off) = flow.shape[:2], thresholds
    pixels, low, high = height * width, t[0], t[-1]
    order = np.lexsort((t, y * width + x))
    pixel, time = (y * width + x)[order], t[order]
    step = np.where(p[order] > 0, c_on, -c_off)
    same = np.r_[False, pixel[1:] == pixel[:-1]]
    last, first = np.r_[~same[1:], True], ~same
    silent = np.setdiff1d(np.arange(pixels), pixel)
    parts = [
        (pixel[same], time[np.r_[same[1:], False]], time[same], step[same], 1),
        (pixel[last], time[last], high, 0, SILENCE),
        (pixel[first], low, time[first], step[first] / 2, SILENCE),
        (silent, low, high, 0, SILENCE),
    ]
    columns = [
        np.concatenate(one) for one in zip(*(np.broadcast_arrays(*v) for v in parts), strict=True)
    ]
    at, begin, end, change, weight = columns
    v = flow.reshape(-1, 2)[at]
    (in_a, col_a, w_a), (in_b, col_b, w_b) = (
        _look_up(at % width - v[:, 0] * when, at // width - v[:, 1] * when, (height, width))
        for when in (begin, end)
    )
    kept = in_a & in_b
    rows = np.repeat(np.arange(kept.sum()), 8)
    values = np.concatenate([w_b[kept], -w_a[kept]], 1).ravel()
    index = np.concatenate([col_b[kept], col_a[kept]], 1).ravel()
    D = sp.csr_matrix((values, (rows, index)), shape=(kept.sum(), pixels))
    change, weight = change[kept], weight[kept]

    def difference(n):
        return sp.diags([-np.ones(n - 1), np.ones(n - 1)], [0, 1], shape=(n - 1, n))

    G = sp.vstack(
        [sp.kron(sp.eye(height), difference(width)), sp.kron(difference(height), sp.eye(width))]
    ).tocsr()
    c, image = (c_on + c_off) / 2, np.zeros(pixels)
    trust, flat = weight, np.ones(G.shape[0])
    for _ in range(8):
        A = (
            D.T @ sp.diags(trust / c**2) @ D
            + TV / c * G.T @ sp.diags(flat) @ G
            + LEAK * sp.eye(pixels)
        )
        b = D.T @ (trust * change) / c**2
        image, _ = cg(A, b, x0=image, rtol=1e-3, maxiter=100, M=sp.diags(1 / A.diagonal()))
        trust = weight / (1 + ((D @ image - change) / c) ** 2 / 2)
        flat = 1 / np.sqrt((G @ image) ** 2 + 0.01**2)
    return image.reshape(height, width)


def tile_images(recording, times, events=None, fastest=(240, 240)):
    """Return log intensities (T, height, width) at times (us)."""
    e, shape = recording.events[:], (recording.height, recording.width)
    x, y, p = e.x.astype(int), e.y.astype(int), np.where(e.p, 1, -1)
    ratio = (p > 0).sum() / max((p < 0).sum(), 1)
    events = EVENTS * shape[0] * shape[1] // 43_200 if events is None else events
    images = []
    for time in times:
        at = np.searchsorted(e.t, time)
        s = slice(max(at - events, 0), at + events)
        window = x[s], y[s], (e.t[s] - time) / 1e6, p[s]
        images.append(solve(*window, tile_flow(*window, shape, fastest), (0.1, 0.1 * ratio)))
    return np.stack(images)
