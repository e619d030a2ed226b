"""Blob tracking on real recordings: a spinning dot and cars on a street.

    python experiments/blob_real.py --data DIR --out blob_real

DIR holds spinning_dot.npz and davis346_street.npz; by default $JAXEVENT_DATA/data. Makes table.md.
No reference uses the tracker, and all are made with hindsight: the dot's path is a circle fitted to
centroids, the cars are found in the frames. The cars' settings were chosen on the first second;
reported numbers are of the time after it. `blob_without_settings.py` has its references from here,
and those of a night sky, whose drift is the one motion that makes the events sharpest.
The dot has the preset "fast"; that detection needs the prefilter (hot pixels) and `surround` (the
dot's tail) was seen on all of its 50 ms.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

import jaxevent
from jaxevent.blob import Tracks, moment
from jaxevent.recording import Recording

DOT_HZ, DOT_RADIUS = 19.39, 107.66  # of the circle that data/README.md gives
DOT_SPAN = 0.015, 0.05  # s
DOT_ROWS: dict[str, dict[str, Any]] = {
    "moment": {"gate_shape": "ellipse"},
    "moment, M = 32": {"gate_shape": "ellipse", "events_per_step": 32},
}
DOT_FOUND: dict[str, Any] = {"gate_shape": "ellipse", "events_per_step": 32, "prefilter": True}

STREET_PARTS = {"chosen": (0.05, 1.0), "reported": (1.0, 2.36)}
# Cars cross their own length in 0.5 s: a velocity averaged over tenths of a second (Q_v), and life
# times of 10,000 events/s. Of 11 variations on the first second two did worse: smaller cells gave
# a third track, so did no prefilter.
STREET: dict[str, Any] = {
    "gate_shape": "ellipse", "gate_decay": 20.0, "gate_min": 8.0, "gate_max": 60.0,
    "Q_v": 1e3, "Q_q": 1.0, "P0_v": 1e4, "lambda0": 15.0, "P0_lambda": 50.0, "lambda_max": 40.0,
    "prefilter": True, "prefilter_time": 0.02, "cycle": 0.01, "cell": 12, "tau_birth": 0.03,
    "n_confirm": 200.0, "t_confirm": 0.05, "t_tentative": 0.1, "t_coast": 0.3, "surround": 2.0,
}  # fmt: skip

# The glare of a planet fills the preset's 8 px: a star is a point. Faint stars need fewer events to
# begin and confirm a track, which the prefilter affords.
SKY: dict[str, Any] = {
    "preset": "slow", "events_per_step": 16, "max_targets": 128, "lambda_max": 4.0, "surround": 2.0,
    "gate": 3.0, "n_birth": 6.0, "n_confirm": 20.0,
    "prefilter": True, "prefilter_time": 0.5, "prefilter_neighbours": 1,
}  # fmt: skip
GLARE = ((470, 300, 170), (800, 450, 130))  # x, y, radius in px of the planet and of its ghost


class CircularPath(NamedTuple):
    """A path centre + a cos(omega t) + b sin(omega t), and the events about it."""

    omega: float  # rad/s
    terms: NDArray[np.float64]  # (3, 2): centre, a, b in px
    size: NDArray[np.float64]  # px, standard deviations of events along their own axes
    turned: float  # rad, from the direction of travel to the first axis

    def __call__(self, t: NDArray) -> tuple[NDArray, NDArray]:
        """Position and velocity at t (s)."""
        c, s = np.cos(self.omega * t), np.sin(self.omega * t)
        p = np.stack([np.ones_like(t), c, s], 1) @ self.terms
        return p, self.omega * np.stack([0 * t, -s, c], 1) @ self.terms


def fit_circular_path(
    recording: Recording, hertz: float = DOT_HZ, window: float = 2.5e-4
) -> CircularPath:
    """Fit the dot's path to centroids of windows (s), and the moments of events about it.

    Centroids and moments are those of the events within three times the larger standard deviation
    of the path, repeated until both agree, because stray events and the dot's tail have no end.
    """
    events = recording.events[:]
    t, xi = events.t * 1e-6, np.stack([events.x, events.y], 1).astype(float)
    edges = np.arange(t[0], t[-1], window)
    rows = np.searchsorted(t, edges)
    middle = (edges[:-1] + edges[1:]) / 2
    centre = np.array([np.median(xi[a:b], 0) for a, b in zip(rows, rows[1:], strict=False)])
    path = CircularPath(2 * np.pi * hertz, np.zeros((3, 2)), np.array([15.0, 10.0]), 0.0)

    def terms(omega: float) -> tuple[NDArray, NDArray]:
        basis = np.stack([np.ones_like(middle), np.cos(omega * middle), np.sin(omega * middle)], 1)
        solved = np.linalg.lstsq(basis, centre, rcond=None)[0]
        return solved, (basis @ solved - centre).ravel()

    for _ in range(6):
        omega = optimize.least_squares(lambda w: terms(w[0])[1], [path.omega]).x[0]
        path = path._replace(omega=float(omega), terms=terms(omega)[0])
        p, v = path(t)
        e, along = xi - p, v / np.hypot(*v.T)[:, None]
        near = np.hypot(*e.T) < 3 * path.size[0]
        centre = path(middle)[0] + [
            e[a:b][near[a:b]].mean(0) for a, b in zip(rows, rows[1:], strict=False)
        ]
        body = np.stack([(e * along).sum(1), e[:, 1] * along[:, 0] - e[:, 0] * along[:, 1]], 1)
        values, axes = np.linalg.eigh(np.cov(body[near].T))
        turned = float(np.arctan(axes[1, 1] / axes[0, 1]))
        path = path._replace(size=np.sqrt(values[::-1]), turned=turned)
    return path


def score_dot(tracks: Tracks, path: CircularPath, span: tuple[float, float]) -> dict[str, float]:
    """Return errors of the longest track every 50 us of a span (s)."""
    t = np.arange(round(span[0] * 1e6), round(span[1] * 1e6), 50)
    longest = tracks.id[[np.argmax(tracks.death - tracks.birth)]]
    states = tracks(t, longest)
    alive = states.valid[:, 0]
    row: dict[str, float] = {"tracked": float(alive.mean())}
    if not alive.any():
        return row
    m = states.mean[alive, 0].astype(np.float64)
    p, v = path(t[alive] * 1e-6)
    speed = np.hypot(*v.T)
    along = v / speed[:, None]
    forward = (m[:, 2:4] * along).sum(1)
    sideways = along[:, 0] * m[:, 3] - along[:, 1] * m[:, 2]
    theta = m[:, 6] - np.arctan2(along[:, 1], along[:, 0]) - path.turned
    theta = np.degrees((theta + np.pi / 2) % np.pi - np.pi / 2)
    circle = 2 * np.pi * DOT_HZ * DOT_RADIUS
    return row | {
        "rmse": float(np.sqrt(((m[:, :2] - p) ** 2).sum(1).mean())),
        "velocity": float(forward.mean() / speed.mean() - 1),
        "velocity_circle": float(np.hypot(*m[:, 2:4].T).mean() / circle - 1),
        "direction": float(np.degrees(np.arctan2(sideways, forward)).mean()),
        "velocity_rms": float(np.sqrt((((m[:, 2:4] - v) / speed[:, None]) ** 2).sum(1).mean())),
        "lambda1": float(m[:, 4].mean() / path.size[0] - 1),
        "lambda2": float(m[:, 5].mean() / path.size[1] - 1),
        "theta": float(np.sqrt((theta**2).mean())),
    }


def spinning_dot(recording: Recording) -> list[dict[str, Any]]:
    """Track the dot by each filter, and score the tracks."""
    path = fit_circular_path(recording)
    start, _ = path(np.zeros(1))
    rows = []
    for label, values in {**DOT_ROWS, "detected, M = 32": DOT_FOUND}.items():
        seeds = None if values is DOT_FOUND else [(*start[0], 20.0)]
        params = moment.Params(preset="fast", **values)
        tracks = moment.estimate(recording, params, seeds=seeds, smooth=False)
        rows.append({"filter": label, "tracks": len(tracks), **score_dot(tracks, path, DOT_SPAN)})
    return rows


class Car(NamedTuple):
    """A car in frames, with the gaps filled between the first and the last sight."""

    frame: NDArray[np.int64]
    centre: NDArray[np.float64]  # (frames, 2), centroid, px
    length: float  # px, median width of its box


def find_cars(images: NDArray, least: int = 60, level: float = 25.0) -> list[Car]:
    """Find parts that differ from the median of all images, linked from frame to frame.

    A component has `least` pixels that differ by more than `level` grey values (opened by one
    pixel, closed by two); it belongs to the car whose straight way on ends within 20 px, and a car
    is seen in six frames or more.
    """
    images = images.astype(float)
    background = np.median(images, 0)
    seen: list[list[tuple[float, ...]]] = []
    for k, image in enumerate(images):
        mask = ndimage.binary_opening(abs(image - background) > level)
        mask = ndimage.binary_closing(mask, iterations=2)
        found: Any = ndimage.label(mask, np.ones((3, 3)))
        labels, count = found
        here: list[tuple[float, ...]] = []
        for number in range(1, count + 1):
            y, x = np.argwhere(labels == number).T
            if len(x) >= least:
                here.append((k, x.mean(), y.mean(), float(np.ptp(x)) + 1))
        free = set(range(len(here)))
        for car in seen:
            last, before = np.array(car[-1]), np.array(car[max(0, len(car) - 6)])
            if k - last[0] > 6 or not free:
                continue
            step = (last - before)[1:3] / max(last[0] - before[0], 1)
            way = last[1:3] + step * (k - last[0])
            far = {j: float(np.hypot(*(np.array(here[j][1:3]) - way))) for j in free}
            nearest = min(far, key=lambda j: far[j])
            if far[nearest] < 20:
                car.append(here[nearest])
                free.remove(nearest)
        seen += [[here[j]] for j in sorted(free)]
    cars = []
    for car in seen:
        if len(car) >= 6:
            k, x, y, width = np.array(car).T
            frame = np.arange(int(k[0]), int(k[-1]) + 1)
            centre = np.stack([np.interp(frame, k, x), np.interp(frame, k, y)], 1)
            cars.append(Car(frame, centre, float(np.median(width))))
    return cars


def score_cars(
    tracks: Tracks, cars: list[Car], times: NDArray[np.int64], span: tuple[float, float]
) -> dict[str, Any]:
    """Compare tracks with cars at frame times (us) within a span (s).

    A car is covered where a track is within half its length; its track stays the same while that
    one covers it, and a change is a switch. A stray is a (track, frame) that covers no car.
    """
    now = (times >= span[0] * 1e6) & (times < span[1] * 1e6)
    states = tracks(times, extrapolate=True)  # frames may come before and after events
    centre, covers = states.mean[..., :2], np.zeros(states.valid.shape, bool)
    instants, distances, relative, switches, each = 0, [], [], 0, []
    for car in cars:
        last, own, count = None, [], 0
        for k, place in zip(car.frame, car.centre, strict=True):
            if not now[k]:
                continue
            count += 1
            distance = np.where(states.valid[k], np.hypot(*(centre[k] - place).T), np.inf)
            near = distance <= car.length / 2
            covers[k] |= near
            if not near.any():
                continue
            if last is None or not near[last]:
                nearest = int(np.argmin(distance))
                switches += last is not None and nearest != last
                last = nearest
            own.append(float(distance[last]))
        instants += count
        distances += own
        relative += [one / car.length for one in own]
        if count:
            median = round(float(np.median(own)), 2) if own else None
            each.append({"frames": count, "covered": len(own), "median": median})
    there = states.valid & now[:, None]
    return {
        "instants": instants,
        "coverage": len(distances) / max(instants, 1),
        "median": float(np.median(distances)) if distances else None,
        "median_of_length": float(np.median(relative)) if distances else None,
        "switches": int(switches),
        "tracks": int(there.any(0).sum()),
        "strays": int((there & ~covers).sum()),
        "cars": each,
    }


def street(recording: Recording) -> list[dict[str, Any]]:
    """Track cars, and score the tracks in the part that settings were chosen on and in the rest."""
    assert recording.frames is not None
    cars = find_cars(np.asarray(recording.frames.images))
    params = moment.Params(**STREET)
    tracks = moment.estimate(recording.with_frames(slice(0)), params, smooth=False)
    rows = []
    for part, span in STREET_PARTS.items():
        row = score_cars(tracks, cars, recording.frames.t, span)
        each = ", ".join(str(car["median"]) for car in row.pop("cars"))
        rows.append({"part": part, **row, "median of each car": each})
    return rows


def away(xy: NDArray) -> NDArray[np.bool_]:
    """Return a mask of the positions (..., 2) outside the glare."""
    outside = np.ones(xy.shape[:-1], bool)
    for x, y, radius in GLARE:
        outside &= np.hypot(xy[..., 0] - x, xy[..., 1] - y) > radius
    return outside


def hot_pixels(recording: Recording, most: int = 15) -> NDArray[np.bool_]:
    """(height, width): more than `most` events, and none at all in two of three neighbours.

    A star passes over a pixel in half a second; it leaves a trace in the pixels around.
    """
    events, count = recording.events[:], np.zeros((recording.height, recording.width))
    np.add.at(count, (events.y, events.x), 1)
    around = ndimage.rank_filter(count, 5, size=3)
    return (count > most) & (around <= 2)


def sharpest_drift(recording: Recording) -> NDArray[np.float64]:
    """Return the one velocity (px/s) that makes the sky's events sharpest, to 0.1 px/s.

    Sharpness is the sum of squared counts in 2 px cells of events carried back along it
    (Gallego et al., "A unifying contrast maximization framework"); glare and hot pixels left out.
    """
    events, hot = recording.events[:], hot_pixels(recording)
    xi = np.stack([events.x, events.y], 1).astype(float)
    keep = away(xi) & ~hot[events.y, events.x]
    xi, t = xi[keep], (events.t[keep] - events.t[0]) * 1e-6
    best, v = -1.0, np.zeros(2)
    for step in (1.0, 0.1):
        middle = v
        for dx in range(-10, 11):
            for dy in range(-10, 11):
                one = middle + step * np.array([dx, dy])
                cell = np.floor((xi - t[:, None] * one + 200) / 2).astype(np.int64)
                count = np.bincount(cell[:, 1] * 1000 + cell[:, 0])
                sharp = float((count.astype(float) ** 2).sum())
                if sharp > best:
                    best, v = sharp, one
    return v


def find_stars(recording: Recording, drift: NDArray, rate: float = 12.0) -> NDArray[np.float64]:
    """Return positions (stars, 2) at the start, bright once all events go along one drift.

    A star has `rate` events per second within 3 px, five times what is between 8 and 16 px around,
    outside the glare and off hot pixels; it stays on the sensor.
    """
    events, hot = recording.events[:], hot_pixels(recording)
    span = (events.t[-1] - events.t[0]) * 1e-6
    xi = np.stack([events.x, events.y], 1).astype(float)
    keep = away(xi) & ~hot[events.y, events.x]
    xi = xi[keep] - (events.t[keep, None] - events.t[0]) * 1e-6 * drift
    count = np.zeros((recording.height, recording.width))
    inside = ((xi > 0) & (xi < (recording.width - 1, recording.height - 1))).all(1)
    np.add.at(count, (np.rint(xi[inside, 1]).astype(int), np.rint(xi[inside, 0]).astype(int)), 1)
    r = np.hypot(*np.mgrid[-16:17, -16:17])
    disc, ring = (r <= 3).astype(float), ((r >= 8) & (r <= 16)).astype(float)
    near = ndimage.convolve(count, disc, mode="constant")
    around = ndimage.convolve(count, ring * disc.sum() / ring.sum(), mode="constant")
    peak = (near == ndimage.maximum_filter(near, 15)) & (near >= rate * span) & (near > 5 * around)
    found: Any = ndimage.label(peak, np.ones((3, 3)))
    labels, number = found
    places = np.array(ndimage.center_of_mass(peak, labels, range(1, number + 1))).reshape(-1, 2)
    places = places[:, ::-1]
    end = places + span * drift
    stay = ((end > 0) & (end < (recording.width - 1, recording.height - 1))).all(1)
    return places[stay & away(places) & away(end)]


PARTS = {
    "spinning_dot": ("spinning_dot.npz", spinning_dot),
    "street": ("davis346_street.npz", street),
}


def main() -> None:
    from common import command_line, table_of_rows, write_text

    arguments = command_line(__doc__, out=True, data=True, parts=PARTS).parse_args()
    text = ""
    for name in arguments.only:
        file, part = PARTS[name]
        text += f"## {file}\n\n{table_of_rows(part(jaxevent.load(arguments.data / file)))}\n\n"
    print(text)
    write_text(arguments.out / "table.md", text)


if __name__ == "__main__":
    main()
