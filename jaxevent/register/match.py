"""A homography from features that frames and events share, to a few pixels."""

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from jaxevent.errors import InputError, require
from jaxevent.recording import Recording
from jaxevent.register.frames import event_span, log_image
from jaxevent.register.geometry import straighten

_FEWEST = 12  # matches that agree on a homography
_TOLERANCE = 3.0  # px of the other camera between matches and the homography
RATIO = 0.75  # of the distances to the nearest and the second descriptor; Lowe's 0.8 is laxer
_MATCHED = 16  # frames whose features are matched
_WIDEST = 400  # px to which wider images of events are shrunk for that
_ALPHAS = (1.0, 3.0)  # rad/s, cut-off of the reconstructions that are matched
_APART = (1, 3)  # frames between which changes are matched


def match(
    recording: Recording, other: Recording, offset: float, progress: bool | None
) -> list[NDArray[np.float64]]:
    """Homographies that most matches of features agree on, to a few pixels.

    Matched are what the events say at a frame's time with that frame, and what they say of the
    time between two frames with their difference. The first gives more right matches where frames
    clip and in fast motion, the second elsewhere. The homography, and the affine map and the
    similarity, which few matches tell better, are the three results.
    """
    cv2 = require("cv2", "vision")
    assert other.frames is not None
    t = other.frames.t + round(offset * 1e6)
    part, rows = _find_busiest(recording, t)
    small = min(1.0, _WIDEST / recording.width)
    scales = small, min(1.0, 1.5 * small * recording.width / other.width)
    sift = cv2.SIFT_create(1000, contrastThreshold=0.02)

    def features(image: NDArray[np.floating], scale: float) -> tuple[NDArray, NDArray]:
        image = image.astype(np.float32)
        size = round(image.shape[1] * scale), round(image.shape[0] * scale)
        seen = image if scale == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        points, about = sift.detectAndCompute(even_out(seen), None)
        if about is None or len(points) < 2:
            return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
        actual = np.array(image.shape[::-1]) / seen.shape[::-1]
        return (np.array([one.pt for one in points]) + 0.5) * actual - 0.5, about

    begin, end = [], []
    for own, shown in _pair_images(part, other, t, rows, progress):
        (where, described), (there, about) = features(own, scales[0]), features(shown, scales[1])
        if not len(where) or not len(there):
            continue
        for pair in cv2.BFMatcher().knnMatch(described, about, k=2):
            if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance:
                begin.append(where[pair[0].queryIdx])
                end.append(there[pair[0].trainIdx])
    found, count = [], 0
    if len(begin) >= _FEWEST:
        one = straighten(recording.camera, np.array(begin))
        two = straighten(other.camera, np.array(end))
        far = _TOLERANCE / scales[1]
        for fit in (cv2.findHomography, cv2.estimateAffine2D, cv2.estimateAffinePartial2D):
            cv2.setRNGSeed(0)
            if fit is cv2.findHomography:
                how = {"method": cv2.USAC_MAGSAC, "confidence": 0.9999}
            else:
                how = {"method": cv2.RANSAC, "confidence": 0.999}
            H, agree = fit(one, two, ransacReprojThreshold=far, maxIters=20_000, **how)
            # The same feature in several frames says the same once.
            places = np.concatenate([one, two], 1)[np.ravel(agree) > 0] / 2
            places = len(np.unique(np.rint(places), axis=0))
            count = max(count, places)
            if H is not None and places >= _FEWEST:
                found.append(np.vstack([H, [0, 0, 1]])[:3])
    if not found:
        raise InputError(
            f"{other.name}: only {count} features of its frames and of the events agree on where "
            f"they are, and {_FEWEST} are needed; give the homography or calibration, or "
            "recordings of a scene with more texture, in motion"
        )
    return found


def _pair_images(
    part: Recording,
    other: Recording,
    t: NDArray[np.int64],
    rows: NDArray[np.intp],
    progress: bool | None,
) -> Iterator[tuple[NDArray[np.floating], NDArray[np.floating]]]:
    """Pairs of images of the same by the events and by the frames `rows`, whose times are t."""
    from jaxevent.reconstruction import high_pass

    if not len(rows):
        return
    for alpha in _ALPHAS:
        video = high_pass.estimate(part, high_pass.Params(alpha=alpha), progress=progress)
        images = video(t[rows], extrapolate=True).mean
        for image, row in zip(images, rows, strict=True):
            level = np.log(np.maximum(image + 1, 1e-3))
            yield ndimage.gaussian_filter(level, 0.7), log_image(other, int(row))[0]
    for apart in _APART:
        for row in rows[rows + apart < len(t)]:
            span = (part.events.index(int(one)) for one in (t[row], t[row + apart]))
            events = part.events[slice(*span)]
            place = events.y.astype(np.intp) * part.width + events.x
            net = np.bincount(place, np.where(events.p, 1.0, -1.0), part.width * part.height)
            net = ndimage.gaussian_filter(net.reshape(part.height, part.width), 1.2)
            (low, known), (high, well) = (log_image(other, int(k)) for k in (row, row + apart))
            change = np.where(known & well, high - low, 0)
            yield net, ndimage.gaussian_filter(change, 1.2 * other.width / part.width)


def _find_busiest(recording: Recording, t: NDArray[np.int64]) -> tuple[Recording, NDArray[np.intp]]:
    """Ten seconds at most, with the most events, and frames in them, evenly spread."""
    begin, end = event_span(recording)
    first = np.arange(begin, max(end - 5_000_000, begin + 1), 5_000_000)
    index = [[recording.events.index(int(f + s)) for s in (0, 10_000_000)] for f in first]
    begin = int(first[np.argmax(np.diff(index, axis=1)[:, 0])])
    end = min(end, begin + 10_000_000)
    events = recording.events[slice(*(recording.events.index(one) for one in (begin, end + 1)))]
    # The reconstruction needs some time before it shows anything.
    inside = np.flatnonzero((t >= begin + min(200_000, (end - begin) // 4)) & (t <= end))
    chosen = (
        inside[np.unique(np.linspace(0, len(inside) - 1, _MATCHED).astype(int))]
        if len(inside)
        else inside
    )
    return dataclasses.replace(recording, events=events, frames=None, extra={}), chosen


def even_out(image: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Grey levels of local contrast: both cameras' images look alike in them."""
    scale = image.shape[1] / 128
    detail = image - ndimage.gaussian_filter(image, 12 * scale)
    contrast = np.sqrt(ndimage.gaussian_filter(detail**2, 20 * scale)) + 0.3 * detail.std() + 1e-6
    return np.clip(128 + 50 * detail / contrast, 0, 255).astype(np.uint8)
