"""Egomotion on real recordings, against what is known of them.

    python experiments/egomotion_real.py --data FOLDER --out real [--only disk slider ...]
        [--without-frames]

FOLDER holds rotating_disk_imu.npz, tubrip_boxes_rotation.npz, tubrip_shapes_rotation.npz,
evbench_seq3_calibrated.npz and slider_depth.zip. Parameters are those that suit the recordings by
themselves, but for those named here:

- disk: a camera rolls before a disk. Every 30 ms the roll rate against the gyro's (mean over the
  same 30 ms, in y-up axes). The lens is not known; f = 200 px is assumed, which a roll does not
  see.
- boxes, shapes: 13 and 99 ms of hand-held rotation, one angular velocity known for each. Contrast
  maximisation, in windows of the cut's length and of half of it, and voting where the cut is longer
  than its start-up.
- evbench: constant motion, known from a chessboard in the frames (heading to about 5 degrees, Omega
  to 3 %). Beside the errors of Omega: how far off that rotation is whose flow is nearest, at the
  events, to the true flow before the board, and what flow that leaves. It is the best Omega
  where no translation is told.
- slider: pure translation along the slider, Omega 0. Planar voting: the direction of the image's
  motion, 180 degrees. General motion: heading and |Omega| from window to window.
- cuts: cuts of 400 ms of the slider's way, each as a recording of its own: heading in the middle,
  what it tells, and the worst heading of the cut.
- stop: the end of the slider's way, which slows down, stands still from 3.22 to 3.31 s and goes
  back. How far the heading is from that of the motion there, and what it tells.

With --without-frames general motion of evbench and the slider is fitted to events alone. Prints
tables in Markdown and writes them.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from common import command_line, machine, table_of_rows

import jaxevent
from jaxevent import egomotion
from jaxevent.camera import PinholeCamera
from jaxevent.egomotion import batch, contrast, geometry, voting
from jaxevent.egomotion.bundle.windows import stamp_offset
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.motion import is_observable

Rows = list[dict[str, Any]]
AXIS = np.array([1.0, 0.0088, 0.0]) / np.hypot(1.0, 0.0088)  # of the slider
CUT_S = 0.4  # s, of the slider's way


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return egomotion.scores.axis_error(np.atleast_2d(a), np.atleast_2d(b))


def disk_rows(data: Path) -> Rows:
    recording = jaxevent.load(data / "rotating_disk_imu.npz")
    middle = (recording.width - 1) / 2, (recording.height - 1) / 2
    camera = PinholeCamera(200.0, 200.0, *middle)
    imu = recording.imu
    assert imu is not None
    times = np.arange(recording.start + 200_000, recording.stop - 30_000, 30_000)
    gyro = np.array(
        [-imu.gyro[(imu.t >= t - 15_000) & (imu.t < t + 15_000), 2].mean() for t in times]
    )
    rows: Rows = []
    for name, motion in (
        ("voting", voting.estimate(recording, model="rotation", camera=camera)),
        (
            "voting, causal",
            voting.estimate(recording, model="rotation", camera=camera, causal=True),
        ),
        ("contrast", contrast.estimate(recording, model="rotation", camera=camera)),
    ):
        mean, _, valid = motion(times, extrapolate=True)
        lost = ~valid
        error = 100 * np.abs(mean[:, 2] - gyro) / np.abs(gyro)
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


def tubrip_rows(data: Path, name: str) -> Rows:
    recording = jaxevent.load(data / f"tubrip_{name}_rotation.npz")
    omega = np.asarray(recording.extra["omega"])
    length = (recording.stop - recording.start) * 1e-6
    rows: Rows = []
    found: list[tuple[str, egomotion.MotionEstimate]] = []
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
        rows.append(
            {
                "recording": name,
                "method": method,
                "estimates": len(kept),
                "omega rad/s": " ".join(f"{v:+.3f}" for v in mean),
                "true": " ".join(f"{v:+.3f}" for v in omega),
                "angle deg": angle(mean, omega)[0],
                "|omega| / true": np.linalg.norm(mean) / np.linalg.norm(omega),
            }
        )
    return rows


def nearest_rotation(
    recording: jaxevent.Recording, twist: np.ndarray, depth: float
) -> tuple[np.ndarray, float, float]:
    """Omega (rad/s) whose flow at the events is nearest to a twist's, before one depth (m).

    And the rms (px/s) of its flow and of what it leaves.
    """
    camera, e = recording.camera, recording.events[:]
    assert camera is not None
    positions, f = pixel_coordinates(recording.width, recording.height, camera)
    xi = positions[e.y, e.x]
    flow = np.asarray(geometry.flow(xi[:, 0], xi[:, 1], f, twist[:3], twist[3:], 1 / depth))
    basis = np.asarray(geometry.rotation_basis(xi, f)).reshape(-1, 3)
    Omega = np.linalg.lstsq(basis, flow.ravel(), rcond=None)[0]
    moved = basis @ Omega
    rms = [float(np.sqrt(2 * (part**2).mean())) for part in (moved, flow.ravel() - moved)]
    return Omega, rms[0], rms[1]


def fit_general_motion(recording: jaxevent.Recording, frames: bool) -> egomotion.MotionEstimate:
    """General motion without settings, to events alone if told so."""
    params = batch.Params.of({"frames": frames})
    suited = batch.adapt_params(recording, params, camera=recording.camera).params
    return batch.estimate(recording, suited)


def evbench_rows(data: Path, frames: bool = True) -> Rows:
    recording = jaxevent.load(data / "evbench_seq3_calibrated.npz")
    twist = np.asarray(recording.extra["camera_twist_pnp"])
    motion = fit_general_motion(recording, frames)
    mean, covariance = motion.mean[motion.valid], motion.covariance[motion.valid]
    turn = np.linalg.norm(mean[:, 3:] - twist[3:], axis=1) / np.linalg.norm(twist[3:])
    heading = angle(mean[:, :3], np.broadcast_to(twist[:3], mean[:, :3].shape))
    sigma = np.degrees(np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2)))
    nearest, moved, left = nearest_rotation(recording, twist, float(recording.extra["depth_pnp"]))
    size = np.linalg.norm(twist[3:])
    off = np.linalg.norm(mean[:, 3:] - nearest, axis=1)
    squares = (mean[:, 3:] - twist[3:]) ** 2 / np.diagonal(covariance, axis1=1, axis2=2)[:, 3:]
    return [
        {
            "recording": "evbench_seq3",
            "method": "batch",
            "estimates": len(mean),
            "heading deg, median": np.median(heading),
            "its sigma": np.median(sigma),
            "undecided %": 100 * (sigma > 57).mean(),
            "frames late by ms": 1e-3 * stamp_offset(recording),
            "Omega %, median": 100 * np.median(turn),
            "max": 100 * turn.max(),
            "Omega, mean error": _numbers((mean[:, 3:] - twist[3:]).mean(0)),
            "its sigma, of one": _numbers(mean[:, 3:].std(0)),
            "errors per sigma, squared": _numbers(squares.mean(0)),
            "nearest rotation, error": _numbers(nearest - twist[3:]),
            "in %": 100 * np.linalg.norm(nearest - twist[3:]) / size,
            "its flow, px/s": moved,
            "flow left, px/s": left,
            "Omega from it, %, median": 100 * np.median(off) / size,
        }
    ]


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:+.4f}" for value in values)


def slider_rows(data: Path, frames: bool = True) -> Rows:
    recording = jaxevent.load(data / "slider_depth.zip")
    rows: Rows = []
    motion = voting.estimate(recording, model="planar")
    times = np.arange(recording.start + 400_000, 3_200_000, 20_000)
    mean, _, valid = motion(times, extrapolate=True)
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
    motion = fit_general_motion(recording[:3.1], frames)
    late = 1e-3 * stamp_offset(recording)
    for first, last in ((0.0, 1.0), (1.0, 2.0), (2.0, 3.1)):
        here = motion.valid & (motion.t >= 1e6 * first) & (motion.t < 1e6 * last)
        mean, covariance = motion.mean[here], motion.covariance[here]
        heading = angle(mean[:, :3], np.broadcast_to(AXIS, (len(mean), 3)))
        turn = np.linalg.norm(mean[:, 3:], axis=1)
        squares = (mean - [*AXIS, 0, 0, 0]) ** 2 / np.diagonal(covariance, axis1=1, axis2=2)
        rows.append(
            {
                "recording": f"slider, {first} to {last} s",
                "method": "batch",
                "estimates": len(mean),
                "frames late by ms": late,
                "lost": int((motion.t[~motion.valid] // 1e6 == first).sum()),
                "undecided": int((~is_observable("general", covariance)[:, 0]).sum()),
                "heading deg, median": np.median(heading),
                "worst": heading.max(),
                "|Omega| deg/s, median": np.degrees(np.median(turn)),
                "worst of these": np.degrees(turn.max()),
                "errors per sigma, squared, ty to wz": " ".join(
                    f"{value:.1f}" for value in squares[:, 1:].mean(0)
                ),
            }
        )
    return rows


def cut_rows(data: Path, frames: bool = True) -> Rows:
    recording = jaxevent.load(data / "slider_depth.zip")
    rows: Rows = []
    for first in np.arange(0.0, 2.8, CUT_S):
        cut = recording[first : first + CUT_S]
        motion = fit_general_motion(cut, frames)
        heading = angle(motion.mean[:, :3], np.broadcast_to(AXIS, (len(motion), 3)))
        middle = np.abs(motion.t - (cut.start + cut.stop) / 2).argmin()
        sigma = np.degrees(np.sqrt(np.diag(motion.covariance[middle])[:3]))
        beside = np.degrees(motion.mean[middle, :3] - AXIS)
        rows.append(
            {
                "recording": f"slider, {first:.1f} to {first + CUT_S:.1f} s",
                "estimates": len(motion),
                "heading deg, middle": heading[middle],
                "ty, tz deg": f"{beside[1]:+.2f} {beside[2]:+.2f}",
                "their sigmas": f"{sigma[1]:.2f} {sigma[2]:.2f}",
                "worst": heading.max(),
                "agreement": motion.agreement[middle] if motion.agreement is not None else np.nan,
            }
        )
    return rows


def stop_rows(data: Path, frames: bool = True) -> Rows:
    recording = jaxevent.load(data / "slider_depth.zip")
    motion = fit_general_motion(recording[2.9:], frames)
    sigma = np.degrees(np.sqrt(np.trace(motion.covariance[:, :3, :3], axis1=1, axis2=2)))
    rows: Rows = []
    for name, first, last, along in (
        ("slows down", 2.9, 3.18, AXIS),
        ("stands still", 3.22, 3.31, None),
        ("goes back", 3.31, 3.5, -AXIS),
    ):
        here = motion.valid & (motion.t >= 1e6 * first) & (motion.t < 1e6 * last)
        row = {"recording": f"slider {name}", "method": "batch", "estimates": int(here.sum())}
        if along is not None:
            heading = angle(motion.mean[here, :3], np.broadcast_to(along, (int(here.sum()), 3)))
            row |= {"heading deg, median": np.median(heading), "worst": heading.max()}
        rows.append(row | {"sigma, least": sigma[here].min(), "most": sigma[here].max()})
    return rows


FITTED = "evbench", "slider", "cuts", "stop"  # by `batch`, which takes frames
PARTS: dict[str, Callable[..., Rows]] = {
    "disk": disk_rows,
    "boxes": lambda data: tubrip_rows(data, "boxes"),
    "shapes": lambda data: tubrip_rows(data, "shapes"),
    "evbench": evbench_rows,
    "slider": slider_rows,
    "cuts": cut_rows,
    "stop": stop_rows,
}


def main() -> None:
    parser = command_line(__doc__, out=True, data=True, parts=PARTS)
    parser.add_argument("--without-frames", action="store_true")
    arguments = parser.parse_args()
    for name in arguments.only:
        more = {"frames": False} if arguments.without_frames and name in FITTED else {}
        text = table_of_rows(PARTS[name](arguments.data, **more))
        print(f"\n## {name}\n\n{text}", flush=True)
        (arguments.out / f"{name}.md").write_text(text)
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
