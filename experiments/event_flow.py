"""Optical flow of moving objects: `mc` beside frames alone, contrast and local planes of events.

    python experiments/event_flow.py --out flows

Every method tells the flow of every pixel halfway between frames, where it is compared with the
true one (px per interval of frames). No parameter is fitted; thresholds are the sensor's.

    flow      DIS between frames (pip install '.[vision]')
    contrast  of patches of 24 px the way that makes their events' image sharpest, over windows of
              1.6 ms to 0.4 s, interpolated between patches
    planes    of normal flows on the surface of active events the flow that fits those around best
    rigid     the camera's planar motion by `contrast` for the whole image: one velocity
    mc        with frames and events
    mc, rigid mc that starts from the row above
    still     no motion at all
"""

import argparse
import functools
import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
from motion_compensated import (
    FAR,
    RATES,
    SCORING,
    Store,
    flow_errors,
    halfway,
    markdown,
    objects_at,
)
from numpy.typing import NDArray
from scipy.interpolate import NearestNDInterpolator
from scipy.ndimage import gaussian_filter
from tqdm import tqdm

import jaxevent
from jaxevent.egomotion import contrast
from jaxevent.egomotion.baselines.planes import normal_flow
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.flow import RigidFlow
from jaxevent.egomotion.patches import (
    MAX_GRID_DISPLACEMENT_PX,
    MIN_RELATIVE_SHARPNESS,
    WINDOW_DURATIONS_S,
    measure_sharpness,
)
from jaxevent.recording import Recording

LONGEST = 0.4  # s
AROUND = 15_000  # us, on either side of a time, of normal flows
SPREAD = 5.0  # px, of the Gaussian over which they are fitted
NONE = jaxevent.blend.Params()  # what is scored has its parameters
PARAMS = {"c_on": 0.2, "c_off": 0.18, "I0": 0.1, "rho_ref": 5e-4}


class Contrast:
    """The way of each patch that makes its events sharpest."""

    def __init__(self, recording: Recording):
        self.recording = recording
        self.xi, _ = pixel_coordinates(recording.width, recording.height, None)

    def flow(self, times: NDArray[np.int64], extrapolate: bool = False) -> NDArray[np.float64]:
        return np.stack([self._one(int(t)) for t in times])

    def _one(self, t: int) -> NDArray[np.float64]:
        best: dict[tuple[float, ...], tuple[float, NDArray]] = {}
        for length in WINDOW_DURATIONS_S[WINDOW_DURATIONS_S <= LONGEST]:
            seen = measure_sharpness(
                self.recording, t, float(length), MAX_GRID_DISPLACEMENT_PX, self.xi
            )
            if seen is None:
                continue
            energy = seen.energy.mean(0).reshape(len(seen.xi), -1)
            at, n = energy.argmax(1), len(seen.displacements)
            way = np.stack([seen.displacements[at % n], seen.displacements[at // n]], -1)
            sharp = energy.max(1) / np.maximum(np.median(energy, 1), 1e-9)
            for k, place in enumerate(map(tuple, seen.xi.tolist())):
                inside = np.abs(way[k]).max() < MAX_GRID_DISPLACEMENT_PX - 0.5
                if inside and sharp[k] > best.get(place, (MIN_RELATIVE_SHARPNESS, way[k]))[0]:
                    best[place] = float(sharp[k]), way[k] / float(length)
        if not best:
            return np.zeros_like(self.xi)
        told = NearestNDInterpolator(np.array(list(best)), np.array([v for _, v in best.values()]))
        nearest = told(self.xi)
        return np.stack([gaussian_filter(nearest[..., c], 6) for c in (0, 1)], -1)


class Planes:
    """The flow that fits the normal flows around a pixel best: weighted least squares."""

    def __init__(self, recording: Recording):
        self.size = recording.height, recording.width
        told = normal_flow(recording, progress=False)
        speed = np.hypot(*told.flow.T)
        use = told.valid & (speed > 0)
        events = recording.events[: len(recording.events)]
        rows = told.row[use]
        self.cell = events.y[rows].astype(int) * recording.width + events.x[rows]
        self.t, self.speed = told.t[use], speed[use]
        self.normal = told.flow[use] / speed[use, None]

    def flow(self, times: NDArray[np.int64], extrapolate: bool = False) -> NDArray[np.float64]:
        return np.stack([self._one(int(t)) for t in times])

    def _one(self, t: int) -> NDArray[np.float64]:
        near = np.abs(self.t - t) < AROUND
        n, v, cell = self.normal[near], self.speed[near], self.cell[near]
        weight, U = np.ones(len(v)), np.zeros((*self.size, 2))

        def gathered(values: NDArray) -> NDArray:
            sums = np.bincount(cell, values, self.size[0] * self.size[1])
            return gaussian_filter(np.asarray(sums, float).reshape(self.size), SPREAD)

        for _ in range(4):
            xx, xy, yy, bx, by = (
                gathered(weight * part)
                for part in (
                    n[:, 0] ** 2,
                    n[:, 0] * n[:, 1],
                    n[:, 1] ** 2,
                    n[:, 0] * v,
                    n[:, 1] * v,
                )
            )
            ridge = 0.02 * (xx + yy) + 1e-9
            xx, yy = xx + ridge, yy + ridge
            scale = xx * yy - xy**2
            U = np.stack([yy * bx - xy * by, xx * by - xy * bx], -1) / scale[..., None]
            off = (U.reshape(-1, 2)[cell] * n).sum(1) - v
            weight = 1 / (1 + (off / (0.2 * v + 10)) ** 2)
        return U


class Still:
    def __init__(self, recording: Recording):
        self.size = recording.height, recording.width

    def flow(self, times: NDArray[np.int64], extrapolate: bool = False) -> NDArray[np.float64]:
        return np.zeros((len(times), *self.size, 2))


def told_by(recording: Recording) -> dict[str, Any]:
    """What tells flow, by label."""
    mc = jaxevent.METHODS["mc"]
    params = mc.Params.of(PARAMS)
    rigid = RigidFlow(recording, contrast.estimate(recording, model="planar", progress=False))
    found: dict[str, Any] = {}
    if importlib.util.find_spec("cv2"):
        found["flow"] = jaxevent.METHODS["flow"].estimate(recording, progress=False)
    return found | {
        "contrast": Contrast(recording),
        "planes": Planes(recording),
        "rigid": rigid,
        "mc": mc.estimate(recording, params, progress=False),
        "mc, rigid": mc.estimate(recording, params, progress=False, motion=rigid),
        "still": Still(recording),
    }


def scored(told: Any, _: Any, middles: NDArray, true: NDArray, rate: float) -> dict[str, float]:
    flows = np.nan_to_num(told.flow(middles))
    pairs = [flow_errors(one / rate, other / rate) for one, other in zip(flows, true, strict=True)]
    epe, far = np.mean(pairs, 0)
    return {"epe": float(epe), "far": float(far), "images": len(middles)}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for everything made")
    out = parser.parse_args().out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    store = Store(out / "flow.json")
    jobs = [(rate, seed) for rate in RATES for seed in SCORING]
    for rate, seed in tqdm(jobs, disable=not sys.stderr.isatty()):
        source, recording = objects_at(out, rate, seed)
        middles = halfway(recording, 4)
        true = np.stack([source.flow(float(t) * 1e-6) for t in middles])
        for name, told in told_by(recording).items():
            score = functools.partial(scored, middles=middles, true=true, rate=rate)
            store.add({"rate": rate, "seed": seed}, {name: (told, NONE)}, score)
    names = list(dict.fromkeys(row["method"] for row in store.rows))
    keys = {"rate": "frames (Hz)", "method": "method"}
    columns = (("EPE px", "epe", 1, 2), (f"% > {FAR:g} px", "far", 1, 1))
    text = markdown(store.means(list(keys), names), keys, columns)
    (out / "flow.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
