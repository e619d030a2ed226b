"""The numbers by which `mc` chooses between its ingredients: fits `choice` and `doubt`.

    python experiments/compensated_choice.py --data $JAXEVENT_DATA --out choice

Every image that is scored here was hidden from the methods: frames of the first half of
slider_depth, at gaps of 2 to 16 frames, and true images of simulated HDR scenes, of moving
objects, before a moving background and a still one, and of frames blurred by long exposures, of the
scenes and seeds that are for fitting. Images of the recording count `REAL` times. Prints the
numbers as TOML.
With --beyond it fits `choice_beyond` and `doubt_beyond` to the same kinds of images of recordings
whose frames end before the image or begin after it, textures that hardly move among them, and
scores them on davis346_street and the second half of slider_depth, cut likewise.
Frames that serve as truth are noisy: their own variance is added to that of the images.
"""

import argparse
import dataclasses
import itertools
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from tqdm import tqdm

import jaxevent
from jaxevent.camera import UnknownResponse
from jaxevent.metrics import ssim
from jaxevent.reconstruction.compensated import estimator, fusion
from jaxevent.reconstruction.compensated.params import FALLBACK_SOURCES, FEATURE_NAMES, Params
from jaxevent.recording import Frames
from jaxevent.runs.protocols import frame_times
from jaxevent.simulate import (
    FITTING_SCENES,
    SENSORS,
    TESTING_SCENES,
    MovingObjects,
    Pan,
    Sensor,
    scene,
    simulate,
)
from jaxevent.simulate.scenes import Speed

BLOCK = 8  # px, over which the noise of frames is averaged
# How many times images of real recordings count. Of 1, 2 and 3 chosen with the images not fitted to
# in view, those of slider_depth's second half and davis346_street among them: 1 makes slider_depth
# worse by up to 3 %, 3 hardly differs from 2.
REAL = 2.0
RARE = (6.25,)  # Hz, of frames so far apart that motion is hardly found
BLURS = ((0.02, 0.05, 0.1), (25.0, 100.0, 300.0))  # s; px/s
CUTS, AWAY = 4, (1, 2, 4, 8)  # places at which a recording is cut; frames from there
# Parts of `FusionFeatures` that are kept of an image.
FIELDS = (
    "candidates",
    "in_place",
    "features",
    "image_variance",
    "beyond",
    "rest",
    "stationary",
    "intervals_away",
)
GAPS = {2: 12, 4: 12, 8: 12, 16: 8}  # frames from one that is given to the next: images scored
# What `jaxevent fit` finds with the likelihood of frames: configs/fit_slider_depth.toml, and the
# same for davis346_street.
SLIDER: dict[str, Any] = dict(
    c_on=0.2723,
    c_off=0.2096,
    clock_offset=0.009589,
    sigma_event=0.5469,
    sigma_bg=0.09179,
    sigma_frame=0.00159,
    sigma_floor=0.02932,
    share=0.8016,
)
STREET: dict[str, Any] = dict(
    c_on=0.177,
    c_off=0.2014,
    clock_offset=0.008711,
    sigma_event=0.6936,
    sigma_bg=0.008503,
    sigma_frame=0.002417,
    sigma_floor=0.009652,
    share=0.5594,
)


def noise_of(frames: Frames) -> float:
    """The variance of a frame's pixel: half of what two frames differ by where nothing moves.

    The median of blocks, of the two consecutive frames that are most alike.
    """
    changes = np.diff(frames.intensity.astype(np.float64), axis=0) ** 2 / 2
    count, h, w = changes.shape
    h, w = h // BLOCK, w // BLOCK
    blocks = changes[:, : h * BLOCK, : w * BLOCK].reshape(count, h, BLOCK, w, BLOCK).mean((2, 4))
    return float(np.median(blocks.reshape(count, -1), axis=1).min())


def frames_of(path: Path) -> Frames:
    frames = jaxevent.load(path).frames
    assert frames is not None
    return frames


def hidden(path: Path, params: Params, gaps: dict[int, int], half: int | None) -> Iterator[tuple]:
    """Targets among the frames that are not given: label, video, time, truth."""
    recording = jaxevent.load(path)
    assert recording.frames is not None
    count = len(recording.frames)
    times = frame_times(recording.frames, params)
    for gap, number in gaps.items():
        given = recording.with_frames(np.arange(0, count, gap))
        video = jaxevent.METHODS["mc"].estimate(given, params, progress=False)
        rows = [k for k in range((count - 1) // gap * gap) if k % gap]
        if half is not None:
            rows = [k for k in rows if (k < count // 2) == (half == 0)]
        chosen = np.unique(np.linspace(0, len(rows) - 1, number).round().astype(int))
        for row in chosen:
            truth = recording.frames[rows[row] : rows[row] + 1].intensity[0]
            yield (
                f"{path.stem} {gap} {half}",
                video,
                int(times[rows[row]]),
                np.asarray(truth),
                False,
            )


def panned(names: tuple[str, ...], seed: int, images: int) -> Iterator[tuple]:
    """Targets among the true images of HDR scenes."""
    for name in names:
        pace: tuple[tuple[Speed, float], ...] = (("fast", 0.5), ("slow", 1.0))
        for speed, seconds in pace:
            source = Pan(scene(name), speed=speed, duration=seconds, seed=seed)
            recording = simulate(source, Sensor(), seed, f"{name}_{speed}")
            params = Params(preset="hdr", c_on=0.2, c_off=0.18, rho_ref=5e-4)
            video = jaxevent.METHODS["mc"].estimate(recording, params, progress=False)
            times, truths = recording.extra["hdr_t"], recording.extra["hdr"]
            for row in np.unique(np.linspace(2, len(times) - 3, images).round().astype(int)):
                yield f"hdr {speed}", video, int(times[row]), np.asarray(truths[row]), True


class Texture:
    """A random texture that slides by on an accelerated path, before another one or without.

    It is `pace` times as fast as others.
    """

    size, duration = (96, 72), 0.6

    def __init__(self, seed: int, pace: float = 1.0):
        self.rng = rng = np.random.default_rng(seed)
        self.y, self.x = np.mgrid[:72, :96].astype(float)
        self.speed = pace * float(np.exp(rng.uniform(np.log(15), np.log(300))))
        self.layers = [self._layer() for _ in range(int(rng.integers(1, 3)))]
        self.edge = rng.uniform(25, 70)

    def _layer(self) -> tuple:
        rng, angle = self.rng, self.rng.uniform(0, 6.28)
        fine = np.exp(rng.uniform(np.log(0.15), np.log(1.2)))
        waves = np.stack([*rng.normal(0, fine, (2, 25)), rng.uniform(0, 6.28, 25)])
        v = self.speed * rng.uniform(0.4, 1) * np.array([np.cos(angle), np.sin(angle)])
        return (
            waves,
            rng.uniform(0.1, 0.4),
            v,
            rng.uniform(-1, 1, 2) * self.speed,
            rng.normal(0, 0.4),
        )

    def _level(self, layer: tuple, t: float) -> np.ndarray:
        (ky, kx, phase), contrast, v, a, mean = layer
        dx, dy = v * t + a * t * t / 2
        at = ky[:, None, None] * (self.y - dy) + kx[:, None, None] * (self.x - dx)
        return -1.2 + mean + contrast * np.cos(at + phase[:, None, None]).sum(0) / 2

    def intensity(self, t: float | int) -> np.ndarray:
        level = self._level(self.layers[0], float(t))
        if len(self.layers) > 1:
            place = self.edge + self.layers[1][2][0] * (t - 0.3)
            front = 1 / (1 + np.exp(-(self.x - place) / 0.4))
            level = front * self._level(self.layers[1], float(t)) + (1 - front) * level
        return np.exp(level).clip(0.01, 1.5)


def textures(seeds: range, pace: float = 1.0) -> Iterator[tuple]:
    """Targets among the true images of sliding textures."""
    for seed in seeds:
        rng = np.random.default_rng(seed)
        rate = float(np.exp(rng.uniform(np.log(8), np.log(80))))
        c_on, c_off = rng.uniform(0.1, 0.35, 2)
        sensor = Sensor(
            c_on=c_on, c_off=c_off, frame_rate=rate, exposure=1e-3,
            background_rate=rng.uniform(0, 0.5), read_noise=rng.uniform(0.3, 2), truth_rate=20.0,
        )  # fmt: skip
        recording = simulate(Texture(seed, pace), sensor, seed, f"texture {seed}")
        wrong = np.exp(rng.normal(0, 0.12, 2))
        params = Params(
            c_on=c_on * wrong[0], c_off=c_off * wrong[1], I0=float(rng.choice([0.01, 0.05, 0.3])),
            rho_ref=5e-4, w_min=float(rng.choice([0.05, 0.6])),
            sigma_event=float(rng.uniform(0.2, 0.7)),
        )  # fmt: skip
        video = jaxevent.METHODS["mc"].estimate(recording, params, progress=False)
        times, truths = recording.extra["hdr_t"], recording.extra["hdr"]
        for row in np.unique(np.linspace(1, len(times) - 2, 3).round().astype(int)):
            label = f"textures x {pace:g}"
            yield label, video, int(times[row]), np.asarray(truths[row]), False


def objects(
    seeds: range, rates: tuple[float, ...] = (25.0, 100.0), **options: Any
) -> Iterator[tuple]:
    """Targets among the true images of moving objects; `options` of `MovingObjects`."""
    for seed in seeds:
        for rate in rates:
            sensor = dataclasses.replace(SENSORS["davis"], frame_rate=rate, truth_rate=20.0)
            recording = simulate(
                MovingObjects(seed=seed, **options), sensor, seed, f"objects {seed}"
            )
            params = Params(c_on=0.2, c_off=0.18, I0=0.1, rho_ref=5e-4)
            video = jaxevent.METHODS["mc"].estimate(recording, params, progress=False)
            times, truths = recording.extra["hdr_t"], recording.extra["hdr"]
            for row in np.unique(np.linspace(2, len(times) - 3, 5).round().astype(int)):
                truth = np.asarray(truths[row])
                label = f"{'still ' if options else ''}objects {rate:g} Hz"
                yield label, video, int(times[row]), truth, False


def blurred(names: tuple[str, ...], seed: int) -> Iterator[tuple]:
    """Targets at the middles of long exposures and halfway between them."""
    for kind, exposure, speed in itertools.product(("pan", "objects"), *BLURS):
        rate = min(25.0, 0.8 / exposure)
        sensor = dataclasses.replace(
            SENSORS["davis"],
            frame_rate=rate,
            exposure=exposure,
            exposure_samples=max(8, round(2 * exposure * speed)),
            response=UnknownResponse(),
        )
        size, duration = (128, 96), 6 / rate + exposure
        light = scene(names[int(speed) % len(names)], decades=1.0)
        light = 0.9 * light / np.quantile(light, 0.9999)
        source = (
            MovingObjects(size, duration, speed, seed=seed)
            if kind == "objects"
            else Pan(light, size, duration, speed, seed)
        )
        recording = simulate(source, sensor, seed, "blurred")
        assert recording.frames is not None
        params = Params(c_on=0.2, c_off=0.18, I0=0.1, rho_ref=5e-4)
        video = jaxevent.METHODS["mc"].estimate(recording, params, progress=False)
        t = recording.frames.t
        for time in (*t[2:4], *((t[1:] + t[:-1]) // 2)[[0, -1]]):
            truth = source.intensity(time * 1e-6).clip(0, 1)
            label = f"blurred {kind} {'fast' if speed > 100 else 'slow'}"
            yield label, video, int(time), truth, False


def cut(targets: Iterator[tuple]) -> Iterator[tuple]:
    """Targets that have the frames before them alone, and the same with those after them."""
    for label, video, t, truth, hdr in targets:
        frames = video.recording.frames
        for rows in (np.flatnonzero(frames.t < t), np.flatnonzero(frames.t > t)):
            if len(rows) > 1:
                given = video.recording.with_frames(rows)
                one = jaxevent.METHODS["mc"].estimate(given, video.params, progress=False)
                yield label, one, t, truth, hdr


def ended(path: Path, params: Params) -> Iterator[tuple]:
    """Targets some frames after the last one given, or before the first; of the first half."""
    recording = jaxevent.load(path)
    assert recording.frames is not None
    times = frame_times(recording.frames, params)
    for at in np.linspace(0, len(times) // 2, CUTS + 2).round().astype(int)[1:-1]:
        for rows, step in ((slice(0, at), 1), (slice(at, None), -1)):
            given = recording.with_frames(rows)
            video = jaxevent.METHODS["mc"].estimate(given, params, progress=False)
            for away in AWAY:
                row = at - 1 + away if step > 0 else at - away
                if 0 <= row < len(times) // 2:
                    truth = np.asarray(recording.frames[row : row + 1].intensity[0])
                    yield f"{path.stem} + {away}", video, int(times[row]), truth, False


def compared(targets: Iterator[tuple]) -> Iterator[dict[str, Any]]:
    features = jax.jit(fusion.fusion_features)
    for label, video, t, truth, hdr in targets:
        target = video.trajectories(t)
        if target.smooth is not None:  # nor is its brightness that of its images
            continue
        given = features(*estimator.compare_images(video.params, target))
        yield {
            "label": label,
            **{name: np.asarray(getattr(given, name)) for name in FIELDS},
            "truth": truth.astype(np.float32),
            "I0": float(video.params.I0),
            "hdr": hdr,
        }


def errors(L: Any, I0: Any, truth: Any, hdr: Any) -> Any:
    """What is made small: squared differences of intensity, of HDR scenes of its logarithm."""
    image = jnp.exp(L) - I0
    linear = jnp.clip(image, 0, 1) - jnp.clip(truth, 0, 1)
    logs = jnp.log(jnp.maximum(image, 0) + 0.003) - jnp.log(truth + 0.003)
    return jnp.where(hdr, logs, linear) ** 2


def noise_in(row: dict[str, Any], noises: dict[str, float]) -> np.ndarray:
    """The variance of the true ln(I + I0) of a row: frames are noisy, simulated truth is not."""
    noise = noises.get(row["label"].split()[0], 0.0)
    return noise / (row["truth"] + row["I0"]) ** 2


def difficulty(row: dict[str, Any]) -> float:
    """What the first two ingredients get wrong, so that hard images do not outweigh."""
    known = (row["I0"], row["truth"], row["hdr"])
    return float(np.sqrt(np.prod([errors(L, *known).mean() for L in row["candidates"][:2]])))


def weight(row: dict[str, Any], noises: dict[str, float]) -> float:
    """How many times an image counts; `noises` has the real recordings."""
    return REAL if row["label"].split()[0] in noises else 1.0


class Pixels(NamedTuple):
    """Pixels of images that are fitted to, a row for each."""

    X: Any  # (n, features)
    variance_X: Any  # (n, features), of the variance
    Y: Any  # (n, 3), candidates
    in_place: Any  # (n, 1), logarithm
    truth: Any
    I0: Any
    R: Any  # variance of the truth, (ln I)^2
    hdr: Any
    scale: Any  # weight of the squared error
    share: Any  # weight for the variance: every kind of images counts the same
    images: Any  # (images,), pixels of each
    kinds: dict[str, list[int]]  # images by label

    @property
    def level(self) -> Any:
        """The true ln(I + I0)."""
        return jnp.log(self.truth + self.I0)


def gather(rows: list[dict], noises: dict[str, float], sub: int = 7) -> Pixels:
    """Gather every `sub`-th pixel; `noises` are those of frames, by recording."""

    def some(image) -> np.ndarray:
        return np.asarray(image).reshape(*np.shape(image)[:-2], -1)[..., ::sub]

    def column(part: Callable[[dict], Any]) -> Any:
        return jnp.asarray(np.concatenate([np.asarray(part(r), np.float32) for r in rows]))

    def constant(part: Callable[[dict], float]) -> Any:
        return column(lambda r: np.full(len(some(r["truth"])), part(r)))

    def variance_features(row: dict) -> np.ndarray:
        given = (row["features"], row["in_place"], row["beyond"] > 0, row["intervals_away"])
        return np.asarray(fusion.variance_features(*map(jnp.asarray, given)))

    kinds: dict[str, list[int]] = {}
    for k, row in enumerate(rows):
        kinds.setdefault(row["label"], []).append(k)
    images = np.array([len(some(r["truth"])) for r in rows])
    share = constant(lambda r: 1 / (len(some(r["truth"])) * len(kinds[r["label"]])))
    return Pixels(
        column(lambda r: some(r["features"]).T),
        column(lambda r: some(variance_features(r)).T),
        column(lambda r: some(r["candidates"]).T),
        column(lambda r: some(np.log(r["in_place"]))[:, None]),
        column(lambda r: some(r["truth"])),
        constant(lambda r: r["I0"]),
        column(lambda r: some(noise_in(r, noises))),
        constant(lambda r: r["hdr"]) > 0,
        constant(lambda r: weight(r, noises) / difficulty(r)),
        share / share.sum(),
        images,
        kinds,
    )


def blend(pixels: Pixels, W: Any) -> Any:
    """Blend the candidates of pixels with weights W (2, features)."""
    zero = jnp.zeros_like(pixels.in_place)
    q = jax.nn.softmax(jnp.concatenate([zero, pixels.X @ W.T + pixels.in_place], 1))
    return (q * pixels.Y).sum(1)


def image_loss(pixels: Pixels, W: Any) -> Any:
    """Return the mean squared error of blended pixels, in units of the candidates'."""
    return (pixels.scale * errors(blend(pixels, W), pixels.I0, pixels.truth, pixels.hdr)).mean()


def variance_loss(pixels: Pixels, w: Any, squares: Any) -> Any:
    """Return the negative log-likelihood of squared errors with variance weights w (features,).

    It is heavy-tailed as a t distribution, so that a few lost pixels do not set all variances.
    """
    P = jnp.exp(pixels.variance_X @ w) + pixels.R
    tail = 10 * jnp.log1p(squares / P / 10)
    return 0.5 * (pixels.share * (1.1 * tail + jnp.log(P))).sum()


def standardise(X: Any) -> tuple[Any, Any, Any]:
    """Return features of mean 0 and standard deviation 1, and these."""
    mean, spread = X.mean(0).at[-1].set(0), X.std(0).at[-1].set(1)
    spread = jnp.where(spread > 1e-3, spread, 1)
    return (X - mean) / spread, mean, spread


def plain(W: Any, mean: Any, spread: Any) -> Any:
    """Convert weights of standardised features to those of the features as they are."""
    W = W / spread
    return W.at[..., -1].add(-(W[..., :-1] * mean[:-1]).sum(-1))


def minimise(value: Callable[..., Any], iterations: int) -> Callable[..., tuple[Any, Any]]:
    """Compile a minimisation of `value(W, *data)` by Adam.

    Returns a function of the start, a mask of the weights that are not 0, and the data, to the
    weights and their value.
    """
    optimiser = optax.adam(0.05)

    @jax.jit
    def minimised(start: Any, used: Any, *data: Any) -> tuple[Any, Any]:
        def step(_: int, carry: tuple) -> tuple:
            W, state = carry
            gradient = jax.grad(lambda W: value(W * used, *data))(W)
            change, state = optimiser.update(gradient, state)
            return optax.apply_updates(W, change), state

        W, _ = jax.lax.fori_loop(0, iterations, step, (start, optimiser.init(start)))
        return W * used, value(W * used, *data)

    return minimised


def penalised_image_loss(W: Any, pixels: Pixels) -> Any:
    """Return the loss of choice weights with a penalty."""
    return image_loss(pixels, W) + 3e-4 * (W[:, :-1] ** 2).sum()


def penalised_variance_loss(w: Any, pixels: Pixels, squares: Any) -> Any:
    """Return the loss of variance weights with a penalty."""
    return variance_loss(pixels, w, squares) + 1e-4 * (w[:-1] ** 2).sum()


class Fit:
    """Fits of weights to pixels, whose features are standardised."""

    def __init__(self, pixels: Pixels, iterations: int = 400):
        X, *self.scales = standardise(pixels.X)
        variance_X, *self.variance_scales = standardise(pixels.variance_X)
        self.images, self.kinds = pixels.images, pixels.kinds
        self.pixels = pixels._replace(X=X, variance_X=variance_X, images=None, kinds={})
        self._choice = minimise(penalised_image_loss, iterations)
        self._variance = minimise(penalised_variance_loss, iterations)

    def choice(self, used: Any) -> Any:
        """Fit choice weights (2, features)."""
        start = jnp.zeros((len(FALLBACK_SOURCES), len(FEATURE_NAMES) + 1))
        start = start.at[:, -1].set(jnp.array([-2.0, -3.0]))
        return self._choice(start, used, self.pixels)[0]

    def squares(self, W: Any) -> Any:
        """Return the squared errors of log intensity."""
        return (blend(self.pixels, W) - self.pixels.level) ** 2

    def variance(self, used: Any, squares: Any) -> Any:
        """Fit variance weights (features,), scaled to a standardised square of 1.

        Of that the geometric mean over images of a kind is taken, and then over kinds.
        """
        start = jnp.zeros(len(FEATURE_NAMES) + 1).at[-1].set(jnp.log(squares.mean()))
        w, _ = self._variance(start, used, self.pixels, squares)
        edges, factor = np.cumsum([0, *self.images]), 1.0
        for _ in range(5):
            P = factor * jnp.exp(self.pixels.variance_X @ w) + self.pixels.R
            z2 = np.asarray(squares / P)
            means = [np.log(z2[i:j].mean()) for i, j in zip(edges[:-1], edges[1:], strict=True)]
            groups = [np.mean([means[k] for k in group]) for group in self.kinds.values()]
            factor *= float(np.exp(np.mean(groups)))
        return w.at[-1].add(np.log(factor))


def eliminate(value: Callable[..., Any], weights: Any, *data: Any) -> list[int]:
    """Order features by backward elimination: the first one is the first to go.

    At each turn the feature goes without which the loss is least when the other weights adapt, by
    the second-order expansion of the loss about its minimum.
    """
    flat = np.asarray(weights, float).ravel()
    hessian = jax.hessian(lambda w: value(w.reshape(weights.shape), *data))
    H = np.asarray(hessian(jnp.asarray(flat, jnp.float32)), float)
    step, rest = weights.shape[-1], list(range(len(FEATURE_NAMES)))
    kept = np.arange(len(flat))
    order: list[int] = []
    while rest:
        inverse, found = np.linalg.inv(H[np.ix_(kept, kept)]), []
        for k in rest:
            own = np.flatnonzero(kept % step == k)
            change = np.linalg.solve(inverse[np.ix_(own, own)], flat[kept[own]])
            found.append((flat[kept[own]] @ change, k, own, change))
        _, gone, own, change = min(found, key=lambda one: one[0])
        flat[kept] -= inverse[:, own] @ change
        kept = np.delete(kept, own)
        rest.remove(gone)
        order.append(gone)
    return order


COUNTS = (16, 12, 8, 4, 0)  # of features, whose held-out losses are printed


def select(fitting: list[dict], testing: list[dict], noises: dict[str, float]) -> None:
    """Print the held-out losses of fewer features, in a table."""
    fit, held_out = Fit(gather(fitting, noises, 61), 300), gather(testing, noises, 61)
    every = jnp.ones(len(FEATURE_NAMES) + 1)
    W = fit.choice(every)
    squares = fit.squares(W)
    choice_order = eliminate(penalised_image_loss, W, fit.pixels)
    w = fit.variance(every, squares)
    variance_order = eliminate(penalised_variance_loss, w, fit.pixels, squares)
    for name, order in (("choice", choice_order), ("variance", variance_order)):
        print(name, [FEATURE_NAMES[k] for k in order], flush=True)
    held_out_squares = (blend(held_out, plain(W, *fit.scales)) - held_out.level) ** 2
    print("| features | image loss, fitted | held out | variance loss, fitted | held out |")
    print("|---:|---:|---:|---:|---:|")
    for count in COUNTS:
        gone = len(FEATURE_NAMES) - count
        used = [every.at[jnp.array(o[:gone], int)].set(0) for o in (choice_order, variance_order)]
        W, w = fit.choice(used[0]), fit.variance(used[1], squares)
        cells = (
            image_loss(fit.pixels, W),
            image_loss(held_out, plain(W, *fit.scales)),
            variance_loss(fit.pixels, w, squares),
            variance_loss(held_out, plain(w, *fit.variance_scales), held_out_squares),
        )
        print(f"| {count} | " + " | ".join(f"{float(v):.4f}" for v in cells) + " |", flush=True)
        weights = plain(W, *fit.scales), plain(w, *fit.variance_scales)
        print("<!--", *(np.round(np.asarray(v), 3).tolist() for v in weights), "-->", flush=True)


def show(rows: list[dict], params: Params, noises: dict[str, float]) -> None:
    """Errors of the ingredients and of the choice, by label.

    The last columns: which part of pixels is not valid; and among these and among the valid ones,
    which part is wrong by more than `vague`.
    """
    fuse_candidates = jax.jit(fusion.fuse_candidates)
    table: dict[str, list] = {}
    for r in rows:
        given = fusion.FusionFeatures(
            shares=jnp.zeros((3, 1, 1)),
            visible=jnp.zeros((2, 1, 1)),
            **{name: jnp.asarray(r[name]) for name in FIELDS},
        )
        fused = fuse_candidates(params, given)
        line = []
        for L in (*r["candidates"], np.asarray(fused.L)):
            line.append(float(errors(L, r["I0"], r["truth"], r["hdr"]).mean()) * 100)
        shown = (np.exp(np.asarray(fused.L)) - r["I0"]).clip(0, 1).astype(np.float32)
        line.append(float(ssim(shown, r["truth"])) if not r["hdr"] else np.nan)
        squares = (np.asarray(fused.L) - np.log(r["truth"] + r["I0"])) ** 2
        P, bound = np.asarray(fused.P), float(params.vague) ** 2
        z2 = squares / (P + noise_in(r, noises))
        vague, wrong = bound <= P, squares > bound
        counts = [vague.mean(), (vague & wrong).mean(), (~vague & wrong).mean()]
        table.setdefault(r["label"], []).append([*line, z2.mean(), *counts])
    print(
        "| images | along | smoothed | blend | mc | SSIM | z2 | vague | wrong there | elsewhere |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for label, lines in table.items():
        means = np.mean(lines, 0)
        means[-2:] /= np.maximum([means[-3], 1 - means[-3]], 1e-9)
        cells = " | ".join(f"{v:.4f}" for v in means)
        print(f"| {label} | {cells} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--beyond", action="store_true", help="where frames are on one side alone")
    parser.add_argument("--features", action="store_true", help="print losses of fewer features")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    data = given.data / "data"

    def kept(name: str, *targets: Iterator[tuple]) -> list[dict]:
        path = given.out / f"{name}.pkl"
        if not path.exists():
            found = [row for one in targets for row in tqdm(compared(one), desc=name)]
            path.write_bytes(pickle.dumps(found))
        return pickle.loads(path.read_bytes())

    slider, street = data / "slider_depth.zip", data / "davis346_street.npz"
    noises = {path.stem: noise_of(frames_of(path)) for path in (slider, street)}
    fitting, testing = (_beyond if given.beyond else _two_sided)(kept, slider, street)
    if given.features:
        rows = ([row for part in parts for row in part] for parts in (fitting, testing))
        return select(*rows, noises)
    fit = Fit(gather([row for part in fitting for row in part], noises))
    every = jnp.ones(len(FEATURE_NAMES) + 1)
    W = fit.choice(every)
    w = fit.variance(every, fit.squares(W))
    choice, doubt = (np.asarray(v) for v in (plain(W, *fit.scales), plain(w, *fit.variance_scales)))
    ending = "_beyond" if given.beyond else ""
    found = {f"choice{ending}": choice.ravel(), f"doubt{ending}": doubt}
    found = {name: [round(float(v), 3) for v in values] for name, values in found.items()}
    for name, values in found.items():
        print(name, "=", values)
    numbers = Params().replace(**found)
    for name, parts in (("fitted", fitting), ("not seen", testing)):
        print(name)
        for part in parts:
            show(part, numbers, noises)


def _two_sided(kept: Callable[..., list[dict]], slider: Path, street: Path) -> tuple[list, list]:
    """What is fitted to, and what is not."""
    fitting = [
        kept("slider", hidden(slider, Params(**SLIDER), GAPS, 0)),
        kept("slider_plain", hidden(slider, Params(), GAPS, 0)),
        kept("hdr", panned(FITTING_SCENES, 11, 5)),
        kept("textures", textures(range(1000, 1060))),
        kept("objects", objects(range(1, 4))),
        kept("still_objects", objects(range(1, 4), background=0)),
        kept("still_objects_rare", objects(range(1, 7), RARE, background=0)),
        kept("blurred", blurred(FITTING_SCENES, 1)),
    ]
    testing = [
        kept("slider_test", hidden(slider, Params(**SLIDER), {2: 10, 4: 10, 8: 10, 16: 8}, 1)),
        kept("slider_plain_test", hidden(slider, Params(), {2: 10, 4: 10, 8: 10, 16: 8}, 1)),
        kept("street_test", hidden(street, Params(**STREET), {2: 10, 4: 10, 8: 10}, None)),
        kept("street_plain_test", hidden(street, Params(), {2: 10, 4: 10, 8: 10}, None)),
        kept("hdr_test", panned(TESTING_SCENES, 2, 4)),
        kept("textures_test", textures(range(2000, 2030))),
        kept("objects_test", objects(range(11, 13))),
        kept("still_objects_test", objects(range(11, 12), background=0)),
        kept("blurred_test", blurred(TESTING_SCENES[:1], 2)),
    ]
    return fitting, testing


def _beyond(kept: Callable[..., list[dict]], slider: Path, street: Path) -> tuple[list, list]:
    """The same of recordings that are cut."""
    few = {2: 8, 8: 8}
    fitting = [
        kept("slider_cut", cut(hidden(slider, Params(), few, 0))),
        kept("slider_ended", ended(slider, Params())),
        kept("hdr_cut", cut(panned(FITTING_SCENES[:1], 11, 3))),
        kept("textures_cut", cut(textures(range(1000, 1012)))),
        kept("still_cut", cut(textures(range(1100, 1106), 0.02))),
        kept("objects_cut", cut(objects(range(1, 2)))),
        kept("still_objects_cut", cut(objects(range(1, 3), background=0))),
    ]
    testing = [
        kept("slider_cut_test", cut(hidden(slider, Params(), few, 1))),
        kept("street_cut_test", cut(hidden(street, Params(), few, None))),
        kept("still_objects_cut_test", cut(objects(range(11, 12), background=0))),
    ]
    return fitting, testing


if __name__ == "__main__":
    main()
