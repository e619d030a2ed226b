"""Egomotion on real recordings, against what is known of them.

    python experiments/egomotion_real.py --data FOLDER --out real [--only disk slider ...]

FOLDER holds rotating_disk_imu.npz, tubrip_boxes_rotation.npz, tubrip_shapes_rotation.npz,
evbench_seq3.npz and slider_depth.zip. All parameters are the defaults but those named here:

- disk: a camera rolls before a disk. Every 30 ms the roll rate against the gyro's (mean over the
  same 30 ms; its sign is that of the best fit, its bias is not known). The lens is not known
  either; f = 200 px is assumed, which a roll does not see.
- boxes, shapes: 13 and 99 ms of hand-held rotation, one angular velocity stated for each, its sign
  convention not: the angle to it or to its negative. Contrast maximisation, in windows of the cut's
  length and of half of it, and voting where the cut is longer than its start-up.
- evbench: constant known motion, f = 211 px, centre (94.5, 89.5) assumed. Beside it, if OpenCV is
  there (the extra 'vision'), the constant twist that fits the corners of the chessboard in its 16
  frames best, for three focal lengths; the frames' rate is not known, so |Omega| is not compared.
- slider: pure translation to the right. Planar voting: the direction of the image's motion, 180
  degrees. General motion: heading and |Omega| in windows of 400 ms, without and with the prior that
  |Omega| is small (`omega_scale`).

Prints tables in Markdown and writes them.
"""

import argparse
import dataclasses
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

import jaxevent
from jaxevent import egomotion
from jaxevent.camera import PinholeCamera
from jaxevent.egomotion import batch, contrast, voting
from jaxevent.egomotion.geometry import rotation_exp, twist_exp
from jaxevent.errors import InputError, require

Rows = list[dict[str, Any]]


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return egomotion.truth.axis_error(np.atleast_2d(a), np.atleast_2d(b))


def disk(data: Path) -> Rows:
    recording = jaxevent.load(data / "rotating_disk_imu.npz")
    middle = (recording.width - 1) / 2, (recording.height - 1) / 2
    camera = PinholeCamera(200.0, 200.0, *middle)
    imu = recording.imu
    assert imu is not None
    times = np.arange(recording.start + 200_000, recording.stop - 30_000, 30_000)
    gyro = np.array(
        [imu.gyro[(imu.t >= t - 15_000) & (imu.t < t + 15_000), 2].mean() for t in times]
    )
    rows: Rows = []
    for name, motion in (
        ("voting", voting.estimate(recording, model="rotation", camera=camera)),
        (
            "voting, smoothed",
            voting.estimate(recording, model="rotation", camera=camera, smooth=True),
        ),
        ("contrast", contrast.estimate(recording, model="rotation", camera=camera)),
    ):
        mean, _, valid = motion(times, centred="smooth" not in name, extrapolate=True)
        lost = ~valid
        sign = np.sign((mean[~lost, 2] * gyro[~lost]).sum())
        error = 100 * np.abs(sign * mean[:, 2] - gyro) / np.abs(gyro)
        failed = lost | (error > 20)
        rows.append(
            {
                "recording": "disk",
                "method": name,
                "windows": len(times),
                "median error %": np.median(error[~lost]),
                "mean error %": error[~lost].mean(),
                "90 % below, %": np.percentile(error[~lost], 90),
                "lost": int(lost.sum()),
                "above 20 % or lost, at s": " ".join(f"{t * 1e-6:.2f}" for t in times[failed]),
                "|wx|, |wy| rad/s": np.abs(mean[~lost, :2]).mean(),
            }
        )
    return rows


def tubrip(data: Path, name: str) -> Rows:
    recording = jaxevent.load(data / f"tubrip_{name}_rotation.npz")
    omega = np.asarray(recording.extra["omega"])
    length = (recording.stop - recording.start) * 1e-6
    rows: Rows = []
    found: list[tuple[str, egomotion.Motion]] = []
    for share in (1.0, 0.5):
        values = {"duration": float(share * length), "events": 30000}
        found.append(
            (
                f"contrast, {1e3 * share * length:.0f} ms",
                contrast.estimate(recording, contrast.Params.of(values), model="rotation"),
            )
        )
    if length > 0.05:
        values = {"tau_max": 0.03, "every": 2}
        found.append(
            (
                "voting, tau_max 30 ms, every 2nd event",
                voting.estimate(recording, voting.Params.of(values), model="rotation"),
            )
        )
    for method, motion in found:
        kept = motion.mean[motion.valid]
        if not len(kept):
            rows.append({"recording": name, "method": method, "estimates": 0})
            continue
        mean = np.median(kept[len(kept) // 2 :] if "voting" in method else kept, axis=0)
        both = angle(mean, omega)[0], angle(mean, -omega)[0]
        rows.append(
            {
                "recording": name,
                "method": method,
                "estimates": len(kept),
                "omega rad/s": " ".join(f"{v:+.3f}" for v in mean),
                "stated": " ".join(f"{v:+.3f}" for v in omega),
                "angle to it, deg": both[0],
                "to its negative": both[1],
                "|omega| / stated": np.linalg.norm(mean) / np.linalg.norm(omega),
            }
        )
    return rows


def evbench(data: Path) -> Rows:
    recording = jaxevent.load(data / "evbench_seq3.npz")
    recording = dataclasses.replace(recording, camera=PinholeCamera(211.0, 211.0, 94.5, 89.5))
    omega = np.asarray(recording.extra["rvec_rad_per_50ms"]) / 0.05
    T = np.asarray(recording.extra["tvec_per_50ms"])
    rows: Rows = []
    motion = batch.estimate(recording)
    for sign, convention in ((1, "camera's twist"), (-1, "scene's twist")):
        mean = motion.mean[motion.valid]
        turn = np.degrees(np.linalg.norm(mean[:, 3:] - sign * omega, axis=1))
        heading = angle(mean[:, :3], np.broadcast_to(sign * T, mean[:, :3].shape))
        rows.append(
            {
                "recording": "evbench_seq3",
                "method": f"batch, taken for the {convention}",
                "windows": len(mean),
                "heading deg, median": np.median(heading),
                "max": heading.max(),
                "|dOmega| deg/s, median": np.median(turn),
                "max ": turn.max(),
                "|Omega| deg/s": np.degrees(np.linalg.norm(omega)),
            }
        )
    return rows + board(recording, T, omega)


def board(recording: jaxevent.Recording, T: np.ndarray, omega: np.ndarray) -> Rows:
    """What a chessboard in the frames of evbench tells of the motion, without any event."""
    try:
        cv2 = require("cv2", "vision")
    except InputError:
        return []
    assert recording.frames is not None and recording.camera is not None
    middle = recording.camera.cx, recording.camera.cy
    size = across, down = 9, 6
    seen = []
    for image in np.asarray(recording.frames.images):
        large = cv2.resize(image, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
        found, corners = cv2.findChessboardCornersSB(large, size)
        if found:
            seen.append((corners.reshape(-1, 2) + 0.5) / 4 - 0.5 - middle)
    seen = np.array(seen)
    grid = np.stack(np.meshgrid(np.arange(across), np.arange(down)), -1).reshape(-1, 2)
    grid = np.pad(grid - ((across - 1) / 2, (down - 1) / 2), ((0, 0), (0, 1)))
    times = np.arange(len(seen)) - (len(seen) - 1) / 2

    @jax.jit
    def left(q: jax.Array, f: float) -> jax.Array:
        """px, of the board's pose and the camera's twist, in squares and frames."""
        x = grid @ rotation_exp(q[:3]).T + q[3:6]
        moved = twist_exp(-times[:, None] * q[6:])
        x = jnp.einsum("kij,nj->kni", moved[:, :3, :3], x) + moved[:, None, :3, 3]
        return (f * x[..., :2] / x[..., 2:] - seen).ravel()

    rows: Rows = []
    for f in (170.0, 211.0, 250.0):
        first = np.zeros(12)
        first[3:6] = *seen.mean((0, 1)) / f * 30, 30
        with jax.enable_x64(True):
            slopes: Any = jax.jit(jax.jacfwd(left))
            fit = least_squares(left, first, jac=slopes, args=(f,))
        rows.append(
            {
                "recording": "evbench_seq3",
                "method": f"chessboard of {len(seen)} frames, f = {f:.0f} px",
                "rms px": np.sqrt(2 * np.mean(fit.fun**2)),
                "heading deg, median": angle(fit.x[6:9], T)[0],
                "axis of Omega deg": angle(fit.x[9:], omega)[0],
            }
        )
    return rows


def slider(data: Path) -> Rows:
    recording = jaxevent.load(data / "slider_depth.zip")
    rows: Rows = []
    motion = voting.estimate(recording, model="planar", smooth=True)
    times = np.arange(recording.start + 400_000, 3_200_000, 20_000)
    mean, _, valid = motion(times, centred=True, extrapolate=True)
    lost = ~valid
    direction = np.degrees(np.arctan2(mean[:, 1], -mean[:, 0]))
    rows.append(
        {
            "recording": "slider, planar",
            "method": "voting, smoothed",
            "windows": len(times),
            "mean velocity px/s": " ".join(f"{v:+.1f}" for v in mean[~lost].mean(0)),
            "direction of the mean, deg off": np.degrees(
                np.arctan2(mean[~lost, 1].mean(), -mean[~lost, 0].mean())
            ),
            "of one estimate, median |deg|": np.median(np.abs(direction[~lost])),
            "lost": int(lost.sum()),
        }
    )
    for label, given in (("batch", {}), ("batch, |Omega| prior 0.1 rad/s", {"omega_scale": 0.1})):
        params = batch.Params.of({**given, "half_window": 0.2})
        for centre in np.arange(0.3, 3.1, 0.4):
            cut = recording[float(centre - 0.2) : float(centre + 0.2)]
            found = batch.estimate(cut, params)
            mean, _, valid = found(np.array([round(centre * 1e6)]))
            rows.append(
                {
                    "recording": f"slider, {centre - 0.2:.1f} to {centre + 0.2:.1f} s",
                    "method": label,
                    "heading deg": angle(mean[0, :3], np.array([1.0, 0, 0]))[0],
                    "|Omega| deg/s": np.degrees(np.linalg.norm(mean[0, 3:])),
                    "lost": int(not valid[0]),
                }
            )
    return rows


def table(rows: Rows) -> str:
    names = list(dict.fromkeys(name for row in rows for name in row))

    def text(value: Any) -> str:
        return f"{value:.3g}" if isinstance(value, float | np.floating) else str(value)

    lines = [names, ["---"] * len(names)]
    lines += [[text(row.get(name, "-")) for name in names] for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


PARTS: dict[str, Callable[[Path], Rows]] = {
    "disk": disk,
    "boxes": lambda data: tubrip(data, "boxes"),
    "shapes": lambda data: tubrip(data, "shapes"),
    "evbench": evbench,
    "slider": slider,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of the recordings")
    parser.add_argument("--out", type=Path, required=True, help="folder for tables")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.only:
        text = table(PARTS[name](arguments.data))
        print(f"\n## {name}\n\n{text}", flush=True)
        (arguments.out / f"{name}.md").write_text(text)
    print(f"\n{platform.machine()}, Python {platform.python_version()}")


if __name__ == "__main__":
    main()
