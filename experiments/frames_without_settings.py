"""Hidden frames of real recordings, without settings: `mc` beside what a user would pick instead.

    python experiments/frames_without_settings.py --out hidden [--data DIR]

DIR holds the recordings, by default $JAXEVENT_DATA/data. Of each every 2nd, 4th or 8th
frame is given, as `jaxevent evaluate` does it; methods calibrate themselves by these. A few of the
hidden frames are scored, evenly chosen: those between given frames, and apart from these those
after the last one. MSE; MSE after the brightness of each image is fitted to the hidden frame
(a I + b), since the frames of evbench_seq3 are not equally bright; SSIM; z2, and z2 of the images
whose brightness is fitted, with the variances that were told. The last column of `mc` is its MSE as
part of the least of its ingredients, `aks` and `blend`. Makes table.md; rows that the folder holds
are kept.

With --strata z2 is told by strata of pixels: no event in the 3x3 pixels around between the two
frames given, events of neighbours alone, events of the pixel's own, the tenth of the pixels where
the hidden frame is steepest, and the quarters of the gap at its ends and in its middle. Makes
strata.md.

With --beyond frames of the second half are scored that lie 1, 2 and 4 frames after the last one
given, and as far before the first: the recording is cut there at three places, its events are not.
Makes beyond.md; a line is of all places, and its gap is how far away the frame is.
"""

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
from common import command_line
from motion_compensated import Row, Store, choose_evenly, noise_of, table
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

import jaxevent
from jaxevent.metrics import ssim
from jaxevent.recording import Frames, Recording
from jaxevent.runs.protocols import frame_times, held_out

RECORDINGS = ("slider_depth.zip", "davis346_street.npz", "evbench_seq3_calibrated.npz")
METHODS = ("last-frame", "blend", "flow", "akf", "aks", "mc")
INGREDIENTS = ("aks", "blend")
GAPS, IMAGES = (2, 4, 8), 8
MIN_STRATUM = 500  # pixels
CUTS, AWAY = (0.55, 0.7, 0.85), (1, 2, 4)  # parts of a recording's frames; frames from the cut
COLUMNS = (
    ("MSE x 1e-2", "mse", 100, 4), ("brightness fitted", "fitted", 100, 4), ("SSIM", "ssim", 1, 3),
    ("z2", "z2", 1, 2), ("z2, brightness fitted", "z2_fitted", 1, 2),
    ("of the best ingredient", "ratio", 1, 2),
)  # fmt: skip
STRATA = ("z2", "still", "around", "own", "edges", "at the ends", "in the middle")
STRATA_COLUMNS = tuple((name, name, 1, 2) for name in STRATA)


def brightness_fitted(image: NDArray, truth: NDArray) -> NDArray:
    a, b = np.polyfit(image.ravel().astype(float), truth.ravel().astype(float), 1)
    return a * image + b


def strata_of(given: Recording, truth: Frames, times: NDArray) -> dict[str, NDArray[np.bool_]]:
    """Return strata of the pixels of hidden frames, whose times on the events' clock are given."""
    assert given.frames is not None
    late, size = times - truth.t, (given.height, given.width)
    stamps = given.frames.t + late[0]
    before = np.searchsorted(stamps, times, "right") - 1
    after = np.minimum(before + 1, len(stamps) - 1)
    own = []
    for begin, end in zip(
        stamps[np.maximum(before, 0)], np.maximum(stamps[after], times), strict=True
    ):
        events = given.events[given.events.index(int(begin)) : given.events.index(int(end))]
        seen = np.zeros(size, bool)
        seen[events.y, events.x] = True
        own.append(seen)
    own, steep = np.stack(own), np.hypot(*np.gradient(truth.intensity, axis=(1, 2)))
    around = np.stack([maximum_filter(image, 3) for image in own])
    part = (times - stamps[before]) / np.maximum(stamps[after] - stamps[before], 1)
    ends = np.broadcast_to((np.abs(part - 0.5) > 0.25)[:, None, None], own.shape)
    edges = steep >= np.quantile(steep, 0.9, axis=(1, 2), keepdims=True)
    return {
        "z2": np.ones_like(own), "still": ~around, "around": around & ~own, "own": own,
        "edges": edges, "at the ends": ends, "in the middle": ~ends,
    }  # fmt: skip


def score_strata(method: Any, _: Any, given: Recording, truth: Frames, noise: float) -> Row:
    """Score the variances of a method's images of hidden frames, stratum by stratum."""
    params = method.usual_params(given)
    times, I0 = frame_times(truth, params), float(params.I0)
    images, P, _ = method.estimate(given, params, progress=False)(times, extrapolate=True)
    true = truth.intensity
    squares = np.log((images.clip(0, 1) + I0) / (true + I0)) ** 2
    squares /= P + noise / (true + I0) ** 2
    strata = strata_of(given, truth, times).items()
    means = {n: float(np.nanmean(squares[s])) for n, s in strata if s.sum() >= MIN_STRATUM}
    return {**means, "images": len(true)}


def score(method: Any, _: Any, given: Recording, truth: Frames, noise: float) -> Row:
    params = method.usual_params(given)
    made = method.estimate(given, params, progress=False)
    images, P, _ = made(frame_times(truth, params), extrapolate=True)
    images, true = images.clip(0, 1).astype(np.float32), truth.intensity
    pairs = list(zip(images, true, strict=True))
    row: Row = {
        "mse": float(((images - true) ** 2).mean()),
        "fitted": float(np.mean([((brightness_fitted(i, t) - t) ** 2).mean() for i, t in pairs])),
        "ssim": float(np.mean([ssim(i, t) for i, t in pairs])),
        "images": len(true),
    }
    if method.has_covariance:
        I0 = float(params.I0)
        fitted = np.stack([brightness_fitted(i, t).clip(0, 1) for i, t in pairs])
        for name, shown in (("z2", images), ("z2_fitted", fitted)):
            squares = np.log((shown + I0) / (true + I0)) ** 2
            row[name] = float(np.nanmean(squares / (P + noise / (true + I0) ** 2)))
    return row


def between_and_after(recording: Recording) -> Iterator[tuple[Row, Recording, Frames]]:
    """Iterate over cells of the table, with the recording that is given and the hidden frames."""
    for gap in GAPS:
        given, hidden = held_out(recording, gap)
        assert given.frames is not None
        last = int(np.searchsorted(hidden.t, given.frames.t[-1]))
        parts = {"between": np.arange(last), "after the last": np.arange(last, len(hidden))}
        for where, rows in parts.items():
            if len(rows):
                yield {"gap": gap, "frames": where}, given, hidden[choose_evenly(rows, IMAGES)]


def beyond(recording: Recording) -> Iterator[tuple[Row, Recording, Frames]]:
    """Iterate over cells of recordings that are cut."""
    frames = recording.frames
    assert frames is not None
    for cut in CUTS:
        at = round(cut * len(frames))
        early, late = (recording.with_frames(s) for s in (slice(0, at), slice(at, None)))
        for away in AWAY:
            after, before = at - 1 + away, at - away
            cell = {"gap": away, "cut": cut}
            if after < len(frames):
                yield {"frames": "after the last", **cell}, early, frames[after : after + 1]
            yield {"frames": "before the first", **cell}, late, frames[before : before + 1]


def main() -> None:
    parser = command_line(__doc__, out=True, data=True)
    parser.add_argument("--recordings", nargs="+", default=RECORDINGS, metavar="NAME")
    parser.add_argument("--methods", nargs="+", default=METHODS, metavar="NAME")
    parser.add_argument("--beyond", action="store_true", help="frames after the last, or before")
    parser.add_argument("--strata", action="store_true", help="variances by strata of pixels")
    arguments = parser.parse_args()
    out = arguments.out.absolute()
    kind, cells = ("beyond", beyond) if arguments.beyond else ("table", between_and_after)
    kind = "strata" if arguments.strata else kind
    store = Store(out / ("rows.json" if kind == "table" else f"{kind}.json"))
    methods: dict[str, Any] = {n: (jaxevent.METHODS[n], None) for n in arguments.methods}
    if arguments.strata:
        methods = {n: pair for n, pair in methods.items() if pair[0].has_covariance}
    for name in arguments.recordings:
        recording = jaxevent.load(arguments.data / name)
        assert recording.frames is not None
        noise = noise_of(recording.frames)
        for cell, given, truth in cells(recording):
            scored = score_strata if arguments.strata else score
            one = functools.partial(scored, given=given, truth=truth, noise=noise)
            store.add({"recording": recording.name, **cell}, methods, one)
    keys = ("recording", "frames", "gap", "method")
    rows = store.means(keys, tuple(methods))
    for row in rows:
        same = [r for r in rows if all(r[k] == row[k] for k in keys[:-1])]
        if row["method"] == "mc" and "mse" in row:
            least = min((r["mse"] for r in same if r["method"] in INGREDIENTS), default=np.nan)
            row["ratio"] = row["mse"] / least
    text = table(rows, {key: key for key in keys}, STRATA_COLUMNS if arguments.strata else COLUMNS)
    (out / f"{kind}.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
