"""Evidence for a motion in the events of a short window: against rest and against its rivals.

    test = EvidenceTest(model, xi)
    found = test.measure(events, time, motion, covariance, 6.5, 0.1)
    found.is_supported

The events of the first and of the last third of the window are moved along a motion to its middle,
and become two signed images, E and L. Their products are the votes of events for each other, as in
`particle_filter`, for pairs of events that lie some pixels of motion apart. The sum over the pixels
of a cell of the image is V_c(m). A motion m has the evidence

    z = sum_c D_c / sqrt(sum_c D_c^2),  D_c = V_c(m) - V_c(rival)

against a rival, where errors of cells are independent. Rivals are no motion, the opposite motion,
motions as fast in other directions, and motions beside the estimate. The parabola through V at the
latter and at m has its maximum beside m by an offset, which an estimate must explain by its sigma.

One object that moves before a camera at rest is explained by a motion of the camera as well. It
covers a part of the image. So a motion of the camera is reported only where many of `N_BLOCKS`^2
blocks of the image support it: with D_b against rest their effective number is
(sum D_b)^2 / sum D_b^2.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc
from jaxevent.egomotion.models import Model

IMAGE_PIXEL_PX = 2.0  # of the images of moved events
CELL_PX = 24  # of the parts of the image whose errors are independent, on all but small sensors
MARGIN_RATIO = 2 / 3  # of the margin around the sensor to the side of a cell
N_BLOCKS = 4  # along each side of the image, and least number of cells along the sensor's
MAX_WINDOW_EVENTS = 6000  # of more, so many evenly
MIN_WINDOW_EVENTS = 40
RIVAL_RATIO = 0.2  # of the motion, least distance of the rivals beside it
RIVAL_SIGMAS = 3.0  # of the estimate, least distance likewise
MIN_REST_Z = 2.5  # against no motion
MIN_RIVAL_Z = -0.5  # against the best rival
MIN_CURVATURE_Z = 2.5  # against the motions on both sides along any axis
MAX_OFFSET_RATIO = 0.15  # of the motion
MIN_BLOCKS = 4.0  # effective number that support a motion of the camera
# A motion that was reported remains so until the evidence is clearly against it.
LOST_REST_Z = 1.5
LOST_RIVAL_Z = -3.0
LOST_BLOCKS = 3.0
N_SUPPORTING_WINDOWS = 2  # in a row, from which on a motion is reported
BLOCKS_WEIGHT = 0.2  # of a window in the mean number of blocks
MAX_DRIFT_SIGMAS = 2.0  # of a motion since it was found
MAX_DRIFT_WINDOWS = 2.0  # over which the drift is measured
DRIFT_RATIO = 2.0  # time for which a reported motion drifts on, per time until it was reported
MIN_DENSITY_RATIO = 0.35  # of events per px of the motion, relative to what they were
DENSITY_DISPLACEMENTS = 2.0  # of a window, stretch of the motion over which they are averaged


class Evidence(NamedTuple):
    """Evidence for a motion in a window."""

    rest: float  # z against no motion
    rival: float  # least z against the other rivals
    offset: NDArray[np.float64]  # (d,) of the window's best motion beside the estimate
    offset_ratio: float  # its flow relative to the motion's
    offset_sigmas: float  # its length in standard deviations of the estimate
    curvature: float  # least z of the motion against those on both of its sides, over axes
    blocks: float  # effective number of blocks of the image that support the motion
    length: float  # s, of the window

    @property
    def is_supported(self) -> bool:
        """Return whether the votes support the motion against rest and against its rivals.

        Along straight parallel edges all motions have the same votes, and none is supported.
        """
        near = self.offset_ratio < MAX_OFFSET_RATIO or self.offset_sigmas < RIVAL_SIGMAS
        is_maximum = self.rival > MIN_RIVAL_Z and self.curvature > MIN_CURVATURE_Z
        return self.rest > MIN_REST_Z and is_maximum and near


class EvidenceTest:
    """Test of motions of a model whose flow is linear in its components.

    Args:
        model: Motion model of d components.
        xi: (height, width, 2) positions of pixels, see `candidates.pixel_coordinates`.
    """

    def __init__(self, model: Model, xi: NDArray[np.floating]):
        self.xi = xi - np.floor(xi.min((0, 1)))
        self.basis = np.asarray(model.basis(xi), np.float64)
        self._sparse_basis = self.basis[::8, ::8].reshape(-1, self.basis.shape[-1])
        self._unit = 1 / np.sqrt((self.basis**2).sum(2).mean((0, 1)))  # of components, for 1 px/s
        shortest = min(xi.shape[:2]) / N_BLOCKS
        cell = self._cell = max(int(min(CELL_PX, shortest) / IMAGE_PIXEL_PX), 1)
        margin = self._margin = round(MARGIN_RATIO * cell)
        columns, rows = (self.xi.max((0, 1)) // IMAGE_PIXEL_PX).astype(int) + 2 * margin + 2
        self._images = np.zeros((2, rows, columns))
        self._cells = -(-rows // cell), -(-columns // cell)
        row, column = np.indices(self._cells)
        side = np.array([rows, columns]) / N_BLOCKS
        self._block = (
            N_BLOCKS * np.minimum(((row + 0.5) * cell / side[0]).astype(int), N_BLOCKS - 1)
            + np.minimum(((column + 0.5) * cell / side[1]).astype(int), N_BLOCKS - 1)
        ).ravel()

    def speed(self, motion: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the root mean square flows (n,) of motions (n, d), px/s."""
        flow = np.asarray(motion, np.float64) @ self._sparse_basis.T
        return np.sqrt((flow**2).reshape(len(flow), -1, 2).sum(2).mean(1))

    def measure(
        self,
        events: Any,
        time: int,
        motion: NDArray[np.floating],
        covariance: NDArray[np.floating],
        displacement: float,
        longest: float,
    ) -> Evidence | None:
        """Measure the evidence in the events before a time.

        Args:
            events: Events of a recording, of which slices are read.
            time: End of the window, us.
            motion: (d,) estimate.
            covariance: (d, d) covariance of the estimate.
            displacement: Displacement of the image in the window, px.
            longest: Largest length of the window, s.

        Returns:
            The evidence, or None if the window or a third of it holds too few events.
        """
        m = np.asarray(motion, np.float64) / self._unit
        size = float(np.linalg.norm(m))
        length = min(displacement / max(float(self.speed(motion[None])[0]), 1e-9), longest)
        part = events[events.index(round(time - 1e6 * length)) : events.index(time)]
        if len(part) < MIN_WINDOW_EVENTS or not size:
            return None
        tau = (part.t - time) * 1e-6 + length / 2
        kept = np.flatnonzero(np.abs(tau) > length / 6)
        if min((tau[kept] < 0).sum(), (tau[kept] > 0).sum()) < MIN_WINDOW_EVENTS / 4:
            return None
        kept = kept[:: -(-len(kept) // MAX_WINDOW_EVENTS) or 1]
        x, y = part.x[kept].astype(int), part.y[kept].astype(int)
        sign = np.where(part.p[kept], 1.0, -1.0)
        scaled = np.asarray(covariance, np.float64) / np.outer(self._unit, self._unit)
        variance, axes = np.linalg.eigh(scaled)
        reach = np.maximum(RIVAL_SIGMAS * np.sqrt(np.maximum(variance, 0)), RIVAL_RATIO * size)
        beside = np.concatenate([m + (reach * axes).T, m - (reach * axes).T])
        across = size * np.linalg.svd(m[None])[2][1:]
        hypotheses = np.concatenate([m[None], 0 * m[None], beside, -m[None], across, -across])
        votes = np.zeros((len(hypotheses), self._cells[0] * self._cells[1]))
        _accumulate_votes(
            self.xi[y, x], tau[kept], sign, self.basis[y, x], hypotheses * self._unit,
            self._images, self._margin, self._cell, self._cells[1], votes,
        )  # fmt: skip
        D = votes[0] - votes[1:]
        z = D.sum(1) / np.sqrt(np.maximum((D**2).sum(1), 1e-12))
        total, d = votes.sum(1), len(m)
        bend = 2 * total[0] - total[2 : 2 + d] - total[2 + d : 2 + 2 * d]
        slope = total[2 : 2 + d] - total[2 + d : 2 + 2 * d]
        steps = np.where(bend > 0, slope / np.maximum(2 * bend, 1e-12), np.sign(slope)).clip(-3, 3)
        offset = axes @ (steps * reach)
        D_sides = 2 * votes[0] - votes[2 : 2 + d] - votes[2 + d : 2 + 2 * d]
        curvature = bend / np.sqrt(np.maximum((D_sides**2).sum(1), 1e-12))
        # Where sigma is larger than the grid of rivals, so is their distance.
        sigmas = np.sqrt(((steps * reach) ** 2 / np.maximum(variance, 1e-12)).sum() / d)
        of_block = np.bincount(self._block, D[0], N_BLOCKS**2)
        blocks = max(of_block.sum(), 0.0) ** 2 / max(float((of_block**2).sum()), 1e-12)
        ratio = float(np.linalg.norm(offset)) / size
        return Evidence(
            float(z[0]), float(z[1:].min()), offset * self._unit, ratio, float(sigmas),
            float(curvature.min()), blocks, length,
        )  # fmt: skip


class LockDetector:
    """Decision, window by window, from when on the motion of a filter is reported.

    Args:
        test: The test of a window.
        displacement: Displacement of the image in a window, px.
        longest: Largest length of a window, and pause after which all begins anew, s.
        diffusion: Function that returns the process noise (d,) of a motion, per sqrt(s).
        camera_moves: Whether the camera is known to move, so that a part of the image suffices.
    """

    def __init__(
        self,
        test: EvidenceTest,
        displacement: float,
        longest: float,
        diffusion: Callable[[NDArray], Any],
        camera_moves: bool = False,
    ):
        self._test, self._displacement, self._longest = test, displacement, longest
        self.diffusion, self._camera_moves = diffusion, camera_moves
        self._end: int | None = None
        self._dense = 0  # us, of the last batch that was not sparse
        self.sparse = np.zeros(0, bool)  # (n,) of the batches of the last update
        self._restart()

    def _restart(self) -> None:
        self._is_settled, self._supporting = False, 0
        self._density = np.nan  # mean number of events in a stretch of the motion
        self._blocks = np.nan  # mean effective number
        self._history: list[tuple[int, NDArray]] = []  # times and motions since it was found

    def update(
        self,
        events: Any,
        count: NDArray[np.int64],
        t: NDArray[np.int64],
        mean: NDArray[np.floating],
        covariance: NDArray[np.floating],
        searching: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        """Decide which estimates of some batches are reported.

        Args:
            events: Events of the recording up to the last time or further.
            count: (n,) number of events of each batch.
            t: (n,) times, us.
            mean: (n, d) motions.
            covariance: (n, d, d) covariances.
            searching: (n,) whether the filter searches.

        Returns:
            (n,) booleans.
        """
        reported = np.zeros(len(t), bool)
        if not len(t):
            return reported
        if self._end is not None and t[0] - self._end > 1e6 * self._longest:
            self._restart()
        ends = self._find_ends(count, t, mean, searching)
        self._end = int(t[-1])
        if ends.any():
            reported[: ends.argmax()] = self._is_settled
            self._restart()
        if not ends[-1]:
            if not self.sparse[-1]:
                self._update_decision(events, int(t[-1]), mean[-1], covariance[-1])
            first = len(t) - int(ends[::-1].argmax()) if ends.any() else 0
            reported[first:] = self._is_settled
        return reported & ~self.sparse

    def _find_ends(
        self, count: NDArray, t: NDArray, mean: NDArray, searching: NDArray
    ) -> NDArray[np.bool_]:
        """Find the batches at which a motion ends, and the `sparse` ones.

        As long as a motion lasts, each px of it makes about as many events. Where batches hold far
        fewer, events may have been dropped. The motion ends where that lasts for longer than a
        window: then no event before has candidates any more.

        Args:
            count: (n,) number of events of each batch.
            t: (n,) times, us.
            mean: (n, d) motions.
            searching: (n,) whether the filter searches.

        Returns:
            (n,) whether a motion ends.
        """
        speed, stretch = self._test.speed(mean), DENSITY_DISPLACEMENTS * self._displacement
        path = 1e-6 * np.diff(t, prepend=t[0] if self._end is None else self._end) * speed / stretch
        window = np.minimum(self._displacement / np.maximum(speed, 1e-9), self._longest)
        self.sparse, ends = np.zeros(len(t), bool), searching.copy()
        for k in range(len(t)):
            least = MIN_DENSITY_RATIO * self._density * path[k]
            self.sparse[k] = not searching[k] and count[k] + 3 * np.sqrt(count[k]) < least
            if self.sparse[k]:
                ends[k] = t[k] - self._dense > 1e6 * window[k]
            else:
                self._dense = int(t[k])
            if ends[k]:
                self._density = np.nan
            elif path[k] > 0 and not self.sparse[k]:
                old = self._density if np.isfinite(self._density) else count[k] / path[k]
                self._density = old + (count[k] - old * path[k]) / max(path[k], 1)
        return ends

    def _update_decision(self, events: Any, t: int, mean: NDArray, covariance: NDArray) -> None:
        """Update the decision by the window before a time.

        Args:
            events: Events of the recording up to the time or further.
            t: Time, us.
            mean: (d,) motion.
            covariance: (d, d) its covariance.
        """
        found = self._test.measure(events, t, mean, covariance, self._displacement, self._longest)
        if found is None:
            return
        old = self._blocks if np.isfinite(self._blocks) else found.blocks
        self._blocks = old + BLOCKS_WEIGHT * (found.blocks - old)
        if self._is_settled:
            is_compact = self._blocks < LOST_BLOCKS and not self._camera_moves
            against = found.rest < LOST_REST_Z or found.rival < LOST_RIVAL_Z or is_compact
            self._is_settled = not against
            self._supporting = 0
            return
        self._history.append((t, mean))
        is_large = self._blocks > MIN_BLOCKS or self._camera_moves
        is_sure = found.is_supported and is_large and self._is_steady(covariance, found.length)
        self._supporting = self._supporting + 1 if is_sure else 0
        if self._supporting >= N_SUPPORTING_WINDOWS:
            self._is_settled, self._history = True, []

    def _is_steady(self, covariance: NDArray, length: float) -> bool:
        """Return whether the motion has not changed by more than its covariance and noise.

        A cloud that has just collapsed is too narrow, and drifts until it is at the motion.

        Args:
            covariance: (d, d) covariance of the last motion.
            length: Length of the window, s.
        """
        t, mean = self._history[-1]
        if t - self._history[0][0] < 1e6 * length:
            return False
        since = max((self._history[0][0] + t) / 2, t - 1e6 * MAX_DRIFT_WINDOWS * length)
        before, m = next(one for one in self._history if one[0] >= since)
        far = np.asarray(mean - m, np.float64)
        noise = np.asarray(self.diffusion(mean), np.float64) ** 2 * 1e-6 * (t - before)
        C = 2 * np.asarray(covariance, np.float64) + np.diag(noise + 1e-12)
        return float(far @ np.linalg.solve(C, far)) < MAX_DRIFT_SIGMAS**2 * len(far)


def report_before_lock(
    t: NDArray[np.int64],
    mean: NDArray[np.floating],
    covariance: NDArray[np.floating],
    searching: NDArray[np.bool_],
    reported: NDArray[np.bool_],
    diffusion: Callable[[NDArray], Any],
) -> tuple[NDArray[np.bool_], NDArray[np.floating], NDArray[np.floating]]:
    """Report the estimates before a motion settled, too, as far as they agree with it.

    A cloud that has just collapsed is too narrow, so the square of its difference from the settled
    motion is added to its covariance. The motion drifts on for up to `DRIFT_RATIO` times as long as
    it took to settle. Until then the square of the difference of estimates from the motion at the
    end of the drift is to be added after smoothing.

    Args:
        t: (n,) times, us.
        mean: (n, d) motions.
        covariance: (n, d, d) covariances.
        searching: (n,) whether the filter searches.
        reported: (n,) whether the motion is reported.
        diffusion: Function that returns the process noise (d,) of a motion, per sqrt(s).

    Returns:
        (n,) whether estimates are reported, the covariances, and what is to be added to them after
        smoothing, (n, d, d).
    """
    reported, covariance, added = reported.copy(), covariance.copy(), np.zeros(covariance.shape)
    eye = np.eye(mean.shape[1])
    for first in np.flatnonzero(reported & ~np.r_[False, reported[:-1]]):
        rate = eye * np.asarray(diffusion(mean[first]), np.float64) ** 2
        begin = int(np.flatnonzero(searching[:first] | reported[:first]).max(initial=-1)) + 1
        for k in range(first - 1, begin - 1, -1):
            far = np.asarray(mean[k] - mean[first], np.float64)
            C = covariance[k] + covariance[first] + rate * (t[first] - t[k]) * 1e-6 + 1e-12 * eye
            if float(far @ np.linalg.solve(C, far)) > MAX_DRIFT_SIGMAS**2 * len(far):
                break
            reported[k] = True
            covariance[k] += np.outer(far, far)
        until = t[first] + DRIFT_RATIO * (t[first] - t[begin])
        rows = np.arange(begin, np.searchsorted(t, until, "right"))
        rows = rows[np.cumsum(searching[rows]) == 0]
        drift = np.asarray(mean[rows] - mean[rows[-1]], np.float64)
        added[rows] = drift[:, :, None] * drift[:, None, :]
    return reported, covariance, added


@njit_noalloc
def _accumulate_votes(at, tau, sign, basis, hypotheses, images, margin, cell, columns, votes):
    """Add up for each hypothesis the products of the images before and after the middle.

    Args:
        at: (E, 2) positions of events, px.
        tau: (E,) times from the window's middle, s.
        sign: (E,) polarities, +-1.
        basis: (E, 2, d) flow per unit of each component, px/s.
        hypotheses: (H, d) motions.
        images: (2, height, width) scratch.
        margin: Pixels of an image around the sensor.
        cell: Side of a cell, pixels of an image.
        columns: Number of columns of cells.
        votes: (H, cells), changed in place.
    """
    for h in range(len(hypotheses)):
        images[:] = 0
        for e in range(len(tau)):
            u, v = 0.0, 0.0
            for k in range(hypotheses.shape[1]):
                u += basis[e, 0, k] * hypotheses[h, k]
                v += basis[e, 1, k] * hypotheses[h, k]
            x = (at[e, 0] - u * tau[e]) / IMAGE_PIXEL_PX + margin
            y = (at[e, 1] - v * tau[e]) / IMAGE_PIXEL_PX + margin
            i, j = int(np.floor(x)), int(np.floor(y))
            if i < 0 or j < 0 or i >= images.shape[2] - 1 or j >= images.shape[1] - 1:
                continue
            x, y = x - i, y - j
            image = images[1 if tau[e] > 0 else 0]
            image[j, i] += sign[e] * (1 - x) * (1 - y)
            image[j, i + 1] += sign[e] * x * (1 - y)
            image[j + 1, i] += sign[e] * (1 - x) * y
            image[j + 1, i + 1] += sign[e] * x * y
        for j in range(images.shape[1]):
            for i in range(images.shape[2]):
                product = images[0, j, i] * images[1, j, i]
                if product != 0:
                    votes[h, j // cell * columns + i // cell] += product
