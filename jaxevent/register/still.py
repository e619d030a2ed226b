"""One HDR image of a still scene brought onto every frame of a recording that moves before it."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError, require
from jaxevent.progress import bar
from jaxevent.recording import Events, Frames, Recording
from jaxevent.register.frames import log_image
from jaxevent.register.geometry import grid_between, straighten
from jaxevent.register.match import RATIO, even_out
from jaxevent.register.warp import Warped

_FEWEST = 15  # matches that agree on a frame's homography
_TOLERANCE = 1.5  # px of the image between matches and the homography, for a pixel of a frame


def register_still(
    recording: Recording,
    image: NDArray,
    *,
    scale: float | int | None = None,
    progress: bool | None = None,
) -> tuple[Recording, list[NDArray[np.float64] | None], float]:
    """Make an HDR image of a still scene the reference of every frame: `extra["hdr"]`.

    `image` (h, w) is linear intensity of any unit, NaN where it is not known, of a scene that is
    far away or flat. Features (SIFT, Lowe 2004) of each frame are matched with those of the image,
    and RANSAC (Barath et al., MAGSAC++, CVPR 2020) finds the homography of most of them, as Wang et
    al., ICCV 2021 do it with SURF. The image is multiplied by `scale`, by default the median ratio
    to what the frames show where they are not clipped, so that intensity 1 is the frames' white.

    Returns the recording with `hdr` and `hdr_t` at the frames' times, the homography of every frame
    (from its pixels to the image's, None where fewer than 15 features agree: such frames have no
    reference) and the scale. Needs OpenCV, the extra "vision". Raises `InputError` for
    recordings without frames and where no frame matches.
    """
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

    def features(level: NDArray) -> tuple[NDArray[np.float64], NDArray | None]:
        points, about = sift.detectAndCompute(even_out(level), None)
        return np.array([one.pt for one in points]).reshape(-1, 2), about

    known = np.isfinite(image)
    dark = float(np.median(image[known])) * 0.05 if known.any() else 1.0
    level = np.log(np.where(known, image, dark) + dark)
    where, described = features(level)
    tolerance = _TOLERANCE * max(1.0, image.shape[1] / recording.width)
    homographies: list[NDArray[np.float64] | None] = []
    for row in bar(range(len(frames)), desc="register frames", unit="frame", progress=progress):
        seen, about = features(log_image(recording, row)[0])
        homographies.append(None)
        if described is None or about is None or len(about) < 2 or len(described) < 2:
            continue
        pairs = [
            pair
            for pair in cv2.BFMatcher().knnMatch(about, described, k=2)
            if pair[0].distance < RATIO * pair[1].distance
        ]
        if len(pairs) < _FEWEST:
            continue
        one = straighten(recording.camera, seen[[pair[0].queryIdx for pair in pairs]])
        two = where[[pair[0].trainIdx for pair in pairs]]
        cv2.setRNGSeed(0)
        how = {"method": cv2.USAC_MAGSAC, "confidence": 0.9999, "maxIters": 20_000}
        H, agree = cv2.findHomography(one, two, ransacReprojThreshold=tolerance, **how)
        if H is not None and np.count_nonzero(agree) >= _FEWEST:
            homographies[-1] = np.asarray(H, np.float64)
    rows = [row for row, H in enumerate(homographies) if H is not None]
    if not rows:
        raise InputError(
            f"{recording.name}: fewer than {_FEWEST} features of every frame are found in the HDR "
            "image; give one of the same scene, with texture"
        )
    images = _seen(recording, still, homographies, rows)
    if scale is None:
        scale = _scale(recording, images, rows)
    extra = {
        name: values for name, values in recording.extra.items() if name not in ("hdr", "hdr_t")
    }
    extra |= {"hdr": images * np.float32(scale), "hdr_t": frames.t[rows]}
    return dataclasses.replace(recording, extra=extra), homographies, float(scale)


def _seen(
    recording: Recording,
    still: Recording,
    homographies: list[NDArray[np.float64] | None],
    rows: list[int],
) -> NDArray[np.float32]:
    """The image as each frame sees it, NaN where it is not known."""
    assert still.frames is not None
    images = np.empty((len(rows), recording.height, recording.width), np.float32)
    for place, row in enumerate(rows):
        H = homographies[row]
        assert H is not None
        warped = Warped(still.frames.images, grid_between(recording, still, H), np.nan)
        images[place] = np.maximum(np.asarray(warped)[0], 0)
    return images


def _scale(recording: Recording, images: NDArray[np.float32], rows: list[int]) -> float:
    """What the frames show over what the image shows, the median of unclipped pixels."""
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
