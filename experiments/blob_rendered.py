"""Targets of rendered scenes: things with parts, behind bars, before textures that move, hot lines.

    python experiments/blob_rendered.py --out rendered [--first 10] [--seeds 2] [--scenes ...]

Unlike the scenes of `blob_scenes.py`, which draw events from shapes, these are images of light on
240x180 pixels, drawn at a thousand times, of which pixels send events at thresholds (0.2, by 5 %
unlike). Each is searched for targets (`find`). A track and a target are one where they are nearer
than the target's reach at half of 200 times. Makes table.md. Rules of the search were made with
seeds 0 to 2 in view.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from jaxevent.blob import TargetSearchResult, find
from jaxevent.blob.scores import score_tracks
from jaxevent.recording import Events, Recording

W, H = 240, 180
Y, X = np.mgrid[:H, :W].astype(np.float32)
STEPS, TIMES, THRESHOLD, NOISE = 1000, 200, 0.2, 2e3
Image = NDArray[np.float32]


class Scene(NamedTuple):
    """Light at a time (s), places (times, targets, 2) px of targets, their reach (px), seconds."""

    draw: Callable[[float], Image]
    places: Callable[[NDArray], NDArray]
    reach: float
    duration: float
    hot: tuple[int, ...] = ()  # columns whose pixels fire all the time


def disc(image: Image, p: NDArray, radius: float, light: float) -> None:
    inside = np.clip(0.5 - (np.hypot(X - p[0], Y - p[1]) - radius) / 1.4, 0, 1)
    image += inside * (light - image)


def box(image: Image, p: NDArray, half: tuple[float, float], angle: float, light: float) -> None:
    c, s, dx, dy = np.cos(angle), np.sin(angle), X - p[0], Y - p[1]
    far = np.maximum(abs(c * dx + s * dy) - half[0], abs(c * dy - s * dx) - half[1])
    image += np.clip(0.5 - far / 1.4, 0, 1) * (light - image)


def limb(image: Image, p: NDArray, angle: float, length: float, half: float, light: float) -> None:
    """A bar that begins at p and hangs down, turned by an angle."""
    middle = p + length / 2 * np.array([np.sin(angle), np.cos(angle)])
    box(image, middle, (half, length / 2), -angle, light)


def person(image: Image, p: NDArray, phase: float, light: float) -> None:
    swing = 0.6 * np.sin(phase)
    for side in (1, -1):
        limb(image, p + [0, 14], side * swing, 26, 3.2, light)
    box(image, p, (6, 16), 0, 1.4 * light)
    disc(image, p - [0, 22], 5.5, 2 * light)
    for side in (1, -1):
        limb(image, p - [0, 12], 1.1 * side * swing, 22, 2.4, 0.8 * light)


def grey(light: float) -> Image:
    return np.full((H, W), light, np.float32)


def texture(rng: np.random.Generator) -> NDArray:
    soft = ndimage.gaussian_filter(rng.normal(size=(2 * H, 4 * W)), 3)
    return 0.5 + 0.22 * soft / soft.std()


def going(start: NDArray, velocity: NDArray) -> Callable[[NDArray], NDArray]:
    """Places (..., targets, 2) of what begins at start (targets, 2) and goes on straight."""
    return lambda t: start + velocity * np.asarray(t, float)[..., None, None]


def propeller(rng: np.random.Generator) -> Scene:
    hub, turn = rng.uniform((80, 70), (160, 110)), rng.uniform(30, 60)

    def draw(t: float) -> Image:
        image = grey(0.4)
        for k in range(3):
            limb(image, hub, turn * t + k * 2 * np.pi / 3, 38, 3, 0.1)
        disc(image, hub, 5, 0.1)
        return image

    return Scene(draw, going(hub[None], np.zeros((1, 2))), 40, 0.6)


def walkers(rng: np.random.Generator, number: int = 2) -> Scene:
    v = np.stack([rng.uniform(50, 90, number) * (1, -1)[:number], np.zeros(number)], 1)
    start = [120, rng.uniform(75, 105)] + 8 * np.arange(number)[:, None] * [0, 1] - 1.4 * v
    places = going(start, v)

    def draw(t: float) -> Image:
        image = grey(0.5)
        for k, p in enumerate(places(np.array(t))):
            person(image, p, 6 * t + k, 0.1 + 0.1 * k)
        return image

    return Scene(draw, places, 30, 2.8)


def car(rng: np.random.Generator) -> Scene:
    v, behind = rng.uniform(80, 200), texture(rng)[:H, :W].astype(np.float32) * 0.5 + 0.25
    places = going(np.array([[-10.0, rng.uniform(80, 110)]]), np.array([[v, 0.0]]))

    def draw(t: float) -> Image:
        image, (p,) = behind.copy(), places(np.array(t))
        box(image, p, (42, 10), 0, 0.75)
        box(image, p - [4, 16], (24, 8), 0, 0.7)
        for x in (-14, 7):
            box(image, p + [x, -15], (9, 6), 0, 0.15)
        for x in (-25, 25):
            disc(image, p + [x, 10], 8, 0.06)
            box(image, p + [x, 10], (6, 1), v * t / 8, 0.5)
        return image

    return Scene(draw, places, 40, 260 / v)


def behind_a_bar(rng: np.random.Generator) -> Scene:
    """Hidden for 0.1 s."""
    v = rng.uniform(100, 160)
    places = going(np.array([[30.0, rng.uniform(60, 120)]]), np.array([[v, 0.0]]))

    def draw(t: float) -> Image:
        image = grey(0.5)
        disc(image, places(np.array(t))[0], 9, 0.9)
        box(image, np.array([120, 90]), (v / 20 + 9, 90), 0, 0.3)
        return image

    return Scene(draw, places, 11, 180 / v)


def birds(rng: np.random.Generator) -> Scene:
    """Five that flap their wings and fly alike."""
    flaps = rng.uniform(20, 40, 5)
    velocity = [60, 10] + 8 * rng.normal(size=(5, 2))
    places = going(rng.uniform((20, 30), (120, 150), (5, 2)), velocity)

    def draw(t: float) -> Image:
        image = grey(0.7)
        for p, flap in zip(places(np.array(t)), flaps, strict=True):
            up = 0.8 * np.sin(flap * t)
            for side in (1, -1):
                limb(image, p, side * (np.pi / 2 + up), 10, 1.5, 0.1)
            box(image, p, (5, 2), 0, 0.1)
        return image

    return Scene(draw, places, 8, 1.6)


def hot_columns(rng: np.random.Generator) -> Scene:
    def places(t: NDArray) -> NDArray:
        t = np.asarray(t, float)[..., None]
        return np.stack([120 + 70 * np.sin(2 * t), 90 + 50 * np.cos(1.7 * t)], -1)

    def draw(t: float) -> Image:
        image = grey(0.5)
        disc(image, places(np.array(t))[0], 10, 0.1)
        return image

    return Scene(draw, places, 12, 2.0, tuple(rng.choice(W, 5, replace=False)))


def pan(rng: np.random.Generator) -> Scene:
    """A camera that turns past a texture, and nothing else."""
    scene, v = texture(rng), rng.uniform(60, 150)

    def draw(t: float) -> Image:
        return ndimage.map_coordinates(scene, [Y + 50, X + 20 + v * t], order=1).astype(np.float32)

    return Scene(draw, lambda t: np.zeros((*np.shape(t), 0, 2)), 1, 1.0)


def shaking(rng: np.random.Generator) -> Scene:
    """A camera that shakes before a texture, by 2 to 4 px at 5 to 9 Hz."""
    scene, f, far = texture(rng), rng.uniform(5, 9), rng.uniform(2, 4)
    dx, dy = far * np.array([np.cos(a := rng.uniform(0, np.pi)), np.sin(a)])

    def draw(t: float) -> Image:
        s = np.sin(2 * np.pi * f * t)
        places = [Y + 50 + s * dy, X + 20 + s * dx]
        return ndimage.map_coordinates(scene, places, order=1).astype(np.float32)

    return Scene(draw, lambda t: np.zeros((*np.shape(t), 0, 2)), 1, 1.0)


def before_a_pan(rng: np.random.Generator) -> Scene:
    """A disc before a texture that a camera sees at rest for half the time, and then turns past."""
    scene, v, u = texture(rng), rng.uniform(60, 150), rng.uniform(70, 110)
    places = going(np.array([[20.0, rng.uniform(60, 120)]]), np.array([[u, 0.0]]))

    def draw(t: float) -> Image:
        far = [Y + 50, X + 20 + v * max(t - 0.8, 0.0)]
        image = ndimage.map_coordinates(scene, far, order=1).astype(np.float32)
        disc(image, places(np.array(t))[0], 9, 0.1)
        return image

    return Scene(draw, places, 12, 1.6)


def turning(rng: np.random.Generator) -> Scene:
    """A textured disc that turns in its place."""
    hub, radius = rng.uniform((80, 70), (160, 110)), rng.uniform(30, 45)
    turn, surface = rng.uniform(6, 20) * rng.choice([-1, 1]), texture(rng)

    def draw(t: float) -> Image:
        c, s, dx, dy = np.cos(turn * t), np.sin(turn * t), X - hub[0], Y - hub[1]
        there = [100 - s * dx + c * dy, 100 + c * dx + s * dy]
        image = grey(0.5)
        inside = np.clip(radius - np.hypot(dx, dy) + 0.5, 0, 1)
        seen = ndimage.map_coordinates(surface, there, order=1)
        return (image + inside * (seen - image)).astype(np.float32)

    return Scene(draw, going(hub[None], np.zeros((1, 2))), radius, 1.0)


def before_turning(rng: np.random.Generator) -> Scene:
    """A disc that swings slowly before a textured disc that turns in its place, never beside it."""
    behind = turning(rng)
    (hub,), far = behind.places(np.array(0.0)), behind.reach - 12
    angle, rate, size = rng.uniform(0, np.pi), rng.uniform(1, 4), rng.uniform(5, 8)
    along = far * np.array([np.cos(angle), np.sin(angle)])

    def places(t: NDArray) -> NDArray:
        swing = hub + along * np.sin(rate * np.asarray(t, float)[..., None])
        return np.stack([np.broadcast_to(hub, swing.shape), swing], -2)

    def draw(t: float) -> Image:
        image = behind.draw(t)
        disc(image, places(np.array(t))[1], size, 0.05)
        return image

    return Scene(draw, places, 12, 1.0)


def circling(rng: np.random.Generator) -> Scene:
    """Eight small discs that go round on one circle, far enough apart to be eight."""
    hub, radius = rng.uniform((90, 75), (150, 105)), rng.uniform(35, 50)
    turn, size = rng.uniform(40, 70) * rng.choice([-1, 1]), rng.uniform(3, 5)

    def places(t: NDArray) -> NDArray:
        angle = turn * np.asarray(t, float)[..., None] + np.arange(8) * np.pi / 4
        return hub + radius * np.stack([np.cos(angle), np.sin(angle)], -1)

    def draw(t: float) -> Image:
        image = grey(0.5)
        for p in places(np.array(t)):
            disc(image, p, size, 0.1)
        return image

    return Scene(draw, places, 6, 0.5)


SCENES: dict[str, Callable[[np.random.Generator], Scene]] = {
    "propeller": propeller, "walker": lambda rng: walkers(rng, 1), "two walkers": walkers,
    "car": car, "behind a bar": behind_a_bar, "five birds": birds, "hot columns": hot_columns,
    "pan, nothing else": pan, "shaking camera": shaking, "disc before a pan": before_a_pan,
    "turning disc": turning, "disc before a turning disc": before_turning,
    "circling discs": circling,
}  # fmt: skip


def record(scene: Scene, rng: np.random.Generator) -> Recording:
    """Events of a scene's light, noise, and what hot columns send."""
    thresholds = THRESHOLD * (1 + 0.05 * rng.normal(size=(2, H, W)))
    times = np.linspace(0, scene.duration, STEPS + 1)
    before = np.log(np.maximum(scene.draw(0.0), 0.02) + 0.05)
    reference = before + rng.uniform(-THRESHOLD, THRESHOLD, before.shape) / 2
    parts = []
    for begin, end in zip(times[:-1], times[1:], strict=True):
        now = np.log(np.maximum(scene.draw(end), 0.02) + 0.05)
        for sign, threshold in zip((1, -1), thresholds, strict=True):
            while True:
                over = sign * (now - reference) - threshold
                y, x = np.nonzero(over >= 0)
                if not len(y):
                    break
                reference[y, x] += sign * threshold[y, x]
                moved = np.maximum(sign * (now - before)[y, x], 1e-6)
                share = np.clip(1 - over[y, x] / moved, 0, 1)
                parts.append((begin + share * (end - begin), x, y, np.full(len(y), sign > 0)))
        before = now
    columns = [(NOISE, None), *((2e4, column) for column in scene.hot)]
    for rate, column in columns:
        n = rng.poisson(rate * scene.duration)
        x = rng.integers(0, W, n) if column is None else np.full(n, column)
        t, y = rng.uniform(0, scene.duration, n), rng.integers(0, H, n)
        parts.append((t, x, y, rng.random(n) < 0.5))
    t, x, y, p = (np.concatenate(column) for column in zip(*parts, strict=True))
    us = np.rint(1e6 * t).astype(np.int64)
    order = np.argsort(us, kind="stable")
    x, y = x[order].astype(np.uint16), y[order].astype(np.uint16)
    return Recording("rendered", W, H, Events(us[order], x, y, p[order]))


def score(found: TargetSearchResult, scene: Scene) -> str:
    """Found of all targets, tracks, false ones, IDF1."""
    times = np.linspace(0, 1e6 * scene.duration - 1, TIMES + 2)[1:-1].astype(np.int64)
    truth = scene.places(1e-6 * times)
    inside = np.asarray(((truth >= 0) & (truth < (W, H))).all(-1))
    told = np.full((TIMES, len(found), 2), np.nan)
    for k, path in enumerate(found.paths):
        now = (times >= path.begin) & (times < path.end)
        told[now, k] = path.at(times[now])
    reach = np.full(truth.shape[:2], float(scene.reach))
    one = score_tracks(np.where(inside[..., None], truth, np.nan), told, reach, hidden=~inside)
    moves = ", the camera moves" if found.camera_moves else ""
    return f"{one.found}/{one.targets}, {one.tracks}, {one.false}, {one.idf1:.2f}{moves}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--first", type=int, default=10)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES))
    args = parser.parse_args()
    seeds = range(args.first, args.first + args.seeds)
    lines = ["| scene | " + " | ".join(f"seed {seed}" for seed in seeds) + " |"]
    lines += ["|---|" + "---|" * len(seeds)]
    for name in args.scenes:
        cells = []
        for seed in seeds:
            rng = np.random.default_rng([seed, 131])
            scene = SCENES[name](rng)
            cells.append(score(find(record(scene, rng), progress=False), scene))
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    args.out.mkdir(parents=True, exist_ok=True)
    text = "found/targets, tracks, false tracks, IDF1\n\n" + "\n".join(lines) + "\n"
    (args.out / "table.md").write_text(text)


if __name__ == "__main__":
    main()
