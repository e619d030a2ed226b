"""A test of whether events and frames report changes of log intensity of the same size."""

from typing import Any, NamedTuple

import numpy as np

from jaxevent.reconstruction.frames import FrameImages
from jaxevent.reconstruction.stream import count_polarities
from jaxevent.recording import Recording

# Intervals between frames, evenly spread over the recording, in which both are compared.
N_COMPARED_INTERVALS = 4
MIN_NET_EVENTS = 2  # least size of ON minus OFF events of a pixel that is compared
CLIPPING_MARGIN = 0.02  # of the range at either end, within which a frame may be clipped
MIN_COMPARED_PIXELS = 100  # fewer do not determine the ratio
MIN_SIGN_AGREEMENT = 0.8  # of signs; below, events and frames differ by more than a scale
# Factor by which the ratio may be off; real recordings at the defaults are within 0.6 to 0.8.
MAX_RATIO_FACTOR = 2.0
DOUBTFUL_RATIO_FACTOR = 1.5  # from which it is worth asking whether other thresholds do better
CONTRADICTION_SIGMAS = 6.0  # of independent pixels; about 3 where neighbours err alike


class ChangeRatio(NamedTuple):
    """Changes of log intensity between frames, as a multiple of what the events report.

    | field | meaning |
    |---|---|
    | ratio | sum of s dL over sum of abs(S), with S = c_on ON - c_off OFF and s its sign |
    | sigma | standard error of the ratio, of independent pixels |
    | agreement | share of pixels where dL and S have the same sign |
    | pixels | number of pixels and intervals compared |
    """

    ratio: float
    sigma: float
    agreement: float
    pixels: int


def change_ratio(recording: Recording, params: Any) -> ChangeRatio | None:
    """Compare changes of log intensity between frames with those that events report.

    The changes are dL = ln(I' + I0) - ln(I + I0) of two frames, and S, the sum of s c over the
    events between these. Compared are unclipped pixels with at least two more events of one
    polarity than of the other, in a few intervals.

    Args:
        recording: Events and frames.
        params: Thresholds, `rho_ref`, `I0` and those of the clock, see `augment.FrameParams`.

    Returns:
        The comparison; None without two frames, or with too few such pixels.
    """
    frames = recording.frames
    if frames is None or len(frames) < 2 or not len(recording.events):
        return None
    c_on, c_off, I0, offset = (
        float(v) for v in (params.c_on, params.c_off, params.I0, params.frame_delay)
    )
    t, gain = frames.t + round(offset * 1e6), recording.gain
    response = FrameImages(recording, np.dtype(np.float32)).response()
    parts = []
    for first in np.unique(
        np.linspace(0, len(t) - 2, N_COMPARED_INTERVALS).round().astype(int)
    ).tolist():
        begin, end = t[first : first + 2].tolist()
        on, off = count_polarities(recording, begin, end, 1e6 * float(params.rho_ref))
        used = np.flatnonzero(np.abs(on - off) >= MIN_NET_EVENTS)
        grey = frames[first : first + 2].intensity.reshape(2, -1)[:, used]
        clear = ((grey > CLIPPING_MARGIN) & (grey < 1 - CLIPPING_MARGIN)).all(0)
        grey, used = grey[:, clear], used[clear]
        intensity = np.interp(grey, np.linspace(0, 1, 256), response)
        level = np.log(intensity / gain[first : first + 2, None] + I0)
        parts.append((c_on * on[used] - c_off * off[used], level[1] - level[0]))
    S, dL = (np.concatenate(part) for part in zip(*parts, strict=True))
    known = S != 0
    size, along = np.abs(S[known]), (np.sign(S) * dL)[known]
    if len(size) < MIN_COMPARED_PIXELS:
        return None
    ratio = along.sum() / size.sum()
    sigma = np.sqrt(((along - ratio * size) ** 2).sum()) / size.sum()
    return ChangeRatio(float(ratio), float(sigma), float((along > 0).mean()), len(size))


def events_contradict_frames(recording: Recording, params: Any) -> str | None:
    """Say that events contradict frames, at thresholds and `I0`, or return None.

    They do where both change in the same direction, and the sizes of their changes differ by more
    than `MAX_RATIO_FACTOR`, beyond what chance explains. Then thresholds or `I0` are not the
    sensor's.

    Args:
        recording: Events and frames.
        params: Thresholds, `rho_ref`, `I0` and those of the clock, see `augment.FrameParams`.

    Returns:
        A sentence that names the parameters, without a full stop.
    """
    found = change_ratio(recording, params)
    if found is None or not _is_beyond(found, MAX_RATIO_FACTOR):
        return None
    less = found.ratio < 1
    c_on, c_off, I0 = (f"{float(v):.3g}" for v in (params.c_on, params.c_off, params.I0))
    lower = "lower" if less else "higher"
    return (
        f"{recording.name}: events contradict frames, between which ln(I + I0) changes by "
        f"{found.ratio:.2g} times what the events report at c_on = {c_on}, c_off = {c_off} and "
        f"I0 = {I0}; give the sensor's own, I0 about 0.003 for simulated log intensity, or {lower} "
        "thresholds"
    )


def thresholds_are_doubtful(recording: Recording, params: Any) -> bool:
    """Return whether events and frames differ enough to ask for better thresholds.

    Args:
        recording: Events and frames.
        params: Thresholds, `rho_ref`, `I0` and those of the clock, see `augment.FrameParams`.

    Returns:
        Whether the sizes of their changes differ by more than `DOUBTFUL_RATIO_FACTOR`.
    """
    found = change_ratio(recording, params)
    return found is not None and _is_beyond(found, DOUBTFUL_RATIO_FACTOR)


def _is_beyond(found: ChangeRatio, factor: float) -> bool:
    """Return whether changes by events and by frames differ in size by more than a factor.

    Changes of opposite signs do not count.

    Args:
        found: The ratio of the changes.
        factor: Factor above 1, either way.

    Returns:
        Whether they do, by more than the ratio's error.
    """
    reach = CONTRADICTION_SIGMAS * found.sigma
    is_beyond = found.ratio + reach < 1 / factor or found.ratio - reach > factor
    return is_beyond and found.agreement >= MIN_SIGN_AGREEMENT
