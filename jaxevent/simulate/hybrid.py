"""A simulated sensor that records events and frames of the same scene, with the truth.

Events follow the contrast threshold model with the faults of real pixels: mismatched thresholds, a
dead time after each event, background events and hot pixels. Frames are exposed, sent through a
camera response that clips, disturbed by noise and quantised. Times are on the events' clock, which
starts at 0. What is not simulated: the photoreceptor's finite bandwidth, bus congestion.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import Response, SCurve
from jaxevent.codegen import njit_noalloc
from jaxevent.errors import InputError
from jaxevent.recording import Events, Frames, Recording
from jaxevent.simulate.scenes import IntensitySource

_BLOCK_SAMPLES = 32
_MAX_STEP_S, _MIN_STEP_S = 4e-3, 1e-4  # between samples
_QUANTILE = 0.95  # of the pixels whose change between samples is kept below half a threshold
_MARGIN = 2.5  # grey levels from either end in which a frame counts as clipped (read noise)
_FIRST_TRUTH_S = 0.2  # so that estimators have settled
_TARGET_GREY, _GAIN_RANGE = 0.45, 16.0  # of automatic exposure


@dataclasses.dataclass(frozen=True)
class Sensor:
    """Settings of a simulated hybrid sensor; the defaults are like a DAVIS.

    Thresholds are changes of ln(I + dark_offset). Intensity 1 is the frames' white.

    Attributes:
        c_on: Threshold of ON events, ln intensity.
        c_off: Threshold of OFF events, ln intensity.
        mismatch: Relative standard deviation of a threshold over the pixels.
        dark_offset: Intensity that a dark photoreceptor reports.
        refractory: Time after an event during which change is lost, s.
        background_rate: Noise events per pixel, of either polarity, Hz.
        hot_fraction: Fraction of pixels that are hot.
        hot_rate: Events of a hot pixel, of either polarity, Hz.
        jitter: Standard deviation of the time stamps, s, dead time or not.
        response: Response of the frames; None: the cropping S-curve `camera.SCurve()`.
        frame_rate: Frames per second.
        exposure: Length of an exposure, s.
        exposure_samples: Instants averaged over an exposure.
        read_noise: Standard deviation in grey levels of 8 bit.
        full_well: Electrons at intensity 1; infinite: no shot noise.
        auto_exposure: Whether frame k shows the intensity times a gain that follows the mean of
            frame k - 1.
        clock_offset: Time that an estimator must add to the frames' stamps, s.
        truth_rate: HDR reference images per second.

    Raises:
        InputError: A value is not possible.
    """

    c_on: float | int = 0.20
    c_off: float | int = 0.18
    mismatch: float | int = 0.03
    dark_offset: float | int = 0.003
    refractory: float | int = 5e-4
    background_rate: float | int = 0.3
    hot_fraction: float | int = 3e-4
    hot_rate: float | int = 100.0
    jitter: float | int = 0.0
    response: Response | None = None
    frame_rate: float | int = 50.0
    exposure: float | int = 5e-3
    exposure_samples: int = 8
    read_noise: float | int = 0.7
    full_well: float | int = math.inf
    auto_exposure: bool = False
    clock_offset: float | int = 0.0
    truth_rate: float | int = 30.0

    def __post_init__(self) -> None:
        positive = ("c_on", "c_off", "dark_offset", "frame_rate", "exposure", "full_well")
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name in ("response", "auto_exposure"):
                continue
            finite = math.isfinite(value) or field.name == "full_well"
            least = -math.inf if field.name == "clock_offset" else 0.0
            if not finite or value < least or (field.name in positive and value == 0):
                raise InputError(
                    f"the sensor's {field.name} = {value} is not possible; give a finite number "
                    f"{'above' if field.name in positive else 'not below'} 0"
                )
        if self.exposure_samples < 1 or self.truth_rate == 0:
            raise InputError("the sensor's exposure_samples and truth_rate must be positive")
        if self.exposure * self.frame_rate > 1:
            raise InputError(
                f"the sensor's exposure of {self.exposure} s does not fit {self.frame_rate} frames "
                "per second; shorten it or lower the frame rate"
            )
        if self.mismatch > 0.2 or self.hot_fraction > 1:
            raise InputError("the sensor's mismatch is at most 0.2, its hot_fraction at most 1")


SENSORS = {
    "ideal": Sensor(
        mismatch=0, refractory=0, background_rate=0, hot_fraction=0, read_noise=0, c_off=0.20
    ),
    "good": Sensor(
        c_on=0.15, c_off=0.15, mismatch=0.02, refractory=3e-4, background_rate=0.1, read_noise=0.5
    ),
    "davis": Sensor(),
    "poor": Sensor(
        c_on=0.30, c_off=0.25, mismatch=0.06, refractory=1e-3, background_rate=0.5,
        hot_fraction=1e-3, read_noise=1.2, full_well=8000.0, jitter=1e-4,
    ),
}  # fmt: skip


def simulate(
    source: IntensitySource, sensor: Sensor | None = None, seed: int = 0, name: str = "simulated"
) -> Recording:
    """Record a source with a sensor; deterministic in `seed`.

    Frame stamps are mid-exposure, `sensor.clock_offset` too early. `extra` holds

    - hdr (T, H, W) float32, hdr_t (T,) int64 us: true intensity, the frames' white being 1, at
      random times from 0.2 s on, none at a frame's stamp;
    - response, certainty (256,): intensity and weight of each grey level, for `TableResponse`;
    - clip (2,): intensities 2.5 grey levels from either end, beyond which frames are clipped;
    - gain (frames,): a frame's intensity is response[grey] / gain, 1 without automatic exposure.
      Frames are kept as the camera gave them: on a common scale each frame would clip at another
      grey level, and saturated pixels could not be distinguished from measured ones;
    - hot (pixels, 2): x and y of the hot pixels;
    - c_on, c_off, mismatch, dark_offset, refractory, background_rate, read_noise, clock_offset:
      the sensor's settings, scalars.

    Args:
        source: The scene.
        sensor: The sensor; None: `Sensor()`.
        seed: Seed of all noise.
        name: Name of the recording.

    Returns:
        The recording.

    Raises:
        InputError: The source has fewer than two frames, or intensities that are not positive.
    """
    sensor = Sensor() if sensor is None else sensor
    width, height = source.size
    pixel_seed, noise_seed, frame_seed, truth_seed = np.random.SeedSequence(seed).spawn(4)
    stamps = frame_times(source.duration, sensor)
    rng = np.random.default_rng(pixel_seed)
    on, off = (
        c * np.maximum(1 + sensor.mismatch * rng.normal(size=width * height), 0.3)
        for c in (sensor.c_on, sensor.c_off)
    )
    rngs = rng, np.random.default_rng(noise_seed)
    events, hot = _simulate_events(source, sensor, (on, off), rngs, name)
    images, gain = expose(source.intensity, stamps, sensor, np.random.default_rng(frame_seed))

    frames_t = stamps - round(sensor.clock_offset * 1e6)
    hdr_t = _truth_times(source.duration, sensor, frames_t, np.random.default_rng(truth_seed))
    hdr = np.stack([source.intensity(float(t)) for t in hdr_t * 1e-6]).astype(np.float32)

    response = sensor_response(sensor)
    levels = np.arange(256) / 255
    ends = np.array([_MARGIN, 255 - _MARGIN]) / 255
    extra: dict[str, NDArray] = {
        "hdr": hdr,
        "hdr_t": hdr_t,
        "response": np.asarray(response.intensity(levels), np.float64),
        "certainty": np.asarray(response.certainty(levels), np.float64),
        "clip": np.asarray(response.intensity(ends), np.float64),
        "gain": gain,
        "hot": hot,
    }
    for setting in (
        "c_on", "c_off", "mismatch", "dark_offset", "refractory", "background_rate", "read_noise",
        "clock_offset",
    ):  # fmt: skip
        extra[setting] = np.asarray(getattr(sensor, setting), np.float64)
    exposure = np.full(len(stamps), round(sensor.exposure * 1e6), np.int64)
    frames = Frames(frames_t, images, exposure)
    return Recording(name, width, height, events, frames, extra=extra).check()


def sensor_response(sensor: Sensor) -> Response:
    """Return the response of a sensor's frames."""
    return SCurve() if sensor.response is None else sensor.response


def frame_times(duration: float | int, sensor: Sensor) -> NDArray[np.int64]:
    """Return the true mid-exposure times of a sensor's frames.

    Args:
        duration: Length of the scene, s.
        sensor: The sensor.

    Returns:
        (frames,) us, of all frames whose exposure fits.

    Raises:
        InputError: Fewer than two frames fit.
    """
    count = math.floor((duration - sensor.exposure) * sensor.frame_rate + 1e-9) + 1
    if not math.isfinite(duration) or count < 2:
        raise InputError(
            f"{duration:.3g} s hold fewer than two frames at {sensor.frame_rate} per second; give "
            "a longer scene or a higher frame rate"
        )
    mid = sensor.exposure / 2 + np.arange(count) / sensor.frame_rate
    return np.rint(mid * 1e6).astype(np.int64)


def expose(
    intensity_at: Callable[[float], NDArray],
    stamps_us: NDArray[np.int64],
    sensor: Sensor,
    rng: np.random.Generator,
    gain: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Expose frames.

    Args:
        intensity_at: A function from a time (s) to linear intensity (...), grey or colour.
        stamps_us: (frames,) mid-exposure times, us.
        sensor: The sensor.
        rng: Source of noise.
        gain: (frames,) gains; None: by automatic exposure, or 1.

    Returns:
        Frames (frames, ...), and their gains (frames,).
    """
    response = sensor_response(sensor)
    within = (np.arange(sensor.exposure_samples) + 0.5) / sensor.exposure_samples - 0.5
    images, gains, factor = [], [], 1.0
    for k, stamp in enumerate(stamps_us):
        if gain is not None:
            factor = float(gain[k])
        times = stamp * 1e-6 + within * sensor.exposure
        mean = np.mean([intensity_at(float(t)) for t in times], axis=0)
        if math.isfinite(sensor.full_well):
            # Poisson, by its normal limit: electrons gain sqrt(electrons), full_well at mean = 1.
            mean = mean + rng.normal(size=mean.shape) * np.sqrt(mean / sensor.full_well)
        grey = np.asarray(response.grey(np.maximum(mean, 0) * factor), np.float64)
        noisy = grey * 255 + sensor.read_noise * rng.normal(size=grey.shape)
        images.append(np.rint(noisy).clip(0, 255).astype(np.uint8))
        gains.append(factor)
        if sensor.auto_exposure and gain is None:
            step = (_TARGET_GREY / max(grey.mean(), 0.05)) ** 0.3
            factor = min(max(factor * step, 1 / _GAIN_RANGE), _GAIN_RANGE)
    return np.stack(images), np.array(gains)


def _truth_times(
    duration: float | int, sensor: Sensor, stamps: NDArray[np.int64], rng: np.random.Generator
) -> NDArray[np.int64]:
    """Draw the times of true images, spread over a recording but beside the frames.

    Args:
        duration: Length of the recording, s.
        sensor: Sensor, with the rate of true images.
        stamps: (frames,) times of the frames, us.
        rng: Generator of random numbers.

    Returns:
        (n,) us.
    """
    begin = min(_FIRST_TRUTH_S, duration / 2)
    count = max(1, int((duration - begin) * sensor.truth_rate + 1e-9))
    cell = (duration - begin) / count
    t = begin + (np.arange(count) + rng.uniform(0.05, 0.95, count)) * cell
    t = np.floor(t * 1e6).astype(np.int64)
    return t + np.isin(t, stamps)


def _samples(
    source: IntensitySource, sensor: Sensor, name: str
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Yield blocks of times (us) and ln(I + dark_offset) (samples, pixels); ends are shared.

    The next step is chosen from the last one's largest change (`_QUANTILE` of the pixels): half a
    threshold, and at most twice or half the last step.
    """

    def level(t: float) -> NDArray[np.float64]:
        light = source.intensity(t)
        if light.shape != source.size[::-1] or not (light > 0).all():
            raise InputError(
                f"{name}: the intensity at {t:.6f} s is not positive everywhere or not of shape "
                f"{source.size[::-1]}; mend the source"
            )
        return np.log(light + sensor.dark_offset).ravel()

    aim = min(sensor.c_on, sensor.c_off) / 2
    rank = int(_QUANTILE * (source.size[0] * source.size[1] - 1))
    t, step = 0.0, _MIN_STEP_S
    times, levels = [t], [level(t)]
    while t < source.duration:
        t = min(t + step, source.duration)
        times.append(t)
        levels.append(level(t))
        change = np.partition(np.abs(levels[-1] - levels[-2]), rank)[rank]
        step = min(max(step * min(max(aim / (change + 1e-12), 0.5), 2.0), _MIN_STEP_S), _MAX_STEP_S)
        if len(times) == _BLOCK_SAMPLES or t >= source.duration:
            yield np.array(times) * 1e6, np.array(levels)
            times, levels = times[-1:], levels[-1:]


class _Pixels(NamedTuple):
    """Pixels of a sensor while events are simulated.

    Attributes:
        on: (pixels,) thresholds of ON events, ln intensity.
        off: (pixels,) thresholds of OFF events, ln intensity.
        reference: (pixels,) level at the last event; updated.
        ready: (pixels,) end of the dead time, us; updated.
    """

    on: NDArray[np.float64]
    off: NDArray[np.float64]
    reference: NDArray[np.float64]
    ready: NDArray[np.float64]


class _NoiseEvents(NamedTuple):
    """Background events, pixel by pixel."""

    t: NDArray[np.float64]  # (events,), us
    p: NDArray[np.bool_]  # (events,)
    following: NDArray[np.int64]  # (pixels,), the next event of each pixel; updated
    stop: NDArray[np.int64]  # (pixels,), the end of its events


def _simulate_events(
    source: IntensitySource,
    sensor: Sensor,
    thresholds: tuple[NDArray[np.float64], NDArray[np.float64]],
    rngs: tuple[np.random.Generator, np.random.Generator],
    name: str,
) -> tuple[Events, NDArray[np.int64]]:
    """Simulate the events of a sensor.

    Args:
        source: Intensity in time.
        sensor: The sensor.
        thresholds: (pixels,) thresholds of ON and of OFF events, ln intensity.
        rngs: Generators for pixels and for noise events.
        name: Name of the recording for messages.

    Returns:
        The events, and x, y of the hot pixels, (n, 2).
    """
    (on, off), (rng, noise_rng) = thresholds, rngs
    width, height = source.size
    pixels = width * height
    hot = np.sort(rng.choice(pixels, round(sensor.hot_fraction * pixels), replace=False))
    rate = np.full(pixels, float(sensor.background_rate))
    rate[hot] = sensor.hot_rate
    # A Poisson process: a Poisson number of times, each uniform.
    counts = noise_rng.poisson(rate * source.duration)
    first = np.concatenate([[0], np.cumsum(counts)])
    noise_t = noise_rng.uniform(0, source.duration * 1e6, first[-1])
    noise_t = noise_t[np.lexsort([noise_t, np.repeat(np.arange(pixels), counts)])]
    noise_p = noise_rng.random(first[-1]) < 0.5

    # The sensor has been on for some time: the level at the last event is anywhere between the
    # thresholds.
    phase = rng.uniform(-on, off)
    state = _Pixels(on, off, np.empty(0), np.full(pixels, -1.0))
    noise = _NoiseEvents(noise_t, noise_p, first[:-1].copy(), first[1:])
    refractory, parts = round(sensor.refractory * 1e6), []
    for times, levels in _samples(source, sensor, name):
        if not len(state.reference):
            state = state._replace(reference=levels[0] + phase)
        # Every crossing takes at least a threshold of the way that the level goes.
        way = np.abs(np.diff(levels, axis=0)).sum(0) / np.minimum(on, off)
        most = int(np.floor(way).sum()) + 2 * pixels + len(noise_t)
        out = tuple(np.empty(most, kind) for kind in (np.int64, np.int32, np.bool_))
        used = _cross_thresholds(times, levels, state, noise, refractory, out)
        parts.append([column[:used].copy() for column in out])
    t, pixel, p = (np.concatenate(column) for column in zip(*parts, strict=True))
    if sensor.jitter:
        late = noise_rng.normal(0, sensor.jitter * 1e6, len(t))
        t = np.rint(t + late).astype(np.int64).clip(0, round(source.duration * 1e6))
    order = np.argsort(t, kind="stable")
    t, pixel, p = t[order], pixel[order], p[order]
    y, x = np.divmod(pixel, width)
    events = Events(t, x.astype(np.uint16), y.astype(np.uint16), p)
    return events, np.stack(np.divmod(hot, width)[::-1], 1)


@njit_noalloc
def _cross_thresholds(times, levels, pixels, noise, refractory, out):
    """Write the events of one block, pixel by pixel.

    Between samples the level is linear in time. After an event at t the pixel is dead until t +
    refractory, and its reference is then the level at that time: the change during it is lost.

    Args:
        times: (samples,) us.
        levels: (samples, pixels) log intensity.
        pixels: `_Pixels`; reference and end of the dead time are updated.
        noise: `_NoiseEvents`; the next event of each pixel is updated.
        refractory: Dead time, us.
        out: Times, pixels and polarities, output.

    Returns:
        Number of events.
    """
    on, off, reference, ready = pixels
    noise_t, noise_p, following, stop = noise
    out_t, out_pixel, out_p = out
    n = 0
    for i in range(levels.shape[1]):
        for k in range(len(times) - 1):
            t, end = times[k], times[k + 1]
            slope = (levels[k + 1, i] - levels[k, i]) / (end - t)
            while True:
                if ready[i] >= t:
                    if ready[i] >= end:
                        break
                    t = ready[i]
                    reference[i] = levels[k, i] + slope * (t - times[k])
                # The next crossing before the next sample, if any, or a noise event before it.
                at, rises = np.inf, True
                if slope > 0:
                    at = times[k] + (reference[i] + on[i] - levels[k, i]) / slope
                elif slope < 0:
                    at = times[k] + (reference[i] - off[i] - levels[k, i]) / slope
                    rises = False
                at = max(at, t)
                while following[i] < stop[i] and noise_t[following[i]] < t:
                    following[i] += 1  # fell into the dead time
                if following[i] < stop[i] and noise_t[following[i]] < at:
                    at, rises = noise_t[following[i]], noise_p[following[i]]
                    if at <= end:
                        following[i] += 1
                if at > end:
                    break
                stamp = np.int64(np.rint(at))
                out_t[n], out_pixel[n], out_p[n] = stamp, i, rises
                n += 1
                # The reference moves to the level at the crossing itself, and from there to the
                # level at the end of the dead time.
                reference[i] = levels[k, i] + slope * (at - times[k])
                t = at
                ready[i] = stamp + refractory if refractory > 0 else at
    return n
