"""Features that frames share with images of the events, or with an HDR image of the scene."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from jaxevent.errors import InputError, require
from jaxevent.progress import bar
from jaxevent.recording import Events, Frames, Recording, check_recording
from jaxevent.register.frames import ResampledImages, log_image
from jaxevent.register.geometry import recording_grid, undistort_positions

_MAX_DISTANCE_RATIO = 0.75  # of the nearest and the second descriptor; Lowe's 0.8 is laxer
_MIN_MATCHES = 12  # of frames and events, that agree on a homography
_TOLERANCE_PX = 3.0  # of the other camera, between these matches and the homography
_N_FRAMES = 16  # whose features are matched with those of events
_MAX_WIDTH_PX = 400  # px, to which wider images of events are shrunk for that
_CUTOFFS_RAD_S = (1.0, 3.0)  # rad/s, cut-off of the reconstructions that are matched
_FRAMES_APART = (1, 3)  # frames between which changes are matched
_MIN_IMAGE_MATCHES = 15  # of a frame and an HDR image, that agree on a homography
_IMAGE_TOLERANCE_PX = 1.5  # px of the HDR image per pixel of a frame, likewise


def _detect(sift: Any, image: NDArray, scale: float = 1.0) -> tuple[NDArray, NDArray]:
    """Detect features of an image.

    Args:
        sift: OpenCV's detector.
        image: (h, w).
        scale: Factor by which the image is shrunk first.

    Returns:
        Positions (n, 2) x, y in px of the whole image, and descriptors (n, 128).
    """
    cv2 = require("cv2", "vision")
    size = round(image.shape[1] * scale), round(image.shape[0] * scale)
    small = image if scale == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    points, descriptors = sift.detectAndCompute(normalise_contrast(small), None)
    if descriptors is None or len(points) < 2:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    actual = np.array(image.shape[::-1]) / small.shape[::-1]
    return (np.array([one.pt for one in points]) + 0.5) * actual - 0.5, descriptors


def _match(one: NDArray, two: NDArray) -> list[tuple[int, int]]:
    """Match descriptors by Lowe's ratio test.

    Args:
        one: (n, d) descriptors of one image.
        two: (m, d) descriptors of another.

    Returns:
        Pairs of a row of `one` and a row of `two`.
    """
    if not len(one) or not len(two):
        return []
    cv2 = require("cv2", "vision")
    return [
        (pair[0].queryIdx, pair[0].trainIdx)
        for pair in cv2.BFMatcher().knnMatch(one, two, k=2)
        if len(pair) == 2 and pair[0].distance < _MAX_DISTANCE_RATIO * pair[1].distance
    ]


def match_frames(
    recording: Recording, other: Recording, offset_s: float, progress: bool | None
) -> list[NDArray[np.float64]]:
    """Return homographies that most matches of features agree on, right to a few pixels.

    Matched are images of the events at a frame's time with that frame, and images of the events
    between two frames with their difference. The first gives more right matches if frames clip and
    in fast motion, the second elsewhere.

    Args:
        recording: Events of the event camera.
        other: Frames of the other camera.
        offset_s: Offset of the clocks, s.
        progress: Whether to show progress.

    Returns:
        Up to three of: the homography, and the affine map and the similarity, for which few matches
        suffice.

    Raises:
        InputError: Too few matches agree.
    """
    cv2 = require("cv2", "vision")
    assert other.frames is not None
    t = other.frames.t + round(offset_s * 1e6)
    part, rows = _select_busiest_part(recording, t)
    small = min(1.0, _MAX_WIDTH_PX / recording.width)
    scales = small, min(1.0, 1.5 * small * recording.width / other.width)
    sift = cv2.SIFT_create(1000, contrastThreshold=0.02)
    begin, end = [], []
    for own, shown in _pair_images(part, other, t, rows, progress):
        (where, described), (there, about) = (
            _detect(sift, image.astype(np.float32), scale)
            for image, scale in zip((own, shown), scales, strict=True)
        )
        pairs = _match(described, about)
        begin += [where[k] for k, _ in pairs]
        end += [there[k] for _, k in pairs]
    found, count = [], 0
    if len(begin) >= _MIN_MATCHES:
        one = undistort_positions(recording.camera, np.array(begin))
        two = undistort_positions(other.camera, np.array(end))
        far = _TOLERANCE_PX / scales[1]
        for fit in (cv2.findHomography, cv2.estimateAffine2D, cv2.estimateAffinePartial2D):
            cv2.setRNGSeed(0)
            if fit is cv2.findHomography:
                how = {"method": cv2.USAC_MAGSAC, "confidence": 0.9999}
            else:
                how = {"method": cv2.RANSAC, "confidence": 0.999}
            H, agree = fit(one, two, ransacReprojThreshold=far, maxIters=20_000, **how)
            # A feature that is matched in several frames counts once.
            places = np.concatenate([one, two], 1)[np.ravel(agree) > 0] / 2
            places = len(np.unique(np.rint(places), axis=0))
            count = max(count, places)
            if H is not None and places >= _MIN_MATCHES:
                found.append(np.vstack([H, [0, 0, 1]])[:3])
    if not found:
        raise InputError(
            f"{other.name}: only {count} features of its frames and of the events agree on where "
            f"they are, and {_MIN_MATCHES} are needed; give the homography or calibration, or "
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
    """Yield pairs of images by the events and by frames.

    Args:
        part: Events.
        other: Frames of the other camera.
        t: (frames,) times of the frames on the events' clock, us.
        rows: Frames that are compared.
        progress: Whether to show progress.

    Yields:
        An image of the events, and one of frames: levels, or changes between two of them.
    """
    from jaxevent.reconstruction import high_pass

    if not len(rows):
        return
    for alpha in _CUTOFFS_RAD_S:
        video = high_pass.estimate(part, high_pass.Params(alpha=alpha), progress=progress)
        images = video(t[rows], extrapolate=True).mean
        for image, row in zip(images, rows, strict=True):
            level = np.log(np.clip(image + 1, 1e-3, 1e30))  # infinite where many events sum up
            yield ndimage.gaussian_filter(level, 0.7), log_image(other, int(row))[0]
    for apart in _FRAMES_APART:
        for row in rows[rows + apart < len(t)]:
            span = (part.events.index(int(one)) for one in (t[row], t[row + apart]))
            events = part.events[slice(*span)]
            place = events.y.astype(np.intp) * part.width + events.x
            net = np.bincount(place, np.where(events.p, 1.0, -1.0), part.width * part.height)
            net = ndimage.gaussian_filter(net.reshape(part.height, part.width), 1.2)
            (low, known), (high, well) = (log_image(other, int(k)) for k in (row, row + apart))
            change = np.where(known & well, high - low, 0)
            yield net, ndimage.gaussian_filter(change, 1.2 * other.width / part.width)


def _select_busiest_part(
    recording: Recording, t: NDArray[np.int64]
) -> tuple[Recording, NDArray[np.intp]]:
    """Select the ten seconds with the most events, and frames in them.

    Args:
        recording: Events.
        t: (frames,) times of the frames on the events' clock, us.

    Returns:
        The part of the recording, and rows of frames, evenly spread.
    """
    begin, end = recording.event_span()
    first = np.arange(begin, max(end - 5_000_000, begin + 1), 5_000_000)
    index = [[recording.events.index(int(f + s)) for s in (0, 10_000_000)] for f in first]
    begin = int(first[np.argmax(np.diff(index, axis=1)[:, 0])])
    end = min(end, begin + 10_000_000)
    events = recording.events[slice(*(recording.events.index(one) for one in (begin, end + 1)))]
    # The reconstruction needs some time before it shows anything.
    inside = np.flatnonzero((t >= begin + min(200_000, (end - begin) // 4)) & (t <= end))
    chosen = (
        inside[np.unique(np.linspace(0, len(inside) - 1, _N_FRAMES).astype(int))]
        if len(inside)
        else inside
    )
    return dataclasses.replace(recording, events=events, frames=None, extra={}), chosen


def normalise_contrast(image: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return grey levels of local contrast, in which both cameras' images look alike."""
    scale = image.shape[1] / 128
    detail = image - ndimage.gaussian_filter(image, 12 * scale)
    contrast = np.sqrt(ndimage.gaussian_filter(detail**2, 20 * scale)) + 0.3 * detail.std() + 1e-6
    return np.clip(128 + 50 * detail / contrast, 0, 255).astype(np.uint8)


def register_still(
    recording: Recording,
    image: NDArray,
    *,
    scale: float | int | None = None,
    progress: bool | None = None,
) -> tuple[Recording, list[NDArray[np.float64] | None], float]:
    """Register an HDR image of a still scene to every frame of a recording, as its reference.

    Features (SIFT, Lowe 2004) of each frame are matched with those of the image, and RANSAC
    (Barath et al., MAGSAC++, CVPR 2020) finds the homography of most of them, as Wang et al., ICCV
    2021 do it with SURF. Needs OpenCV, the extra "vision".

    Args:
        recording: Recording with frames.
        image: (h, w) linear intensity of any unit, NaN if unknown, of a scene that is far away or
            flat.
        scale: Factor of the image that makes the frames' white intensity 1; by default the median
            ratio to the frames' unclipped pixels.
        progress: Whether to show progress; by default on a terminal.

    Returns:
        The recording with `extra["hdr"]` and `extra["hdr_t"]` at the frames' times; the
        homography of every frame from its pixels to the image's, None if fewer than 15 features
        agree, which leaves the frame without reference; and the scale.

    Raises:
        InputError: The recording has no frames, the image cannot be used, or no frame matches.
    """
    check_recording(recording, "register_still")
    cv2 = require("cv2", "vision")
    frames = recording.frames
    if frames is None:
        missing = recording.describe_left_out("frames")
        raise InputError(
            f"{recording.name}: holds no frames that an image could be registered to{missing}; "
            "give a recording with frames"
        )
    image = np.asarray(image, np.float32)
    if image.ndim != 2 or not (image[np.isfinite(image)] >= 0).all() or min(image.shape) < 16:
        raise InputError(
            f"an HDR image of shape {image.shape} cannot be used; give linear intensities "
            "(height, width), none negative, NaN where they are not known"
        )
    # Linear intensity, which goes beyond 1 and is NaN where it is not known.
    shown = Frames.of_checked(np.zeros(1, np.int64), image[None], np.zeros(1, np.int64))
    still = Recording("image", image.shape[1], image.shape[0], Events.empty(), shown)
    sift = cv2.SIFT_create(4000, contrastThreshold=0.02)
    known = np.isfinite(image)
    dark = float(np.median(image[known])) * 0.05 if known.any() else 1.0
    level = np.log(np.where(known, image, dark) + dark)
    where, described = _detect(sift, level)
    tolerance = _IMAGE_TOLERANCE_PX * max(1.0, image.shape[1] / recording.width)
    homographies: list[NDArray[np.float64] | None] = []
    for row in bar(range(len(frames)), desc="register frames", unit="frame", progress=progress):
        seen, about = _detect(sift, log_image(recording, row)[0])
        homographies.append(None)
        pairs = _match(about, described)
        if len(pairs) < _MIN_IMAGE_MATCHES:
            continue
        one = undistort_positions(recording.camera, seen[[k for k, _ in pairs]])
        two = where[[k for _, k in pairs]]
        cv2.setRNGSeed(0)
        how = {"method": cv2.USAC_MAGSAC, "confidence": 0.9999, "maxIters": 20_000}
        H, agree = cv2.findHomography(one, two, ransacReprojThreshold=tolerance, **how)
        if H is not None and np.count_nonzero(agree) >= _MIN_IMAGE_MATCHES:
            homographies[-1] = np.asarray(H, np.float64)
    rows = [row for row, H in enumerate(homographies) if H is not None]
    if not rows:
        raise InputError(
            f"{recording.name}: fewer than {_MIN_IMAGE_MATCHES} features of every frame are found "
            "in the HDR image; give one of the same scene, with texture"
        )
    images = _resample_to_frames(recording, still, homographies, rows)
    if scale is None:
        scale = _estimate_scale(recording, images, rows)
    extra = {
        name: values for name, values in recording.extra.items() if name not in ("hdr", "hdr_t")
    }
    extra |= {"hdr": images * np.float32(scale), "hdr_t": frames.t[rows]}
    return dataclasses.replace(recording, extra=extra), homographies, float(scale)


def _resample_to_frames(
    recording: Recording,
    still: Recording,
    homographies: list[NDArray[np.float64] | None],
    rows: list[int],
) -> NDArray[np.float32]:
    """Resample a still image as frames see it.

    Args:
        recording: A recording with frames.
        still: The image, as the only frame of a recording.
        homographies: (3, 3) from each frame's pixels to the image's, px; None: not matched.
        rows: Rows of the frames wanted, which are matched.

    Returns:
        (rows, H, W) 0 or more, NaN where it is not known.
    """
    assert still.frames is not None
    images = np.empty((len(rows), recording.height, recording.width), np.float32)
    for place, row in enumerate(rows):
        H = homographies[row]
        assert H is not None
        warped = ResampledImages(still.frames.images, recording_grid(recording, still, H), np.nan)
        images[place] = np.maximum(np.asarray(warped)[0], 0)
    return images


def _estimate_scale(recording: Recording, images: NDArray[np.float32], rows: list[int]) -> float:
    """Estimate the factor from an image to intensity.

    Args:
        recording: A recording with frames.
        images: (rows, H, W) the image as the frames see it.
        rows: Rows of these frames.

    Returns:
        The median ratio of the frames' unclipped pixels to the image.

    Raises:
        InputError: The frames show nothing unclipped of it.
    """
    assert recording.frames is not None
    ratios = []
    for image, row in zip(images, rows, strict=True):
        _, good = log_image(recording, row)
        grey = recording.frames[row : row + 1].intensity[0]
        intensity = np.asarray(recording.response.intensity(grey)) / recording.gain[row]
        usable = good & (image > 0) & (intensity > 0.05)
        ratios.append(np.median(intensity[usable] / image[usable]) if usable.any() else np.nan)
    found = float(np.nanmedian(ratios)) if np.isfinite(ratios).any() else np.nan
    if not found > 0:
        raise InputError(
            f"{recording.name}: its frames show nothing unclipped of the HDR image; give --scale"
        )
    return found
