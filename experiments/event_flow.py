"""Measure dense flow from events against true flow, beside tiles' contrast and fitted planes.

    python experiments/event_flow.py [--seeds 2] [--scenes objects,slider] [--real]

Median end-point error (px/s) and share below 1 px in 20 ms, at pixels with events, at all, and
within 5 px of borders of objects. Baselines have the window of the method. Tiles search up to 1.2
times the largest true speed, and between the speeds tried by a parabola; their flow is of 28 px,
of scores smoothed over neighbours. Planes' is pooled over 6 px by least squares. With --real:
slider_depth, angles to the direction of its poses, and speeds against features tracked through its
frames. With --speed: cost of sensors of three sizes.
"""

import argparse
import itertools
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter, median_filter, zoom
from tile_images import tile_scores

import jaxevent
from jaxevent.egomotion.baselines.planes import normal_flow
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.truth import twists_from_poses
from jaxevent.simulate import SENSORS, MovingObjects, motion_scene, simulate

SCENES = ("rotation", "slider", "braking", "shapes", "objects", "large")
TIMES_S = (0.1, 0.2)
STEP_PX, SIZE_PX = 12, 28  # of tiles
FRAME_OFFSET_US = 7500  # of slider_depth's frames
BORDER_PX, BORDER_STEP = 5, 40.0  # from steps of the flow, px/s; where errors are given, too


def make(scene: str, seed: int):
    """Return a recording and its true flow, a function of time (s)."""
    if scene == "objects":
        objects = MovingObjects(size=(240, 180), duration=0.3, seed=seed)
        return simulate(objects, SENSORS["davis"], seed), objects.flow
    size = (640, 480) if scene == "large" else (240, 180)
    name, motion = {
        "rotation": ("rotation", "varying"),
        "slider": ("texture", "constant"),
        "braking": ("planar", "linear"),
        "shapes": ("shapes", "varying"),
        "large": ("texture", "varying"),
    }[scene]
    duration = 0.22 if scene == "large" else 0.3
    focal, sensor = 200 * size[0] / 240, SENSORS["davis"]
    recording, camera = motion_scene(
        name, motion, seed, size=size, focal=focal, duration=duration, sensor=sensor
    )
    return recording, lambda t: camera_flow(camera, t)


def camera_flow(camera, t: float):
    """Return the flow (H, W, 2) of a simulated camera, px/s."""
    twist, Z, lens = camera.twist(np.array([t])), camera.depth(np.array([t])), camera.camera
    T, Omega = (part[0] for part in twist)
    Z = Z.reshape(camera.size[::-1])
    y, x = np.mgrid[: Z.shape[0], : Z.shape[1]]
    X, Y = (x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy
    u = (X * T[2] - T[0]) / Z + X * Y * Omega[0] - (1 + X**2) * Omega[1] + Y * Omega[2]
    v = (Y * T[2] - T[1]) / Z + (1 + Y**2) * Omega[0] - X * Y * Omega[1] - X * Omega[2]
    return np.stack([lens.fx * u, lens.fy * v], -1)


def tile_flow(events, shape, at: int, fastest: float):
    """Maximise contrast per tile over constant velocities, to a part of the grid's step."""
    h, w = shape
    s = (events.t - at) * 1e-6
    unit = float(np.abs(s).max())
    s, p = s / unit, np.where(events.p, 1.0, -1.0)
    reach = fastest * unit
    us = np.linspace(-reach, reach, 2 * int(np.ceil(reach / 0.7)) + 1)
    us = us if len(us) <= 61 else np.linspace(-reach, reach, 61)
    ys, xs = np.arange(STEP_PX // 2, h, STEP_PX), np.arange(STEP_PX // 2, w, STEP_PX)
    scores = np.zeros((len(ys), len(xs), len(us), len(us)))
    for i, cy in enumerate(ys):
        for j, cx in enumerate(xs):
            m = (abs(events.x.astype(int) - cx) < SIZE_PX / 2) & (
                abs(events.y.astype(int) - cy) < SIZE_PX / 2
            )
            if m.sum() >= 30:
                places = (events.x[m] - float(cx), events.y[m] - float(cy))
                scores[i, j] = tile_scores(*places, s[m], p[m], us, us, np.zeros((64, 64)))
    scores -= scores.mean((2, 3), keepdims=True)
    scores = gaussian_filter(scores, (1, 1, 0.7, 0.7))
    rows, columns = np.indices(scores.shape[:2])
    best = np.unravel_index(scores.reshape(*rows.shape, -1).argmax(-1), scores.shape[2:])
    parts = []
    for axis in (1, 0):  # x, y
        near = np.clip(best[axis], 1, len(us) - 2)
        low, mid, high = (
            scores[(rows, columns, *(near + k if n == axis else best[n] for n in (0, 1)))]
            for k in (-1, 0, 1)
        )
        bend = np.minimum(low - 2 * mid + high, -1e-9)
        found = us[near] + np.clip((low - high) / (2 * bend), -1, 1) * (us[1] - us[0])
        parts.append(gaussian_filter(median_filter(found, 3), 0.7) / unit)
    factors = [(h / len(ys), w / len(xs))] * 2
    return np.stack([zoom(c, f, order=1, grid_mode=True, mode="nearest") for c, f in
                     zip(parts, factors, strict=True)], -1)[:h, :w]  # fmt: skip


def plane_flow(recording, start: int, stop: int):
    """Pool normal flows of fitted planes by least squares in Gaussian neighbourhoods."""
    part = jaxevent.Recording(
        "part", recording.width, recording.height, recording.events[start:stop]
    )
    found = normal_flow(part, progress=False)
    e, f = part.events[:], found.flow[found.valid]
    rows = found.row[found.valid]
    speed = np.maximum(np.linalg.norm(f, axis=1), 1e-9)
    n = f / speed[:, None]
    shape = (recording.height, recording.width)
    where = e.y[rows].astype(int) * shape[1] + e.x[rows]

    def pooled(values):
        sums = np.bincount(where, values, shape[0] * shape[1]).reshape(shape)
        return gaussian_filter(sums, 6.0)

    A = np.stack([pooled(n[:, i] * n[:, j]) for i in (0, 1) for j in (0, 1)], -1)
    A = A.reshape(*shape, 2, 2) + 1e-6 * np.eye(2)
    b = np.stack([pooled(n[:, i] * speed) for i in (0, 1)], -1)
    return np.linalg.solve(A, b[..., None])[..., 0]


def near_borders(flow):
    """Return pixels (H, W) near borders of objects, where the true flow has steps."""
    steps = [np.linalg.norm(np.diff(flow, axis=k), axis=-1) > BORDER_STEP for k in (0, 1)]
    borders = np.pad(steps[0], ((0, 1), (0, 0))) | np.pad(steps[1], ((0, 0), (0, 1)))
    return binary_dilation(borders, iterations=BORDER_PX)


def measure(scene: str, seed: int):
    """Return errors of ours, tiles and planes (median, share) with events, of all, at borders."""
    recording, truth = make(scene, seed)
    shape = (recording.height, recording.width)
    rows, z2, seconds = [], [], 0.0
    flow = jaxevent.flow_from_events(recording)
    for t_s in TIMES_S:
        at, true = round(t_s * 1e6), truth(t_s)
        clock = time.process_time()
        mean, covariance, valid = (part[0] for part in flow([at]))
        seconds += time.process_time() - clock
        row, half = recording.events.index(at), flow.window_events(at)
        start, stop = max(row - half, 0), row + half
        events = recording.events[start:stop]
        fastest = 1.2 * float(np.abs(true).max())
        seen = np.zeros(shape, bool)
        seen[events.y, events.x] = True
        found = [mean, tile_flow(events, shape, at, fastest)[: shape[0], : shape[1]],
                 plane_flow(recording, start, stop)]  # fmt: skip
        errors = [np.linalg.norm(one - true, axis=-1) for one in found]
        parts = (seen, np.ones(shape, bool), near_borders(true))
        rows.append([[(np.median(e[part]), (e[part] * 0.02 < 1).mean()) if part.any() else
                      (np.nan, np.nan) for part in parts] for e in errors])  # fmt: skip
        e = (mean - true)[valid]
        z2.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(covariance[valid]), e).mean() / 2)
    return np.mean(rows, 0), float(np.mean(z2)), float(valid.mean()), seconds


def track_features(frames, first: int, last: int):
    """Return features of a frame and where they are in another, (n, 2) each, px, by OpenCV."""
    import cv2

    follow: Any = cv2.calcOpticalFlowPyrLK  # takes None for points to start from

    images = [np.clip(image * 255, 0, 255).astype(np.uint8) for image in frames.intensity[
        first : last + 1]]  # fmt: skip
    images = [cv2.GaussianBlur(image, (0, 0), 0.7) for image in images]
    start = cv2.goodFeaturesToTrack(images[0], 300, 0.02, 5)
    now, kept = start, np.ones(len(start), bool)
    for before, after in itertools.pairwise(images):
        new, found, _ = follow(before, after, now, None, winSize=(15, 15))
        back, _, _ = follow(after, before, new, None, winSize=(15, 15))
        kept &= (found[:, 0] > 0) & (np.linalg.norm(back - now, axis=-1)[:, 0] < 0.15)
        now = new
    return start[kept, 0], now[kept, 0]


def angle_between(one, other):
    """Return the signed angle from one vector to another, degrees."""
    cross = one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]
    return np.degrees(np.arctan2(cross, (one * other).sum(-1)))


def measure_slider():
    """Return median errors of ours, tiles and planes on slider_depth: degrees, share, and px/s.

    The poses say that the camera moves along its rows. Features tracked through 13 frames show by
    which angle it is mounted otherwise. Speeds are compared with features tracked through 4 frames.
    """
    path = Path(os.environ.get("JAXEVENT_DATA", ".")) / "data" / "slider_depth.zip"
    recording = jaxevent.load(path)
    assert recording.poses is not None and recording.frames is not None
    twists = twists_from_poses(recording.poses, 0.05)
    assert twists.T is not None
    xi, f = pixel_coordinates(recording.width, recording.height, recording.camera)
    jacobian = np.linalg.inv(np.stack([np.gradient(xi, axis=1), np.gradient(xi, axis=0)], -1))

    velocity = twists.T.T

    def direction(at):
        T = np.array([np.interp(at, twists.t, c) for c in velocity])
        d = np.stack([xi[..., 0] * T[2] - f * T[0], xi[..., 1] * T[2] - f * T[1]], -1)
        return (jacobian @ d[..., None])[..., 0]

    def look_up(image, places):
        x, y = np.rint(places).astype(int).T
        return image[y.clip(0, len(image) - 1), x.clip(0, image.shape[1] - 1)]

    times = np.array([500_000, 1_000_000, 1_500_000, 2_000_000, 2_500_000, 3_000_000])
    t = recording.frames.t + FRAME_OFFSET_US
    mounted = []
    for at in times:
        k = int(np.searchsorted(t, at))
        start, stop = track_features(recording.frames, k - 6, min(k + 6, len(t) - 1))
        along = look_up(direction(at), (start + stop) / 2)
        mounted.append(np.median(angle_between(along, stop - start)))
    print(f"mounted at {np.mean(mounted):.2f} degrees, spread {np.std(mounted):.2f}")
    flow, rows = jaxevent.flow_from_events(recording), []
    for at in times:
        mean, _, _ = (part[0] for part in flow([at]))
        row, half = recording.events.index(at), flow.window_events(at)
        start, stop = max(row - half, 0), row + half
        events = recording.events[start:stop]
        seen = np.zeros(xi.shape[:2], bool)
        seen[events.y, events.x] = True
        found = [mean, tile_flow(events, seen.shape, at, 240.0),
                 plane_flow(recording, start, stop)]  # fmt: skip
        angles = [abs(angle_between(direction(at), one) - np.mean(mounted)) for one in found]
        k = int(np.searchsorted(t, at))
        first, last = track_features(recording.frames, k - 2, k + 1)
        tracked = (last - first) / ((t[k + 1] - t[k - 2]) * 1e-6)
        speeds = [np.median(np.linalg.norm(look_up(one, (first + last) / 2) - tracked, axis=1))
                  for one in found]  # fmt: skip
        rows.append([(np.median(a[seen]), (a[seen] < 10).mean(), v)
                     for a, v in zip(angles, speeds, strict=True)])  # fmt: skip
    return np.mean(rows, 0)


def measure_speed():
    """Print the cost of flow on copies of a scene side by side, at the median of its anchors."""
    recording, _ = make("slider", 0)
    e = recording.events[: recording.events.index(150_000)]
    print("| sensor | events/s | CPU s per million events |\n|---|---|---|")
    for columns, rows in ((1, 1), (3, 3), (5, 4)):
        i, j = (one.ravel() for one in np.meshgrid(np.arange(columns), np.arange(rows)))

        x, y = (np.add.outer(a.astype(int), size * k).ravel().astype(np.uint16)
                for a, size, k in ((e.x, 240, i), (e.y, 180, j)))  # fmt: skip
        events = jaxevent.Events(np.repeat(e.t, i.size), x, y, np.repeat(e.p, i.size))
        copies = jaxevent.Recording("copies", 240 * columns, 180 * rows, events)
        flow = jaxevent.flow_from_events(copies)
        flow([30_000])
        first = flow.window_events(30_000)
        clock = time.process_time()
        flow([120_000])
        seconds = time.process_time() - clock
        covered = events.index(120_000) - events.index(30_000) + first
        rate = len(events) / 0.15 / 1e6
        print(f"| {240 * columns} x {180 * rows} | {rate:.1f} M | {seconds / covered * 1e6:.2f} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--real", action="store_true")
    parser.add_argument("--speed", action="store_true")
    options = parser.parse_args()
    print("| scene | | ours | tiles | planes | z2 | valid | CPU s |\n" + "|---" * 8 + "|")
    for scene in options.scenes.split(",") if options.scenes else ():
        found = [measure(scene, options.first + k) for k in range(options.seeds)]
        errors, z2 = np.mean([one[0] for one in found], 0), np.mean([one[1] for one in found])
        valid, seconds = (np.mean([one[k] for one in found]) for k in (2, 3))
        for k, what in enumerate(("events", "all", "borders")):
            if np.isnan(errors[0, k, 0]):
                continue
            cells = " | ".join(f"{e:.1f}, {100 * share:.0f} %" for e, share in errors[:, k])
            tail = f"{z2:.2f} | {100 * valid:.0f} % | {seconds:.2f}" if k == 0 else "| |"
            print(f"| {scene} | {what} | {cells} | {tail} |", flush=True)
    if options.real:
        found = measure_slider()
        cells = " | ".join(f"{a:.1f}, {100 * share:.0f} %" for a, share, _ in found)
        print(f"| slider_depth | angle, below 10 degrees | {cells} | | | |")
        print("| slider_depth | tracked features | " + " | ".join(f"{v:.1f}" for _, _, v in found)
              + " | | | |")  # fmt: skip
    if options.speed:
        measure_speed()
