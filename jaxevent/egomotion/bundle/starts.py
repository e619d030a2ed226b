"""Motions to begin with: of planes, and of patches whose flow is measured.

- `rotation`: the pure rotation of the highest contrast;
- `homography`, `before_a_plane`: the homography flow exp(M tau) of the highest contrast, taken
  apart into the two motions before a plane that explain it;
- `patch_flows`, `headings`: flows of patches of the derotated events with their uncertainty; a
  robust fit of the rest of the rotation for every heading of a hemisphere, both signs of T told
  apart by depths > 0.

The two kinds fail on different scenes.
"""

import dataclasses
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.bundle import images
from jaxevent.egomotion.bundle.alignment import Window
from jaxevent.egomotion.bundle.path import LEAST, Path, crossing, rays_of
from jaxevent.egomotion.geometry import A, B

DIRECTIONS = 600  # headings of a hemisphere that are tried
HOP, PATCH = 16, 24  # px between patches whose flow is measured, and their size


# Of a search for the sharpest image: halvings of a step at most, and the share that is no gain.
HALVED, GAINED = 12, 1e-8

TURNS = np.array([crossing(axis) for axis in np.eye(3)])
STRAINS = np.array(
    [
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, -2]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
    ]
)


def _least(
    function: Callable[[NDArray], tuple[float, NDArray]], at: NDArray, steps: int
) -> tuple[NDArray[np.float64], float]:
    """Where a function of a few numbers is least, from somewhere on, and its value there.

    By steps of BFGS, the first of length 1. (That of scipy wakes BLAS's threads, which spin
    then: three quarters of the CPU seconds.)
    """
    value, slope = function(at)
    inverse = np.eye(len(at)) / max(float(np.sqrt(slope @ slope)), 1e-30)
    for number in range(steps):
        way = -inverse @ slope
        down, share = float(slope @ way), 1.0
        for _ in range(HALVED):
            new, beyond = function(at + share * way)
            if new <= value + 1e-4 * share * down:
                break
            # Of the parabola, whose bottom it is.
            share *= min(max(-share * down / 2 / (new - value - share * down), 0.1), 0.5)
        else:
            break
        s, y, gain = share * way, beyond - slope, value - new
        at, value, slope = at + s, new, beyond
        if gain < GAINED * abs(value):
            break
        if s @ y > 1e-10 * float(np.sqrt((s @ s) * (y @ y))):
            if not number:
                inverse = np.eye(len(at)) * (s @ y) / (y @ y)
            turned = np.eye(len(at)) - np.outer(s, y) / (s @ y)
            inverse = turned @ inverse @ turned.T + np.outer(s, s) / (s @ y)
    return at, value


def _sharpest(
    window: Window, basis: NDArray, values: NDArray, blurs: tuple[int, ...], steps: int
) -> tuple[NDArray[np.float64], float]:
    """Values of generators of the highest contrast, from some on, and minus that contrast."""
    per_px, real, least = 1 / (window.f * window.half), window.x.dtype, 0.0
    image, work = np.empty(window.shape, real), np.empty(window.shape, real)
    terms = np.empty((3, images.ORDER + 1, 3))

    def loss(values: NDArray, times: int) -> tuple[float, NDArray]:
        M, slope = np.tensordot(values, basis, 1), np.empty(len(basis))
        told = images.contrast_and_slope(
            window.x, window.y, window.tau, window.p, M, basis, window.corner, window.f, times,
            image, work, terms, slope,
        )  # fmt: skip
        return told, slope

    for times in blurs:
        scale = max(-loss(values, times)[0], 1e-9)

        def value(px: NDArray, times: int = times, scale: float = scale) -> tuple[float, NDArray]:
            told, slope = loss(px * per_px, times)
            return told / scale, slope / scale * per_px

        found, told = _least(value, values / per_px, steps)
        values, least = found * per_px, told * scale
    return values, least


def _coarser(window: Window) -> Window:
    """A third of the events, in pixels twice as large: to blur twice there is to blur 8 times."""
    x, y, tau, p = (part[::3].copy() for part in (window.x, window.y, window.tau, window.p))
    (left, right, top, bottom), (height, width) = window.box, window.shape
    return dataclasses.replace(
        window, x=x / 2, y=y / 2, tau=tau, p=p, f=window.f / 2, cell=window.cell // 2,
        box=(left / 2, right / 2, top / 2, bottom / 2), shape=(height // 2, width // 2),
        corner=(window.corner[0] / 2, window.corner[1] / 2),
    )  # fmt: skip


def rotation(window: Window) -> NDArray[np.float64]:
    """The pure rotation (rad/s) of the highest contrast; with parallax only a beginning."""
    far = 8 / (window.f * window.half)
    first = [np.zeros(3), *(far * sign * axis for axis in np.eye(3) for sign in (1, -1))]
    coarse = _coarser(window)
    found = side_by_side(lambda at: _sharpest(coarse, TURNS, at, (2,), 4), first)
    best = min(found, key=lambda pair: pair[1])[0]
    best = _sharpest(coarse, TURNS, best, (2,), 12)[0]
    return _sharpest(window, TURNS, best, (2, 1), 12)[0]


class Plane(NamedTuple):
    """A motion before a plane: rho = normal . (x, y, f) / f, in 1/m if T is in m/s."""

    T: NDArray[np.float64]
    normal: NDArray[np.float64]
    Omega: NDArray[np.float64]

    def path(self, x: NDArray, y: NDArray, f: float, real: np.dtype) -> Path:
        """The path of this constant twist, with the plane's depths at some places (px)."""
        rho = rays_of(x, y, f) @ self.normal * np.linalg.norm(self.T)
        log_rho = np.log(np.maximum(rho, LEAST * np.median(np.abs(rho))))
        return Path.constant(self.T / np.linalg.norm(self.T), self.Omega, log_rho.astype(real))


def homography(window: Window, Omega: NDArray) -> NDArray[np.float64]:
    """M (3, 3), 1/s, of the homographies exp(M tau) of highest contrast, from a rotation on.

    Of a camera that moves before a plane M is [Omega]x + T n' but for a multiple of 1.
    """
    basis, values = np.concatenate([TURNS, STRAINS]), np.append(Omega, np.zeros(len(STRAINS)))
    return np.tensordot(_sharpest(window, basis, values, (8, 4, 2, 1), 20)[0], basis, 1)


def before_a_plane(M: NDArray) -> list[Plane]:
    """The two motions before a plane that explain M: T and n change places, Omega + n x T.

    Of the symmetric part of T n' the middle eigenvalue is 0, the others are
    (T . n +- |T| |n|) / 2 (cf. Longuet-Higgins, "The visual ambiguity of a moving plane", 1984; Ma
    et al., "An Invitation to 3-D Vision", section 5.3.4). Only perspective and time tell the two
    from each other.
    """
    size, axes = np.linalg.eigh((M + M.T) / 2)
    a = np.sqrt(max(size[2] - size[1], 1e-9)) * axes[:, 2]
    b = np.sqrt(max(size[1] - size[0], 1e-9)) * axes[:, 0]
    turn = np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]]) / 2
    found = []
    for T, normal in ((a + b, a - b), (a - b, a + b)):
        sign = 1.0 if normal[2] > 0 else -1.0
        found.append(Plane(sign * T, sign * normal, turn - crossing(normal) @ T / 2))
    return found


def _flow_maps(window: Window, Omega: NDArray, flows: NDArray) -> tuple[NDArray, NDArray]:
    """Contrast and number of events of all patches, (n, rows, columns), for flows (px/s)."""
    real = window.x.dtype
    X, Y = np.empty_like(window.x), np.empty_like(window.x)
    M = np.tensordot(Omega, TURNS, 1)
    images.turned(window.x, window.y, window.tau, M, window.f, X, Y)
    rows, columns = (max((n // 8 - 3) // 2 + 1, 0) for n in window.shape)
    S, N = np.empty((len(flows), rows, columns)), np.empty((len(flows), rows, columns))
    both, work = np.empty((2, *window.shape), real), np.empty(window.shape, real)
    squares = np.empty((2, window.shape[0] // 8, window.shape[1] // 8))
    images.flow_maps(
        X, Y, window.tau, window.p, flows.astype(real), window.corner, both, work, squares, S, N
    )
    return S, N


class Flows(NamedTuple):
    """Of patches: places (n, 2) px, flows (n, 2) px/s and their covariances."""

    xi: NDArray[np.float64]
    U: NDArray[np.float64]
    covariance: NDArray[np.float64]


def patch_flows(window: Window, Omega: NDArray, flow_max: float) -> Flows | None:
    """Flows of patches of the derotated events; None if fewer than 6 tell one."""
    step = 0.6 / window.half
    count = int(np.ceil(flow_max / step))
    grid = np.arange(-count, count + 1) * step
    n = len(grid)
    flows = np.stack(np.meshgrid(grid, grid, indexing="ij"), -1).reshape(-1, 2)
    S, N = _flow_maps(window, Omega, flows)
    sharp = (S / np.maximum(N, 20)).reshape(n, n, *S.shape[1:])
    N = N.reshape(sharp.shape)
    a, b = (part.ravel() for part in np.mgrid[-1:2, -1:2].astype(float))
    # Least squares of a quadratic on 3 x 3 values.
    solve = np.linalg.pinv(np.stack([np.ones(9), a, b, a * a / 2, a * b, b * b / 2], 1))
    found = []
    for row, column in np.ndindex(*S.shape[1:]):
        map_ = sharp[:, :, row, column]
        i, j = np.unravel_index(np.argmax(map_), map_.shape)
        events = N[i, j, row, column]
        if not (0 < i < n - 1 and 0 < j < n - 1) or events < 40:
            continue
        _, ga, gb, aa, ab, bb = solve @ map_[i - 1 : i + 2, j - 1 : j + 2].ravel()
        bend, axes = np.linalg.eigh(-np.array([[aa, ab], [ab, bb]]))
        bend = np.maximum(bend, 1e-4 * map_[i, j] + 1e-9)
        off = np.clip(axes @ (axes.T @ np.array([ga, gb]) / bend), -1, 1)
        information = axes * bend @ axes.T * events / map_[i, j] / step**2
        covariance = 16 * np.linalg.inv(information) + 4 * np.eye(2)
        xi = np.array(window.corner) + np.array([column, row]) * HOP + (PATCH - 1) / 2
        found.append((xi, np.array([grid[i], grid[j]]) + off * step, covariance))
    if len(found) < 6:
        return None
    return Flows(*(np.array(part) for part in zip(*found, strict=True)))


def headings(flows: Flows, f: float, Omega: NDArray, number: int, omega_weight: float) -> list:
    """The best (heading, Omega, inverse depths, their weights), at least 32 degrees apart.

    For every heading of a hemisphere the rest of the rotation is fitted to what flows are across
    its epipolar lines, robustly (Geman & McClure, the limit falling from 64 to 2 deviations);
    depths > 0 choose its sign.
    """
    k = np.arange(DIRECTIONS) + 0.5
    z, azimuth = k / DIRECTIONS, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - z * z)
    T = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], 1)
    x, y = flows.xi.T
    a = np.einsum("kij,tj->tki", np.asarray(A(x, y, f), np.float64), T)
    turn = np.asarray(B(x, y, f), np.float64)
    across = np.stack([-a[..., 1], a[..., 0]], -1)
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
    variance = np.einsum("tki,kij,tkj->tk", across, flows.covariance, across)
    target = np.einsum("tki,ki->tk", across, flows.U)
    basis = np.einsum("tki,kij->tkj", across, turn)
    more = np.zeros((DIRECTIONS, 3))
    damping = (1e-6 * f * f + omega_weight) * np.eye(3)
    for turn_number in range(10):
        left = target - np.einsum("tkj,tj->tk", basis, more)
        limit = 4.0 * 4.0 ** max(0, 5 - turn_number)
        weight = 1 / variance / (1 + left**2 / variance / limit) ** 2
        weighted = (weight[..., None] * basis).swapaxes(1, 2)
        H = weighted @ basis + damping
        side = (weighted @ target[..., None])[..., 0] - omega_weight * Omega
        more = np.linalg.solve(H, side[..., None])[..., 0]
    rest = flows.U - np.einsum("kij,tj->tki", turn, more)
    information = np.linalg.inv(flows.covariance)
    along = np.einsum("tki,kij,tkj->tk", a, information, a)
    towards = np.einsum("tki,kij,tkj->tk", a, information, rest)
    found = []
    for sign in (1, -1):
        rho = np.maximum(sign * towards / np.maximum(along, 1e-12), 0)
        miss = rest - sign * rho[..., None] * a
        e = np.einsum("tki,kij,tkj->tk", miss, information, miss)
        cost = (e / (1 + e / 4)).sum(1) + omega_weight * ((more + Omega) ** 2).sum(1)
        found += list(zip(cost, sign * T, more + Omega, rho, along, strict=True))
    found.sort(key=lambda one: one[0])
    best: list = []
    for one in found:
        if all(one[1] @ other[1] < 0.85 for other in best):
            best.append(one)
            if len(best) == number:
                break
    return [one[1:] for one in best]


def start(
    window: Window, flows: Flows, T: NDArray, Omega: NDArray, rho: NDArray, weight: NDArray
) -> Path:
    """A path of constant twist with depths that patches tell, the nearest ones most."""
    x, y = window.places
    far = (x[:, None] - flows.xi[:, 0]) ** 2 + (y[:, None] - flows.xi[:, 1]) ** 2
    usual = max(float(np.average(rho, weights=weight + 1e-12)), 1e-3)
    share = np.exp(-far / (2 * PATCH**2)) * weight / max(weight.mean(), 1e-12) + 1e-6
    depth = (share * np.clip(rho, 0.15 * usual, 6 * usual)).sum(1) / share.sum(1)
    return Path.constant(T, Omega, np.log(depth).astype(window.x.dtype))


def side_by_side(follow: Callable[[Any], Any], rivals: list[Any]) -> list[Any]:
    """What comes of rivals, of some at a time: steps of one keep about one core busy."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(follow, rivals))
