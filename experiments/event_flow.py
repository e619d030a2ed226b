"""Measure dense flow from events against true flow, beside tiles' contrast and fitted planes.

    python experiments/event_flow.py [--seeds 2] [--scenes objects,slider] [--real]

Median end-point error (px/s) and share below 1 px in 20 ms, at pixels with events and at all.
Baselines have the window of the method; tiles search up to 1.2 times the largest true speed. Their
flow is that of 28 px, of scores smoothed over neighbours; planes' is pooled over 6 px by least
squares. With --real: angles between flow and its true direction on slider_depth, from its poses.
"""

import argparse
import os
import time
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, median_filter, zoom
from tile_images import tile_scores

import jaxevent
from jaxevent.egomotion.baselines.planes import normal_flow
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.truth import from_poses
from jaxevent.simulate import SENSORS, MovingObjects, motion_scene, simulate

SCENES = ("rotation", "slider", "braking", "shapes", "objects", "large")
TIMES_S = (0.1, 0.2)
STEP_PX, SIZE_PX = 12, 28  # of tiles


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
    """Maximise contrast per tile over constant velocities."""
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
    a, b = np.unravel_index(scores.reshape(*scores.shape[:2], -1).argmax(-1), scores.shape[2:])
    parts = [gaussian_filter(median_filter(us[c], 3), 0.7) / unit for c in (b, a)]
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


def measure(scene: str, seed: int):
    """Return rows of errors: ours, tiles, planes; median and share with events, and of all."""
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
        rows.append([(np.median(e[seen]), (e[seen] * 0.02 < 1).mean(), np.median(e),
                      (e * 0.02 < 1).mean()) for e in errors])  # fmt: skip
        e = (mean - true)[valid]
        z2.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(covariance[valid]), e).mean() / 2)
    return np.mean(rows, 0), float(np.mean(z2)), float(valid.mean()), seconds


def measure_slider():
    """Return median angles (degrees) of ours, tiles and planes at pixels with events."""
    path = Path(os.environ.get("JAXEVENT_DATA", ".")) / "data" / "slider_depth.zip"
    recording = jaxevent.load(path)
    shape = (recording.height, recording.width)
    assert recording.poses is not None
    twists = from_poses(recording.poses, 0.05)
    assert twists.T is not None
    xi, f = pixel_coordinates(recording.width, recording.height, recording.camera)
    jacobian = np.linalg.inv(np.stack([np.gradient(xi, axis=1), np.gradient(xi, axis=0)], -1))
    flow, rows = jaxevent.flow_from_events(recording), []
    for t_s in (0.5, 1.0, 1.5, 2.0, 2.5, 3.0):
        at = round(t_s * 1e6)
        T = np.array([np.interp(at, twists.t, c) for c in twists.T.T])
        d = np.stack([xi[..., 0] * T[2] - f * T[0], xi[..., 1] * T[2] - f * T[1]], -1)
        d = (jacobian @ d[..., None])[..., 0]
        mean, _, valid = (part[0] for part in flow([at]))
        row, half = recording.events.index(at), flow.window_events(at)
        events = recording.events[max(row - half, 0) : row + half]
        seen = np.zeros(shape, bool)
        seen[events.y, events.x] = True
        found = [mean, tile_flow(events, shape, at, 240.0),
                 plane_flow(recording, max(row - half, 0), row + half)]  # fmt: skip
        angles = [np.degrees(np.abs(np.arctan2(one[..., 0] * d[..., 1] - one[..., 1] * d[..., 0],
                  (one * d).sum(-1)))) for one in found]  # fmt: skip
        rows.append([(np.median(a[seen]), (a[seen] < 10).mean()) for a in angles])
    return np.mean(rows, 0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--real", action="store_true")
    options = parser.parse_args()
    print("| scene | | ours | tiles | planes | z2 | valid | CPU s |\n" + "|---" * 8 + "|")
    for scene in options.scenes.split(",") if options.scenes else ():
        found = [measure(scene, options.first + k) for k in range(options.seeds)]
        errors, z2 = np.mean([one[0] for one in found], 0), np.mean([one[1] for one in found])
        valid, seconds = (np.mean([one[k] for one in found]) for k in (2, 3))
        for k, what in ((0, "events"), (2, "all")):
            cells = " | ".join(f"{e[k]:.1f}, {100 * e[k + 1]:.0f} %" for e in errors)
            tail = f"{z2:.2f} | {100 * valid:.0f} % | {seconds:.2f}" if k == 0 else "| |"
            print(f"| {scene} | {what} | {cells} | {tail} |", flush=True)
    if options.real:
        cells = " | ".join(f"{a:.1f}, {100 * share:.0f} %" for a, share in measure_slider())
        print(f"| slider_depth | angle, below 10 degrees | {cells} | | | |")
