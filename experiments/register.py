"""Simulated two-camera rigs: how well `jaxevent.register` finds grid and clock, and what it is for.

    python experiments/register.py                # all seeds: about 20 minutes on two shared cores
    python experiments/register.py --seeds 1

Far scenes: a panorama of 2.5 decades, of which frames clip a part, seen by a moving event camera
(128x96, the sensor "davis") and by another one (200x150, 50 frames/s) that is turned, sheared,
shifted and scaled against it, with a clock up to 0.3 s off. Nothing is known. Near scenes: a wall
at 2 m seen by two cameras 10 cm apart with distorted lenses; the calibration is known, the clock is
not. Errors of the grid are in pixels of the event camera, rms over its pixels that are seen. The
reconstruction's error is that of `akf` with the sensor's thresholds, at times between frames, as
ln(I + 0.003), before (frames scaled to the sensor, clocks taken to agree) and after.
"""

import argparse
import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

import jaxevent
from jaxevent import register
from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.geometry import centred_coordinates
from jaxevent.recording import Events, Frames, Recording
from jaxevent.simulate import (
    SENSORS,
    BoxWorld,
    CameraMotion,
    Pan,
    Sensor,
    make_texture,
    planar_motion,
    scene,
    simulate,
)
from jaxevent.simulate.hybrid import expose, frame_times

SCENES = (("lake", "slow"), ("room", "fast"), ("forest", "slow"), ("night", "fast"))


@dataclasses.dataclass(frozen=True, eq=False)
class PanoramaView:
    """View of a panorama whose pixels are `homography` of those of a `Pan`."""

    pan: Pan
    homography: NDArray[np.float64]
    size: tuple[int, int]

    @property
    def duration(self) -> float | int:
        return self.pan.duration

    def intensity(self, t: float | int) -> NDArray[np.float64]:
        y, x = np.mgrid[: self.size[1], : self.size[0]]
        u, v, w = np.linalg.inv(self.homography) @ np.stack(
            [x.ravel(), y.ravel(), 1 + 0 * x.ravel()]
        )
        width, height = self.pan.size
        (left, top), roll, zoom = self.pan.pose(t)
        across, down = (u / w - (width - 1) / 2) * zoom, (v / w - (height - 1) / 2) * zoom
        cos, sin = np.cos(roll), np.sin(roll)
        at = [top + sin * across + cos * down, left + cos * across - sin * down]
        level = map_coordinates(self.pan._spline, at, order=3, mode="grid-wrap", prefilter=False)
        return np.exp(level).reshape(y.shape)


@dataclasses.dataclass(frozen=True, eq=False)
class CameraView:
    """View of a camera with a distorted lens, at `rotation`, `translation` from a moving one."""

    world: BoxWorld
    motion: CameraMotion
    camera: PinholeCamera
    size: tuple[int, int]
    duration: float | int
    rotation: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.eye(3))
    translation: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.zeros(3))
    _ray: NDArray[np.float64] = dataclasses.field(init=False, repr=False)

    def __post_init__(self) -> None:
        y, x = np.mgrid[: self.size[1], : self.size[0]].reshape(2, -1)
        at, f = centred_coordinates(self.camera, x, y)
        ray = np.concatenate([at / f, np.ones((len(at), 1))], 1) @ self.rotation
        object.__setattr__(self, "_ray", ray)

    def intensity(self, t: float | int) -> NDArray[np.float64]:
        pose = self.motion.pose(np.array([float(t)]))[0]
        centre = pose[:3, 3] - pose[:3, :3] @ self.rotation.T @ self.translation
        level, _ = self.world.render(centre, self._ray @ pose[:3, :3].T, 1 / self.camera.fx)
        return np.exp(level).reshape(self.size[::-1]) / 3  # even ground is a third of white


def frames_of(source: Any, sensor: Sensor, offset: float, seed: int) -> Recording:
    """Return a recording of frames only, whose clock is `offset` s behind."""
    stamps = frame_times(source.duration, sensor)
    images, _ = expose(source.intensity, stamps, sensor, np.random.default_rng([seed, 7]))
    exposure = np.full(len(stamps), round(sensor.exposure * 1e6), np.int64)
    frames = Frames(stamps - round(offset * 1e6), images, exposure)
    width, height = source.size
    return Recording("frames", width, height, Events.empty(), frames)


def far_rig(
    seed: int,
    name: str = "lake",
    speed: Any = "slow",
    size: tuple[int, int] = (128, 96),
    other: tuple[int, int] = (200, 150),
    duration: float = 1.5,
    sensor: Sensor = SENSORS["davis"],
) -> tuple[Pan, Recording, Recording, NDArray[np.float64], float]:
    """Return source, events, frames, and the true homography and offset."""
    rng = np.random.default_rng([seed, 3])
    pan = Pan(scene(name, 2.5), size, duration, speed, seed)
    turn = rng.normal(0, 0.05)
    whole = np.eye(3)
    whole[:2, :2] = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    whole[:2, :2] = (
        0.85 * other[0] / size[0] * whole[:2, :2] @ (np.eye(2) + rng.normal(0, 0.02, (2, 2)))
    )
    whole[2, :2] = rng.normal(0, 2e-4, 2)
    here, there = np.eye(3), np.eye(3)
    here[:2, 2] = (1 - np.array(size)) / 2
    there[:2, 2] = (np.array(other) - 1) / 2 + rng.normal(0, 4, 2)
    homography = there @ whole @ here
    homography /= homography[2, 2]
    offset = float(rng.uniform(-0.3, 0.3))
    seen = frames_of(PanoramaView(pan, homography, other), sensor, offset, seed)
    recording = simulate(pan, sensor, seed)
    seen = dataclasses.replace(
        seen, extra={k: recording.extra[k] for k in ("response", "certainty")}
    )
    return pan, recording, seen, homography, offset


def near_rig(
    seed: int, duration: float = 1.0, shrink: float | int = 1, exposure_samples: int = 8
) -> tuple[CameraView, CameraView, Recording, Recording, register.Rig, float]:
    """Return both views, events, frames, the rig and the true offset; the wall is at 2 m."""
    rng = np.random.default_rng([seed, 5])
    one = (110.0, 111.0, 63.0, 48.5), (-0.2, 0.05, 1e-3, -5e-4, 0.0)
    two = (160.0, 160.0, 101.0, 74.0), (-0.15, 0.03, -1e-3, 1e-3, 0.0)
    one, two = (
        PinholeCamera(fx / shrink, fy / shrink, cx / shrink, cy / shrink, lens)
        for (fx, fy, cx, cy), lens in (one, two)
    )
    sizes = [(round(w / shrink), round(h / shrink)) for w, h in ((128, 96), (200, 150))]
    rotation = Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix()
    rig = register.Rig(one, two, rotation, np.array([-0.1, 0.01, 0.0]))
    texture = make_texture("noise", 0.012 * shrink, seed, 2.0)
    world = BoxWorld((-4.0, -4.0, -3.0), (4.0, 4.0, 2.0), texture)
    motion = planar_motion(
        (20, -15), 2.0, one.fx, amplitude=(60, 90), frequency=1.3, phase=float(rng.uniform(0, 6))
    )
    source = CameraView(world, motion, one, sizes[0], duration)
    other = CameraView(world, motion, two, sizes[1], duration, rotation, rig.translation)
    sensor = dataclasses.replace(
        SENSORS["davis"],
        response=jaxevent.camera.UnknownResponse(),
        exposure_samples=exposure_samples,
    )
    offset = float(rng.uniform(-0.2, 0.2))
    seen = frames_of(other, sensor, offset, seed)
    recording = dataclasses.replace(simulate(source, sensor, seed), camera=one)
    return source, other, recording, seen, rig, offset


def grid_error(found: NDArray, true: NDArray) -> float:
    """rms px of the event camera, over pixels that both see."""
    area = np.gradient(true[..., 0], axis=1) * np.gradient(true[..., 1], axis=0)
    area -= np.gradient(true[..., 0], axis=0) * np.gradient(true[..., 1], axis=1)
    off = np.linalg.norm(found - true, axis=-1) / np.sqrt(np.nanmedian(np.abs(area)))
    return float(np.sqrt(np.nanmean(off**2)))


def reconstruction_error(recording: Recording, covered: NDArray[np.bool_]) -> float:
    """Mean squared error of ln(I + 0.003) of the AKF, at the times of `extra["hdr_t"]`."""
    params = jaxevent.akf.Params(preset="hdr", c_on=0.2, c_off=0.18)
    image, _, _ = jaxevent.akf.estimate(recording, params)(recording.extra["hdr_t"])
    truth = np.asarray(recording.extra["hdr"], np.float64)
    error = jaxevent.metrics.log_mse(image.astype(np.float64), truth, where=covered)
    return float(np.mean(error))


def register_by_scale(recording: Recording, other: Recording) -> Recording:
    """Return the other camera's images scaled to the sensor, clocks taken to agree."""
    scale = np.diag([other.width / recording.width, other.height / recording.height, 1.0])
    grid = register.homography_grid(
        scale, (recording.width, recording.height), (other.width, other.height)
    )
    return register.apply_registration(recording, other, register.Registration(grid, 0.0, scale))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    seeds = range(parser.parse_args().seeds)
    print("| far scene | seed | grid px | clock ms | agreement | log MSE before | after |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name, speed in SCENES:
        for seed in seeds:
            _, recording, other, H, offset = far_rig(seed, name, speed)
            try:
                found = register.estimate(recording, other)
            except jaxevent.InputError as error:
                print(f"| {name} {speed} | {seed} | refused: {error} |", flush=True)
                continue
            size, seen = (recording.width, recording.height), (other.width, other.height)
            true = register.homography_grid(H, size, seen)
            after = register.apply_registration(recording, other, found)
            covered = after.extra["covered"]
            before = reconstruction_error(register_by_scale(recording, other), covered)
            later = reconstruction_error(after, covered)
            print(
                f"| {name} {speed} | {seed} | {grid_error(found.grid, true):.3f} "
                f"| {1e3 * (found.offset - offset):+.2f} | {found.agreement:.3f} "
                f"| {before:.3f} | {later:.3f} |",
                flush=True,
            )
    print("\n| near scene | seed | clock ms | agreement | log MSE before | after |")
    print("|---|---:|---:|---:|---:|---:|")
    for seed in seeds:
        _, _, recording, other, rig, offset = near_rig(seed)
        size, seen = (recording.width, recording.height), (other.width, other.height)
        grid = rig.grid(size, seen, plane=(0, 0, 1, 2.0))
        found = register.estimate(recording, other, grid)
        after = register.apply_registration(recording, other, found)
        covered = after.extra["covered"]
        before = reconstruction_error(register_by_scale(recording, other), covered)
        later = reconstruction_error(after, covered)
        print(
            f"| wall | {seed} | {1e3 * (found.offset - offset):+.2f} | {found.agreement:.3f} "
            f"| {before:.3f} | {later:.3f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
