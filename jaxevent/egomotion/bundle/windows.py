"""General motion by fitting a whole window of events: the camera's path and the scene's depth.

- Starts, from short windows (`starts`): motions before planes, and headings of patches' flows.
- If a plane explains the events, the fit of a growing window with a plane's depths tells which of
  two motions it is: to first order both explain them, over time only one.
- Else each start is followed with a constant twist, then over longer windows (`alignment`). The
  mean over blocks of n (log S - 1.5 log n) / N, S the contrast and n the number of events of a
  block, selects those that go on.
- Of these the cost of the photometric fit (`photometric`) selects, again and again as the fit
  proceeds. Where events are noisy, sigma is not made much smaller than that noise.
- Windows overlap, and the path of the one before is followed into the next. After some of them new
  starts compete with it, and where they win the windows before are fitted again from there.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.bundle.alignment import Window, refine, score
from jaxevent.egomotion.bundle.depths import depths
from jaxevent.egomotion.bundle.frames import FramePixels, look_at, offset, with_frames
from jaxevent.egomotion.bundle.path import SEGMENTS, Path, Prior
from jaxevent.egomotion.bundle.photometric import Report, adjust, compute_covariance
from jaxevent.egomotion.bundle.rivals import SETTLE, SIGMA, STEPS, TELLING, Trial
from jaxevent.egomotion.bundle.starts import (
    Plane,
    before_a_plane,
    headings,
    homography,
    patch_flows,
    rotation,
    side_by_side,
    start,
)
from jaxevent.egomotion.bundle.tracks import Scene, Tracks
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.motion import lens_error
from jaxevent.egomotion.truth import Twists
from jaxevent.parameters import Choice, Count, Number, Parameters, Positive
from jaxevent.recording import Recording

NODE = 4  # px between nodes of depth
MARGIN = 24  # px of the reference view around the sensor
APART = np.cos(np.radians(6))  # headings of rivals
TURN = 0.1  # rad/s, likewise
COARSE = 15000  # events of short windows
MIDDLE = 30000
LAST = 60000
STARTED = 6  # paths at most that go on from the first
TRIED = 30000  # of the photometric fit of rivals


class Stage(NamedTuple):
    """Steps of the photometric fit.

    A flatter map and a stiffer path leave less freedom, so the fit converges sooner, and a short
    window, which does not tell how motion changes, does not lead away from the truth.
    """

    sigma: float  # C
    steps: int
    flatter: float | int = 1  # how much: times the prior's weight
    stiffer: float | int = 1  # likewise


ROUNDS = Stage(1.0, 6), Stage(0.5, 6), Stage(0.2, 10), Stage(0.1, 10)  # after a trial of depths
FINAL = Stage(0.05, 20, 10), Stage(0.02, 20, 3)
# Sigma (C) and steps by which the map first takes the frames' brightness, some 10 C from 0.
BRIGHTNESS = (20.0, 1), (5.0, 1)
# Of a path that is about right: all of the above takes 1.6 times as long and ends no nearer.
FOLLOWING: tuple[tuple[Stage, ...], tuple[Stage, ...]] = (
    (Stage(0.5, 6), Stage(0.1, 8)),
    (Stage(0.05, 10, 10),),
)
# Its last stage. 20 steps take .6 CPU seconds more, and headings of slider_depth end no nearer.
ENDING = (Stage(0.02, 8, 3),)
# Rivals remain whose cost is so many times the least, and so much more (C^2): depths that were just
# looked for leave up to 0.03 C.
CLOSE = 1.75, 5e-4
# Of motions before a plane: the part of the window, events, stages, the most that a plane costs
# (C^2). What is no plane costs 1.8e-2 and more after the first of these, a plane 7e-3 and less; in
# the end 1.5e-3 and more, 2e-4 and less. Without the flatter maps of the third some fits end on the
# way, 5 to 30 degrees off at 100 times the cost of the truth.
GROWING = (
    (0.5, TRIED // 2, (Stage(2.0, 8), Stage(1.0, 8)), 1e-2),
    (0.5, TRIED, (Stage(0.3, 12, 1, 100), Stage(0.1, 6, 1, 100)), 1e-3),
    (1.0, TRIED, tuple(Stage(sigma, 20, 10) for sigma in (1.0, 0.3, 0.1, 0.05)), 1e-3),
    (1.0, TRIED, (Stage(0.1, 10), Stage(0.05, 20)), 3e-4),
)
RATIO, GROWTH = 2.5, 5.0  # see `inflation`
SKEW = 0.03  # standard deviation of the thresholds' skew by counts, at least
# Where the thresholds themselves are noisy sigma is never less than that noise: else half of the
# events are fitted exactly, and the others are outliers, for any motion. Simulated without noise
# the stage NOISY shows 0.07 C, slider_depth 0.07 to 0.1 C, evbench_seq3 0.13 C and more. With 0.05
# headings of slider_depth are 2.2 degrees off at most, not 3.1, but simulated textures lose.
NOISY, NOISE = 0.5, 0.1  # C: the stage's sigma, the noise
# The share of inliers below which rivals are compared, whatever they cost. Walls seen with uneven
# thresholds have 0.70, whichever motion; ideal ones 0.97.
AGREED = 0.8
HARDLY = -3.0  # added to log inverse depths where translation is not told
# Rivals whose cost is so many times the least in the end are compared on pixels left out: fitted
# events tell the motion from its mirror image by 3 % of the cost, or the other way round. Only what
# these pixels refute gives way: outlines before nothing else tell more where they are fitted.
ALIKE = 1.5
PARALLAX = 6.0  # px in a window; where there is less, rotation alone is tried too
SHARP = 0.4  # sigma by the noise that is seen, at least: events beside edges are outliers


class Params(Parameters):
    """Parameters of the fit of a window, and of the sequence of windows."""

    half_window = Positive(0.15, "s", "half the length of the last window; earlier: 1/3, 2/3")
    step = Positive(0.1, "s", "from one window to the next")
    events = Count(60000, "", "most events of a window, of pixels taken at random")
    fewest = Count(2000, "", "events that a window needs")
    fresh = Count(5, "", "windows until new starts compete; twice as many each time they agree")
    starts = Count(3, "", "headings that are followed, of each of two short windows")
    cell = Count(24, "px", "of one depth")
    iterations = Count(8, "", "steps of the alignment of segments on the whole window")
    rivals = Count(3, "", "aligned starts, some degrees apart, that go on to the photometric fit")

    smooth = Positive(1.0, "", "weight of differences of log depth between cells")
    relief = Positive(0.1, "", "weight of differences of log depth from its mean")
    change = Positive(0.02, "1/px^2", "weight of changes of the twist, in px at the window's end")
    bond = Positive(1.0, "", "weight of differences of log depth between nodes")
    flat = Positive(0.01, "1/C^2", "weight of differences of log intensity between pixels")
    alike = Positive(10.0, "", "how many events together tell as much as one: errors are alike")
    omega_scale = Number(0.0, "rad/s", "prior: |Omega| is about so much or less; 0: not known")
    gyro_std = Positive(0.03, "rad/s", "of a gyro, if one is given")
    frames = Choice((True, False), "whether frames are fitted beside the events")
    flow_max = Positive(220.0, "px/s", "flows of patches that are tried, without the rotation")


class Fit(NamedTuple):
    """A fitted window: path with depths at nodes, covariance (6, 6) of heading and Omega.

    The covariance counts errors that differ from one part of the image to another (24 px). Beside
    plain shapes, where they do not, errors are far larger than it tells.
    `agreement` is the share of events that the fit explains, `cost` the robust cost per event.
    `doubted` says how far (rad) off other headings are that are not refuted, by their likelihood.
    """

    path: Path
    covariance: NDArray[np.float64]
    agreement: float
    cost: float
    map: NDArray[np.floating]
    doubted: float = 0.0


Rival = tuple[Scene, Report]


def inflation(inliers: float) -> float:
    """By how much errors squared are larger than the covariance of independent cells tells.

    Where many events are not explained, as before plain shapes that pass before each other, the
    model errs.
    """
    return (RATIO * np.exp(GROWTH * max(0.95 - inliers, 0.0))) ** 2


class Windows:
    """The windows of a recording, and how one is fitted."""

    def __init__(
        self,
        recording: Recording,
        params: Params,
        camera: PinholeCamera,
        gyro: Twists | None = None,
        seed: int = 0,
    ):
        self.recording, self.params, self.gyro, self.seed = recording, params, gyro, seed
        self.lens = lens_error(camera)
        self.least: dict[int, float] = {}  # C, sigma at least, by windows
        # Stages look at the same window one after another.
        self.look_at = functools.lru_cache(2)(self._look_at)
        self.real = np.dtype(jax.dtypes.canonicalize_dtype(float))
        self.xi, self.f = pixel_coordinates(recording.width, recording.height, camera)
        flat = self.xi.reshape(-1, 2)
        lower, upper = np.floor(flat.min(0)) - MARGIN, np.ceil(flat.max(0)) + MARGIN
        cells = np.ceil((upper - lower + 1) / params.cell).astype(int)
        corner = lower - (cells * params.cell - (upper - lower + 1)) // 2
        self.corner = (float(corner[0]), float(corner[1]))
        self.shape = (int(cells[1]) * params.cell, int(cells[0]) * params.cell)
        ends = flat[:, 0].min(), flat[:, 0].max(), flat[:, 1].min(), flat[:, 1].max()
        self.box = (float(ends[0]), float(ends[1]), float(ends[2]), float(ends[3]))

    @functools.cached_property
    def late(self) -> int:
        """How many us frames are later than their stamps."""
        return offset(self.recording)

    def _look_at(self, first: int, last: int) -> FramePixels | None:
        return look_at(self.recording, first, last, self.late)

    def rows(self, centre: int, half: float) -> tuple[int, int]:
        """The events of a window."""
        span, index = round(half * 1e6), self.recording.events.index
        return index(centre - span), index(centre + span)

    def cut(self, centre: int, half: float, most: int) -> Window:
        """At most so many of a window's events, the rest empty."""
        most = min(most, self.params.events)
        first, last = self.rows(centre, half)
        events = self.recording.events[first:last]
        rng = np.random.default_rng([self.seed, abs(centre), most])
        keep = np.arange(len(events))
        if len(keep) > most:
            keep = np.sort(rng.choice(len(keep), most, replace=False))
        x, y = self.xi[events.y[keep], events.x[keep]].T.astype(self.real)
        tau = ((events.t[keep] - centre) * 1e-6).astype(self.real)
        return Window(
            np.ascontiguousarray(x),
            np.ascontiguousarray(y),
            tau,
            np.where(events.p[keep], 1, -1).astype(self.real),
            self.f,
            half,
            self.box,
            self.shape,
            self.corner,
            self.params.cell,
        )

    def prior(self, centre: int, half: float) -> Prior:
        params = self.params
        gyro, weight = np.zeros((SEGMENTS, 3)), 0.0
        if self.gyro is not None:
            times = centre + ((np.arange(SEGMENTS) + 0.5) / SEGMENTS * 2 - 1) * half * 1e6
            at = np.clip(np.rint(times), self.gyro.start, self.gyro.stop).astype(np.int64)
            gyro, weight = self.gyro(at)[1], 1 / float(params.gyro_std) ** 2
        smooth, relief, change, bond, flat, alike = (
            float(getattr(params, name))
            for name in ("smooth", "relief", "change", "bond", "flat", "alike")
        )
        own = smooth, relief, change, self.omega_weight, gyro, weight
        return Prior(*own, bond, flat, alike, *self.skew(centre, half))

    def skew(self, centre: int, half: float) -> tuple[float, float]:
        """The skew of the thresholds by which pixels end where they began, and its weight.

        Levels that end where they begin have N_on C (1 + skew) = N_off C (1 - skew). Without a
        prior the fit of real events runs away to skew = -1: no ON threshold, so all ON events fit.
        """
        first, last = self.rows(centre, half)
        events, shape = (
            self.recording.events[first:last],
            (self.recording.height, self.recording.width),
        )
        where = np.ravel_multi_index((events.y, events.x), shape)
        on, off = (
            np.bincount(where[events.p == p], minlength=np.prod(shape)) for p in (True, False)
        )
        both = (on > 0) & (off > 0)
        total, more = ((both * part).reshape(shape) for part in (on + off, on - off))
        cells = np.add.reduceat(
            np.add.reduceat(np.stack([total, more]), np.arange(0, shape[0], 24), 1),
            np.arange(0, shape[1], 24),
            2,
        )
        number = max(float(cells[0].sum()), 1.0)
        skew = -float(cells[1].sum()) / number
        spread = float(np.sqrt(((cells[1] + skew * cells[0]) ** 2).sum())) / number
        return skew, 1 / (SKEW**2 + spread**2)

    @property
    def omega_weight(self) -> float:
        scale = float(self.params.omega_scale)
        return 1 / scale**2 if scale > 0 else 0.0

    def rotation(self, centre: int) -> NDArray[np.float64]:
        """The rotation (rad/s) about the middle of a window, a gyro's if there is one."""
        if self.gyro is None:
            return rotation(self.cut(centre, float(self.params.half_window) / 3, COARSE))
        middle = np.clip(centre, self.gyro.start, self.gyro.stop)
        return self.gyro(np.array([middle], np.int64))[1][0]

    def starts(self, centre: int, Omega: NDArray, planes: list[Plane]) -> list[Path]:
        """Paths of constant twist to begin with, followed for a third of the window."""
        params, half = self.params, float(self.params.half_window) / 3
        window, prior = self.cut(centre, half, MIDDLE), self.prior(centre, half)
        found = [plane.path(*window.places, self.f, self.real) for plane in planes]
        cuts = [self.cut(centre, length, COARSE) for length in (half / 2, half)]
        for flows in side_by_side(
            lambda cut: patch_flows(cut, Omega, float(params.flow_max)), cuts
        ):
            if flows is None:
                continue
            best = headings(flows, self.f, Omega, params.starts, self.omega_weight)
            found += [start(window, flows, *one) for one in best]

        def follow(path: Path) -> Path:
            path = refine(window, path, prior, degree=0, blurs=4, steps=6)
            return refine(window, path, prior, degree=0, blurs=1, steps=6)

        ranked = side_by_side(lambda path: self.scored(window, follow(path)), found)
        return self.best(ranked)[:STARTED]

    def tracks(
        self, centre: int, half: float, most: int, limit: int | None = None, skip: int = 0
    ) -> Tracks:
        """All of a window's events of as many pixels as have so many in total.

        Beside them as many pixels of frames, where there are any. Or, without frames, the events of
        as many pixels as have `limit`, after those that have `skip`.
        """
        seen = None
        if limit is None and self.params.frames:
            span = round(half * 1e6)
            seen = self.look_at(centre - span, centre + span)
        most = min(most, self.params.events)
        limit = most if limit is None else min(limit, most)
        first, last = self.rows(centre, half)
        events = self.recording.events[first:last]
        width, pixels = self.recording.width, self.recording.width * self.recording.height
        pixel = events.y.astype(np.int64) * width + events.x
        count = np.bincount(pixel, minlength=pixels)
        # One event alone tells nothing.
        order = np.random.default_rng([self.seed, abs(centre), most]).permutation(pixels)
        order = order[count[order] > 1]
        taken = np.zeros(pixels, bool)
        number = np.cumsum(count[order])
        # A pixel that holds event number `skip` is of neither part.
        taken[order[(number - count[order] >= skip) & (number <= skip + limit)]] = True
        keep = np.flatnonzero(taken[pixel])
        keep = keep[np.argsort(pixel[keep], kind="stable")]
        n, where = len(keep), pixel[keep]
        begins = np.append(True, where[1:] != where[:-1])[:n]
        begin = np.maximum.accumulate(np.where(begins, np.arange(n), 0))
        p = np.where(events.p[keep], 1, -1)
        total = np.cumsum(p)
        lower, upper = np.array(self.box[::2]) - MARGIN, np.array(self.box[1::2]) + MARGIN
        lower = np.floor(lower)
        across, down = (np.ceil(upper - lower).astype(int) + 1).tolist()
        x, y = self.xi.reshape(-1, 2)[where].T
        rows = x, y, (events.t[keep] - centre) * 1e-6, total - (total - p)[begin]
        rows += np.arange(n) - begin + 1, p
        x, y, tau, level, number, p = (np.ascontiguousarray(row, self.real) for row in rows)
        tracks = Tracks(
            x,
            y,
            tau,
            level,
            number,
            p,
            np.ones_like(x),
            n,
            np.append(np.flatnonzero(begins), n),
            self.f,
            half,
            (down, across),
            (float(lower[0]), float(lower[1])),
            NODE,
        )
        if seen is None:
            return tracks
        return with_frames(tracks, seen, self.xi.reshape(-1, 2), centre, most, self.seed)

    def aligned(self, centre: int, paths: list[Path]) -> list[Path]:
        """Starts followed by the alignment of segments, the best first, some degrees apart."""
        half = float(self.params.half_window)
        middle, last = self.cut(centre, 2 * half / 3, MIDDLE), self.cut(centre, half, LAST)
        priors = self.prior(centre, 2 * half / 3), self.prior(centre, half)

        def follow(paths: list[Path], window: Window, prior: Prior, degree: int, n: int) -> list:
            def one(path: Path) -> tuple[float, Path]:
                return self.scored(
                    window, refine(window, path, prior, degree=degree, blurs=2, steps=n)
                )

            return self.best(side_by_side(one, paths))

        best = follow(paths, middle, priors[0], 1, 8)[: 2 * self.params.rivals]
        best = follow(best, last, priors[1], 2, self.params.iterations)
        return best[: self.params.rivals]

    def scored(self, window: Window, path: Path) -> tuple[float, Path]:
        """A path with what selects it among others."""
        return float(score(window, path)) - self.turning(path), path

    def best(self, paths: list[tuple[float, Path]]) -> list[Path]:
        """The best first, without those near to a better one."""
        sound = sorted((pair for pair in paths if np.isfinite(pair[0])), key=lambda pair: -pair[0])
        return _apart([path for _, path in sound], lambda path: path)

    def on_nodes(self, path: Path, tracks: Tracks) -> Path:
        """A path with the depths of cells, with depths at nodes."""
        cell, (x, y) = self.params.cell, tracks.places
        middle = (cell - 1) / 2
        u, v = (x - self.corner[0] - middle) / cell, (y - self.corner[1] - middle) / cell
        cells = path.log_rho.astype(np.float64).reshape(
            self.shape[0] // cell, self.shape[1] // cell
        )
        log_rho = scipy.ndimage.map_coordinates(cells, [v, u], order=1, mode="nearest")
        return Path(path.O, path.D, log_rho.astype(self.real))

    def before_a_plane(self, centre: int, planes: list[Plane]) -> list[Rival]:
        """Of motions before a plane those of least cost first, if a plane explains the events.

        Fitted to a growing part of the window, with the depths of a plane throughout: of the two
        motions that explain a homography only one explains how it changes, if it is one plane.
        """
        paths, found = [], []
        for row, (share, events, stages, most) in enumerate(GROWING):
            half = share * float(self.params.half_window)
            tracks, prior = self.tracks(centre, half, events), self.prior(centre, half)
            if not paths:
                paths = [plane.path(*tracks.places, self.f, self.real) for plane in planes]
            scenes = [blank(tracks, path, prior) for path in paths]
            follow = functools.partial(_begun, tracks, prior=prior, stages=stages, plane=True)
            found = [one for one in side_by_side(follow, scenes) if one[1].cost < most]
            # The first is too coarse to choose among motions that are alike.
            found = self.ranked(found) if row else found
            paths = [scene.path for scene, _ in found]
            if not paths:
                break
        return found

    def rivals(self, centre: int, warm: Path | None = None) -> list[Rival]:
        """What to follow to the end, the best first: of new starts, and of a path about right."""
        half, paths = float(self.params.half_window), [] if warm is None else [warm]
        Omega = self.rotation(centre)
        cuts = [self.cut(centre, share * half, MIDDLE) for share in (1 / 3, 2 / 3)]
        planes = side_by_side(lambda cut: before_a_plane(homography(cut, Omega)), cuts)
        # Of the two before a plane the false one may cost 2 % less until all events are fitted.
        found, (times, more) = self.before_a_plane(centre, planes[0] + planes[1]), (ALIKE, 0.0)
        if not found:
            tracks = self.tracks(centre, half, TRIED)
            starts = self.starts(centre, Omega, planes[0] + planes[1])
            paths += [self.on_nodes(path, tracks) for path in self.aligned(centre, starts)]
            found, (times, more) = self.ranked(self.rounds(centre, tracks, paths)), CLOSE
        limit = times * self.cost(*found[0]) + more if found else 0.0
        return [one for one in found if self.cost(*one) < limit]

    def rounds(
        self, centre: int, tracks: Tracks, paths: list[Path], stages: tuple[Stage, ...] = ROUNDS
    ) -> list[Rival]:
        """Paths through the first stages, depths looked for before each of them."""
        prior = self.prior(centre, float(self.params.half_window))
        found: list[Rival] = []
        scenes = [blank(tracks, path, prior) for path in paths]
        self.least[centre] = 0.0
        for stage in stages:

            def follow(scene: Scene, stage: Stage = stage) -> Rival:
                path = Path(scene.path.O, scene.path.D, depths(scene.path, tracks))
                scene = Scene(path, scene.map, prior.skew)
                return _begun(tracks, scene, prior, (stage,), least=self.least[centre])

            found = side_by_side(follow, scenes)
            scenes = [scene for scene, _ in found]
            if stage.sigma == NOISY and found:
                noise = min(report.noise for _, report in found)
                self.least[centre] = noise if noise > NOISE else 0.0
        return found

    def followed(self, centre: int, warm: Path) -> Rival:
        """A path with depths at nodes that is about right, but for the last stage."""
        half = float(self.params.half_window)
        tracks, prior = self.tracks(centre, half, TRIED), self.prior(centre, half)
        first, second = FOLLOWING
        ((scene, report),) = self.rounds(centre, tracks, [warm], first)
        return _adjusted(tracks, scene, report, prior, second, least=self.least[centre])

    def fit(self, centre: int, warm: Path | None = None) -> Fit | None:
        """The best of new starts, and of a path with depths at nodes that is about right."""
        return self.ended(centre, self.rivals(centre, warm), FINAL)

    def ended(
        self, centre: int, rivals: list[Rival], stages: tuple[Stage, ...] = ENDING
    ) -> Fit | None:
        """The best rival after the last stages."""
        half = float(self.params.half_window)
        tracks, prior = self.tracks(centre, half, self.params.events), self.prior(centre, half)
        least = self.least.get(centre, 0.0)
        left = side_by_side(
            lambda one: _adjusted(tracks, one[0], one[1], prior, stages, least=least), rivals
        )
        if not left:
            return None
        ranked = self.ranked(left)
        first, seen = ranked[0]
        parallax = self.parallax(first.path, tracks)
        few = least > 0 or parallax < PARALLAX or seen.inliers < AGREED
        limit = np.inf if few else ALIKE * self.cost(*ranked[0])
        close = [one for one in ranked if self.cost(*one) <= limit]
        trial = self.trial(centre) if few or len(close) > 1 else None
        # What is alone is at its end: more steps than its map takes hardly change z.
        alone = len(close) == 1
        steps = SETTLE if alone else STEPS
        fits = side_by_side(lambda one: trial.fit(one[0].path, steps=steps), close) if trial else []
        chosen = trial.best(fits) if trial else 0
        scene, report = close[chosen]
        sigma = max(stages[-1].sigma, SHARP * report.noise, least)
        covariance = compute_covariance(tracks, scene, prior, sigma=sigma)
        scene, report = adjust(tracks, scene, prior, sigma=sigma, settle=0, steps=1)
        covariance = inflation(report.inliers) * covariance + self.of_lens(scene.path)
        left_open = np.zeros((6, 6))
        if trial:
            others = [(one.path, fit) for (one, _), fit in zip(close, fits, strict=True)]
            best, path, z = others.pop(chosen)[1], scene.path, np.inf
            if few:
                still, z = trial.rotation(path, self.rotation(centre), best, begun=alone)
            if z < TELLING:
                path, covariance = _without_heading(path, still.path, covariance)
                scene = scene._replace(path=path)
            else:
                left_open = _left_open(trial, path, best, others)
        return Fit(
            scene.path,
            covariance + left_open,
            report.inliers,
            report.cost,
            scene.map,
            float(np.sqrt(np.trace(left_open[:3, :3]))),
        )

    def of_lens(self, path: Path) -> NDArray[np.float64]:
        """The covariance (6, 6) by what a calibration leaves of a lens that distorts.

        That is a share of the image's motion, which heading and Omega make up for.
        """
        rho, heading = float(np.exp(np.median(path.log_rho))), path.D[0]
        moved = self.lens * (rho + float(np.linalg.norm(path.O[0])))  # rad/s
        left = np.zeros((6, 6))
        left[:3, :3] = (moved / rho) ** 2 * (np.eye(3) - np.outer(heading, heading))
        left[3:, 3:] = moved**2 * np.eye(3)
        return left

    def parallax(self, path: Path, tracks: Tracks) -> float:
        """How far (px) the usual point moves by translation while a window's events last."""
        lasts = float(np.ptp(tracks.tau)) if len(tracks.tau) else 0.0
        return lasts * self.f * float(np.exp(np.median(path.log_rho)))

    def trial(self, centre: int) -> Trial:
        """Pixels of a window for the comparison of rivals."""
        half = float(self.params.half_window)
        first, last = self.rows(centre, half)
        limit = min(TRIED, int(0.6 * (last - first)))
        return Trial(
            self.tracks(centre, half, TRIED, limit),
            self.tracks(centre, half, TRIED, TRIED, limit),
            self.prior(centre, half),
            max(SIGMA, self.least.get(centre, 0.0)),
        )

    def ranked(self, rivals: list[Rival]) -> list[Rival]:
        """That of least cost first, without those that came to a better one."""
        return _apart(sorted(rivals, key=lambda one: self.cost(*one)), lambda one: one[0].path)

    def cost(self, scene: Scene, report: Report) -> float:
        """What selects among rivals: the cost per event, with the prior of |Omega|."""
        value = report.cost + self.turning(scene.path)
        return value if np.isfinite(value) else np.inf

    def turning(self, path: Path) -> float:
        """The prior of |Omega|, per event."""
        return 0.5 * self.omega_weight * float((path.O[0] ** 2).sum()) / LAST


def _without_heading(
    path: Path, still: Path, covariance: NDArray[np.float64]
) -> tuple[Path, NDArray[np.float64]]:
    """Path and covariance where rotation alone, `still`, is not refuted: nothing tells the heading.

    The path is the rotation's, with hardly a translation, and Omega may be either's.
    """
    told, heading, turn = covariance.copy(), path.D[0], still.O[0] - path.O[0]
    told[:3], told[:, :3] = 0, 0
    told[:3, :3] = (np.pi / 2) ** 2 / 2 * (np.eye(3) - np.outer(heading, heading))
    told[3:, 3:] += np.outer(turn, turn)
    return Path(still.O, path.D, path.log_rho + HARDLY), told


def _left_open(
    trial: Trial, path: Path, best: Scene, others: list[tuple[Path, Scene]]
) -> NDArray[np.float64]:
    """What other motions add to the covariance of a path, by their likelihood, exp(-z^2 / 2).

    Of pixels left out (`rivals`), on which `best` is the path's scene.
    """
    told = np.zeros((6, 6))
    for other, scene in others:
        z = max(trial.z(scene, best), 0.0)
        apart = np.concatenate([other.D[0] - path.D[0], other.O[0] - path.O[0]])
        told += np.exp(-(z**2) / 2) * np.outer(apart, apart)
    return told


def near_to(path: Path, other: Path) -> bool:
    turn = float(((path.O[0] - other.O[0]) ** 2).sum())
    return bool(path.D[0] @ other.D[0] > APART) and turn < TURN**2


def _apart(ranked: list[Any], path: Callable[[Any], Path]) -> list[Any]:
    """Those that are not near to an earlier one that is kept."""
    best: list[Any] = []
    for one in ranked:
        if not any(near_to(path(one), path(other)) for other in best):
            best.append(one)
    return best


def blank(tracks: Tracks, path: Path, prior: Prior) -> Scene:
    """The scene of a path alone."""
    return Scene(path, np.zeros(tracks.shape, tracks.x.dtype), prior.skew)


def _begun(
    tracks: Tracks,
    scene: Scene,
    prior: Prior,
    stages: tuple[Stage, ...],
    plane: bool = False,
    least: float = 0.0,
) -> Rival:
    """Through stages; first the map settles, or is made if it is blank."""
    if len(tracks.x) > tracks.events and not scene.map.any():
        for sigma, steps in BRIGHTNESS:
            scene, _ = adjust(
                tracks, scene, prior, sigma=sigma, settle=steps, steps=steps, plane=plane
            )
    scene, report = adjust(
        tracks, scene, prior, sigma=ROUNDS[0].sigma, settle=2, steps=2, plane=plane
    )
    return _adjusted(tracks, scene, report, prior, stages, plane, least)


def _adjusted(
    tracks: Tracks,
    scene: Scene,
    report: Report,
    prior: Prior,
    stages: tuple[Stage, ...],
    plane: bool = False,
    least: float = 0.0,
) -> Rival:
    """Through stages; sigma is no less than `least`, nor much less than the noise (C) seen."""
    for stage in stages:
        flat, change = stage.flatter * prior.flat, stage.stiffer * prior.change
        seen = prior._replace(flat=flat, change=change)
        sigma = max(stage.sigma, SHARP * report.noise, least)
        scene, report = adjust(
            tracks, scene, seen, sigma=sigma, settle=0, steps=stage.steps, plane=plane
        )
    return scene, report
