"""Video from events alone: simulated scenes with truth, and the methods' errors on them.

python experiments/events_only.py --out DIR [--only ...]
"""

import dataclasses
import functools
import json
import math
import time
from typing import NamedTuple

import numba
import numpy as np
from common import command_line, machine, markdown_table, write_text
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from tile_images import tile_images

import jaxevent
from jaxevent.metrics import mse, ssim
from jaxevent.show.images import new_figure, save_figure, write_png

TEXELS = 2  # per pixel at the depth of the farthest plane
SCENES = ("rotation", "slider", "objects", "hdr", "large", "turn", "return")
TIMES = 6  # at which a scene's truth is given


# Natural scenes


def paint_leaves(side, contrast, smallest, rng):
    """Paint a periodic image of occluding leaves with the sizes' law r^-3, (side, side), intensity.

    Such images have the spectrum of natural ones, edges, and large regions of one brightness (Lee,
    Mumford and Huang 2001). Leaves have shades and textures of their own; lengths are texels.
    """
    f = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side))
    f[0, 0] = np.inf
    grain = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(side, side))) / f, (side, side))
    grain /= grain.std()
    level, largest, covered = 0.3 * grain, side / 4, 0.0
    while covered < 3 * side**2:
        r = (smallest**-2 + rng.uniform() * (largest**-2 - smallest**-2)) ** -0.5
        stretch, angle = rng.uniform(0.4, 1), rng.uniform(0, np.pi)
        n = math.ceil(r)
        y, x = np.mgrid[-n : n + 1, -n : n + 1] / r
        along = np.cos(angle) * x + np.sin(angle) * y
        across = (np.cos(angle) * y - np.sin(angle) * x) / stretch
        power = rng.choice([2, 2, 8])  # an ellipse or a box
        inside = along**power + across**power < 1
        at = tuple((rng.integers(0, side) + np.arange(2 * n + 1)) % side for _ in range(2))
        own = rng.normal(0, contrast) + rng.normal(0, 0.15) * along
        own = own + rng.uniform(0, 0.25) * grain[: 2 * n + 1, : 2 * n + 1]
        level[np.ix_(*at)] = np.where(inside, own, level[np.ix_(*at)])
        covered += inside.sum()
    return gaussian_filter(np.exp(level - level.max()), 0.7 * TEXELS, mode="wrap")


def cut_object(canvas, radius, rng):
    """Cut an object with a wavy outline out of an image, (rows, columns, 2): intensity, cover."""
    n = math.ceil(1.5 * radius)
    y, x = np.mgrid[-n : n + 1, -n : n + 1]
    angle = np.arctan2(y, x)
    outline = 1 + sum(
        rng.normal(0, 0.25 / k) * np.cos(k * angle + rng.uniform(0, 2 * np.pi)) for k in (2, 3, 5)
    )
    cover = gaussian_filter((np.hypot(x, y) < radius * outline).astype(float), 0.7 * TEXELS)
    at = (rng.integers(0, len(canvas)) + np.arange(2 * n + 1)) % len(canvas)
    return np.stack([canvas[np.ix_(at, at)] * np.exp(rng.normal(0, 0.4)), cover], -1)


class Layer(NamedTuple):
    """A plane normal . X = 1 that moves on its own; the farthest covers the image and repeats."""

    texture: np.ndarray  # (rows, columns, 2), intensity and cover
    normal: np.ndarray  # (3,), of the camera's axes at the time 0; its length is 1 / distance
    origin: np.ndarray  # (2,), texel at which the optical axis meets the plane at the time 0
    path: CubicSpline  # time (s) to displacement x, y (px) and angle (rad)
    repeats: bool


@numba.njit(cache=True)
def _draw(image, visible, number, texture, repeats, h):
    """Draw a layer over an image; h maps pixels (x, y, 1) to texels."""
    rows, columns = texture.shape[:2]
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
            u = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w
            v = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w
            i, j = math.floor(u), math.floor(v)
            fx, fy = u - i, v - j
            if repeats:
                i, j, i1, j1 = i % columns, j % rows, (i + 1) % columns, (j + 1) % rows
            elif i < 0 or j < 0 or i >= columns - 1 or j >= rows - 1:
                continue
            else:
                i1, j1 = i + 1, j + 1
            a, b = (1 - fx) * (1 - fy), fx * (1 - fy)
            c, d = (1 - fx) * fy, fx * fy
            level, cover = (
                a * texture[j, i, 0]
                + b * texture[j, i1, 0]
                + c * texture[j1, i, 0]
                + d * texture[j1, i1, 0],
                a * texture[j, i, 1]
                + b * texture[j, i1, 1]
                + c * texture[j1, i, 1]
                + d * texture[j1, i1, 1],
            )
            image[y, x] += cover * (level - image[y, x])
            if cover > 0.5:
                visible[y, x] = number


@dataclasses.dataclass(frozen=True, eq=False)
class LayeredScene:
    """A moving camera before textured planes: an `IntensitySource` with the true flow."""

    layers: tuple[Layer, ...]  # from far to near
    camera: CubicSpline  # time (s) to position (px at the distance 1) and rotation vector (rad)
    size: tuple[int, int]
    duration: float
    focal: float  # px

    def homography(self, layer, t):
        """Return the matrix (3, 3) from pixels to texels of a layer at t seconds."""
        width, height = self.size
        f, pose = self.focal, self.camera(t)
        inverse = np.array(
            [[1 / f, 0, -(width - 1) / 2 / f], [0, 1 / f, -(height - 1) / 2 / f], [0, 0, 1]]
        )
        rays = Rotation.from_rotvec(pose[3:]).as_matrix() @ inverse
        c, n = pose[:3] / f, layer.normal
        # X = c + s ray with n . X = 1: X (n . ray) = c (n . ray) + (1 - n . c) ray.
        point = (np.outer(c, n) + (1 - n @ c) * np.eye(3)) @ rays
        dx, dy, angle = layer.path(t)
        scale = TEXELS * f * np.linalg.norm(n)
        plane = np.stack([scale * point[0], scale * point[1], n @ rays])
        cos, sin = np.cos(angle), np.sin(angle)
        move = np.array(
            [
                [cos, sin, -TEXELS * (cos * dx + sin * dy)],
                [-sin, cos, TEXELS * (sin * dx - cos * dy)],
                [0, 0, 1],
            ]
        )
        move = np.array([[1, 0, layer.origin[0]], [0, 1, layer.origin[1]], [0, 0, 1]]) @ move
        return move @ plane

    def render(self, t):
        """Return intensity and the number of the layer that is visible, (height, width) each."""
        image = np.zeros(self.size[::-1])
        visible = np.zeros(self.size[::-1], np.int64)
        for k, layer in enumerate(self.layers):
            _draw(image, visible, k, layer.texture, layer.repeats, self.homography(layer, t))
        return image, visible

    def intensity(self, t):
        """Return the linear intensity (height, width) at t seconds."""
        return self.render(t)[0]

    def flow(self, t, step=1e-4):
        """Return the optical flow (height, width, 2) of what pixels show at t seconds, px/s."""
        width, height = self.size
        _, visible = self.render(t)
        pixels = np.stack(
            [*np.meshgrid(np.arange(width), np.arange(height)), np.ones((height, width))], -1
        )
        flow = np.zeros((height, width, 2))
        for k, layer in enumerate(self.layers):
            now = pixels[visible == k] @ self.homography(layer, t).T
            ends = [now @ np.linalg.inv(self.homography(layer, t + s)).T for s in (-step, step)]
            before, after = (one[:, :2] / one[:, 2:] for one in ends)
            flow[visible == k] = (after - before) / (2 * step)
        return flow


class Scene(NamedTuple):
    """A simulated recording without frames, and its truth at some times."""

    name: str
    recording: jaxevent.Recording
    times: np.ndarray  # (T,) int64, us
    intensity: np.ndarray  # (T, height, width), linear
    flow: np.ndarray  # (T, height, width, 2), px/s
    source: LayeredScene  # intensity and flow at any time (s)
    sensor: jaxevent.simulate.Sensor  # with the true thresholds

    @property
    def shown(self):
        """The truth in [0, 1], (T, height, width), as a frame shows it; of hdr the logarithm."""
        truth = np.log(self.intensity) if self.name == "hdr" else self.intensity
        low = np.percentile(truth, 0.5) if self.name == "hdr" else 0.0
        return np.clip((truth - low) / (np.percentile(truth, 98) - low), 0, 1)


def _spline(velocity, duration):
    """Integrate velocities at times (s), (T,) to (T, values), from 0 on."""
    t = np.linspace(-0.01, duration + 0.01, 400)
    path = CubicSpline(t, velocity(t)).antiderivative()
    return CubicSpline(t, path(t) - path(0))


def _vary(rng, size, mean, amplitude):
    """Draw velocities (T,) to (T, len(mean)) that change by a sinusoid about the mean."""
    frequency, phase = rng.uniform(0.5, 2, size), rng.uniform(0, 2 * np.pi, size)
    return lambda t: mean + amplitude * np.sin(2 * np.pi * frequency * t[:, None] + phase)


def make_source(name, seed):
    """Make a scene by name, deterministic in the seed.

    - rotation: the camera turns, at varying speed;
    - slider: it translates before slanted planes and nearer objects, and for odd seeds brakes;
    - objects: objects move and turn, before a background that is still for even seeds;
    - hdr: a rotation over a scene of 3 to 4 decades of intensity;
    - large: slider with 640x480 pixels;
    - turn: the motion is horizontal first, then vertical;
    - return: slider that stops for some time and then goes back.
    """
    rng = np.random.default_rng([seed, SCENES.index(name)])
    size, focal, duration, side = (240, 180), 200.0, 0.6, 1024
    if name == "large":
        size, focal, duration, side = (640, 480), 500.0, 0.3, 2048
    contrast, smallest = rng.uniform(0.4, 0.9), 8 * 4 ** rng.uniform() * focal / 200
    canvas = paint_leaves(side, contrast, smallest, rng)
    if name == "hdr":
        canvas = canvas ** (np.log(10 ** rng.uniform(3, 4)) / np.ptp(np.log(canvas)))
    speed = rng.uniform(40, 150) * focal / 200  # px/s
    heading = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(heading), np.sin(heading)])

    def still(t):
        return np.zeros((len(t), 3))

    def turning(t):
        x, y = along * speed / focal
        wave = _vary(np.random.default_rng([seed, 1]), 3, [-y, x, 0], 0.4 * speed / focal)
        return np.concatenate([np.zeros((len(t), 3)), wave(t)], 1)

    def sliding(t):
        brake = 1 - 0.9 / (1 + np.exp(-(t / duration - 0.8) * 25)) if seed % 2 else 1 + 0 * t
        x, y = along * speed * [1, 0.3]
        depth = 0.2 * speed * rng.normal()
        return brake[:, None] * [x, y, depth, 0, 0, 0]

    def turned(t):
        late = 1 / (1 + np.exp(-(t / duration - 0.5) * 30))
        x, y = speed * np.sign(along)
        return np.stack([x * (1 - late), y * late, *np.zeros((4, len(t)))], 1)

    def returning(t):
        draw = np.random.default_rng([seed, 2])
        stop, ramp, rest = (draw.uniform(*span) for span in ((0.33, 0.38), (0.01, 0.02), (0, 0.05)))
        there = 1 / (1 + np.exp((t - stop) / ramp))
        back = 1 / (1 + np.exp((stop + 4 * ramp + rest - t) / ramp))
        x, y = along * speed * [1, 0.3]
        return (there - back)[:, None] * [x, y, 0, 0, 0, 0]

    motions = {"rotation": turning, "hdr": turning, "turn": turned, "return": returning}
    motion = motions.get(name, sliding)
    if name == "objects":
        mean = np.r_[along * speed * 0.5 * (seed % 2), np.zeros(4)]
        motion = _vary(rng, 6, mean, 0.3 * mean)
    slant = rng.normal(0, 0.15, 2) if name in ("slider", "large", "return") else np.zeros(2)
    texture = np.stack([canvas, np.ones_like(canvas)], -1)
    origin = rng.uniform(0, side, 2)
    layers = [Layer(texture, np.array([*slant, 1]), origin, _spline(still, duration), True)]
    for distance in np.sort(rng.uniform(0.4, 0.9, rng.integers(4, 7)))[::-1]:
        if name not in ("slider", "objects", "large", "return"):
            break
        radius = rng.uniform(0.07, 0.18) * size[1] * TEXELS
        cut = cut_object(canvas, radius, rng)
        middle = rng.uniform(-0.45, 0.45, 2) * size * TEXELS
        path = _spline(still, duration)
        if name == "objects":
            own = speed * rng.uniform(0.3, 1) * rng.choice([-1, 1], 2) * [1, 0.6]
            mean = np.r_[own, rng.normal(0, 0.5)]
            middle -= own * duration / 2 * TEXELS
            path = _spline(_vary(rng, 3, mean, 0.4 * mean), duration)
            distance = 1.0
        place = np.array(cut.shape[1::-1]) / 2 - middle
        layers.append(Layer(cut, np.array([0, 0, 1 / distance]), place, path, False))
    return LayeredScene(tuple(layers), _spline(motion, duration), size, duration, focal)


def make_sensor(duration, rng):
    """Draw a sensor with unequal thresholds and noise; few frames, which are not used."""
    c = float(np.exp(rng.uniform(np.log(0.1), np.log(0.3))))
    ratio = float(np.exp(rng.normal(0, 0.25)))
    return jaxevent.simulate.Sensor(
        c_on=c, c_off=c * ratio, mismatch=rng.uniform(0.03, 0.1), dark_offset=1e-3,
        refractory=10 ** rng.uniform(-4, -3), background_rate=10 ** rng.uniform(-1, 0.3),
        hot_fraction=3e-4, jitter=1e-5, frame_rate=2.01 / duration, exposure=1e-3,
        exposure_samples=1, truth_rate=1 / duration,
    )  # fmt: skip


@functools.lru_cache(4)
def make_scene(name, seed):
    """Simulate a scene by name, see `make_source`; deterministic in the seed.

    Seeds 0 to 9 are for reports; constants are chosen with seeds from 100 on.
    """
    source = make_source(name, seed)
    sensor = make_sensor(source.duration, np.random.default_rng([seed, SCENES.index(name), 2]))
    recording = jaxevent.simulate.simulate(source, sensor, seed, f"{name} {seed}")
    recording = dataclasses.replace(recording, frames=None, extra={})
    times = np.rint(np.linspace(0.25, 0.99, TIMES) * source.duration * 1e6).astype(np.int64)
    intensity = np.stack([source.intensity(t) for t in times / 1e6])
    flow = np.stack([source.flow(t) for t in times / 1e6])
    return Scene(name, recording, times, intensity, flow, source, sensor)


# Scores


def score(image, truth):
    """Return MSE and SSIM after the best affine fit, then both after matching histograms, (4,).

    Args:
        image: Intensity up to a factor and an offset, (height, width).
        truth: Intensity in [0, 1], (height, width).
    """
    from skimage.exposure import match_histograms

    image, truth = np.asarray(image, np.float64), np.asarray(truth, np.float64)
    if not np.isfinite(image).all():
        return np.full(4, np.nan)
    columns = np.stack([image.ravel(), np.ones(image.size)], 1)
    fit = columns @ np.linalg.lstsq(columns, truth.ravel(), rcond=None)[0]
    fitted = fit.reshape(truth.shape).clip(0, 1)
    matched = match_histograms(image, truth)
    return np.array([m(one, truth) for one in (fitted, matched) for m in (mse, ssim)])


class Case(NamedTuple):
    """A recording without frames, and true images at some times that no method is given."""

    recording: jaxevent.Recording
    times: np.ndarray  # (T,) int64, us
    truth: np.ndarray  # (T, height, width) in [0, 1]
    log_truth: np.ndarray  # (T, height, width), up to an offset and a factor
    logarithmic: bool  # whether `truth` is a logarithm
    networks: dict  # images (T, height, width) by the networks' names


# File, clock offset of the frames (us), and the networks' images of real recordings
REAL = {
    "slider_depth": ("slider_depth.zip", 7500, "slider_depth"),
    "slider_depth, first 0.3 s": ("slider_depth.zip", 7500, None),
    "evbench_seq3": ("evbench_seq3_calibrated.npz", 0, "evbench_seq3"),
    "davis346_street": ("davis346_street.npz", 0, None),
}
SEEDS = (0, 1)  # of the simulated scenes
FRAME_DARK = 0.1  # intensity added inside the logarithm of frames, whose dark pixels are noisy


def real_case(data, name):
    """Load a real recording: eight frames from 0.3 s on, or all before, and networks' images."""
    file, offset, golden = REAL[name]
    recording = jaxevent.load(data / file)
    assert recording.frames is not None
    t = recording.frames.t + offset
    begin, end = recording.events[:1].t[0], recording.events[-1:].t[0]
    if "first" in name:
        chosen = np.flatnonzero((t > begin + 50_000) & (t <= begin + 300_000))[::2]
    else:
        chosen = np.flatnonzero((t > begin + 300_000) & (t <= end))
        chosen = chosen[np.linspace(0, len(chosen) - 1, 8).astype(int)]
    networks = {}
    if golden and (path := data.parent / "golden/firenet" / f"{golden}.npz").exists():
        held = np.load(path)
        assert (held["frames"] == chosen).all()
        networks = {
            label: held[key].astype(np.float64)
            for label, key in (("FireNet", "firenet"), ("FireNet+", "firenet_plus"))
        }
    truth = recording.frames.intensity[chosen].astype(np.float64)
    alone = dataclasses.replace(recording, frames=None)
    return Case(alone, t[chosen], truth, np.log(truth + FRAME_DARK), False, networks)


def simulated_case(name, seed):
    """Simulate a scene; every second of its times."""
    scene, every = make_scene(name, seed), slice(1, None, 2)
    log_truth = np.log(scene.intensity[every] + scene.sensor.dark_offset)
    times, truth = scene.times[every], scene.shown[every]
    return Case(scene.recording, times, truth, log_truth, name == "hdr", {})


# Methods: log images (T, height, width), and their variances or None


def constant(recording, times):
    """Return images of nothing but noise, the least that a measure can be worth."""
    shape = (len(times), recording.height, recording.width)
    return np.random.default_rng(0).normal(0, 1e-3, shape), None


def high_pass(recording, times, alpha=None):
    """Return the images of the high-pass filter, with its default rate or another."""
    params = (
        jaxevent.high_pass.Params() if alpha is None else jaxevent.high_pass.Params(alpha=alpha)
    )
    mean = jaxevent.high_pass.estimate(recording, params)(times).mean
    return np.log1p(np.maximum(mean, -0.999)), None


def accumulate(recording, times):
    """Return sums of the polarities of the last events, half an event per pixel, (T, H, W)."""
    e, shape = recording.events[:], (recording.height, recording.width)
    images = np.zeros((len(times), *shape))
    for image, stop in zip(images, np.searchsorted(e.t, times), strict=True):
        last = e[max(stop - shape[0] * shape[1] // 2, 0) : stop]
        np.add.at(image, (last.y, last.x), np.where(last.p, 1.0, -1.0))
    return images, None


def events_only(recording, times, **options):
    """Return the images of the method `events-only`."""
    mean, variance, _ = jaxevent.events_only.estimate(recording, **options)(times)
    return np.log(np.asarray(mean) + jaxevent.events_only.Params().I0), np.asarray(variance)


METHODS = {
    "constant": constant,
    "accumulated events": accumulate,
    "high-pass": high_pass,
    "high-pass, alpha 3": functools.partial(high_pass, alpha=3.0),
    "tiles": lambda recording, times: (tile_images(recording, times), None),
    "events-only, causal": functools.partial(events_only, causal=True),
    "events-only": events_only,
}
STRIP = ("high-pass", "FireNet", "events-only", "frame, given to none")  # of the picture
EXPONENTIAL = ("tiles", "events-only, causal", "events-only")  # methods whose images are ln I


def honesty(log_image, variance, log_truth):
    """Return the mean of squared errors of an affine fit to the truth, over its variance."""
    columns = np.stack([log_image.ravel(), np.ones(log_image.size)], 1)
    weight = 1 / np.sqrt(variance.ravel())
    fit = np.linalg.lstsq(columns * weight[:, None], log_truth.ravel() * weight, rcond=None)[0]
    error = (columns @ fit).reshape(log_truth.shape) - log_truth
    return np.mean(error**2 / (fit[0] ** 2 * variance))


def run_case(case, label):
    """Score one method at the case's times; return a row, and images for the eye."""
    start = time.process_time()
    if label in case.networks:
        images, variance = case.networks[label], None
    else:
        images, variance = METHODS[label](case.recording, case.times)
    measured = label not in case.networks
    seconds = measured * (time.process_time() - start) / len(case.times)
    shown = np.exp(images) if label in EXPONENTIAL and not case.logarithmic else images
    scores = np.array([score(*pair) for pair in zip(shown, case.truth, strict=True)])
    row = {"method": label, "scores": scores.tolist(), "seconds": seconds}
    if variance is not None:
        pairs = zip(images, variance, case.log_truth, strict=True)
        row["z2"] = [honesty(*one) for one in pairs]
    return row, shown


def format_scores(scores):
    """Return scores (images, 4) as text: 100 MSE / SSIM of the affine fit; of equal histograms."""
    a, b, c, d = np.mean(scores, axis=0)
    return f"{100 * a:.2f}/{b:.3f}; {100 * c:.2f}/{d:.3f}"


def match_tone(image, truth):
    """Return the affine fit of an image to the truth in 8 bit, for a picture."""
    image = np.nan_to_num(image)
    slope, offset = np.polyfit(image.ravel(), truth.ravel(), 1)
    return np.rint(255 * np.clip(slope * image + offset, 0, 1)).astype(np.uint8)


def write_sheet(path, images, truth):
    """Write a picture of a case: times downwards, methods across, the truth last."""
    chosen = np.unique(np.linspace(0, len(truth) - 1, 3).astype(int))
    columns = [*images, truth]
    rows = [np.hstack([match_tone(one[k], truth[k]) for one in columns]) for k in chosen]
    write_png(path, np.vstack(rows))


def write_strip(path, panels):
    """Write labelled images (height, width) side by side, each from its 2nd to 98th percentile."""
    figure = new_figure(3 * len(panels), 2.5)
    for axis, (label, image) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        low, high = np.percentile(image, [2, 98])
        axis.imshow(image, cmap="gray", vmin=low, vmax=high)
        axis.set_title(label, fontsize=11)
        axis.set_axis_off()
    save_figure(figure, path, dpi=110)


def run_part(name, options):
    """Run the methods on a recording, or on a scene with all seeds; return rows of the table."""
    real = name in REAL
    found = {}
    for seed in (None,) if real else SEEDS:
        case = real_case(options.data, name) if real else simulated_case(name, seed)
        images = {}
        for label in (*options.methods, *case.networks):
            row, images[label] = run_case(case, label)
            found.setdefault(label, []).append(row)
            quality = f"; z2 {np.mean(row['z2']):.2f}" if "z2" in row else ""
            print(f"{case.recording.name}, {label}: {format_scores(row['scores'])}{quality}; "
                  f"{row['seconds']:.2f} s", flush=True)  # fmt: skip
        write_sheet(options.out / f"{name}{seed or ''}.png", images.values(), case.truth)
        panels = {**images, "frame, given to none": case.truth}
        if name == "slider_depth" and all(label in panels for label in STRIP):
            write_strip(
                options.out / "events_only.png", {k: panels[k][len(case.truth) // 2] for k in STRIP}
            )
    return {
        label: {
            "scores": np.concatenate([row["scores"] for row in rows]).tolist(),
            "z2": np.concatenate([row.get("z2", []) for row in rows]).tolist(),
            "seconds": float(np.mean([row["seconds"] for row in rows])),
        }
        for label, rows in found.items()
    }


def make_tables(results):
    """Return tables of scores, of variances and of CPU seconds, in Markdown."""
    if "slider_depth" in results:
        last = {
            label: {k: v[-1:] if k in ("scores", "z2") else v for k, v in row.items()}
            for label, row in results["slider_depth"].items()
        }
        results = {**results, "slider_depth, last image": last}
    texts = {
        "100 MSE / SSIM after the affine fit; after matching histograms": lambda row: format_scores(
            row["scores"]
        ),
        "z2 of the log image, the median over the images": lambda row: (
            f"{np.median(row['z2']):.2f}" if row["z2"] else ""
        ),
        "CPU s an image": lambda row: f"{row['seconds']:.2f}" if row["seconds"] else "",
    }
    parts = []
    for title, text in texts.items():
        for simulated in (False, True):
            cases = {k: case for k, case in results.items() if (k in SCENES) == simulated}
            rows = [
                [label, *(text(case[label]) if label in case else "" for case in cases.values())]
                for label in dict.fromkeys(label for case in cases.values() for label in case)
            ]
            kept = [row for row in rows if any(row[1:])]
            parts.append(f"{title}\n\n{markdown_table(['', *cases], kept)}\n")
    return "\n".join([*parts, machine(), ""])


def image_seconds(estimate, recording, events, count):
    """Return CPU seconds of an image, of `count` images with `events` between, after one more."""
    times = recording.events.t[events * 4 :: events][: count + 1]
    video = estimate(recording)
    video(times[:1])
    start = time.process_time()
    video(times[1:])
    return (time.process_time() - start) / (len(times) - 1)


def events_only_bench():
    """Return M events per CPU second of videos of a scene, and ratios, for `bench.py`."""
    small, large = make_scene("slider", 0).recording, make_scene("large", 0).recording
    shorter = jaxevent.events_only.Params(window=jaxevent.events_only.Params().window / 2)
    taken = {
        name: (events, image_seconds(estimate, recording, events, count))
        for name, estimate, recording, events, count in (
            ("240x180", jaxevent.events_only.estimate, small, 20_000, 8),
            ("240x180, causal", lambda one: jaxevent.events_only.estimate(one, causal=True),
             small, 20_000, 8),
            ("240x180, half of the events",
             lambda one: jaxevent.events_only.estimate(one, shorter), small, 20_000, 8),
            ("640x480", jaxevent.events_only.estimate, large, 167_000, 4),
            ("240x180, high-pass", jaxevent.high_pass.estimate, small, 20_000, 8),
            ("240x180, tiles", lambda one: functools.partial(tile_images, one), small, 20_000, 2),
        )
    }  # fmt: skip
    for name, (_, seconds) in taken.items():
        print(f"events-only, {name}: {seconds:.3f} CPU s an image")
    speed = {f"events-only, {k}": events / 1e6 / seconds for k, (events, seconds) in taken.items()}
    cost = {k: seconds for k, (_, seconds) in taken.items()}
    pixels = 640 * 480 / (240 * 180)
    return speed, {
        "events-only / images of tiles": cost["240x180, tiles"] / cost["240x180"],
        "events-only: pixel of 640x480 / of 240x180": cost["640x480"] / cost["240x180"] / pixels,
    }


def main():
    """Run the parts, and write tables, results and sheets of pictures."""
    parser = command_line(__doc__, out=True, data=True, parts=(*REAL, *SCENES))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    options = parser.parse_args()
    stored = options.out / "results.json"
    results = json.loads(stored.read_text()) if stored.exists() else {}
    for name in options.only:
        results[name] = {**results.get(name, {}), **run_part(name, options)}
        write_text(stored, json.dumps(results))
    table = make_tables(results)
    write_text(options.out / "table.md", table)
    print(table)


if __name__ == "__main__":
    main()
