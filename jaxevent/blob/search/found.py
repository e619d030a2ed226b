"""What was found of a recording: paths of targets, scales, and the parameters that follow."""

import dataclasses
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.params import TrackerParams
from jaxevent.blob.search.paths import STILL, Path
from jaxevent.blob.search.scale import Choice
from jaxevent.display import plural
from jaxevent.errors import InputError
from jaxevent.recording import Recording

P = TypeVar("P", bound=TrackerParams)

# Of x in 1 + sqrt(2) x + x^2 + x^3 / (3 sqrt(2)), see `most_events`.
LONGER = (1 / (3 * 2**0.5), 1.0, 2**0.5)

FIRST = 4  # windows that tell the size at the start
FOREVER, ANYWHERE = 1e3, 1e9  # s, px; what was found tells when targets end


@dataclasses.dataclass(frozen=True)
class Pass:
    """What one pass over the recording chose and found."""

    choice: Choice
    targets: int


@dataclasses.dataclass(frozen=True, repr=False)
class Found:
    """Targets of a recording, found by `find`.

    Attributes:
        paths: Where targets were, by their beginning.
        passes: The scales chosen, and how many targets were found with each.
        hot_pixels: How many were left out.
        background: Events of no target, per s, of the whole sensor.
        recording: Whose events these are.
        camera_moves: Whether the background was taken for a scene that moves past the camera.
        lamps: How many things that flicker with the mains were left out.
        full: Whether most of the sensor sees events most of the time, whatever makes them.
    """

    paths: tuple[Path, ...]
    passes: tuple[Pass, ...]
    hot_pixels: int
    background: float
    recording: Recording
    camera_moves: bool = False
    lamps: int = 0
    full: bool = False

    def __len__(self) -> int:
        return len(self.paths)

    def __repr__(self) -> str:
        return f"<{self.summary()}>"

    def summary(self) -> str:
        """One line of what was found."""
        text = f"{len(self)} {plural('target', len(self))}, "
        text += f"background of {self.background:,.0f} events/s"
        if self.hot_pixels:
            text += f", {self.hot_pixels} {plural('hot pixel', self.hot_pixels)} left out"
        if self.lamps:
            text += f", {self.lamps} {plural('lamp', self.lamps)} left out"
        if self.camera_moves:
            text += ", the camera moves"
        turns = [f"{path.turn:.3g}" for path in self.paths if path.turn is not None]
        if turns:
            verb = "turns" if len(turns) == 1 else "turn"
            text += f", {len(turns)} {verb} in place at {' and '.join(turns)} rad/s"
        if not len(self):
            return text
        size, speed, rate = (self._typical(values) for values in self._numbers())
        windows = [f"{p.choice.scale.window * 1e3:g}" for p in self.passes if p.targets]
        return (
            f"{text}; size {size:.3g} px, speed {speed:.3g} px/s, {rate:,.0f} events/s each; "
            f"seen in windows of {' and '.join(windows)} ms"
        )

    def seeds(self, start: int, stop: int) -> list[tuple[float, float, float, int]]:
        """One (x, y, size, us) for each target, where it is first seen."""
        width, height = self.recording.width, self.recording.height
        out = []
        for path in self.paths:
            x, y = path.p[0]
            at = int(np.clip(path.begin, start, stop - 1))
            x, y = np.clip(x, -0.5, width - 0.5), np.clip(y, -0.5, height - 0.5)
            size = np.median(path.size[:FIRST].mean(1))
            out.append((float(x), float(y), float(size), at))
        return out

    def settings(self, accuracy: float | int | None = None) -> dict[str, Any]:
        """Values of parameters that suit what was found: scales of length, time and rate.

        Of what differs between targets these are the median ones, weighted by events. `accuracy`
        is by which share the standard deviation of positions may be larger than event by event,
        and chooses `events_per_step`, see `most_events`; None: about 32 steps in a window. Raises
        `InputError` for an accuracy that is not positive.
        """
        check_accuracy(accuracy)
        if not len(self):
            return {}
        sizes, _, rates = self._numbers()
        windows = np.array([path.window * 1e-6 for path in self.paths])
        most, least = self._typical(sizes, 0.95), self._typical(sizes, 0.05)
        W = self._typical(windows)
        steps = self._typical(rates) * self._together() * W / 32
        events = int(2 ** np.clip(np.round(np.log2(max(steps, 1e-9))), 0, 5))
        if accuracy is not None:
            most = self._typical(self._most_events(float(accuracy)), 0.05)
            events = int(2 ** np.clip(np.floor(np.log2(max(most, 1e-9))), 0, 5))
        return {name: self._typical(values) for name, values in self._each().items()} | {
            "events_per_step": events,
            "lambda_min": min(0.5, least / 3),
            "lambda_max": 6 * most,
            "t_coast": FOREVER,
            "t_merge": FOREVER,
            "aspect_max": 1e3,
            "sigma_max": ANYWHERE,
            "cycle": W,
        }

    def own(self, params: TrackerParams) -> dict[str, NDArray]:
        """What of `params` differs between targets, as it is stored; not what the user has set."""
        usual, told = self.settings(), {}
        for name, values in self._each().items():
            if np.isclose(float(getattr(params, name)), usual[name], rtol=1e-5):
                stored = jnp.asarray(values, params.raw[name].dtype)
                told[name] = np.asarray(getattr(type(params), name).unconstrained(stored))
        return told

    def _each(self) -> dict[str, NDArray[np.float64]]:
        """Values of parameters for each target."""
        L, v, _ = self._numbers()
        W = np.array([path.window * 1e-6 for path in self.paths])
        return {
            "Q_p": 1e-4 * L**2 / W,
            "Q_v": np.array([path.agility for path in self.paths]),
            "Q_lambda": (0.05 * L) ** 2 / W,
            "Q_theta": 0.01 / W,
            "Q_q": 0.01 / W**3,
            "P0_p": L**2 / 4,
            "P0_v": 4 * v**2 + (L / W) ** 2,
            "P0_lambda": (0.5 * L) ** 2,
            "P0_q": (0.1 / W) ** 2,
            "lambda0": L,
            "gate_decay": 1 / W,
            "gate_min": np.maximum(2.0, 3 * L / 2),
            "gate_max": 24 * L,
            "t_still": STILL * W,
        }

    def _most_events(self, accuracy: float) -> NDArray[np.float64]:
        """Events per step that each target may have, while those go along that live as long."""
        begin, end = (np.array([getattr(p, name) for p in self.paths]) for name in ("begin", "end"))
        rate = np.array([np.quantile(p.n, 0.25) / (p.window * 1e-6) for p in self.paths])
        along = (begin <= begin[:, None]) & (end >= end[:, None])
        size = np.array([np.median(path.size[:, 1]) for path in self.paths])
        agility = np.array([path.agility for path in self.paths])
        return most_events(accuracy, size, rate, agility) * (along @ rate) / rate

    def _numbers(self) -> tuple[NDArray, NDArray, NDArray]:
        """Of each target: size of the longer axis (px), speed (px/s), rate (events/s)."""
        paths = self.paths
        return (
            np.array([np.median(path.size[:, 0]) for path in paths]),
            np.array([np.median(np.hypot(*path.v.T)) for path in paths]),
            np.array([np.median(path.n) / (path.window * 1e-6) for path in paths]),
        )

    def _typical(self, values: NDArray, part: float | int = 0.5) -> float:
        """The quantile of values of targets, weighted by their events."""
        events = np.array([path.n.sum() for path in self.paths])
        order = np.argsort(values)
        total = np.cumsum(events[order])
        return float(values[order][np.searchsorted(total, part * total[-1])])

    def _together(self) -> int:
        """Most targets at a time."""
        times = np.sort([path.begin for path in self.paths])
        ends = np.sort([path.end for path in self.paths])
        return int((np.arange(1, len(times) + 1) - np.searchsorted(ends, times, "right")).max())


def check_accuracy(accuracy: float | int | None) -> None:
    """Raise `InputError` for an accuracy that is not positive."""
    if accuracy is not None and not 0 < accuracy < np.inf:
        raise InputError(f"an accuracy of {accuracy:g} is not possible; give a share above 0")


def most_events(
    accuracy: float, size: NDArray, rate: NDArray, agility: NDArray
) -> NDArray[np.float64]:
    """Events per step with which positions are by a share of `accuracy` less certain, at most.

    Of targets (targets,) of `size` px, `rate` events/s and `agility` px^2/s^3. In its steady state
    a filter of constant velocity has the variances sqrt(2) q s^3 of position and sqrt(2) q s of
    velocity and their covariance q s^2, with q the agility and s = (size^2 / rate / q)^(1/4) its
    time constant. Before the next step, x s later, that of position is 1 + sqrt(2) x + x^2 +
    x^3 / (3 sqrt(2)) times as large.
    """
    roots = np.roots([*LONGER, 1 - (1 + accuracy) ** 2])
    x = float(roots[abs(roots.imag) < 1e-9].real.max())
    return x * rate * (size**2 / rate / agility) ** 0.25
