"""Events of moving blobs, discs and lights, with the truth of each target's state at any time.

    target = Target(LissajousMotion((640, 360), (400, 250), (0.6, 0.8), spin=4.0), rate=1e5)
    recording, truth = simulate_blobs([target], (1280, 720), duration=1.5, noise=1e4, seed=0)
    truth(0.25)    # (1, 1, 8): the state of every target at 0.25 s
    truth.source   # (events,): the target that each event came from, -1 for background

States are (px, py, vx, vy, lambda1, lambda2, theta, q): position and velocity in px and px/s, the
standard deviations of the events' positions along the two axes in px, the angle of the first axis
in rad and its rate in rad/s. x is to the right, y downwards, pixel centres are whole numbers.
Event times are a Poisson process. What is not simulated: dead times, latency, the bus.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from jaxevent.deprecated import renamed_names
from jaxevent.errors import InputError
from jaxevent.parameters import check_choice, suggest_name
from jaxevent.recording import Events, Recording, Times
from jaxevent.simulate.scenes import parse_seconds

Pair = tuple[float | int, float | int]
Shape = Literal["gaussian", "ring", "uniform", "disc"]
BACKGROUND_SOURCE = -1  # source of background events
_DELTA_S = 1e-6  # of the central difference for a heading's rate


@runtime_checkable
class TargetMotion(Protocol):
    """A target's state as a function of time."""

    def state(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the states (times, 8) at times (s) from 0 on."""
        ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class _ConstantSize:
    """Base of targets of constant size.

    Attributes:
        size: lambda1 and lambda2, px.
        theta: Initial angle, rad.
        spin: Angular velocity, rad/s.
    """

    size: Pair = (10.0, 5.0)
    theta: float | int = 0.0
    spin: float | int = 0.0

    def path(self, t: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions (px) and velocities (px/s), each (times, 2), at times (s)."""
        raise NotImplementedError

    def state(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the states (times, 8) at times (s)."""
        size = np.broadcast_to(np.asarray(self.size, np.float64), (len(t), 2))
        turn = np.stack([self.theta + self.spin * t, np.full_like(t, self.spin)], 1)
        return np.concatenate([*self.path(t), size, turn], 1)


@dataclasses.dataclass(frozen=True)
class LissajousMotion(_ConstantSize):
    """Motion along a Lissajous curve: p = centre + amplitude sin(2 pi frequency t + phase).

    Attributes:
        centre: x and y of the centre, px.
        amplitude: Amplitudes along x and y, px.
        frequency: Frequencies along x and y, Hz.
        phase: Phases along x and y, rad.
    """

    centre: Pair
    amplitude: Pair
    frequency: Pair
    phase: Pair = (0.0, 0.0)

    def path(self, t: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        rate = 2 * np.pi * np.asarray(self.frequency, np.float64)
        at = rate * t[:, None] + np.asarray(self.phase)
        amplitude = np.asarray(self.amplitude)
        return np.asarray(self.centre) + amplitude * np.sin(at), amplitude * rate * np.cos(at)


@dataclasses.dataclass(frozen=True)
class LinearMotion(_ConstantSize):
    """Motion at constant velocity: p = start + velocity t.

    Attributes:
        start: x and y at time 0, px.
        velocity: Velocity along x and y, px/s.
    """

    start: Pair
    velocity: Pair = (0.0, 0.0)

    def path(self, t: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        velocity = np.broadcast_to(np.asarray(self.velocity, np.float64), (len(t), 2))
        return np.asarray(self.start) + velocity * t[:, None], velocity


@dataclasses.dataclass(frozen=True)
class CircularMotion(_ConstantSize):
    """Motion along a circle.

    As y is downwards, a positive rate is clockwise.

    Attributes:
        centre: x and y of the centre, px.
        radius: Radius, px.
        rate: Angular velocity, rad/s.
        phase: Angle at time 0, rad.
    """

    centre: Pair
    radius: float | int
    rate: float | int
    phase: float | int = 0.0

    def path(self, t: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        at = self.phase + self.rate * t
        outward = np.stack([np.cos(at), np.sin(at)], 1)
        along = np.stack([-np.sin(at), np.cos(at)], 1)
        position = np.asarray(self.centre, np.float64) + self.radius * outward
        return position, self.radius * self.rate * along


@dataclasses.dataclass(frozen=True)
class ApproachMotion:
    """Motion of a target whose depth is distance - speed t - acceleration t^2 / 2.

    Its image is at centre + focal point / depth. Its lambda_i is size_factor focal extent_i /
    depth. The inverse time to contact is (speed + acceleration t) / depth.

    Attributes:
        point: X and Y of the target, m.
        distance: Depth at time 0, m.
        speed: Speed of approach at time 0, m/s.
        extent: Diameters along its two axes, m.
        focal: Focal length, px.
        centre: Principal point, px.
        size_factor: lambda over the diameter of the image.
        acceleration: Acceleration of the approach, m/s^2.
        theta: Angle of the first axis, rad.
    """

    point: Pair
    distance: float | int
    speed: float | int
    extent: Pair
    focal: float | int = 1000.0
    centre: Pair = (639.5, 359.5)
    size_factor: float | int = 0.25
    acceleration: float | int = 0.0
    theta: float | int = 0.0

    def depth(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the depth (times,) in m at times (s)."""
        return self.distance - self.speed * t - self.acceleration * t**2 / 2

    def state(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the states (times, 8) at times (s)."""
        depth, closing = self.depth(t)[:, None], (self.speed + self.acceleration * t)[:, None]
        offset = self.focal * np.asarray(self.point) / depth
        size = self.size_factor * self.focal * np.asarray(self.extent) / depth
        turn = np.stack([np.full_like(t, self.theta), np.zeros_like(t)], 1)
        return np.concatenate([self.centre + offset, offset * closing / depth, size, turn], 1)


@dataclasses.dataclass(frozen=True)
class RandomWalk:
    """A random path of the filters' own model.

    Velocity and spin are Wiener processes, position and angle their integrals plus Wiener
    processes; d log lambda = sqrt(Q_lambda) / lambda dW, which keeps lambda positive. Drawn on a
    grid, where position, velocity, angle and spin have exactly the model's joint distribution;
    between grid times the conditional mean is given. It lacks at most Q_v step / 12 of the variance
    of velocity; without Q_p velocity is the derivative of position everywhere.

    Attributes:
        start: (8,) state at time 0.
        duration: Length of the path, s.
        Q_p: Spectral density of the position's own process, px^2/s.
        Q_v: Spectral density of the velocity's process, px^2/s^3.
        Q_lambda: Spectral density of the sizes' processes, px^2/s.
        Q_theta: Spectral density of the angle's own process, rad^2/s.
        Q_q: Spectral density of the spin's process, rad^2/s^3.
        seed: Seed of the random numbers.
        step: Distance of grid times, s.
    """

    start: tuple[float | int, ...]
    duration: float | int
    Q_p: float | int = 0.0
    Q_v: float | int = 1e6
    Q_lambda: float | int = 0.0
    Q_theta: float | int = 0.0
    Q_q: float | int = 0.0
    seed: int = 0
    step: float | int = 1e-4

    def __post_init__(self) -> None:
        densities = (self.Q_p, self.Q_v, self.Q_lambda, self.Q_theta, self.Q_q)
        if len(self.start) != 8 or not all(0 <= q < math.inf for q in densities):
            raise InputError(
                "a random walk starts from 8 values and has densities Q_p, Q_v, Q_lambda, Q_theta "
                f"and Q_q that are finite and not negative, not {len(self.start)} and {densities}"
            )
        if not (0 < self.step <= self.duration < math.inf and min(self.start[4:6]) > 0):
            raise InputError(
                f"a random walk of {self.duration} s in steps of {self.step} s from the size "
                f"{self.start[4:6]} is not possible; give positive numbers, the step the shorter"
            )

    def state(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the states (times, 8) at times (s)."""
        h = self.step
        integral, rate, wander, log_size = self._grid_path
        k = np.clip(np.floor(t / h).astype(int), 0, len(rate) - 2)
        a = ((t - k * h) / h)[:, None]
        # Given both ends, the mean of an integrated Wiener process is the cubic through their
        # values and slopes, that of a Wiener process the chord.
        (s0, v0), (s1, v1) = ((integral[i], rate[i]) for i in (k, k + 1))
        c2, c3 = 3 * (s1 - s0) - h * (2 * v0 + v1), 2 * (s0 - s1) + h * (v0 + v1)
        chord = wander[k] + a * (wander[k + 1] - wander[k])
        position = s0 + a * (h * v0 + a * (c2 + a * c3)) + chord
        slope = v0 + a * (2 * c2 + 3 * a * c3) / h
        size = np.exp(log_size[k] + a * (log_size[k + 1] - log_size[k]))
        return np.concatenate(
            [position[:, :2], slope[:, :2], size, position[:, 2:], slope[:, 2:]], axis=1
        )

    @functools.cached_property
    def _grid_path(self) -> tuple[NDArray[np.float64], ...]:
        """The path on the grid of steps.

        The integral of the rate, the rate and the Wiener part of x, y and theta, (steps + 1, 3)
        each; and the logarithm of the two sizes (steps + 1, 2).
        """
        h, steps = self.step, math.ceil(self.duration / self.step - 1e-9)
        rng = np.random.default_rng(self.seed)
        first = np.asarray(self.start, np.float64)
        white = np.sqrt([self.Q_v, self.Q_v, self.Q_q])
        n1, n2, n3 = rng.normal(size=(3, steps, 3))
        # (integral, rate) over a step: covariance [[h^3/3, h^2/2], [h^2/2, h]], by Cholesky.
        change = white * math.sqrt(h) * n1
        gain = white * h**1.5 * (n1 / 2 + n2 / math.sqrt(12))

        def accumulate(start: NDArray, steps: NDArray) -> NDArray[np.float64]:
            return np.concatenate([start[None], start + np.cumsum(steps, axis=0)])

        rate = accumulate(first[[2, 3, 7]], change)
        integral = accumulate(first[[0, 1, 6]], rate[:-1] * h + gain)
        wander = accumulate(
            np.zeros(3), np.sqrt(np.array([self.Q_p, self.Q_p, self.Q_theta]) * h) * n3
        )
        log_size = np.empty((steps + 1, 2))
        log_size[0] = np.log(first[4:6])
        noise = math.sqrt(self.Q_lambda * h) * rng.normal(size=(steps, 2))
        if self.Q_lambda == 0:
            log_size[:] = log_size[0]
        else:
            for k in range(steps):
                log_size[k + 1] = log_size[k] + noise[k] * np.exp(-log_size[k])
        return integral, rate, wander, log_size


@dataclasses.dataclass(frozen=True)
class Target:
    """A moving target that makes `rate` events per second, those outside the sensor included.

    `shape` is the distribution of the events about the centre. The events of a "gaussian", a "ring"
    (an elliptic line), and a "uniform" ellipse have the standard deviations lambda1, lambda2 of the
    motion; their polarity is random. A "disc" makes events at the leading and the trailing edge: on
    its rim, of the radius sqrt(3/2) lambda1, in proportion to |cos| of the angle to the heading, ON
    in front if it is `bright`. Its lambda2 is lambda1 / sqrt(2), theta is the heading and q its
    rate; those of the motion are ignored.

    With `flicker` (Hz) the events come in bursts, ON at the start of a period and OFF in its
    middle, whose rate decays with the time constant `burst` (s); `rate` is still the mean. There
    are no events in `dropouts`, pairs of times (s).

    Attributes:
        motion: Motion of the centre, and the sizes.
        rate: Events per second.
        shape: Distribution of the events about the centre.
        bright: Whether a disc is brighter than the background.
        flicker: Frequency of bursts, Hz; 0: events come evenly.
        burst: Time constant of a burst, s.
        dropouts: Pairs of times without events, s.

    Raises:
        InputError: A value is not possible.
    """

    motion: TargetMotion
    rate: float | int
    shape: str = "gaussian"
    bright: bool = True
    flicker: float | int = 0.0
    burst: float | int = 2e-4
    dropouts: Sequence[Pair] = ()

    def __post_init__(self) -> None:
        if self.shape not in get_args(Shape):
            raise InputError(
                f"a target's shape is {self.shape!r}; {suggest_name(self.shape, get_args(Shape))}"
            )
        if not (0 < self.rate < math.inf and 0 <= self.flicker < math.inf and self.burst >= 0):
            raise InputError(
                f"a target of {self.rate} events/s, flickering at {self.flicker} Hz in bursts of "
                f"{self.burst} s is not possible; give finite numbers, the rate above 0"
            )
        if not all(begin < end for begin, end in self.dropouts):
            raise InputError(f"the drop-outs {self.dropouts} are not pairs of a start and an end")

    def state(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the true states (times, 8) of the events at times (s)."""
        state = self.motion.state(t)
        if self.shape != "disc":
            return state

        def heading(t: NDArray[np.float64]) -> NDArray[np.float64]:
            velocity = self.motion.state(t)[:, 2:4]
            return np.arctan2(velocity[:, 1], velocity[:, 0])

        # Density |cos| / 4 of the angle on the rim: E cos^2 = 2/3 and E sin^2 = 1/3.
        state[:, 5] = state[:, 4] / math.sqrt(2)
        state[:, 6] = np.unwrap(heading(t))
        turn = heading(t + _DELTA_S) - heading(t - _DELTA_S)
        state[:, 7] = (np.mod(turn + np.pi, 2 * np.pi) - np.pi) / (2 * _DELTA_S)
        return state

    def visible(self, t: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which times (s) are outside all drop-outs."""
        visible = np.ones(t.shape, bool)
        for begin, end in self.dropouts:
            visible &= ~((begin <= t) & (t < end))
        return visible

    def events(
        self, duration: float | int, rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Draw the events.

        Args:
            duration: Length of the simulation, s.
            rng: Source of random numbers.

        Returns:
            Times (events,), s, positions (events, 2), px, and polarities (events,), unsorted.
        """
        count = rng.poisson(self.rate * duration)
        if self.flicker:
            edge = rng.integers(0, max(1, math.ceil(2 * self.flicker * duration)), count)
            t = edge / (2 * self.flicker) + rng.exponential(self.burst, count)
            on = edge % 2 == 0
        else:
            t = rng.uniform(0, duration, count)
            on = rng.random(count) < 0.5
        kept = self.visible(t) & (t < duration)
        t, on = t[kept], on[kept]
        state = self.state(t)
        u, front = self._offsets(len(t), rng)
        if self.shape == "disc":
            on = front if self.bright else ~front
        u = u * state[:, 4:6]
        c, s = np.cos(state[:, 6]), np.sin(state[:, 6])
        turned = np.stack([c * u[:, 0] - s * u[:, 1], s * u[:, 0] + c * u[:, 1]], 1)
        return t, state[:, :2] + turned, on

    def _offsets(
        self, count: int, rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Draw the offsets of events, of unit covariance along the axes.

        Args:
            count: Number of events.
            rng: Generator.

        Returns:
            (count, 2) offsets, and whether each is in front, on the positive side of the first
                axis.
        """
        if self.shape == "gaussian":
            offsets = rng.normal(size=(count, 2))
        elif self.shape == "disc":
            sine = rng.uniform(-1, 1, count)  # the density |cos| of the angle
            cosine = np.sqrt(1 - sine**2) * np.where(rng.random(count) < 0.5, 1, -1)
            offsets = np.stack([cosine * math.sqrt(3 / 2), sine * math.sqrt(3)], 1)
        else:
            angle = rng.uniform(0, 2 * np.pi, count)
            radius = math.sqrt(2) if self.shape == "ring" else 2 * np.sqrt(rng.random(count))
            offsets = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
        return offsets, offsets[:, 0] > 0


@dataclasses.dataclass(frozen=True)
class BlobTruth:
    """The truth of a simulated recording: `truth(times)` gives the states (times, targets, 8).

    Rounding of events to pixels adds 1/12 px^2 to the variances of their positions, which the true
    lambda does not contain.

    Attributes:
        targets: The targets.
        duration: Length of the recording, s.
        source: (events,) target of each event, -1 for background.
        t: (events,) times before rounding to microseconds, s.
        xi: (events, 2) positions before rounding to pixels, px.
    """

    targets: tuple[Target, ...]
    duration: float | int
    source: NDArray[np.int64]
    t: NDArray[np.float64]
    xi: NDArray[np.float64]

    def __call__(self, times: Times) -> NDArray[np.float64]:
        """Return the states of all targets.

        Args:
            times: (times,) integers (us) or floats (s) from 0 to the duration.

        Returns:
            (times, targets, 8).

        Raises:
            InputError: A time is outside the recording.
        """
        t = parse_seconds(times, self.duration)
        return np.stack([target.state(t) for target in self.targets], 1)

    def visible(self, times: Times) -> NDArray[np.bool_]:
        """Return which targets make events, (times, targets): False in their drop-outs."""
        t = parse_seconds(times, self.duration)
        return np.stack([target.visible(t) for target in self.targets], 1)


def simulate_blobs(
    targets: Sequence[Target],
    size: tuple[int, int],
    duration: float | int,
    noise: float | int = 0.0,
    seed: int = 0,
    name: str = "blobs",
) -> tuple[Recording, BlobTruth]:
    """Simulate the events of targets; deterministic in `seed`.

    Times are rounded to microseconds, positions to pixels; events outside the sensor are lost. A
    target's events do not depend on the targets after it, nor on the noise.

    Args:
        targets: The targets.
        size: Width and height of the sensor, px.
        duration: Length of the recording, s.
        noise: Rate of background events over the whole sensor, 1/s; they are uniform in space and
            time, of random polarity.
        seed: Seed of all random numbers.
        name: Name of the recording.

    Returns:
        The recording and its truth.

    Raises:
        InputError: A setting is not possible, a target's state is not finite or its size not
            positive, or there is no event.
    """
    targets = tuple(targets)
    width, height = size
    if not (0 < duration < math.inf and 0 <= noise < math.inf and width > 0 and height > 0):
        raise InputError(
            f"{name}: {duration} s of {noise} background events/s on {width}x{height} pixels are "
            "not possible; give positive, finite numbers"
        )
    if not targets:
        raise InputError(f"{name}: has no target; give at least one")
    probes = np.linspace(0, duration, 1001)
    for number, target in enumerate(targets):
        state = target.state(probes)
        if not np.isfinite(state).all() or not (state[:, 4:6] > 0).all():
            raise InputError(
                f"{name}: the size of target {number} is not positive or its state not finite "
                f"somewhere between 0 and {duration} s; change its motion or shorten the scene"
            )
    seeds = np.random.SeedSequence(seed).spawn(len(targets) + 1)
    rng = np.random.default_rng(seeds[0])
    count = rng.poisson(noise * duration)
    parts = [
        (
            rng.uniform(0, duration, count),
            rng.uniform(-0.5, (width - 0.5, height - 0.5), (count, 2)),
            rng.random(count) < 0.5,
        )
    ]
    for target, own in zip(targets, seeds[1:], strict=True):
        parts.append(target.events(duration, np.random.default_rng(own)))
    t, xi, on = (np.concatenate(column) for column in zip(*parts, strict=True))
    source = np.repeat(np.arange(len(parts)) + BACKGROUND_SOURCE, [len(part[0]) for part in parts])
    pixel = np.rint(xi)
    inside = ((pixel >= 0) & (pixel < size)).all(1)
    order = np.flatnonzero(inside)[np.argsort(t[inside], kind="stable")]
    t, (x, y) = t[order], pixel[order].astype(np.uint16).T
    events = Events(np.rint(t * 1e6).astype(np.int64), x, y, on[order])
    recording = Recording(name, width, height, events).check()
    return recording, BlobTruth(targets, duration, source[order], t, xi[order])


_WIDE = (1280, 720)
_LISSAJOUS = LissajousMotion((639.5, 359.5), (420, 240), (0.6143, 0.7927), (0.5, -0.3), spin=4.0)
Scene = tuple[list[Target], tuple[int, int], float, float]  # targets, size, duration, noise


def _lissajous(rate: float | int = 1e5, noise: float | int = 0.0, **target: Any) -> Scene:
    return [Target(_LISSAJOUS, rate, **target)], _WIDE, 1.5, float(noise)


def _noise(ratio: float | int = 1.0, rate: float | int = 1e5) -> Scene:
    return _lissajous(rate, noise=ratio * rate)


def _growing(rate: float | int = 1e5) -> Scene:
    motion = ApproachMotion((1.0, 0.4), distance=17.0, speed=8.0, extent=(0.24, 0.16), theta=0.4)
    return [Target(motion, rate)], _WIDE, 1.5, 0.0


def _ttc(rate: float | int = 5e4, ratio: float | int = 0.1) -> Scene:
    # 20 m to 8 m in 3.45 s, from 1.6 to 5.36 m/s.
    lights = [
        ApproachMotion((x, 0.3), 20.0, 1.6, extent=(0.4, 0.3), acceleration=1.09)
        for x in (-0.7, 0.7)
    ]
    return [Target(light, rate) for light in lights], _WIDE, 3.45, float(2 * rate * ratio)


def _cars(rate: float | int = 2e4, ratio: float | int = 0.1) -> Scene:
    targets = []
    for lane, distance, speed, acceleration in CAR_MOTIONS:
        for x in (lane - 0.7, lane + 0.7):
            light = ApproachMotion(
                (x, 0.8), distance, speed, (0.2, 0.15), acceleration=acceleration
            )
            targets.append(Target(light, rate))
    return targets, _WIDE, 2.0, float(6 * rate * ratio)


def _disc(rate: float | int = 1e5, radius: float | int = 12.0) -> Scene:
    spread = radius * math.sqrt(2 / 3)
    return [
        Target(dataclasses.replace(_LISSAJOUS, size=(spread, spread)), rate, shape="disc")
    ], _WIDE, 1.5, 0.0  # fmt: skip


def _crossing(
    offset: float | int = 0.0, rate: float | int = 1e5, speed: float | int = 600.0
) -> Scene:
    x, y, half = 639.5, 359.5, 0.3 * speed
    targets = [
        Target(
            LinearMotion((x - s * half, y - s * offset / 2), (s * speed, 0.0), theta=0.3 * s), rate
        )
        for s in (1, -1)
    ]
    return targets, _WIDE, 0.6, 0.0


def _dropout(length: float | int = 0.05, at: float | int = 0.55, rate: float | int = 1e5) -> Scene:
    return _lissajous(rate, dropouts=((at, at + length),))


def _flock(
    count: int = 8, rate: float | int = 3e4, ratio: float | int = 0.0, stagger: float | int = 0.0
) -> Scene:
    targets = []
    for k in range(count):
        phase = 2 * math.pi * k / count
        motion = CircularMotion(
            (639.5, 359.5), 220 + 60 * (k % 2), 2.0, phase, size=(6.0, 4.0), theta=phase
        )
        hidden = ((-1.0, k * stagger),) if k * stagger > 0 else ()
        targets.append(Target(motion, rate, dropouts=hidden))
    return targets, _WIDE, 0.5, float(count * rate * ratio)


def _walk(
    duration: float | int = 0.5, rate: float | int = 1e5, walk_seed: int = 0, **densities: Any
) -> Scene:
    start = (999.5, 999.5, 0, 0, 10, 5, 0.3, 0)
    walk = RandomWalk(start, duration, seed=walk_seed, **densities)
    return [Target(walk, rate)], (2000, 2000), float(duration), 0.0


# Of `_cars`, left, in front, right: offset (m), distance (m), speed (m/s), acceleration (m/s^2).
CAR_MOTIONS = ((-3.2, 22.0, 2.0, 2.0), (0.0, 18.0, 0.5, 0.0), (3.0, 14.0, 3.5, 0.0))

_SCENES: dict[str, Callable[..., Scene]] = {
    "lissajous": _lissajous,
    "noise": _noise,
    "growing": _growing,
    "ttc": _ttc,
    "cars": _cars,
    "disc": _disc,
    "crossing": _crossing,
    "dropout": _dropout,
    "flock": _flock,
    "walk": _walk,
}
BLOB_SCENES = tuple(_SCENES)


def blob_scene(name: str, seed: int = 0, **settings: Any) -> tuple[Recording, BlobTruth]:
    """Simulate a scene of `BLOB_SCENES` by name.

    - lissajous: one blob of (10, 5) px, to 2000 px/s, turning at 4 rad/s, 1.5 s (rate, noise);
    - noise: lissajous in background events of `ratio` times its rate (ratio, rate);
    - growing: from 17 m to 5 m at 8 m/s, 0.24 m wide, focal length 1000 px, size factor 1/4, so
      that lambda1 grows from 3.5 to 12 px (rate);
    - ttc: two lights 1.4 m apart from 20 m to 8 m in 3.45 s, 1 / TTC from 0.08 to 0.67 1/s (rate,
      ratio of background events);
    - cars: three cars in lanes side by side for 2 s, with two lights each, 1.4 m apart and 0.2 m
      wide: targets 0 and 1 left, 2 and 3 in the middle, 4 and 5 right; 1 / TTC from 0.09 to 0.43,
      from 0.028 to 0.029 and from 0.25 to 0.5 1/s (rate, ratio of background events);
    - disc: leading and trailing edges on the path of lissajous (rate, radius);
    - crossing: two blobs that pass each other at 0.3 s, 1200 px/s relative, `offset` px apart
      (offset, rate, speed of each);
    - dropout: lissajous without events from `at` for `length` s (length, at, rate);
    - flock: `count` blobs of (6, 4) px, the k-th visible from k `stagger` s on (count, rate,
      ratio, stagger);
    - walk: a `RandomWalk` of (10, 5) px on 2000 x 2000 pixels (duration, rate, walk_seed, Q_p,
      Q_v, ...).

    Args:
        name: Name of the scene.
        seed: Seed of all random numbers.
        **settings: Those in brackets; `rate` is that of each target, events/s.

    Returns:
        The recording and its truth.

    Raises:
        InputError: The name is unknown.
    """
    check_choice(name, "scene", BLOB_SCENES)
    targets, size, duration, noise = _SCENES[name](**settings)
    return simulate_blobs(targets, size, duration, noise, seed, name)


__getattr__ = renamed_names(__name__)
