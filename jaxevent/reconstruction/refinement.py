"""Parameters of a method that predict hidden frames of the recording itself best.

A calibration finds the sensor's thresholds and clock. What a method does best with is not quite
these: it counts whole events, which are late, and some of a method's numbers stand for what it
leaves out. So every second given frame of a sample is hidden, and the parameters that predict these
frames with the least squared error are sought from the calibration by damped Gauss-Newton steps.
Nothing but given frames is used.
"""

import contextlib
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError, InputWarning
from jaxevent.events import crop
from jaxevent.parameters import Positive
from jaxevent.recording import Frames, Recording

N_SEGMENTS = 3
FRAMES_PER_SEGMENT = 9
MIN_CHOICE_GAIN = 0.1  # the same of each choice, of a few frames
FRAMES_TO_CHOOSE = 5  # of a segment, where methods are slow
MAX_PIXELS = 40_000
MAX_EVENTS = 400_000  # of all segments
N_GAUSS_NEWTON_STEPS = 6
N_TRIES = 4  # of a step, each with more damping
CLOCK_STEP_FRAMES = 0.02  # of differences, in the time between frames
LOG_STEP = 0.1  # of differences of positive numbers
MAX_STEP = 0.4  # of one move, in logarithms; as much in tenths of the time between frames
MIN_GAIN = 1e-3  # relative fall of the error, below which the search ends


class HiddenFrames:
    """Part of a recording with every second frame hidden.

    Args:
        part: A few frames of the recording and the events around them.
    """

    def __init__(self, part: Recording):
        assert part.frames is not None
        self.given = part.with_frames(slice(0, None, 2))
        last = (len(part.frames) - 1) // 2 * 2
        self.hidden: Frames = part.frames[slice(1, last, 2)]
        self.interval_s = float(np.median(np.diff(part.frames.t))) * 1e-6
        gain = part.gain[slice(1, last, 2), None, None]
        linear = np.asarray(part.response.intensity(self.hidden.intensity), np.float64)
        self.white, self.truth = 1 / gain, linear / gain

    def errors(self, method: Any, params: Any) -> NDArray[np.float64]:
        """Return the errors of the predicted frames, intensities clipped to the frames' range.

        Args:
            method: The reconstruction method.
            params: Its parameters.

        Returns:
            (frames * pixels,) errors, as parts of the frames' white at a gain of 1.
        """
        late = round(float(params.clock_offset) * 1e6)
        images = method.estimate(self.given, params, progress=False)
        images.is_checked = True  # thresholds that are tried may well be wrong
        mean, _, _ = images(self.hidden.t + late, extrapolate=True)
        image = np.nan_to_num(np.asarray(mean, np.float64), nan=0.5)
        return (image.clip(0, self.white) - self.truth).ravel()


def _busiest_band(recording: Recording, events: Any) -> tuple[int, int]:
    """Find the band of rows with most events.

    Args:
        recording: The recording.
        events: Some of its events.

    Returns:
        First row and height, px.
    """
    height = min(max(MAX_PIXELS // recording.width, 16), recording.height)
    rows = np.bincount(events.y, minlength=recording.height)
    total = np.concatenate([[0], np.cumsum(rows)])
    return int(np.argmax(total[height:] - total[:-height])), height


def choose_parts(
    recording: Recording, clock_offset: float, each: int = FRAMES_PER_SEGMENT
) -> list[HiddenFrames]:
    """Choose parts of a recording that are spread over it.

    Args:
        recording: Events and frames.
        clock_offset: Calibrated clock offset, s.
        each: Largest number of frames of a part.

    Returns:
        The parts; none where there are fewer than three frames.
    """
    frames, source = recording.frames, recording.events
    if frames is None or len(frames) < 3:
        return []
    each = min(each, len(frames))
    number = min(N_SEGMENTS, max(len(frames) // each, 1))
    found = []
    for begin in np.unique(np.linspace(0, len(frames) - each, number).astype(int)).tolist():
        rows = np.arange(begin, begin + each)
        while True:
            ends = frames.t[rows[[0, -1]]] + round(1e6 * clock_offset)
            step = int(ends[1] - ends[0]) // (len(rows) - 1)
            first, last = (source.index(int(t)) for t in (ends[0] - step, ends[1] + step))
            if last - first <= 4 * MAX_EVENTS // number or len(rows) <= 5:
                break
            rows = rows[:-2]
        events = source[first:last]
        if not len(events):
            continue
        part = recording.with_frames(slice(int(rows[0]), int(rows[-1]) + 1))
        part = Recording(
            part.name, part.width, part.height, events, part.frames, part.camera, extra=part.extra
        )
        y, height = _busiest_band(recording, events)
        with contextlib.suppress(InputError):
            found.append(HiddenFrames(crop(part, 0, y, part.width, height)))
    return found


def _all_errors(parts: list[HiddenFrames], method: Any, params: Any) -> NDArray[np.float64]:
    """Predict the hidden frames of some parts, and return the errors.

    Args:
        parts: The parts.
        method: Method of reconstruction.
        params: Its parameters.

    Returns:
        (n,) errors of all pixels, one part after another.
    """
    return np.concatenate([part.errors(method, params) for part in parts])


def refine(
    method: Any, recording: Recording, params: Any, names: Sequence[str], more: Sequence[Any] = ()
) -> dict[str, float]:
    """Find the parameters of a method that predict hidden frames of a recording best.

    Args:
        method: The reconstruction method.
        recording: Events and frames.
        params: Parameters to start from.
        names: Names of the numbers that may move.
        more: Further parameters to start from, if they are better.

    Returns:
        Values by name; none where the recording is too short to tell.
    """
    parts = choose_parts(recording, float(params.clock_offset))
    if not parts or not names:
        return {}
    interval = parts[0].interval_s

    def move(at: Any, steps: NDArray[np.float64]) -> Any:
        """Move parameters by steps.

        Args:
            at: Parameters.
            steps: Step of each name, in the logarithm of a positive number; in a time of the clock
                `LOG_STEP` counts as `CLOCK_STEP_FRAMES` intervals between frames.

        Returns:
            New parameters.
        """
        values = {}
        for name, step in zip(names, steps.tolist(), strict=True):
            value = float(getattr(at, name))
            if isinstance(type(at).numbers[name], Positive):
                values[name] = value * np.exp(step)
            else:
                values[name] = value + step / LOG_STEP * CLOCK_STEP_FRAMES * interval
        if "share" in values:
            values["share"] = min(values["share"], 1.0)
        return at.replace(**values)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        known = [(_all_errors(parts, method, at), at) for at in (params, *more)]
        e, at = min(known, key=lambda one: float((one[0] ** 2).mean()))
        best, damping = float((e**2).mean()), 0.01
        for _ in range(N_GAUSS_NEWTON_STEPS):
            # Errors have kinks, so that a derivative on one side is biased by the step.
            sides = [
                [_all_errors(parts, method, move(at, sign * LOG_STEP * unit)) for sign in (-1, 1)]
                for unit in np.eye(len(names))
            ]
            J = np.stack([(right - left) / (2 * LOG_STEP) for left, right in sides])
            A = J @ J.T / len(e)
            g = np.array([(r**2).mean() - (left**2).mean() for left, r in sides]) / (4 * LOG_STEP)
            gain = 0.0
            for _ in range(N_TRIES):
                H = A + damping * (np.diag(np.diag(A)) + 0.1 * np.diag(A).mean() * np.eye(len(A)))
                new = move(at, np.clip(-np.linalg.pinv(H) @ g, -MAX_STEP, MAX_STEP))
                found = _all_errors(parts, method, new)
                error = float((found**2).mean())
                if error < best:
                    gain, best, at, e = 1 - error / best, error, new, found
                    damping = max(damping / 8, 1e-4)
                    break
                damping *= 8
            if gain < MIN_GAIN:
                break
    return {name: float(getattr(at, name)) for name in names}


def choose(
    method: Any,
    recording: Recording,
    params: Any,
    steps: Sequence[Sequence[Mapping[str, float]]],
) -> dict[str, float]:
    """Choose the values with which a method predicts hidden frames of a recording best.

    Args:
        method: The reconstruction method.
        recording: Events and frames.
        params: Parameters, as they are without these values.
        steps: Values by name that each step tries beside those chosen before.

    Returns:
        The values that lower the squared error by a tenth; none where the recording is too short to
        tell.
    """
    parts = choose_parts(recording, float(params.clock_offset), FRAMES_TO_CHOOSE)
    if not parts:
        return {}

    def loss(values: Mapping[str, float]) -> float:
        return float((_all_errors(parts, method, params.replace(**values)) ** 2).mean())

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        chosen: dict[str, float] = {}
        least = loss(chosen)
        for offered in steps:
            before = chosen
            for values in offered:
                error = loss({**before, **values})
                if error < (1 - MIN_CHOICE_GAIN) * least:
                    chosen, least = {**before, **values}, error
    return chosen
