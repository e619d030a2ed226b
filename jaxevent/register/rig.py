"""The calibration of an event camera and another one."""

import dataclasses
import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.io import calibration
from jaxevent.io.checks import make_camera
from jaxevent.parameters import read_toml
from jaxevent.register.geometry import Grid, mask_outside, pixel_rays, project


@dataclasses.dataclass(frozen=True)
class Rig:
    """Calibration of an event camera and another one.

    A point X (m) in the event camera's axes (x to the right, y down, z forward) is
    rotation @ X + translation in the other's.

    Attributes:
        events: The event camera.
        frames: The other camera.
        rotation: (3, 3) rotation matrix.
        translation: (3,) m.

    Raises:
        InputError: The matrix is no rotation.
    """

    events: PinholeCamera
    frames: PinholeCamera
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    def __post_init__(self) -> None:
        rotation, translation = (
            np.asarray(part, np.float64) for part in (self.rotation, self.translation)
        )
        turned = rotation.shape == (3, 3) and np.allclose(rotation @ rotation.T, np.eye(3), 0, 1e-4)
        if not turned or np.linalg.det(rotation) < 0:
            raise InputError(
                f"the rotation {rotation.tolist()} between the cameras is not a rotation matrix; "
                "give three orthonormal rows, right-handed"
            )
        if translation.shape != (3,) or not np.isfinite(translation).all():
            raise InputError(
                f"the translation {translation.tolist()} between the cameras cannot be used; give "
                "three finite numbers in m"
            )
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def read(
        cls,
        path: str | Path,
        events: PinholeCamera | None = None,
        *,
        cameras: tuple[str, str] | None = None,
        sizes: tuple[tuple[int, int], tuple[int, int]] | None = None,
    ) -> "Rig":
        """Read a rig from a camchain of Kalibr (YAML, needs the extra `ros`) or a file of TOML.

            [events]                                  # default: the recording's, `events`
            camera = [fx, fy, cx, cy, k1, k2, p1, p2, k3]    # px, Brown-Conrady; or the first four
            [frames]
            camera = [fx, fy, cx, cy, k1, k2, p1, p2, k3]
            transform = [[...], [...], [...], [0, 0, 0, 1]]  # 4 x 4, or its first three rows

        `transform` takes places (m) from the event camera's axes to the other's, as Kalibr's
        T_cn_cnm1 does if the event camera was its cam0.

        Args:
            path: The file.
            events: The event camera, for a file of TOML that does not hold it.
            cameras: The names of the event camera and the other one in a camchain, as
                ("cam1", "cam0"); omitted, those of the right sizes, and the first two where any
                would do.
            sizes: (width, height) in px of the event camera and of the other one.

        Returns:
            The rig.

        Raises:
            InputError: The file is missing or damaged, or does not hold both cameras.
        """

        if Path(path).suffix.lower() in calibration.CALIBRATION_SUFFIXES:
            return cls._from_camchain(Path(path), cameras, sizes)
        if cameras is not None:
            raise InputError(
                f"{path}: only a camchain in YAML names its cameras; leave out cameras"
            )
        table = read_toml(Path(path))
        known = {"events": {"camera"}, "frames": {"camera", "transform"}}
        for name, part in table.items():
            if name not in known or not isinstance(part, dict) or not set(part) <= known[name]:
                raise InputError(
                    f"{path}: [{name}] is not known or holds more than camera and transform; give "
                    "[events] camera and [frames] camera, transform"
                )

        def camera(name: str) -> PinholeCamera | None:
            values = table.get(name, {}).get("camera")
            if values is None:
                return None
            numbers = np.ravel(_check_numbers(values, f"{path}: [{name}] camera"))
            if len(numbers) == 4:
                numbers = np.concatenate([numbers, np.zeros(5)])
            return make_camera(numbers, f"{path}: [{name}] camera")

        own, other = camera("events") or events, camera("frames")
        if own is None or other is None:
            raise InputError(
                f"{path}: has no camera of the {'frames' if own else 'events'}, nor has the "
                f"recording; add [{'frames' if own else 'events'}] camera = [fx, fy, cx, cy, ...]"
            )
        where = f"{path}: [frames] transform"
        transform = _check_numbers(
            table.get("frames", {}).get("transform", np.eye(4).tolist()), where
        )
        if transform.shape not in ((3, 4), (4, 4)):
            raise InputError(f"{where} has the shape {transform.shape}; give four rows of four")
        try:
            return cls(own, other, transform[:3, :3], transform[:3, 3])
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    @classmethod
    def _from_camchain(
        cls,
        path: Path,
        cameras: tuple[str, str] | None,
        sizes: tuple[tuple[int, int], tuple[int, int]] | None,
    ) -> "Rig":
        """Read a rig from a camchain; see `read`."""
        found = calibration.read_cameras(path)
        own, other = cameras or _choose_cameras(path, found, sizes)
        for name in (own, other):
            if name not in found:
                raise InputError(f"{path}: has no camera {name!r}; give two of {', '.join(found)}")
        lenses = [calibration.lens_of(found, name, path) for name in (own, other)]
        try:
            from_events = np.linalg.inv(found[own].transform)
            transform = found[other].transform @ from_events
            return cls(*lenses, transform[:3, :3], transform[:3, 3])
        except np.linalg.LinAlgError:
            raise InputError(
                f"{path}: the T_cn_cnm1 of {own} is no transform; correct it"
            ) from None
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def grid(
        self,
        size: tuple[int, int],
        other: tuple[int, int],
        *,
        depth: ArrayLike | float | int = math.inf,
        plane: tuple[float | int, float | int, float | int, float | int] | None = None,
    ) -> Grid:
        """Return the grid that maps each pixel of the event camera to the other one's images.

        Hartley and Zisserman, Multiple View Geometry, 2nd ed., sections 6.1 and 7.4: the pixel's
        distortion is undone, its ray X = Z (x, y, 1) ends at `depth`, and X is projected.

        Args:
            size: (width, height) of the event camera.
            other: (width, height) of the other one.
            depth: Z in m in the event camera, one number or (height, width); infinite: so far
                that the translation does not matter, NaN: not known. Occlusion in the other
                camera by something nearer is not noticed.
            plane: (a, b, c, d): the scene is a X + b Y + c Z = d, m, in the event camera's axes,
                instead of `depth`.

        Returns:
            The grid (height, width, 2), px, NaN outside the other camera's images.

        Raises:
            InputError: The depth is of another shape or not positive, the plane is none, or the
                distortion of the event camera has no inverse in its image.
        """
        width, height = size
        ray = pixel_rays(self.events, size)
        if plane is not None:
            normal, distance = np.asarray(plane[:3], np.float64), float(plane[3])
            if not np.isfinite(plane).all() or not normal.any() or distance == 0:
                raise InputError(
                    f"the plane {list(plane)} is none that a camera can see; give a, b, c, d of "
                    "a X + b Y + c Z = d with d in m, not 0"
                )
            facing = ray @ normal
            Z = distance / np.where(facing == 0, np.nan, facing)
        else:
            Z = np.asarray(depth, np.float64)
            if Z.shape not in ((), (height, width)) or (Z <= 0).any() or np.isnan(Z).all():
                raise InputError(
                    f"a depth of shape {Z.shape} from {Z.min():g} m cannot be used; give metres "
                    f"above 0, one number or ({height}, {width})"
                )
            Z = np.broadcast_to(Z, (height, width)).ravel()
        ahead = Z > 0
        # X / Z, so that infinite depth is no special case.
        seen = ray @ self.rotation.T + self.translation / np.where(ahead, Z, np.nan)[:, None]
        return mask_outside(project(self.frames, seen), other).reshape(height, width, 2)


def _choose_cameras(
    path: Path,
    found: Mapping[str, calibration.CalibratedCamera],
    sizes: tuple[tuple[int, int], tuple[int, int]] | None,
) -> tuple[str, str]:
    """Return the names of the event camera and the other one of a camchain, by their sizes."""
    if len(found) < 2:
        raise InputError(f"{path}: holds one camera, {', '.join(found)}; give two of one camchain")
    pairs = [
        pair
        for pair in itertools.permutations(found, 2)
        if sizes is None
        or all(found[one].size in (None, size) for one, size in zip(pair, sizes, strict=True))
    ]
    if not pairs:
        held = ", ".join(f"{name} {one.size}" for name, one in found.items())
        raise InputError(
            f"{path}: holds {held}, which are not of the sizes {sizes} of the recording and the "
            "frames; name two cameras with cameras= or --cameras"
        )
    if len(pairs) > 1 and len(found) > 2:
        raise InputError(
            f"{path}: holds {', '.join(found)}; name the event camera and the other one with "
            "cameras= or --cameras"
        )
    return pairs[0]


def _check_numbers(values: Any, where: str) -> NDArray[np.float64]:
    """Convert numbers to an array, checked.

    Args:
        values: Numbers, in nested lists.
        where: Name of their place, for messages.

    Returns:
        The array.

    Raises:
        InputError: They are no finite numbers.
    """
    try:
        numbers = np.array(values, np.float64)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    if not np.isfinite(numbers).all():
        raise InputError(f"{where} is not a list of finite numbers; give numbers")
    return numbers
