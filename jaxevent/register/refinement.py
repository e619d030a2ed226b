"""Refinement of a registration to a fraction of a pixel and a millisecond, by images of change."""

import contextlib
import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse

from jaxevent.errors import InputError
from jaxevent.recording import Recording
from jaxevent.register.frames import log_image
from jaxevent.register.geometry import (
    Grid,
    Registration,
    apply_homography,
    check_homography,
    distort,
    mask_outside,
    pixel_scale,
    recording_grid,
    undistorted_pixels,
)

_SMOOTHINGS_PX = (4.0, 2.0, 1.2)  # smoothings of changes, one after another, px of the event camera
_MAX_STEPS = 12  # most Gauss-Newton steps at each smoothing
_N_FRAME_PAIRS = 32  # pairs of frames that are compared
_MAX_PAIR_PIXELS = 40_000  # most pixels of a pair that are compared
_MIN_UNCLIPPED_WEIGHT = 0.75  # least weight of unclipped pixels in a smoothed change that counts
MIN_AGREEMENT = 0.25  # correlation of changes below which a registration is refused


def refine(
    recording: Recording,
    other: Recording,
    offset: float | int,
    grid: Grid | None = None,
    homographies: Sequence[ArrayLike] | None = None,
    *,
    keep_offset: bool = False,
) -> Registration:
    """Refine an offset, and a homography unless a grid is given, to a fraction of a ms and a pixel.

    Between two frames ln intensity changes by D. With W the position that a pixel sees and o the
    offset, events of the same time give

        D(W(x; h)) = a ON(x; o) - b OFF(x; o) + const,

    ON and OFF being the numbers of events from one mid-exposure to the other. h, o and the
    thresholds a, b minimise the sum of squares over pixels and 32 pairs of frames, with Huber's
    weights, by Gauss-Newton steps from coarse to fine (smoothed by 4, 2 and 1.2 px). This is the
    alignment of Evangelidis and Psarakis (PAMI 2008), applied to images of change. Both cameras
    measure changes alike, so no reconstruction, which would lag, is needed. Clipped pixels do not
    count. The homography is parameterised by the positions of the image's corners.

    Args:
        recording: Events of the event camera.
        other: Frames of the other camera.
        offset: Initial offset of the clocks, s, correct to half a frame.
        grid: Grid (height, width, 2) of a calibrated rig, which is kept.
        homographies: Initial homographies (3, 3), correct to about 5 px; the one whose changes
            agree best is refined.
        keep_offset: Whether the offset is kept.

    Returns:
        The refined registration.

    Raises:
        InputError: Frames and events share no changes to compare.
    """
    if (grid is None) == (not homographies):
        raise InputError("give either a grid or homographies to start from")
    starts = [None] if grid is not None else [check_homography(one) for one in homographies or ()]
    tries = []
    for H in starts:
        problem = _AlignmentProblem(recording, other, grid, H, keep_offset)
        unknowns = np.append(problem.corners, float(offset))
        with contextlib.suppress(InputError):
            problem.choose_pairs(float(offset))
            fit = problem.fit_thresholds(unknowns, _SMOOTHINGS_PX[0])
            tries.append((fit.agreement, H, problem, unknowns))
    if not tries:
        raise InputError(
            f"{other.name}: with the offset {offset:g} s its frames show too little, unclipped, of "
            "what the events show to compare them; give another offset, homography or calibration"
        )
    agreement, H, problem, unknowns = max(tries, key=lambda one: one[0])
    for sigma in _SMOOTHINGS_PX:
        unknowns, agreement = problem.run_gauss_newton(unknowns, sigma)
        if agreement < MIN_AGREEMENT / 2:  # correct registrations begin above 0.5
            break
    if H is not None:
        H = problem.homography(unknowns)
        grid = recording_grid(recording, other, H)
    assert grid is not None
    return Registration(grid, float(unknowns[-1]), H, float(agreement))


@dataclasses.dataclass(frozen=True)
class _Fit:
    """Linear model of the changes of all pairs of frames, fitted to events.

    Attributes:
        X: (values, 3) ON events, OFF events, and 1.
        D: (values,) changes of log intensity.
        slope: (values, 2) derivative of `D` per px of the other camera.
        use: (pairs, n) whether a pixel of a pair is used.
        weight: (values,) robust weights.
        b: (3,) coefficients of `X`.
        agreement: Correlation of the fit with the changes.
    """

    X: NDArray[np.float64]
    D: NDArray[np.float64]
    slope: NDArray[np.float64]
    use: NDArray[np.bool_]
    weight: NDArray[np.float64]
    b: NDArray[np.float64]
    agreement: float


class _AlignmentProblem:
    """Least-squares problem of `refine`: changes between frames, by frames and by events."""

    def __init__(
        self,
        recording: Recording,
        other: Recording,
        grid: Grid | None,
        homography: NDArray[np.float64] | None,
        keep_offset: bool,
    ):
        assert other.frames is not None
        self.recording, self.other, self.keep_offset = recording, other, keep_offset
        self.frames = other.frames
        self.size = recording.width, recording.height
        width, height = self.size
        self.shape = other.height, other.width
        self.finest = max(1, math.ceil(math.sqrt(width * height / _MAX_PAIR_PIXELS)))
        self.stride = self.finest
        self.fixed = None if grid is None or homography is not None else grid
        self.corners = np.empty(0)
        self.outline = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
        if homography is not None:
            self.corners = apply_homography(homography, self.outline).ravel()
        self.pixels = undistorted_pixels(recording.camera, self.size).reshape(height, width, 2)
        self.pairs = np.empty((0, 2), np.intp)
        self._near: tuple[float, list] | None = None
        self._images: tuple[Any, Any] = None, None

    def homography(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the homography that maps the corners to at[:8] (Hartley & Zisserman, 4.1)."""
        rows, values = [], []
        for (x, y), (u, v) in zip(self.outline, unknowns[:8].reshape(4, 2), strict=True):
            rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
            values += [u, v]
        return np.append(np.linalg.solve(np.array(rows), values), 1.0).reshape(3, 3)

    def positions(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the positions (n, 2), px, in the other camera of compared pixels; NaN outside."""
        s = self.stride
        if self.fixed is not None:
            return self.fixed[s // 2 :: s, s // 2 :: s].reshape(-1, 2)
        pixels = self.pixels[s // 2 :: s, s // 2 :: s].reshape(-1, 2)
        seen = distort(self.other.camera, apply_homography(self.homography(unknowns), pixels))
        return mask_outside(seen, (self.other.width, self.other.height))

    def choose_pairs(self, offset: float) -> None:
        """Choose pairs of frames with many events between them, about one event per pixel."""
        t = self.frames.t + round(offset * 1e6)
        begin, end = self.recording.event_span()
        inside = np.flatnonzero((t >= begin) & (t <= end))
        if len(inside) < 2:
            raise InputError(
                f"{self.other.name}: with the offset {offset:g} s no two of its frames fall into "
                "the time of the events; give another offset"
            )
        index = np.array([self.recording.events.index(int(one)) for one in t[inside]])
        each = max((index[-1] - index[0]) / (len(index) - 1), 1) / (self.size[0] * self.size[1])
        apart = int(np.clip(round(1 / each), 1, max(1, (len(inside) - 1) // 4)))
        first = np.arange(0, len(inside) - apart, max(1, apart // 2))
        # Spread over all times: under constant motion a translation cannot be told from an offset.
        clear = np.array([self._unclipped_share(int(k)) for k in inside])
        worth = (index[first + apart] - index[first]) * np.minimum(
            clear[first], clear[first + apart]
        )
        first = first[worth >= 0.2 * worth.max()]
        first = first[np.unique(np.linspace(0, len(first) - 1, _N_FRAME_PAIRS).astype(int))]
        self.pairs = np.stack([inside[first], inside[first + apart]], 1)
        self.apart = float(np.median(t[self.pairs[:, 1]] - t[self.pairs[:, 0]]))
        self._near, self._images = None, (None, None)

    @functools.lru_cache(maxsize=4096)  # noqa: B019, lives as long as one estimate
    def _unclipped_share(self, row: int) -> float:
        """Return the share of a frame's pixels that are not clipped."""
        return float(log_image(self.other, row)[1].mean())

    def event_changes(self, offset: float, sigma: float) -> NDArray[np.float64]:
        """Return smoothed numbers of ON and OFF events of each pair.

        An event shows that a threshold has been crossed since the pixel's last event, so counts lag
        behind intensity by half a threshold, in slow scenes by tens of ms. Each event is therefore
        spread evenly over the interval from the pixel's previous event of the same polarity to it;
        this interval is cut to the length of the one after it if that is shorter.

        Args:
            offset: Offset of the clocks, s.
            sigma: Smoothing, px of the event camera.

        Returns:
            (pairs, n, 2) numbers at the compared pixels.
        """
        t = self.frames.t[self.pairs] + offset * 1e6
        width, height = self.size
        s, out = self.stride, []
        for (begin, end), (place, first, last) in zip(
            t, self._event_intervals(offset), strict=True
        ):
            within = np.minimum(last, end) - np.maximum(first, begin)
            part = np.clip(within / (last - first), 0, 1)
            counts = np.bincount(place, part, 2 * width * height).reshape(2, height, width)
            smooth = ndimage.gaussian_filter(counts.astype(np.float32), (0, sigma, sigma))
            out.append(smooth[::-1, s // 2 :: s, s // 2 :: s].reshape(2, -1).T)
        return np.stack(out).astype(np.float64)

    def _event_intervals(self, offset: float) -> list[tuple[NDArray, NDArray, NDArray]]:
        """Return, for each pair, the events' index of polarity and pixel, begin and end (us)."""
        if self._near is None or abs(offset - self._near[0]) * 1e6 > self.apart / 2:
            width, height = self.size
            found = []
            for begin, end in self.frames.t[self.pairs] + round(offset * 1e6):
                around = (begin - 2 * self.apart, end + 2 * self.apart)
                rows = slice(*(self.recording.events.index(int(one)) for one in around))
                events = self.recording.events[rows]
                pixel = events.y.astype(np.intp) * width + events.x
                order = np.argsort(pixel, kind="stable")
                t, p, pixel = events.t[order].astype(np.float64), events.p[order], pixel[order]
                same = (pixel[1:] == pixel[:-1]) & (p[1:] == p[:-1])
                gap = np.where(same, np.diff(t), np.inf)
                since = np.minimum(np.append(np.inf, gap), np.append(gap, np.inf))
                # An isolated event has no interval: 1 us.
                since = np.maximum(np.where(np.isfinite(since), since, 1), 1)
                found.append((p * (height * width) + pixel, t - since, t))
            self._near = offset, found
        return self._near[1]

    def frame_changes(self, unknowns: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
        """Return the smoothed changes of frames at the compared pixels.

        Args:
            unknowns: Corners' positions (8,), if a homography is fitted, and the offset.
            sigma: Smoothing, px of the event camera.

        Returns:
            (pairs, n, 4): D, its gradient along x and y, and its weight.
        """
        where = self.positions(unknowns)
        part = self.pixels[self.stride // 2 :: self.stride, self.stride // 2 :: self.stride]
        scale = pixel_scale(where.reshape(part.shape)) / self.stride
        images = self._smoothed_changes(sigma, scale)
        inside = ~np.isnan(where[:, 0])
        values = _interpolation_matrix(np.where(inside[:, None], where, 0), self.shape) @ images
        values = values.reshape(len(where), -1, 4).swapaxes(0, 1)
        values[..., 3] *= inside
        return values

    def _smoothed_changes(self, sigma: float, scale: float) -> NDArray[np.float64]:
        """Smooth the changes of the other camera's frames.

        Args:
            sigma: Smoothing, px of the event camera.
            scale: Pixels of the other camera per pixel of the event camera.

        Returns:
            (other pixels, pairs * 4): D, its gradient along x and y, and 1 where it is known.
        """
        blur = sigma * scale
        if self._images[0] is None or abs(math.log(self._images[0] / blur)) > 0.1:
            images = []
            for one, two in self.pairs:
                (low, known), (high, well) = (log_image(self.other, int(k)) for k in (one, two))
                good = (known & well).astype(np.float32)
                change = (high - low).astype(np.float32) * good
                weight = ndimage.gaussian_filter(good, blur)
                D = ndimage.gaussian_filter(change, blur) / np.maximum(weight, 0.1)
                known = (weight > _MIN_UNCLIPPED_WEIGHT).astype(np.float32)
                images += [D, np.gradient(D, axis=1), np.gradient(D, axis=0), known]
            self._images = blur, np.stack([one.ravel() for one in images], 1).astype(np.float64)
        return self._images[1]

    def run_gauss_newton(
        self, unknowns: NDArray[np.float64], sigma: float
    ) -> tuple[NDArray[np.float64], float]:
        """Take Gauss-Newton steps at one smoothing until they are small.

        Args:
            unknowns: Corners' positions (8,), if a homography is fitted, and the offset.
            sigma: Smoothing, px of the event camera.

        Returns:
            The unknowns, and the correlation of changes.
        """
        self.choose_pairs(float(unknowns[-1]))
        self.stride = max(self.finest, int(sigma / 1.3))  # neighbours in smooth images are alike
        fit = self.fit_thresholds(unknowns, sigma)
        for _ in range(_MAX_STEPS):
            step, moved = self.gauss_newton_step(unknowns, sigma, fit), None
            for _ in range(4):
                now = self.fit_thresholds(unknowns + step, sigma)
                if now.agreement > fit.agreement:
                    moved = unknowns + step
                    break
                step = step / 3
            if moved is None:
                break
            unknowns, fit = moved, now
            if np.abs(step[:-1]).max(initial=0) < 5e-3 and abs(step[-1]) < 3e-6:
                break
        return unknowns, fit.agreement

    def fit_thresholds(self, unknowns: NDArray[np.float64], sigma: float) -> _Fit:
        """Fit the thresholds with all other unknowns fixed, and correlate the changes.

        Args:
            unknowns: Corners' positions (8,), if a homography is fitted, and the offset.
            sigma: Smoothing, px of the event camera.

        Returns:
            The fit.

        Raises:
            InputError: Frames and events show too little in common.
        """
        D, slope_x, slope_y, counts = np.moveaxis(self.frame_changes(unknowns, sigma), -1, 0)
        use = counts > 0.99
        if use.sum() < 100:
            raise InputError(
                f"{self.other.name}: shows too little of what the events show, unclipped, to "
                "compare them; correct the calibration or homography, or give other frames"
            )
        X = self.event_changes(float(unknowns[-1]), sigma)[use]
        X, D = np.concatenate([X, np.ones((len(X), 1))], -1), D[use]
        weight, b = np.ones(len(D)), np.zeros(3)
        for _ in range(3):
            b = _least_squares(X, D, weight)
            r = np.abs(D - X @ b)
            spread = 1.345 * 1.4826 * float(np.median(r[:: max(1, len(r) // 20_000)])) + 1e-9
            weight = np.minimum(1, spread / np.maximum(r, 1e-12))
        agreement = _correlate_weighted(D, X @ b, weight)
        return _Fit(X, D, np.stack([slope_x[use], slope_y[use]], -1), use, weight, b, agreement)

    def gauss_newton_step(
        self, unknowns: NDArray[np.float64], sigma: float, fit: _Fit
    ) -> NDArray[np.float64]:
        """Return the Gauss-Newton step at given unknowns, limited to a multiple of the smoothing.

        D + D' dh = X(o) b + (X' b) do + X db is linear in dh, do and b + db.

        Args:
            unknowns: Corners' positions (8,), if a homography is fitted, and the offset.
            sigma: Smoothing, px of the event camera.
            fit: Fit at these unknowns.

        Returns:
            The step, in the order of `unknowns`.
        """
        offset, free = float(unknowns[-1]), len(unknowns) - 1
        columns = [fit.X]
        if not self.keep_offset:
            delta = min(self.apart / 8, 2000.0) * 1e-6
            later, earlier = (
                self.event_changes(offset + d, sigma)[fit.use] for d in (delta, -delta)
            )
            columns.append(((later - earlier) @ fit.b[:2] / (2 * delta))[:, None])
        pixel, eps = np.nonzero(fit.use)[1], 0.01
        for k in range(free):
            ahead, back = unknowns.copy(), unknowns.copy()
            ahead[k] += eps
            back[k] -= eps
            move = np.nan_to_num((self.positions(ahead) - self.positions(back)) / (2 * eps))
            columns.append(-(fit.slope * move[pixel]).sum(-1, keepdims=True))
        found = _least_squares(np.concatenate(columns, 1), fit.D, fit.weight)[3:]
        step = np.zeros(len(unknowns))
        if not self.keep_offset:
            step[-1], found = found[0], found[1:]
        step[:free] = found
        far = np.abs(step[:free]).max(initial=0) / (4 * sigma)
        return step / max(far, abs(step[-1]) / (self.apart * 5e-7), 1)


def _interpolation_matrix(at: NDArray[np.float64], shape: tuple[int, int]) -> Any:
    """Return the matrix of bilinear interpolation of an image.

    Args:
        at: (n, 2) positions x, y, px.
        shape: (height, width) of the image.

    Returns:
        (n, height * width) sparse matrix.
    """
    height, width = shape
    i = np.clip(np.floor(at).astype(int), 0, [max(width - 2, 0), max(height - 2, 0)])
    u, v = (at - i).T
    first = i[:, 1] * width + i[:, 0]
    source = first[:, None] + np.array([0, min(1, width - 1), width, width + 1])
    weight = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], 1)
    source = np.minimum(source, height * width - 1)
    ends = np.arange(len(at) + 1) * 4
    return sparse.csr_array((weight.ravel(), source.ravel(), ends), (len(at), height * width))


def _least_squares(
    A: NDArray[np.float64], y: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Solve weighted least squares; of dependent columns the solution of least norm is taken.

    Args:
        A: (n, d) rows.
        y: (n,) values.
        weight: (n,) weights.

    Returns:
        (d,) solution.
    """
    size = np.sqrt((weight[:, None] * A**2).sum(0)) + 1e-30
    A = A / size
    W = weight[:, None] * A
    return np.linalg.lstsq(A.T @ W, W.T @ y, rcond=1e-9)[0] / size


def _correlate_weighted(
    a: NDArray[np.float64], b: NDArray[np.float64], weight: NDArray[np.float64]
) -> float:
    """Return Pearson's correlation of two vectors under weights.

    Args:
        a: (n,).
        b: (n,).
        weight: (n,), 0 or more.

    Returns:
        The correlation; 0 where one of them is constant.
    """
    total = weight.sum()
    a, b = (one - (weight * one).sum() / total for one in (a, b))
    size = math.sqrt(float((weight * a * a).sum() * (weight * b * b).sum()))
    return float((weight * a * b).sum()) / size if size > 0 else 0.0
