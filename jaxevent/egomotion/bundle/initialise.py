"""Initial motions of a window: those before planes, and headings by the flow of patches.

- `sharpest_rotation`: the pure rotation of the highest contrast;
- `homography_flow`, `planar_solutions`: the homography flow exp(M tau) of the highest contrast,
  decomposed into the two motions before a plane that explain it;
- `measure_patch_flows`, `search_headings`: flows of patches of the derotated events with their
  uncertainty; a robust fit of the rest of the rotation for every heading of a hemisphere, whose
  sign follows from depths > 0.

The two kinds fail on different scenes.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined
from jaxevent.egomotion.bundle.alignment import (
    ContrastMaps,
    ImageScratch,
    WindowEvents,
    blur,
    splat,
)
from jaxevent.egomotion.bundle.warp import MIN_RELATIVE_PLANE_RHO, Path, cross_matrix, pixel_rays
from jaxevent.egomotion.geometry import A, B

N_SEARCHED_HEADINGS = 600  # of a hemisphere, that are tried
PATCH_PX = 24  # of a patch whose flow is measured
PATCH_STRIDE_PX = 16  # between patches
MATRIX_EXPONENTIAL_ORDER = 5  # of exp(M tau)
MAX_BFGS_STEP_HALVINGS = 12  # of a step of `minimise_bfgs`
MIN_BFGS_RELATIVE_GAIN = 1e-8  # of a step that is not the last

ROTATION_GENERATORS = np.array([cross_matrix(axis) for axis in np.eye(3)])
STRAIN_GENERATORS = np.array(
    [
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, -2]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
    ]
)


@njit_fastmath_inlined
def _warp_point(M, x, y, t, f):
    """Move a point by the homography exp(M t).

    Args:
        M: (3, 3) generator, 1/s.
        x: px from the principal point.
        y: px from the principal point.
        t: Time, s.
        f: Focal length, px.

    Returns:
        The position, px from the principal point.
    """
    a, b, c = x / f, y / f, 1.0
    X, Y, Z = a, b, c
    for k in range(1, MATRIX_EXPONENTIAL_ORDER + 1):
        s = t / k
        a, b, c = (
            s * (M[0, 0] * a + M[0, 1] * b + M[0, 2] * c),
            s * (M[1, 0] * a + M[1, 1] * b + M[1, 2] * c),
            s * (M[2, 0] * a + M[2, 1] * b + M[2, 2] * c),
        )
        X, Y, Z = X + a, Y + b, Z + c
    return f * X / Z, f * Y / Z


@njit_fastmath_inlined
def _image_gradient(image, x, y):
    """Return the gradient of an image between its pixels, 0 beyond it.

    Args:
        image: (height, width).
        x: Column, px from the first pixel.
        y: Row, px from the first pixel.

    Returns:
        The derivatives by x and y, 1/px, of the bilinear interpolation.
    """
    height, width = image.shape
    if not (x > -1 and y > -1 and x < width and y < height):
        return 0.0, 0.0
    i, j = int(np.floor(x)), int(np.floor(y))
    u, v = x - i, y - j
    a = image[j, i] if i >= 0 and j >= 0 else 0.0
    b = image[j, i + 1] if i + 1 < width and j >= 0 else 0.0
    c = image[j + 1, i] if i >= 0 and j + 1 < height else 0.0
    d = image[j + 1, i + 1] if i + 1 < width and j + 1 < height else 0.0
    return (1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)


@njit_fastmath
def contrast_and_gradient(window, M, basis, blurs, scratch, gradient):
    """Return minus the contrast of events moved by exp(M tau), and write its gradient.

    Args:
        window: `WindowEvents`.
        M: (3, 3) generator, 1/s.
        basis: (n, 3, 3) generators that M is a combination of.
        blurs: Number of times that the image is blurred.
        scratch: `ImageScratch` with sums (3, MATRIX_EXPONENTIAL_ORDER + 1, 3).
        gradient: (n,) output, by the factors of `basis`.
    """
    x, y, tau, p, f, corner = window.x, window.y, window.tau, window.p, window.f, window.corner
    image, work, terms = scratch.images[0], scratch.work, scratch.sums
    image[:] = 0
    for e in range(len(x)):
        X, Y = _warp_point(M, x[e], y[e], tau[e], f)
        splat(image, X - corner[0], Y - corner[1], p[e])
    blur(image, work, blurs)
    total = 0.0
    for j in range(image.shape[0]):
        for i in range(image.shape[1]):
            total -= float(image[j, i]) ** 2
    blur(image, work, blurs)
    by = terms[2]
    by[:] = 0
    for e in range(len(x)):
        # p_k = (M tau)^k (x, y, f) / f, of which sum_k p_k / k! is the place in homogeneous
        # coordinates. By M, g in these: sum_ij q_i p_j' tau / (i + j + 1)!, q_i = (M' tau)^i g.
        t, X, Y, Z = tau[e], x[e] / f, y[e] / f, 1.0
        p_k, q_k = terms[0], terms[1]
        p_k[0, 0], p_k[0, 1], p_k[0, 2] = X, Y, Z
        share = 1.0
        for k in range(1, MATRIX_EXPONENTIAL_ORDER + 1):
            share /= k
            for m in range(3):
                p_k[k, m] = t * (
                    M[m, 0] * p_k[k - 1, 0] + M[m, 1] * p_k[k - 1, 1] + M[m, 2] * p_k[k - 1, 2]
                )
            X, Y, Z = X + share * p_k[k, 0], Y + share * p_k[k, 1], Z + share * p_k[k, 2]
        px, py = f * X / Z, f * Y / Z
        gx, gy = _image_gradient(image, px - corner[0], py - corner[1])
        gx, gy = -2 * p[e] * gx / Z, -2 * p[e] * gy / Z
        q_k[0, 0], q_k[0, 1], q_k[0, 2] = f * gx, f * gy, -(gx * px + gy * py)
        before = t
        for i in range(MATRIX_EXPONENTIAL_ORDER):
            share = before / (i + 1)
            a, b, c, before = 0.0, 0.0, 0.0, share
            for j in range(MATRIX_EXPONENTIAL_ORDER - i):
                a, b, c = a + share * p_k[j, 0], b + share * p_k[j, 1], c + share * p_k[j, 2]
                share /= i + j + 2
            for m in range(3):
                by[m, 0] += q_k[i, m] * a
                by[m, 1] += q_k[i, m] * b
                by[m, 2] += q_k[i, m] * c
                q_k[i + 1, m] = t * (
                    M[0, m] * q_k[i, 0] + M[1, m] * q_k[i, 1] + M[2, m] * q_k[i, 2]
                )
    for n in range(len(gradient)):
        gradient[n] = 0
        for m in range(3):
            gradient[n] += (
                basis[n, m, 0] * by[m, 0] + basis[n, m, 1] * by[m, 1] + basis[n, m, 2] * by[m, 2]
            )
    return total


@njit_fastmath
def _warp_by_generator(window, M, X, Y):
    """Move events by the homographies exp(M tau).

    Args:
        window: `WindowEvents`.
        M: (3, 3) generator, 1/s.
        X: (n,) output, px from the principal point.
        Y: (n,) output.
    """
    for e in range(len(window.x)):
        X[e], Y[e] = _warp_point(M, window.x[e], window.y[e], window.tau[e], window.f)


@njit_fastmath
def _contrast_by_flow(window, flows, scratch, out):
    """Write contrast and number of events of patches, by flow.

    Args:
        window: `WindowEvents`.
        flows: (n, 2) px/s.
        scratch: `ImageScratch` with sums (2, height // 8, width // 8).
        out: `ContrastMaps` (n, rows, columns) of patches of 3 x 3 squares of 8 px, 16 px apart.
    """
    x, y, tau, corner = window.x, window.y, window.tau, window.corner
    images, squares = scratch.images, scratch.sums
    height, width = images.shape[1:]
    for n in range(len(flows)):
        images[:] = 0
        for e in range(len(x)):
            X, Y = x[e] - flows[n, 0] * tau[e], y[e] - flows[n, 1] * tau[e]
            splat(images[0], X - corner[0], Y - corner[1], window.p[e])
            splat(images[1], X - corner[0], Y - corner[1], images.dtype.type(1))
        blur(images[0], scratch.work, 1)
        squares[:] = 0
        for j in range(height // 8 * 8):
            signed, number = images[0, j], images[1, j]
            for i in range(width // 8):
                s = t = images.dtype.type(0)
                for k in range(8 * i, 8 * i + 8):
                    s += signed[k] * signed[k]
                    t += number[k]
                squares[0, j // 8, i] += s
                squares[1, j // 8, i] += t
        for j in range(out.contrast.shape[1]):
            for i in range(out.contrast.shape[2]):
                s = t = 0.0
                for m in range(3):
                    for k in range(3):
                        s += squares[0, 2 * j + m, 2 * i + k]
                        t += squares[1, 2 * j + m, 2 * i + k]
                out.contrast[n, j, i], out.number[n, j, i] = s, t


def minimise_bfgs(
    function: Callable[[NDArray], tuple[float, NDArray]], at: NDArray, steps: int
) -> tuple[NDArray[np.float64], float]:
    """Minimise a function of a few numbers by BFGS, the first step of length 1.

    SciPy's wakes BLAS's threads, which spin then: three quarters of the CPU seconds.

    Args:
        function: Returns value and gradient.
        at: (n,) numbers to begin with.
        steps: Most steps.

    Returns:
        The numbers (n,) at the minimum, and the value there.
    """
    value, slope = function(at)
    inverse = np.eye(len(at)) / max(float(np.sqrt(slope @ slope)), 1e-30)
    for number in range(steps):
        way = -inverse @ slope
        down, share = float(slope @ way), 1.0
        for _ in range(MAX_BFGS_STEP_HALVINGS):
            new, beyond = function(at + share * way)
            if new <= value + 1e-4 * share * down:
                break
            # To the minimum of the parabola through both values.
            share *= min(max(-share * down / 2 / (new - value - share * down), 0.1), 0.5)
        else:
            break
        s, y, gain = share * way, beyond - slope, value - new
        at, value, slope = at + s, new, beyond
        if gain < MIN_BFGS_RELATIVE_GAIN * abs(value):
            break
        if s @ y > 1e-10 * float(np.sqrt((s @ s) * (y @ y))):
            if not number:
                inverse = np.eye(len(at)) * (s @ y) / (y @ y)
            turned = np.eye(len(at)) - np.outer(s, y) / (s @ y)
            inverse = turned @ inverse @ turned.T + np.outer(s, s) / (s @ y)
    return at, value


def _maximise_contrast(
    window: WindowEvents, basis: NDArray, values: NDArray, blurs: tuple[int, ...], steps: int
) -> tuple[NDArray[np.float64], float]:
    """Maximise the contrast by the factors of generators, from coarse to fine.

    Args:
        window: Events.
        basis: (n, 3, 3) generators.
        values: (n,) factors to begin with, 1/s.
        blurs: Number of times that the image is blurred, for each maximisation.
        steps: Most steps of each.

    Returns:
        The factors, and minus the contrast.
    """
    per_px, least = 1 / (window.f * window.half), 0.0
    terms = np.empty((3, MATRIX_EXPONENTIAL_ORDER + 1, 3))
    scratch = ImageScratch.of(window.shape, window.x.dtype, terms)

    def loss(values: NDArray, times: int) -> tuple[float, NDArray]:
        M, slope = np.tensordot(values, basis, 1), np.empty(len(basis))
        return contrast_and_gradient(window, M, basis, times, scratch, slope), slope

    for times in blurs:
        scale = max(-loss(values, times)[0], 1e-9)

        def value(px: NDArray, times: int = times, scale: float = scale) -> tuple[float, NDArray]:
            contrast, slope = loss(px * per_px, times)
            return contrast / scale, slope / scale * per_px

        found, contrast = minimise_bfgs(value, values / per_px, steps)
        values, least = found * per_px, contrast * scale
    return values, least


def _downsample(window: WindowEvents) -> WindowEvents:
    """Take a third of the events, in pixels twice as large: blurs count four times there."""
    x, y, tau, p = (part[::3].copy() for part in (window.x, window.y, window.tau, window.p))
    (left, right, top, bottom), (height, width) = window.box, window.shape
    return window._replace(
        x=x / 2, y=y / 2, tau=tau, p=p, f=window.f / 2, cell=window.cell // 2,
        box=(left / 2, right / 2, top / 2, bottom / 2), shape=(height // 2, width // 2),
        corner=(window.corner[0] / 2, window.corner[1] / 2),
    )  # fmt: skip


def sharpest_rotation(window: WindowEvents) -> NDArray[np.float64]:
    """Return the pure rotation (3,), rad/s, of the highest contrast; parallax disturbs it."""
    far = 8 / (window.f * window.half)
    first = [np.zeros(3), *(far * sign * axis for axis in np.eye(3) for sign in (1, -1))]
    coarse, basis = _downsample(window), ROTATION_GENERATORS
    found = map_parallel(lambda at: _maximise_contrast(coarse, basis, at, (2,), 4), first)
    best = min(found, key=lambda pair: pair[1])[0]
    best = _maximise_contrast(coarse, basis, best, (2,), 12)[0]
    return _maximise_contrast(window, basis, best, (2, 1), 12)[0]


class PlanarMotion(NamedTuple):
    """A motion before a plane: rho = normal . (x, y, f) / f.

    Attributes:
        T: (3,) translation, m/s or in units of |T|.
        normal: (3,) normal of the plane over its distance, 1/m if T is in m/s.
        Omega: (3,) angular velocity, rad/s.
    """

    T: NDArray[np.float64]
    normal: NDArray[np.float64]
    Omega: NDArray[np.float64]

    def path(self, positions: tuple[NDArray, NDArray], f: float, real: np.dtype) -> Path:
        """Return the path of this constant twist, with the plane's depths at some positions.

        Args:
            positions: x and y (n,), px from the principal point.
            f: Focal length, px.
            real: Type of the depths.
        """
        rho = pixel_rays(*positions, f) @ self.normal * np.linalg.norm(self.T)
        log_rho = np.log(np.maximum(rho, MIN_RELATIVE_PLANE_RHO * np.median(np.abs(rho))))
        heading = self.T / np.linalg.norm(self.T)
        return Path.constant_twist(heading, self.Omega, log_rho.astype(real))


def homography_flow(window: WindowEvents, Omega: NDArray) -> NDArray[np.float64]:
    """Find the generator M of the homographies exp(M tau) of highest contrast.

    For a camera that moves before a plane M is [Omega]x + T n' but for a multiple of 1.

    Args:
        window: Events.
        Omega: (3,) rotation that the search begins with, rad/s.

    Returns:
        M (3, 3), 1/s.
    """
    basis = np.concatenate([ROTATION_GENERATORS, STRAIN_GENERATORS])
    values = np.append(Omega, np.zeros(len(STRAIN_GENERATORS)))
    return np.tensordot(_maximise_contrast(window, basis, values, (8, 4, 2, 1), 20)[0], basis, 1)


def planar_solutions(M: NDArray) -> list[PlanarMotion]:
    """Return the two motions before a plane that explain M: T and n change places, Omega + n x T.

    Of the symmetric part of T n' the middle eigenvalue is 0, the others are
    (T . n +- |T| |n|) / 2 (cf. Longuet-Higgins, "The visual ambiguity of a moving plane", 1984; Ma
    et al., "An Invitation to 3-D Vision", section 5.3.4). Only perspective and time distinguish
    the two.
    """
    size, axes = np.linalg.eigh((M + M.T) / 2)
    a = np.sqrt(max(size[2] - size[1], 1e-9)) * axes[:, 2]
    b = np.sqrt(max(size[1] - size[0], 1e-9)) * axes[:, 0]
    turn = np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]]) / 2
    found = []
    for T, normal in ((a + b, a - b), (a - b, a + b)):
        sign = 1.0 if normal[2] > 0 else -1.0
        found.append(PlanarMotion(sign * T, sign * normal, turn - cross_matrix(normal) @ T / 2))
    return found


def _contrast_of_flows(window: WindowEvents, Omega: NDArray, flows: NDArray) -> ContrastMaps:
    """Compute the contrast of patches of derotated events, by flow.

    Args:
        window: Events.
        Omega: (3,) rotation that is taken off, rad/s.
        flows: (n, 2) px/s.

    Returns:
        Maps (n, rows, columns) of patches.
    """
    real = window.x.dtype
    X, Y = np.empty_like(window.x), np.empty_like(window.x)
    _warp_by_generator(window, np.tensordot(Omega, ROTATION_GENERATORS, 1), X, Y)
    rows, columns = (max((n // 8 - 3) // 2 + 1, 0) for n in window.shape)
    out = ContrastMaps(*(np.empty((len(flows), rows, columns)) for _ in range(2)))
    squares = np.empty((2, window.shape[0] // 8, window.shape[1] // 8))
    scratch = ImageScratch.of(window.shape, real, squares)
    _contrast_by_flow(window._replace(x=X, y=Y), flows.astype(real), scratch, out)
    return out


class PatchFlows(NamedTuple):
    """Flows of patches."""

    xi: NDArray[np.float64]  # (n, 2) px, from the principal point
    U: NDArray[np.float64]  # (n, 2) px/s
    covariance: NDArray[np.float64]  # (n, 2, 2)


def measure_patch_flows(window: WindowEvents, Omega: NDArray, flow_max: float) -> PatchFlows | None:
    """Measure the flows of patches of derotated events.

    Args:
        window: Events.
        Omega: (3,) rotation that is taken off, rad/s.
        flow_max: Largest component of the remaining flow, px/s.

    Returns:
        The flows; None if fewer than 6 patches show one.
    """
    step = 0.6 / window.half
    count = int(np.ceil(flow_max / step))
    grid = np.arange(-count, count + 1) * step
    n = len(grid)
    flows = np.stack(np.meshgrid(grid, grid, indexing="ij"), -1).reshape(-1, 2)
    S, N = _contrast_of_flows(window, Omega, flows)
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
        xi = np.array([column, row]) * PATCH_STRIDE_PX
        xi = np.array(window.corner) + xi + (PATCH_PX - 1) / 2
        found.append((xi, np.array([grid[i], grid[j]]) + off * step, covariance))
    if len(found) < 6:
        return None
    return PatchFlows(*(np.array(part) for part in zip(*found, strict=True)))


class InitialMotion(NamedTuple):
    """A constant twist with depths of patches."""

    heading: NDArray[np.float64]  # (3,)
    Omega: NDArray[np.float64]  # (3,) rad/s
    rho: NDArray[np.float64]  # (patches,), in units of 1/|T|
    information: NDArray[np.float64]  # (patches,) of rho

    def path(self, window: WindowEvents, flows: PatchFlows) -> Path:
        """Return the path of this twist, with depths of cells by those of the patches nearby.

        Args:
            window: Events, which define the cells.
            flows: Flows of the patches, for their positions.

        Returns:
            The path.
        """
        x, y = window.cell_positions
        far = (x[:, None] - flows.xi[:, 0]) ** 2 + (y[:, None] - flows.xi[:, 1]) ** 2
        weight, rho = self.information, self.rho
        mean_rho = max(float(np.average(rho, weights=weight + 1e-12)), 1e-3)
        share = np.exp(-far / (2 * PATCH_PX**2)) * weight / max(weight.mean(), 1e-12) + 1e-6
        depth = (share * np.clip(rho, 0.15 * mean_rho, 6 * mean_rho)).sum(1) / share.sum(1)
        return Path.constant_twist(self.heading, self.Omega, np.log(depth).astype(window.x.dtype))


def search_headings(
    flows: PatchFlows, f: float, Omega: NDArray, number: int
) -> list[InitialMotion]:
    """Search the headings that explain the flows of patches best, at least 32 degrees apart.

    For every heading of a hemisphere the rest of the rotation is fitted to the flows' components
    across its epipolar lines, robustly (Geman & McClure, the limit falling from 64 to 2
    deviations); depths > 0 choose its sign.

    Args:
        flows: Flows of derotated patches.
        f: Focal length, px.
        Omega: (3,) rotation that was taken off, rad/s.
        number: Most motions.

    Returns:
        The motions, the best first.
    """
    k = np.arange(N_SEARCHED_HEADINGS) + 0.5
    z, azimuth = k / N_SEARCHED_HEADINGS, np.pi * (1 + 5**0.5) * k
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
    more = np.zeros((N_SEARCHED_HEADINGS, 3))
    damping = 1e-6 * f * f * np.eye(3)
    for turn_number in range(10):
        left = target - np.einsum("tkj,tj->tk", basis, more)
        limit = 4.0 * 4.0 ** max(0, 5 - turn_number)
        weight = 1 / variance / (1 + left**2 / variance / limit) ** 2
        weighted = (weight[..., None] * basis).swapaxes(1, 2)
        H = weighted @ basis + damping
        side = (weighted @ target[..., None])[..., 0]
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
        cost = (e / (1 + e / 4)).sum(1)
        found += list(zip(cost, sign * T, more + Omega, rho, along, strict=True))
    found.sort(key=lambda one: one[0])
    best: list[InitialMotion] = []
    for _, *one in found:
        if all(one[0] @ other.heading < 0.85 for other in best):
            best.append(InitialMotion(*one))
            if len(best) == number:
                break
    return best


def map_parallel(function: Callable[[Any], Any], items: list[Any]) -> list[Any]:
    """Apply a function to items, on as many threads as there are cores.

    Args:
        function: Function of one item.
        items: The items.

    Returns:
        The results, in the items' order.
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(function, items))
