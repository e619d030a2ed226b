"""The one driver of all per-pixel filters: filter events tile by tile, read at any time.

A `Filter` is a handful of pure functions of one pixel, written in scalars beside the paper's
equations; this module supplies what all share: `run` scans the ranks of a window's tiles and maps
the step over their lanes, `read` evaluates images.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxevent.deprecated import renamed_fields, renamed_methods, renamed_names
from jaxevent.devices import loop_unroll
from jaxevent.estimator import Estimate, ShortRepr
from jaxevent.reconstruction.augment import FrameParams
from jaxevent.reconstruction.engine.images import (
    FilterImages,
    FilterVideo,
    images_from_kernel,
    video_from_kernel,
)
from jaxevent.reconstruction.estimator import P, PixelEstimator, PreparedImages
from jaxevent.reconstruction.features import (
    SHAPES,
    SLOTS,
    Features,
    FrameFeatures,
    Numeric,
    Points,
    ReadOut,
    Tiles,
)
from jaxevent.reconstruction.video import ImageSequence, Video
from jaxevent.recording import Recording, Times

UNROLLED = 8  # ranks of a tile that a GPU passes over at once


class PixelState(eqx.Module):
    """Log intensity L = ln(I + I0) of a pixel and its variance P (NaN if not estimated).

    The usual state of a `Filter`, whose own may be any pytree of numbers per pixel.
    """

    L: Float[Numeric, "*pixels"]
    P: Float[Numeric, "*pixels"]


def init_without_variance(params: FrameParams, level: Array) -> PixelState:
    """The initial state of methods that estimate no variance."""
    return PixelState(level, jnp.full_like(level, jnp.nan))


class Observation(eqx.Module):
    """What the frames say at a point: log intensity, and the rate (1/s) at which to believe it."""

    level: Float[Numeric, "*points"]
    rate: Float[Numeric, "*points"]
    # A bound and the rate at which to pull states below it (positive) or above it (negative) there.
    bound: Float[Numeric, "*points"] | None = None
    push: Float[Numeric, "*points"] | None = None


class Event(eqx.Module):
    """One event as a filter's step sees it."""

    since: Float[Numeric, "*points"]  # s since the pixel's previous event
    near: Float[Numeric, "*points"]  # s since the 3x3 neighbourhood's previous event
    polarity: Int[Numeric, "*points"]  # +1, -1; 0: no event, change nothing
    frame: Observation  # just before the event


class LaneBlock(eqx.Module):
    """Which lanes tiles serve, and in which shape (`features.Tiles`)."""

    kind: Int[Array, " tiles"]
    lane: Int[Array, " tiles"]


@renamed_methods(outset="initial_level")
class FrameModel(eqx.Module):
    """What the frames say anywhere in a window: tables made once, looked up at points."""

    @abc.abstractmethod
    def __call__(self, points: Points) -> Observation: ...

    def initial_level(self, points: Points) -> Float[Array, "..."]:
        """The log intensity from which a filter starts."""
        return self(points).level


class Trajectory(ShortRepr):
    """A filtered window: enough to read an image at any time inside it."""

    frame_model: FrameModel
    start: Any  # state (pixels,), after each pixel's last event before the window
    path: Any  # state (slots,), after every event, in the order of the features' slots; or None

    def at(self, slot: Int[Array, "*images pixels"]) -> Any:
        """The states after each pixel's event in a slot, or at the window's start for slot -1."""
        if self.path is None:
            return self.start

        def look(start: Array, path: Array) -> Array:
            return jnp.where(slot < 0, start, path.at[slot].get(mode="clip"))

        return jax.tree.map(look, self.start, self.path)


def readout_log_intensity(params: FrameParams, state: Any) -> tuple[Array, Array]:
    """Log intensity and its variance of a pixel whose state is a `PixelState`."""
    return state.L, state.P


@renamed_methods(at_pixel="step_and_readout", initial_state="init_from_frames")
@renamed_fields(
    observe="frame_model", initial="init", advance="predict", jump="event_update", tell="readout"
)
@dataclasses.dataclass(frozen=True, repr=False)
class Filter(PixelEstimator[P]):
    """A causal method, made of pure functions of one pixel.

    Attributes:
        frame_model: `frame_model(params, frames)` makes the `FrameModel` of a window.
        init: `init(params, level)` returns the state at the recording's start, any pytree of
            numbers; `level` is the log intensity of the frames there.
        predict: `predict(params, state, dt, observation)` returns the state dt seconds later,
            without events.
        event_update: `event_update(params, state, event)` returns the state after an event. A
            method without it keeps no state: its image is the observation.
        readout: `readout(params, state)` returns the log intensity and its variance.
    """

    frame_model: Callable[[P, FrameFeatures], "FrameModel"]
    init: Callable[[P, Array], Any]
    predict: Callable[[P, Any, Array, Observation], Any]
    event_update: Callable[[P, Any, Event], Any] | None = None
    readout: Callable[[P, Any], tuple[Array, Array]] = readout_log_intensity
    options: frozenset[str] = dataclasses.field(
        default=frozenset({"window_events", "devices", "compiler"}), kw_only=True
    )

    @property
    def is_event_driven(self) -> bool:
        return self.event_update is not None

    def estimate(
        self,
        recording: Recording,
        params: P | None = None,
        *,
        compiler: str | None = None,
        **options: Any,
    ) -> ImageSequence[P]:
        """Images of a recording: `image, variance, valid = estimate(recording, params)(times)`.

        In single precision they come from a kernel that numba compiles from the method's own
        functions (`fused`), which the CPU runs, several times faster than the `run` and `read` that
        XLA compiles, and than a GPU runs these. They serve where a function has no translation, in
        double precision and on several devices. `compiler` asks for one of the two: "numba" or
        "xla". Further options are those of `Video`. Raises `InputError` if the recording lacks what
        the method needs, and where numba is asked for what it cannot do.
        """
        self.check_options(**options)
        params = self.Params() if params is None else params
        fused = video_from_kernel(FilterVideo, self, recording, params, compiler, options)
        return Video(self, recording, params, **options) if fused is None else fused

    def prepare_images(
        self,
        recording: Recording,
        times: Times,
        params: P | None = None,
        *,
        extrapolate: bool = False,
        compiler: str | None = None,
    ) -> PreparedImages:
        """As `ImageEstimator.prepare_images`.

        On CPUs, in single precision, a kernel makes images and their derivatives by all parameters
        in one pass over the events. `run` and `read` serve where a function has no translation, in
        double precision, on other devices and on several, for derivatives by the dead time
        `rho_ref`, and where JAX computed before jaxevent was imported (`jaxevent.dispatch`).
        `compiler` is as in `estimate`.
        """
        params = self.Params() if params is None else params
        fused = images_from_kernel(
            FilterImages, self, recording, times, params, extrapolate=extrapolate, compiler=compiler
        )
        if fused is not None:
            return fused
        return super().prepare_images(recording, times, params, extrapolate=extrapolate)

    def step(self, params: P, state: Any, event: Event) -> Any:
        """The state of a pixel after an event: advance to it, then jump."""
        assert self.event_update is not None
        return self.event_update(
            params, self.predict(params, state, event.since, event.frame), event
        )

    def image(self, params: P, state: Any, since: Array, frame: Observation) -> tuple[Array, Array]:
        """Intensity and variance of a pixel `since` seconds after its last event."""
        L, P = self.readout(params, self.predict(params, state, since, frame))
        return jnp.exp(L) - params.I0, P

    def step_and_readout(
        self,
        params: P,
        frame: Observation,
        state: Any,
        since: Array,
        near: Array,
        polarity: Array,
    ) -> tuple[Any, Array, Array]:
        """The state after an event; intensity and variance at its time without it."""
        after = state
        if self.event_update is not None:
            after = self.step(params, state, Event(since, near, polarity, frame))
        return after, *self.image(params, state, since, frame)

    def init_from_frames(self, params: P, frame_model: FrameModel, points: Points) -> Any:
        """The state of the pixels at the recording's start."""
        level = frame_model.initial_level(points)[0]
        return jax.vmap(functools.partial(self.init, params))(level)

    def init_state(self, params: P, features: Features) -> Any:
        frame_model = self.frame_model(params, features.frames)
        return self.init_from_frames(params, frame_model, features.start)

    def run(
        self, params: P, features: Features, state: Any = None, future: None = None
    ) -> tuple[Trajectory, Any]:
        """As `PixelEstimator.run`; the state is (pixels,), after each pixel's last event."""
        features = features.at_dead_time(params.rho_ref)
        frame_model = self.frame_model(params, features.frames)
        if state is None:
            state = self.init_from_frames(params, frame_model, features.start)
        if features.tiles is None:
            return Trajectory(frame_model, state, None), state
        path = self.scan(params, frame_model, features.tiles, state)
        trajectory = Trajectory(frame_model, state, path)
        return trajectory, trajectory.at(jnp.asarray(features.last))

    def scan(self, params: P, frame_model: FrameModel, tiles: Tiles, state: Any) -> Any:
        """The states after every event, (slots,)."""
        path = tiles.map_shards(self._scan, params, frame_model, state)
        return jax.tree.map(jnp.ravel, path)

    def _scan(self, tiles: Tiles, params: P, frame_model: FrameModel, state: Any) -> Any:
        """The states after every event, (tiles, slots)."""
        frame = frame_model(tiles.points)
        events = Event(
            jnp.asarray(tiles.since), jnp.asarray(tiles.near), jnp.asarray(tiles.polarity), frame
        )
        place = LaneBlock(jnp.asarray(tiles.kind), jnp.asarray(tiles.lane))
        lanes = jax.tree.map(lambda s: s[tiles.pixel], state)
        return _path(self, params, events, lanes, place)

    def read(self, params: P, trajectory: Trajectory, out: ReadOut) -> Estimate:
        out = out.at_dead_time(params.rho_ref)
        before = trajectory.at(jnp.asarray(out.slot))
        since, frame = jnp.asarray(out.since), trajectory.frame_model(out.points)

        frame = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, since.shape), frame)
        one = functools.partial(self.image, params)
        over_images = jax.vmap(jax.vmap(one), (0 if trajectory.path is not None else None, 0, 0))
        image, P = over_images(before, since, frame)
        return Estimate(image, P, jnp.isfinite(image))


def _over_tiles(step: Callable, lanes: Any, place: LaneBlock, slots: Any) -> Any:
    """Scan the tiles in order, and in each its ranks: `step(lanes, slots) -> lanes, output`.

    `lanes` are arrays (lanes,), `slots` (tiles, slots). Returns the outputs, (tiles, slots). Of
    tiles shared out among devices each has an equal share of the lanes of every block of `LANES`.
    """
    share = SLOTS // jax.tree.leaves(slots)[0].shape[1]
    shapes = [(ranks, width // share) for ranks, width in SHAPES]
    widest = max(width for _, width in shapes)

    def use(ranks: int, width: int, lanes: Any, tile: Any) -> tuple[Any, Any]:
        tile = jax.tree.map(lambda v: v.reshape(ranks, width), tile)
        mine = jax.tree.map(lambda s: s[:width], lanes)
        end, out = lax.scan(step, mine, tile, unroll=loop_unroll(UNROLLED))
        lanes = jax.tree.map(lambda s, e: jnp.concatenate([e, s[width:]]), lanes, end)
        return lanes, jax.tree.map(jnp.ravel, out)

    def skip(lanes: Any, tile: Any) -> tuple[Any, Any]:
        out = jax.eval_shape(lambda: use(*shapes[0], lanes, tile)[1])
        return lanes, jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), out)

    kinds = [functools.partial(use, *shape) for shape in shapes]

    # Branches see a tile's lanes, not all: XLA copies what goes through a branch. With all lanes
    # the filter took 22 ms for a million events, with a tile's 9 ms.
    def body(lanes: Any, tile: tuple[LaneBlock, Any]) -> tuple[Any, Any]:
        where, slots = tile
        lane = where.lane if share == 1 else where.lane // share
        mine = jax.tree.map(lambda s: lax.dynamic_slice(s, (lane,), (widest,)), lanes)
        end, out = lax.switch(where.kind, [*kinds, skip], mine, slots)
        lanes = jax.tree.map(lambda s, e: lax.dynamic_update_slice(s, e, (lane,)), lanes, end)
        return lanes, out

    return lax.scan(body, lanes, (place, slots))[1]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _path(method: Filter, params: Any, events: Event, lanes: Any, place: LaneBlock) -> Any:
    """The states after every event, (tiles, slots), from those of lanes, (lanes,)."""

    def step(at: Any, event: Event) -> tuple[Any, Any]:
        at = _each(method, params, at, event)
        return at, at

    return _over_tiles(step, lanes, place, events)


def _each(method: Filter, params: Any, at: Any, event: Event) -> Any:
    """The filter's step, mapped over all axes of states and events."""
    step = functools.partial(method.step, params)
    for _ in range(event.since.ndim):
        step = jax.vmap(step)
    return step(at, event)


# With s the state before an event, f the filter's step, the state's derivative obeys
#   d s' = (df / ds) d s + (df / dtheta) d theta.
# The states are known after the scan, so both Jacobians are found for all events at once and only
# this linear recursion is left to be scanned; it transposes to the adjoint one. Derivatives of the
# scan itself keep and move what each step computed: reverse mode took 1.2 s where this takes 0.6 s
# for 5 M events (two cores), next to 0.05 s for the states.
@_path.defjvp
def _path_jvp(method: Filter, primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    params, events, lanes, place = primals
    d_params, d_events, d_lanes, _ = tangents

    def step(at: Any, event: Event) -> tuple[Any, tuple[Any, Any]]:
        after = _each(method, params, at, event)
        return after, (at, after)

    before, path = _over_tiles(step, lanes, place, events)
    # Counters and flags of a state have no derivative: only its real leaves are followed.
    real, rest = eqx.partition(before, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(real)

    def by_state(*leaves: Array) -> list[Array]:
        at = eqx.combine(jax.tree.unflatten(tree, leaves), rest)
        return _real(_each(method, params, at, events))

    def by_rest(params: Any, frame: Observation) -> list[Array]:
        return _real(_each(method, params, before, dataclasses.replace(events, frame=frame)))

    zero, one = (tuple(full(leaf) for leaf in leaves) for full in (jnp.zeros_like, jnp.ones_like))
    columns = [
        jax.jvp(by_state, leaves, [*zero[:k], one[k], *zero[k + 1 :]])[1]
        for k in range(len(leaves))
    ]
    _, pushed = jax.jvp(by_rest, (params, events.frame), (d_params, d_events.frame))

    def linear(at: list[Array], slot: Any) -> tuple[list[Array], list[Array]]:
        columns, pushed = slot
        after = []
        for i, push in enumerate(pushed):
            terms = [column[i] * d for column, d in zip(columns, at, strict=True)]
            after.append(functools.reduce(jnp.add, [*terms, push]))
        return after, after

    def recursion(d_lanes: list[Array], pushed: list[Array]) -> list[Array]:
        return _over_tiles(linear, d_lanes, place, (columns, pushed))

    return path, _as_tangent(path, _linear(recursion, _real_tangents(lanes, d_lanes), pushed))


def _linear(function: Callable, *arguments: Any) -> Any:
    """Apply a linear function that scans.

    JAX before 0.10 transposes a scan only where its own `linearize` found what is linear in it.
    """
    if jax.__version_info__ >= (0, 10):
        return function(*arguments)
    zeros = jax.tree.map(jnp.zeros_like, arguments)
    return jax.linearize(function, *zeros)[1](*arguments)


def _real(state: Any) -> list[Array]:
    """The leaves of a state that have derivatives."""
    return jax.tree.leaves(eqx.filter(state, eqx.is_inexact_array))


def _real_tangents(state: Any, tangent: Any) -> list[Array]:
    """The tangents of those leaves."""
    pairs = zip(jax.tree.leaves(state), jax.tree.leaves(tangent), strict=True)
    return [d for leaf, d in pairs if eqx.is_inexact_array(leaf)]


def _as_tangent(state: Any, real: list[Array]) -> Any:
    """A tangent of a state from those of its real leaves; the others have none (float0)."""
    leaves, tree = jax.tree.flatten(state)
    following = iter(real)
    return jax.tree.unflatten(
        tree,
        [
            next(following)
            if eqx.is_inexact_array(leaf)
            else np.zeros(leaf.shape, jax.dtypes.float0)
            for leaf in leaves
        ],
    )


__getattr__ = renamed_names(__name__)
