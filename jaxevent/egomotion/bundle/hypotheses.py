"""Hypotheses of the general motion in a window: made, refined, and compared.

- Initial motions, from short windows (`initialise`): those before planes, and headings of patches'
  flows.
- If a plane explains the events, the fit of a growing window with a plane's depths selects among
  the motions: to first order two explain them, over time only one.
- Else each is refined with a constant twist, then over longer windows (`alignment`), and a few of
  the best continue.
- Of these the cost of the bundle adjustment (`photometric_ba`) selects, repeatedly as it proceeds.
  If events are noisy, sigma is not made much smaller than that noise.
- Hypotheses of similar cost are compared on pixels that none was fitted to (`HeldOutTest`), with
  rotation alone as one of them if parallax is small.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from jaxevent.cache import cache_method
from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.bundle.alignment import WindowEvents, align_segments, contrast_score
from jaxevent.egomotion.bundle.initialise import (
    PlanarMotion,
    homography_flow,
    map_parallel,
    measure_patch_flows,
    planar_solutions,
    search_headings,
    sharpest_rotation,
)
from jaxevent.egomotion.bundle.photometric_ba import (
    FitReport,
    adjust,
    compute_covariance,
    init_problem,
    search_depths,
)
from jaxevent.egomotion.bundle.residuals import PixelSeries, Scene, subtract_mean
from jaxevent.egomotion.bundle.warp import Path, Prior
from jaxevent.egomotion.bundle.windows import Params, WindowReader
from jaxevent.recording import Recording

MAX_FLOW_EVENTS = 15_000  # of windows for patches' flows
MAX_ALIGNED_EVENTS = 30_000  # of windows for the first alignments
MAX_SCORED_EVENTS = 60_000  # of windows for the last alignment
MAX_HYPOTHESIS_EVENTS = 30_000  # of the bundle adjustment until one hypothesis is left
MAX_INITIAL_PATHS = 6  # that go on from the first alignment
MIN_SAME_HEADING_COSINE = np.cos(np.radians(6))  # of motions that are taken for one
MAX_SAME_TURN_RAD_S = 0.1  # rad/s, likewise


class Stage(NamedTuple):
    """Steps of the bundle adjustment at one sigma.

    A flatter map and a stiffer path leave less freedom, so the fit converges sooner, and a short
    window, which hardly determines changes of the motion, does not lead away from the truth.

    Attributes:
        sigma: Standard deviation of residuals, C.
        steps: Number of steps.
        flatness: Factor of the map's prior.
        stiffness: Factor of the prior on changes of the twist.
    """

    sigma: float
    steps: int
    flatness: float | int = 1
    stiffness: float | int = 1


# Stages of new hypotheses, each after a search of depths, and of the rest.
COARSE_TO_FINE_STAGES = Stage(1.0, 6), Stage(0.5, 6), Stage(0.2, 10), Stage(0.1, 10)
FINAL_STAGES = Stage(0.05, 20, 10), Stage(0.02, 20, 3)
# Stages in which the map first takes the frames' brightness, some 10 C from 0.
FRAME_BRIGHTNESS_STAGES = Stage(20.0, 1), Stage(5.0, 1)
# Stages of a predicted path: with and without a search of depths, and the last one.
PREDICTED_COARSE_TO_FINE_STAGES = Stage(0.5, 6), Stage(0.1, 8)
PREDICTED_STAGES = (Stage(0.05, 10, 10),)
PREDICTED_FINAL_STAGES = (Stage(0.02, 8, 3),)
# Hypotheses remain whose cost is below so many times the least, plus so much (C^2): a search of
# depths leaves up to 0.03 C.
MAX_COST_RATIO, COST_MARGIN = 1.75, 5e-4
MAX_SELECTIVE_SIGMA = 0.5  # C, of stages that select: before, the true motion may cost half more


class PlanarStages(NamedTuple):
    """Stages of the fit of a motion before a plane, on a part of the window.

    Attributes:
        share: Part of the window's length, 0..1.
        events: Most events.
        stages: The stages, one after another.
        max_cost: Largest cost of a scene that is a plane, C^2.
    """

    share: float
    events: int
    stages: tuple[Stage, ...]
    max_cost: float


# Scenes that are no plane cost 1.8e-2 and more after the first of these, planes 7e-3 and less; in
# the end 1.5e-3 and more, 2e-4 and less. Without the flatter maps of the third some fits end on the
# way, 5 to 30 degrees off at 100 times the cost of the truth.
PLANAR_STAGES = (
    PlanarStages(0.5, MAX_HYPOTHESIS_EVENTS // 2, (Stage(2.0, 8), Stage(1.0, 8)), 1e-2),
    PlanarStages(0.5, MAX_HYPOTHESIS_EVENTS, (Stage(0.3, 12, 1, 100), Stage(0.1, 6, 1, 100)), 1e-3),
    PlanarStages(
        1.0,
        MAX_HYPOTHESIS_EVENTS,
        tuple(Stage(sigma, 20, 10) for sigma in (1.0, 0.3, 0.1, 0.05)),
        1e-3,
    ),
    PlanarStages(1.0, MAX_HYPOTHESIS_EVENTS, (Stage(0.1, 10), Stage(0.05, 20)), 3e-4),
)
MIN_ERROR_INFLATION, ERROR_GROWTH_PER_OUTLIER_SHARE = 2.5, 5.0  # see `error_inflation`
# If the thresholds themselves are noisy sigma is never less than that noise: else half of the
# events are fitted exactly, and the others are outliers, for any motion. Simulated without noise
# the stage of NOISE_STAGE_SIGMA shows 0.07 C, slider_depth 0.07 to 0.1 C, evbench_seq3 0.13 C.
NOISE_STAGE_SIGMA = 0.5  # C, of the stage that measures the noise
MIN_RESIDUAL_NOISE = 0.1  # C, that limits sigma
MIN_SIGMA_PER_NOISE = 0.4  # of the residuals: events beside edges are outliers
# The share of inliers below which hypotheses are compared, whatever they cost. Walls seen with
# uneven thresholds have 0.70, whichever motion; ideal ones 0.97.
MIN_INLIER_SHARE = 0.8
# Hypotheses that cost at most so many times the least in the end are compared on held-out pixels:
# fitted events distinguish the motion from its mirror image by 3 % of the cost, or the other way.
MAX_SIMILAR_COST_RATIO = 1.5
MIN_WINDOW_PARALLAX_PX = 6.0  # in a window, below which rotation alone is a hypothesis too
UNOBSERVED_LOG_RHO_SHIFT = -3.0  # added to log inverse depths if translation is not observable

INDEPENDENT_CELL_PX = 48  # within which errors of the held-out test are alike
INFINITE_LOG_RHO = -9.0  # log inverse depth that makes no parallax
MIN_TEST_SIGMA = 0.1  # C
N_TEST_MAP_STEPS, N_TEST_STEPS = 4, 16  # of the map alone, and in all
MIN_TRANSLATION_Z = 3.0  # from which there is a translation
MIN_REFUTING_Z = 2.0  # of another motion, from which one is refuted

TEST_WINDOW_DISPLACEMENT_PX = 25.0  # that the image moves in a window of `translation_z`
MIN_TEST_HALF_WINDOW_S, MAX_TEST_HALF_WINDOW_S = 0.01, 1.0  # of half such a window
INITIAL_RELATIVE_PARALLAX = 0.3  # of the image's motion, that a translation makes at first


class WindowFit(NamedTuple):
    """A fitted window.

    The covariance counts errors that differ from one part of the image to another (24 px). Beside
    plain shapes, where they do not, errors are far larger.

    Attributes:
        path: Path with log depths at nodes.
        covariance: (6, 6) of heading and Omega.
        agreement: Share of events that the fit explains.
        cost: Robust cost per event, C^2.
        map: (height, width) log intensity, in units of the mean threshold.
        ambiguity: Spread of the headings that are not refuted, weighted by likelihood, rad.
    """

    path: Path
    covariance: NDArray[np.float64]
    agreement: float
    cost: float
    map: NDArray[np.floating]
    ambiguity: float = 0.0


Hypothesis = tuple[Scene, FitReport]


def finite_cost(hypothesis: Hypothesis) -> float:
    """Return the cost of a hypothesis per event, C^2; infinite where it is not known."""
    value = hypothesis[1].cost
    return value if np.isfinite(value) else np.inf


def error_inflation(inliers: float) -> float:
    """Return the factor of squared errors by which independent cells underestimate them.

    The model errs if many events are not explained, as before plain shapes that pass each other.
    """
    return (
        MIN_ERROR_INFLATION * np.exp(ERROR_GROWTH_PER_OUTLIER_SHARE * max(0.95 - inliers, 0.0))
    ) ** 2


class WindowFitter(WindowReader):
    """Fits of the windows of a recording."""

    @functools.cached_property
    def rotation(self) -> Callable[[int], NDArray[np.float64]]:
        """The function of a window's centre that returns its rotation; it keeps the latest two."""
        return cache_method(self._find_rotation, 2)

    def _find_rotation(self, centre: int) -> NDArray[np.float64]:
        """Return the rotation (3,), rad/s, at the middle of a window, by a gyro if there is one."""
        if self.gyro is None:
            return sharpest_rotation(self.sample_events(centre, self.half / 3, MAX_FLOW_EVENTS))
        middle = np.clip(centre, self.gyro.start, self.gyro.stop)
        return self.gyro(np.array([middle], np.int64))[1][0]

    def initial_paths(self, centre: int, Omega: NDArray, planes: list[PlanarMotion]) -> list[Path]:
        """Make aligned paths of constant twist, with depths of cells.

        Args:
            centre: Middle of the window, us; a third of it is used.
            Omega: (3,) rotation about there, rad/s.
            planes: Motions before planes.

        Returns:
            The paths, the best first.
        """
        params, half = self.params, self.half / 3
        window = self.sample_events(centre, half, MAX_ALIGNED_EVENTS)
        found = [plane.path(window.cell_positions, self.f, self.real) for plane in planes]
        cuts = [self.sample_events(centre, length, MAX_FLOW_EVENTS) for length in (half / 2, half)]
        flow_max = float(params.flow_max)
        for flows in map_parallel(lambda cut: measure_patch_flows(cut, Omega, flow_max), cuts):
            if flows is not None:
                best = search_headings(flows, self.f, Omega, params.starts)
                found += [one.path(window, flows) for one in best]

        return self._align(window, centre, found, (0, 4, 6), (0, 1, 6))[:MAX_INITIAL_PATHS]

    def align(self, centre: int, paths: list[Path]) -> list[Path]:
        """Align paths over longer windows.

        Args:
            centre: Middle of the window, us.
            paths: Paths with depths of cells.

        Returns:
            The best, some degrees apart, the best first.
        """
        middle = self.sample_events(centre, 2 * self.half / 3, MAX_ALIGNED_EVENTS)
        last = self.sample_events(centre, self.half, MAX_SCORED_EVENTS)
        best = self._align(middle, centre, paths, (1, 2, 8))[: 2 * self.params.rivals]
        steps = self.params.iterations
        return self._align(last, centre, best, (2, 2, steps))[: self.params.rivals]

    def _align(
        self, window: WindowEvents, centre: int, paths: list[Path], *passes: tuple[int, int, int]
    ) -> list[Path]:
        """Align paths in passes, and sort them by their score.

        Args:
            window: Events.
            centre: Middle of the window, us, for its prior.
            paths: Paths with depths of cells.
            *passes: Degree, number of blurs and number of steps of each pass, see `align_segments`.

        Returns:
            The paths, the best first, without those near to a better one.
        """
        prior = self.prior(centre, window.half)

        def align(path: Path) -> tuple[float, Path]:
            for degree, blurs, steps in passes:
                path = align_segments(window, path, prior, degree=degree, blurs=blurs, steps=steps)
            return contrast_score(window, path), path

        scored = [pair for pair in map_parallel(align, paths) if np.isfinite(pair[0])]
        scored.sort(key=lambda pair: -pair[0])
        return _drop_near([path for _, path in scored], lambda path: path)

    def interpolate_to_nodes(self, path: Path, series: PixelSeries) -> Path:
        """Return a path with depths of cells as one with depths at nodes."""
        cell, (x, y) = self.params.cell, series.node_positions
        middle = (cell - 1) / 2
        u, v = (x - self.corner[0] - middle) / cell, (y - self.corner[1] - middle) / cell
        cells = path.log_rho.astype(np.float64).reshape(
            self.shape[0] // cell, self.shape[1] // cell
        )
        log_rho = scipy.ndimage.map_coordinates(cells, [v, u], order=1, mode="nearest")
        return Path(path.O, path.D, log_rho.astype(self.real))

    def planar_hypotheses(self, centre: int, planes: list[PlanarMotion]) -> list[Hypothesis]:
        """Fit motions before a plane to a growing part of the window.

        Of the two motions that explain a homography only one explains its change, if the scene is
        one plane.

        Args:
            centre: Middle of the window, us.
            planes: Motions to begin with.

        Returns:
            Hypotheses, the least costly first; none if no plane explains the events.
        """
        paths, found = [], []
        for row, (share, events, stages, max_cost) in enumerate(PLANAR_STAGES):
            half = share * self.half
            series, prior = self.series(centre, half, events), self.prior(centre, half)
            if not paths:
                nodes = series.node_positions
                paths = [plane.path(nodes, self.f, self.real) for plane in planes]
            scenes = [blank_scene(series, path, prior) for path in paths]
            refine = functools.partial(
                _settle_and_refine, series, prior=prior, stages=stages, plane=True
            )
            found = [one for one in map_parallel(refine, scenes) if one[1].cost < max_cost]
            # The first stage is too coarse to select among similar motions.
            found = self.rank(found) if row else found
            paths = [scene.path for scene, _ in found]
            if not paths:
                break
        return found

    def hypotheses(self, centre: int, warm: Path | None = None) -> list[Hypothesis]:
        """Make hypotheses for the final refinement.

        Args:
            centre: Middle of the window, us.
            warm: A path with depths at nodes that is one of the starts.

        Returns:
            Scenes and reports of their fits, the best first.
        """
        paths = [] if warm is None else [warm]
        Omega = self.rotation(centre)
        cuts = [
            self.sample_events(centre, share * self.half, MAX_ALIGNED_EVENTS)
            for share in (1 / 3, 2 / 3)
        ]
        solutions = map_parallel(lambda cut: planar_solutions(homography_flow(cut, Omega)), cuts)
        planes = solutions[0] + solutions[1]
        found = self.planar_hypotheses(centre, planes)
        if found:
            limit = MAX_SIMILAR_COST_RATIO * finite_cost(found[0])
            return [one for one in found if finite_cost(one) < limit]
        series = self.series(centre, self.half, MAX_HYPOTHESIS_EVENTS)
        aligned = self.align(centre, self.initial_paths(centre, Omega, planes))
        paths += [self.interpolate_to_nodes(path, series) for path in aligned]
        found = self.refine_coarse_to_fine(centre, series, paths, COARSE_TO_FINE_STAGES)
        return self.rank([one for one in found if np.isfinite(one[1].cost)])

    def refine_coarse_to_fine(
        self, centre: int, series: PixelSeries, paths: list[Path], stages: tuple[Stage, ...]
    ) -> list[Hypothesis]:
        """Refine paths by stages, each after a search of depths.

        Args:
            centre: Middle of the window, us.
            series: Events.
            paths: Paths with depths at nodes.
            stages: The stages, from large to small sigma.

        Returns:
            The hypotheses that remain, in no order.
        """
        prior = self.prior(centre, self.half)
        found: list[Hypothesis] = []
        scenes = [blank_scene(series, path, prior) for path in paths]
        self.sigma_floor[centre] = 0.0
        for stage in stages:

            def refine(scene: Scene, stage: Stage = stage) -> Hypothesis:
                depths = search_depths(scene.path, series)
                scene = Scene(Path(scene.path.O, scene.path.D, depths), scene.map, prior.skew)
                floor = self.sigma_floor[centre]
                return _settle_and_refine(series, scene, prior, (stage,), sigma_floor=floor)

            found = map_parallel(refine, scenes)
            if stage.sigma == NOISE_STAGE_SIGMA and found:
                noise = min(report.noise for _, report in found)
                self.sigma_floor[centre] = noise if noise > MIN_RESIDUAL_NOISE else 0.0
            if stage.sigma <= MAX_SELECTIVE_SIGMA:
                least = min(map(finite_cost, found), default=0.0)
                limit = MAX_COST_RATIO * least + COST_MARGIN
                found = [one for one in found if finite_cost(one) <= limit]
            scenes = [scene for scene, _ in found]
        return found

    def refine_from(self, centre: int, warm: Path) -> Hypothesis:
        """Refine a path that is about right, up to the last stage.

        Args:
            centre: Middle of the window, us.
            warm: The path, with depths at nodes.

        Returns:
            The scene and the report of its fit.
        """
        series = self.series(centre, self.half, MAX_HYPOTHESIS_EVENTS)
        (found,) = self.refine_coarse_to_fine(
            centre, series, [warm], PREDICTED_COARSE_TO_FINE_STAGES
        )
        prior, floor = self.prior(centre, self.half), self.sigma_floor[centre]
        return _refine(found, series, prior, PREDICTED_STAGES, sigma_floor=floor)

    def fit(self, centre: int, warm: Path | None = None) -> WindowFit | None:
        """Fit a window from new initial paths, and from a known one.

        Args:
            centre: Middle of the window, us.
            warm: The known path, with depths at nodes, or None.

        Returns:
            The fit; None if no hypothesis converged.
        """
        return self.refine_final(centre, self.hypotheses(centre, warm), FINAL_STAGES)

    def refine_final(
        self,
        centre: int,
        hypotheses: list[Hypothesis],
        stages: tuple[Stage, ...] = PREDICTED_FINAL_STAGES,
    ) -> WindowFit | None:
        """Refine the remaining hypotheses at the final scales and return the best.

        Those within `MAX_SIMILAR_COST_RATIO` of the least cost are compared on held-out pixels. The
        result's covariance includes the hypotheses that were not refuted.

        Args:
            centre: Middle of the window, us.
            hypotheses: Scenes and reports of their fits.
            stages: Last stages.

        Returns:
            The fit; None without hypotheses.
        """
        series = self.series(centre, self.half, self.params.events)
        prior, floor = self.prior(centre, self.half), self.sigma_floor.get(centre, 0.0)
        refined = map_parallel(
            lambda one: _refine(one, series, prior, stages, sigma_floor=floor), hypotheses
        )
        if not refined:
            return None
        ranked = self.rank(refined)
        first, report = ranked[0]
        parallax = self.parallax(first.path, series)
        uncertain = (
            floor > 0 or parallax < MIN_WINDOW_PARALLAX_PX or report.inliers < MIN_INLIER_SHARE
        )
        limit = np.inf if uncertain else MAX_SIMILAR_COST_RATIO * finite_cost(ranked[0])
        close = [one for one in ranked if finite_cost(one) <= limit]
        test = self.held_out_test(centre) if uncertain or len(close) > 1 else None
        # A single hypothesis has converged: more steps than its map takes hardly change z.
        alone = len(close) == 1
        steps = N_TEST_MAP_STEPS if alone else N_TEST_STEPS
        fits = map_parallel(lambda one: test.fit(one[0].path, steps=steps), close) if test else []
        chosen = test.best(fits) if test else 0
        scene, report = close[chosen]
        sigma = max(stages[-1].sigma, MIN_SIGMA_PER_NOISE * report.noise, floor)
        covariance = compute_covariance(series, scene, prior, sigma=sigma)
        scene, report = adjust(series, scene, prior, sigma=sigma, map_steps=0, steps=1)
        covariance = error_inflation(report.inliers) * covariance + self.lens_covariance(scene.path)
        ambiguity = np.zeros((6, 6))
        if test:
            others = [(one.path, fit) for (one, _), fit in zip(close, fits, strict=True)]
            best, path, z = others.pop(chosen)[1], scene.path, np.inf
            if uncertain:
                rotation = self.rotation(centre)
                still, z = test.fit_rotation(path, rotation, best, only_map=alone)
            if z < MIN_TRANSLATION_Z:
                path, covariance = _without_heading(path, still.path, covariance)
                scene = scene._replace(path=path)
            else:
                ambiguity = _ambiguity_covariance(test, path, best, others)
        spread = float(np.sqrt(np.trace(ambiguity[:3, :3])))
        covariance = covariance + ambiguity
        return WindowFit(scene.path, covariance, report.inliers, report.cost, scene.map, spread)

    def lens_covariance(self, path: Path) -> NDArray[np.float64]:
        """Return the covariance due to the errors of a distorting lens's calibration.

        The errors are a share of the image's motion, which heading and Omega make up for.

        Args:
            path: Path with log depths.

        Returns:
            (6, 6), of heading and Omega.
        """
        rho, heading = float(np.exp(np.median(path.log_rho))), path.D[0]
        moved = self.lens * (rho + float(np.linalg.norm(path.O[0])))  # rad/s
        left = np.zeros((6, 6))
        left[:3, :3] = (moved / rho) ** 2 * (np.eye(3) - np.outer(heading, heading))
        left[3:, 3:] = moved**2 * np.eye(3)
        return left

    def parallax(self, path: Path, series: PixelSeries) -> float:
        """Return the motion of a point of median depth by translation, while events last.

        Args:
            path: Path with log depths.
            series: Events.

        Returns:
            px.
        """
        lasts = float(np.ptp(series.tau)) if len(series.tau) else 0.0
        return lasts * self.f * float(np.exp(np.median(path.log_rho)))

    def held_out_test(self, centre: int) -> "HeldOutTest":
        """Divide the pixels of a window for a comparison of hypotheses on held-out pixels.

        Args:
            centre: Middle of the window, us.

        Returns:
            The test.
        """
        half = self.half
        first, last = self.event_range(centre, half)
        limit = min(MAX_HYPOTHESIS_EVENTS, int(0.6 * (last - first)))
        return HeldOutTest(
            self.series(centre, half, MAX_HYPOTHESIS_EVENTS, limit),
            self.series(centre, half, MAX_HYPOTHESIS_EVENTS, MAX_HYPOTHESIS_EVENTS, limit),
            self.prior(centre, half),
            max(MIN_TEST_SIGMA, self.sigma_floor.get(centre, 0.0)),
        )

    def rank(self, hypotheses: list[Hypothesis]) -> list[Hypothesis]:
        """Sort hypotheses by cost, without those near to a better one."""
        ranked = sorted(hypotheses, key=finite_cost)
        return _drop_near(ranked, lambda one: one[0].path)


def _without_heading(
    path: Path, still: Path, covariance: NDArray[np.float64]
) -> tuple[Path, NDArray[np.float64]]:
    """Return path and covariance of a window whose rotation alone is not refuted.

    The path is the rotation's, with hardly a translation, and Omega may be either's. The heading is
    not observable.

    Args:
        path: The path with a translation.
        still: The path by rotation alone.
        covariance: (6, 6) of heading and Omega of `path`.

    Returns:
        The path, and its covariance (6, 6).
    """
    found, heading, turn = covariance.copy(), path.D[0], still.O[0] - path.O[0]
    found[:3], found[:, :3] = 0, 0
    found[:3, :3] = (np.pi / 2) ** 2 / 2 * (np.eye(3) - np.outer(heading, heading))
    found[3:, 3:] += np.outer(turn, turn)
    return Path(still.O, path.D, path.log_rho + UNOBSERVED_LOG_RHO_SHIFT), found


def _ambiguity_covariance(
    test: "HeldOutTest", path: Path, best: Scene, others: list[tuple[Path, Scene]]
) -> NDArray[np.float64]:
    """Return the covariance that other motions add, by their likelihood exp(-z^2 / 2).

    Args:
        test: Test with held-out pixels.
        path: The path.
        best: Its scene in the test.
        others: Other paths and their scenes in the test.

    Returns:
        (6, 6), of heading and Omega.
    """
    found = np.zeros((6, 6))
    for other, scene in others:
        z = max(test.z(scene, best), 0.0)
        apart = np.concatenate([other.D[0] - path.D[0], other.O[0] - path.O[0]])
        found += np.exp(-(z**2) / 2) * np.outer(apart, apart)
    return found


def is_near(path: Path, other: Path) -> bool:
    """Return whether two paths have about the same motion at the window's middle."""
    turn = float(((path.O[0] - other.O[0]) ** 2).sum())
    return bool(path.D[0] @ other.D[0] > MIN_SAME_HEADING_COSINE) and turn < MAX_SAME_TURN_RAD_S**2


def _drop_near(ranked: list[Any], path: Callable[[Any], Path]) -> list[Any]:
    """Keep the items whose paths differ from those of all items kept before.

    Args:
        ranked: Items, the best first.
        path: Function that returns an item's path.

    Returns:
        The items that are kept, in order.
    """
    best: list[Any] = []
    for one in ranked:
        if not any(is_near(path(one), path(other)) for other in best):
            best.append(one)
    return best


def blank_scene(series: PixelSeries, path: Path, prior: Prior) -> Scene:
    """Return the scene of a path with an empty map."""
    return Scene(path, np.zeros(series.shape, series.x.dtype), prior.skew)


def _settle_and_refine(
    series: PixelSeries,
    scene: Scene,
    prior: Prior,
    stages: tuple[Stage, ...],
    *,
    plane: bool = False,
    sigma_floor: float = 0.0,
) -> Hypothesis:
    """Refine a scene by stages, after its map has been fitted.

    Args:
        series: Events.
        scene: Scene, whose map may be empty.
        prior: Priors, which stages scale.
        stages: See `_refine`.
        plane: Whether depths are a plane's.
        sigma_floor: Least sigma, C.

    Returns:
        The scene and the report of its fit.
    """

    def settle(scene: Scene, sigma: float, steps: int) -> Hypothesis:
        return adjust(series, scene, prior, sigma=sigma, map_steps=steps, steps=steps, plane=plane)

    if len(series.x) > series.n_events and not scene.map.any():
        for stage in FRAME_BRIGHTNESS_STAGES:
            scene, _ = settle(scene, stage.sigma, stage.steps)
    settled = settle(scene, COARSE_TO_FINE_STAGES[0].sigma, 2)
    return _refine(settled, series, prior, stages, plane=plane, sigma_floor=sigma_floor)


def _refine(
    hypothesis: Hypothesis,
    series: PixelSeries,
    prior: Prior,
    stages: tuple[Stage, ...],
    *,
    plane: bool = False,
    sigma_floor: float = 0.0,
) -> Hypothesis:
    """Refine a hypothesis by stages of the bundle adjustment.

    Args:
        hypothesis: Scene, and report of the fit before.
        series: Events.
        prior: Priors, which stages scale.
        stages: Sigma and steps; sigma is not much less than the noise of the fit before.
        plane: Whether depths are a plane's.
        sigma_floor: Least sigma, C.

    Returns:
        The scene and the report of its fit.
    """
    scene, report = hypothesis
    for stage in stages:
        flat, change = stage.flatness * prior.flat, stage.stiffness * prior.change
        scaled = prior._replace(flat=flat, change=change)
        sigma = max(stage.sigma, MIN_SIGMA_PER_NOISE * report.noise, sigma_floor)
        scene, report = adjust(
            series, scene, scaled, sigma=sigma, map_steps=0, steps=stage.steps, plane=plane
        )
    return scene, report


@dataclasses.dataclass(frozen=True)
class HeldOutTest:
    """Comparison of scenes on pixels of a window that none was fitted to.

    All are fitted at one sigma, from the same empty map: d_e is the difference of an event's cost
    under two scenes, and D_c its sum over cells of 48 px, which err independently:

        z = sum_c D_c / sqrt(sum_c D_c^2)

    Single events are not independent: those of a cell see the same edges.
    """

    series: PixelSeries  # of the pixels that scenes are fitted to
    held_out: PixelSeries  # of the pixels on which they are compared
    prior: Prior
    sigma: float  # C

    def fit(self, path: Path, *, moves: bool = True, steps: int = N_TEST_STEPS) -> Scene:
        """Fit a scene from a path.

        Args:
            path: Path with log depths at nodes.
            moves: Whether translation and depths are free, beside the rotation.
            steps: Number of steps, the first of them of the map alone.
        """
        prior = self.prior._replace(moves=moves)
        scene = blank_scene(self.series, path, prior)
        scene, _ = adjust(self.series, scene, prior, sigma=1.0, map_steps=2, steps=2)
        return adjust(
            self.series, scene, prior, sigma=self.sigma, map_steps=N_TEST_MAP_STEPS, steps=steps
        )[0]

    def fit_rotation(
        self,
        path: Path,
        sharpest: NDArray[np.float64],
        moving: Scene,
        *,
        only_map: bool = False,
    ) -> tuple[Scene, float]:
        """Fit rotation alone, from a path and from the sharpest rotation.

        A path may have a false turn with a translation that makes up for it, from which rotation
        alone does not find back. If both rotations explain less than the `moving` scene as soon as
        their maps are made they are left at that: steps of the rotation hardly change z.

        Args:
            path: Path of a general motion.
            sharpest: (3,) pure rotation of the highest contrast, rad/s.
            moving: Scene of the general motion in this test.
            only_map: Whether only the map of `moving` was fitted.

        Returns:
            The likelier rotation's scene, and z of `moving` over the rotation that it refutes
            least.
        """
        first = without_translation(path)
        turn = np.zeros_like(path.O)
        turn[0] = sharpest
        paths = first, Path(turn, first.D, first.log_rho)
        settled = [self.fit(one, moves=False, steps=N_TEST_MAP_STEPS) for one in paths]
        z = self.least_z(settled, moving)
        if z >= MIN_TRANSLATION_Z:
            return self.likelier(*settled), z
        fitted = [self.fit(one, moves=False) for one in paths]
        if only_map and self.least_z(fitted, moving) < MIN_TRANSLATION_Z:
            moving = self.fit(path)
            z = self.least_z(settled, moving)
            if z >= MIN_TRANSLATION_Z:
                return self.likelier(*settled), z
        return self.likelier(*fitted), self.least_z(fitted, moving)

    def least_z(self, scenes: list[Scene], moving: Scene) -> float:
        """Return z of a scene over the one that it refutes least.

        Args:
            scenes: Scenes to refute.
            moving: The scene.

        Returns:
            z, above 0 if held-out events cost less under `moving`.
        """
        return min(self.z(one, moving) for one in scenes)

    def likelier(self, one: Scene, other: Scene) -> Scene:
        """Return the scene under which held-out events cost less."""
        return other if self.z(one, other) > 0 else one

    def z(self, one: Scene, other: Scene) -> float:
        """Compare two scenes by the cost of held-out events.

        Args:
            one: A scene.
            other: Another one.

        Returns:
            z, above 0 if they cost less under `other`.
        """
        (a, on), (b, both) = self._event_costs(one), self._event_costs(other)
        series = self.held_out
        D = np.asarray((a - b) * on * both, np.float64)
        across = (series.x - series.corner[0]) // INDEPENDENT_CELL_PX
        down = (series.y - series.corner[1]) // INDEPENDENT_CELL_PX
        cell = (down * (series.shape[1] // INDEPENDENT_CELL_PX + 1) + across).astype(int)
        sums = np.bincount(np.maximum(cell, 0), D)
        size = float(np.sqrt((sums**2).sum()))
        return float(sums.sum()) / size if size > 0 else 0.0

    def _event_costs(self, scene: Scene) -> tuple[NDArray, NDArray]:
        """Return costs of held-out events, C^2, and whether they lie inside the map."""
        problem, evaluation = init_problem(
            self.held_out, scene, self.prior, self.sigma, plane=False
        )
        left, on = evaluation.residual.copy(), evaluation.samples.inside
        subtract_mean(left, on, self.held_out.begin)
        return left**2 / (1 + left**2 / problem.loss.limit), on

    def best(self, scenes: list[Scene]) -> int:
        """Return the index of the scene to take: the first, unless another refutes it."""
        z = [0.0, *(self.z(scenes[0], other) for other in scenes[1:])]
        best = int(np.argmax(z))
        return best if z[best] > MIN_REFUTING_Z else 0


def without_translation(path: Path) -> Path:
    """Return a rotation before a scene at infinity, that makes about the flow of a path.

    At the median depth T_x and T_y do in the middle of the image what T_x rho does as Omega_y and
    -T_y rho as Omega_x.
    """
    rho, O = float(np.exp(np.median(path.log_rho))), path.O.copy()  # noqa: E741
    O[0] += rho * np.array([-path.D[0, 1], path.D[0, 0], 0])
    return Path(O, path.D, np.full_like(path.log_rho, INFINITE_LOG_RHO))


class MotionGuess(NamedTuple):
    """An initial motion about a time: a rotation alone, and a heading with its own rotation."""

    centre: int  # us
    speed: float  # px/s of the image
    turn: NDArray[np.float64]  # rad/s
    heading: NDArray[np.float64]  # (3,), a unit vector
    Omega: NDArray[np.float64]  # rad/s


class WindowTest(NamedTuple):
    """Test of a translation in a window.

    Attributes:
        z: Test statistic, standard normal if nothing translates.
        first: First event of the window.
        last: Event after its last one.
    """

    z: float
    first: int
    last: int


def translation_z(
    recording: Recording, camera: PinholeCamera, guesses: list[MotionGuess]
) -> float | None:
    """Test whether a camera translates, in windows of a recording.

    A rotation and general motions are fitted to a part of the pixels, in windows in which the image
    moves several times farther than patches do, so that a small parallax shows.

    Args:
        recording: Events.
        camera: Calibration.
        guesses: Motions about the windows' middles.

    Returns:
        z, which shows a translation from 3 on; None if all windows hold too few events.
    """
    found = [_test_window(recording, camera, guess) for guess in guesses]
    return combine_z([one for one in found if one is not None])


def combine_z(windows: list[WindowTest]) -> float | None:
    """Combine z of some windows to one; None without windows.

    Each is standard normal if nothing translates. Two windows that share events correlate by the
    number of these over the geometric mean of their own numbers.
    """
    if not windows:
        return None
    z, first, last = np.array(windows, np.float64).T
    shared = np.minimum(last, last[:, None]) - np.maximum(first, first[:, None])
    own = np.sqrt(last - first)
    correlation = np.maximum(shared, 0) / (own * own[:, None])
    return float(z.sum() / np.sqrt(correlation.sum()))


def _test_window(
    recording: Recording, camera: PinholeCamera, guess: MotionGuess
) -> WindowTest | None:
    """Test one window; None if it holds too few events."""
    half = min(
        max(TEST_WINDOW_DISPLACEMENT_PX / 2 / guess.speed, MIN_TEST_HALF_WINDOW_S),
        MAX_TEST_HALF_WINDOW_S,
    )
    windows = WindowFitter(recording, Params.of({"half_window": half}), camera)
    first, last = windows.event_range(guess.centre, half)
    if last - first < windows.params.fewest:
        return None
    test = windows.held_out_test(guess.centre)
    nodes = np.prod(test.series.nodes)
    level = np.log(INITIAL_RELATIVE_PARALLAX * guess.speed / windows.f)

    def constant(heading: NDArray, turn: NDArray, log_rho: float) -> Path:
        return Path.constant_twist(heading, turn, np.full(nodes, log_rho, windows.real))

    still = constant(guess.heading, guess.turn, INFINITE_LOG_RHO)
    moving = [
        constant(guess.heading, guess.Omega, level),
        constant(-guess.heading, guess.Omega, level),
        constant(guess.heading, guess.turn, level),
    ]
    moving[0] = Path(moving[0].O, moving[0].D, search_depths(moving[0], test.series))
    fits = map_parallel(lambda path: test.fit(path, moves=path is not still), [still, *moving])
    return WindowTest(max(test.z(fits[0], fit) for fit in fits[1:]), first, last)
