"""Motion of real recordings that are changed in ways whose answer is known.

    python experiments/egomotion_changed.py --out changed --data FOLDER [--only shapes boxes slider]

Without settings, as by `jaxevent motion FILE`: the model is chosen, windows suit the recording.
Each recording is estimated as it is, mirrored, turned by 180 degrees, backwards, three times slower
and faster, 1000 s later, with a third of its events, without frames, at half the width and height,
and without its last quarter. Of the slider it is 0.4 s. Told are the model, how many estimates are
valid, and how far the mean motion, changed back, is from that of the recording as it is: the
largest difference of a component by the usual sigmas of both, the heading's angle (degrees) and the
length of Omega's (degrees/s). Makes table.md.
"""

import argparse
import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import jaxevent
from jaxevent.cli.motion import estimated
from jaxevent.egomotion import MotionEstimate
from jaxevent.egomotion.model_selection import select_model
from jaxevent.errors import InputError
from jaxevent.recording import Events, Frames, Recording
from jaxevent.runs.egomotion import find_estimator

FILES = {
    "shapes": ("tubrip_shapes_rotation.npz", 0.0, None),
    "boxes": ("tubrip_boxes_rotation.npz", 0.0, None),
    "slider": ("slider_depth.zip", 0.5, 0.9),
}
SLOW, LATER = 3, 1_000_000_000  # us
# Signs of T and of Omega, which the motion has in what is changed.
SAME = np.ones(3), np.ones(3)
MIRRORED = np.array([-1.0, 1, 1]), np.array([1.0, -1, -1])
TURNED = np.array([-1.0, -1, 1]), np.array([-1.0, -1, 1])
BACK = -np.ones(3), -np.ones(3)
Change = tuple[str, Callable[[Recording], Recording], tuple[NDArray, NDArray], float]


def timed(recording: Recording, change: Callable[[NDArray], NDArray]) -> Recording:
    """With other times; backwards, where they fall, with polarities exchanged."""
    e, frames = recording.events[:], recording.frames
    t = change(e.t).astype(np.int64)
    back = t[0] > t[-1]
    order = np.argsort(t, kind="stable")
    events = Events(t[order], e.x[order], e.y[order], (e.p ^ back)[order])
    if frames is not None:
        at = change(frames.t).astype(np.int64)
        which = np.argsort(at, kind="stable")
        frames = Frames(at[which], np.asarray(frames.images)[which], frames.exposure[which])
    return dataclasses.replace(recording, events=events, frames=frames)


def flipped(recording: Recording, down: bool) -> Recording:
    """Mirrored, and if `down` from top to bottom too."""
    e, frames, camera = recording.events[:], recording.frames, recording.camera
    assert camera is not None
    x, y = recording.width - 1 - e.x, recording.height - 1 - e.y if down else e.y
    k1, k2, p1, p2, k3 = camera.distortion
    cy, p1 = (recording.height - 1 - camera.cy, -p1) if down else (camera.cy, p1)
    camera = dataclasses.replace(
        camera, cx=recording.width - 1 - camera.cx, cy=cy, distortion=(k1, k2, p1, -p2, k3)
    )
    if frames is not None:
        images = np.asarray(frames.images)[:, :: -1 if down else 1, ::-1]
        frames = Frames(frames.t, np.ascontiguousarray(images), frames.exposure)
    events = Events(e.t, x.astype(e.x.dtype), y.astype(e.y.dtype), e.p)
    return dataclasses.replace(recording, events=events, frames=frames, camera=camera)


def halved(recording: Recording) -> Recording:
    """Events alone, at half the width and height."""
    e, camera = recording.events[:], recording.camera
    assert camera is not None
    fx, fy, cx, cy = camera.fx / 2, camera.fy / 2, (camera.cx - 0.5) / 2, (camera.cy - 0.5) / 2
    camera = dataclasses.replace(camera, fx=fx, fy=fy, cx=cx, cy=cy)
    events = Events(e.t, e.x // 2, e.y // 2, e.p)
    width, height = recording.width // 2, recording.height // 2
    return dataclasses.replace(
        recording, width=width, height=height, events=events, frames=None, camera=camera
    )


def thinned(recording: Recording) -> Recording:
    e, keep = recording.events[:], np.arange(0, len(recording.events), 3)
    events = Events(e.t[keep], e.x[keep], e.y[keep], e.p[keep])
    return dataclasses.replace(recording, events=events)


def shortened(recording: Recording) -> Recording:
    """Without its last quarter."""
    first, last = recording.events[:1].t[0], recording.events[-1:].t[0]
    return recording[first * 1e-6 : (first + 3 * last) / 4 * 1e-6]


def changes() -> Iterator[Change]:
    """Names, changes, signs of the motion, and how many times faster it is."""
    yield "as it is", lambda r: r, SAME, 1.0
    yield "mirrored", lambda r: flipped(r, False), MIRRORED, 1.0
    yield "turned by 180 degrees", lambda r: flipped(r, True), TURNED, 1.0
    yield "backwards", lambda r: timed(r, lambda t: r.start + r.stop - t), BACK, 1.0
    yield "three times slower", lambda r: timed(r, lambda t: SLOW * (t - r.start)), SAME, 1 / SLOW
    yield "three times faster", lambda r: timed(r, lambda t: (t - r.start) // SLOW), SAME, SLOW
    yield "1000 s later", lambda r: timed(r, lambda t: t + LATER), SAME, 1.0
    yield "a third of its events", thinned, SAME, 1.0
    yield "without frames", lambda r: dataclasses.replace(r, frames=None), SAME, 1.0
    yield "half the size", halved, SAME, 1.0
    yield "without its end", shortened, SAME, 1.0


def told(recording: Recording) -> MotionEstimate | None:
    """As by the command, with all its choices; None where nothing is seen to move."""
    with contextlib.redirect_stdout(None):
        try:
            kind = select_model(recording).model
        except InputError:
            return None
        settings = {"model": kind, "seed": 0}
        method, no_gyro = find_estimator(kind.method), (False, None, None)
        return estimated(method, recording, None, settings, no_gyro, True)[1]


def usual(
    motion: MotionEstimate, signs: tuple[NDArray, NDArray], faster: float
) -> tuple[NDArray, NDArray]:
    """The mean motion and its usual sigmas, changed back."""
    told = motion.valid
    by = np.concatenate(signs) if motion.mean.shape[1] == 6 else signs[1]
    by = by * np.append(np.ones(by.size - 3), np.full(3, 1 / faster))
    mean = motion.mean[told].mean(0) * by
    sigma = np.sqrt(np.median(np.diagonal(motion.covariance[told], axis1=1, axis2=2), 0))
    return mean, sigma * np.abs(by)


def compared(name: str, recording: Recording) -> Iterator[dict[str, Any]]:
    first, sigmas = np.zeros(0), np.zeros(0)
    for change, make, signs, faster in changes():
        if change == "without frames" and recording.frames is None:
            continue
        motion = told(make(recording))
        row = {"recording": name, "change": change}
        if motion is None:
            yield row | {"model": "nothing is seen to move"}
            continue
        row["model"] = motion.model.title
        row["valid"] = f"{motion.valid.sum()} of {len(motion.t)}"
        if not motion.valid.any() or (first.size and motion.mean.shape[1] != first.size):
            yield row
            continue
        mean, sigma = usual(motion, signs, faster)
        if not first.size:
            first, sigmas = mean, sigma
        off = np.abs(mean - first) / np.hypot(sigma, sigmas)
        row["in sigmas"] = f"{off.max():.1f}"
        if len(mean) == 6:
            heading = mean[:3] @ first[:3] / np.linalg.norm(mean[:3]) / np.linalg.norm(first[:3])
            row["heading, deg"] = f"{np.degrees(np.arccos(min(heading, 1.0))):.1f}"
        turn = np.linalg.norm(mean[-3:] - first[-3:])
        row["Omega, deg/s"] = f"{np.degrees(turn):.2g}"
        yield row


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for table.md")
    parser.add_argument("--data", type=Path, required=True, help="folder of the recordings")
    parser.add_argument("--only", nargs="+", choices=FILES, default=list(FILES))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    names = "recording", "change", "model", "valid", "in sigmas", "heading, deg", "Omega, deg/s"
    lines = [f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    print("\n".join(lines), flush=True)
    for name in arguments.only:
        file, begin, end = FILES[name]
        recording = jaxevent.load(arguments.data / file)
        part = recording if end is None else recording[begin:end]
        for row in compared(name, part):
            lines.append(f"| {' | '.join(str(row.get(one, '-')) for one in names)} |")
            print(lines[-1], flush=True)
    (arguments.out / "table.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
