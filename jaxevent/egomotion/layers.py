"""Whether the image moves as one, as planar motion or a rotation makes it move."""

import dataclasses

import numpy as np

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.candidates import coordinates
from jaxevent.egomotion.geometry import rotation_basis
from jaxevent.egomotion.models import Model, Planar, Rotation
from jaxevent.egomotion.patch_fits import looks, planar, rotation, sharpness, standard
from jaxevent.egomotion.patches import Speed, usual_speed
from jaxevent.recording import Recording

Z = 3.0  # from which parts of the image move differently
# Of the usual speed, by patches; of a roll half of them go back.
FACTORS = np.concatenate([-np.geomspace(3.0, 0.3, 25), np.geomspace(0.3, 3.0, 25)])


@dataclasses.dataclass(frozen=True)
class Layers:
    """How differently parts of the image move, along the usual direction.

    `spread` is the standard deviation of their velocities along it, in shares of the usual one, `z`
    how sure it is that they differ, and `slow` and `fast` (px/s) bound the middle four fifths of
    their speeds. `both` tells that some go the usual way and some back.
    """

    spread: float
    z: float
    slow: float
    fast: float
    both: bool

    @property
    def several(self) -> bool:
        """Whether the image does not move as one."""
        return self.z > Z


def layers(
    recording: Recording,
    model: type[Model] = Planar,
    camera: PinholeCamera | None = None,
    speed: Speed | None = None,
) -> Layers | None:
    """Whether the image moves as one, as planar motion or a rotation does; None where nothing is
    seen to move, and of other models.

    Every patch may go its own share of the way that the model makes there. `speed` is the usual
    one, if it is known.
    """
    camera = camera or recording.camera
    uniform = model in (Planar, Rotation)
    speed = (speed or usual_speed(recording, camera)) if uniform else None
    seen = [] if speed is None else looks(recording, speed, camera)
    _, f = coordinates(recording.width, recording.height, camera)
    differ, factors, speeds = [], [], []
    for one in seen:
        d = planar(one)
        if float(np.hypot(*d)) < 1:
            continue
        ways = np.tile(d, (len(one.xi), 1))
        if model is Rotation:
            ways = np.asarray(rotation_basis(one.xi, f)) @ rotation(one, f, d)
        own = np.append(FACTORS, 1.0)[:, None, None] * ways
        train = sharpness(one, 0, own)
        pick, at = train.argmax(0), np.arange(len(one.xi))
        differ.append(sharpness(one, 1, own[pick, at]) - sharpness(one, 1, own[-1]))
        telling = train.max(0) - train[-1] + train.max(0) - np.median(train, 0) > np.log(1.3)
        factor = np.append(FACTORS, 1.0)[pick][telling]
        factors.append(factor)
        speeds.append(np.abs(factor) * np.hypot(*ways[telling].T) / one.length)
    if not factors or not len(np.concatenate(factors)):
        return None
    factor, speed_of = np.concatenate(factors), np.concatenate(speeds)
    low, high = np.percentile(factor, [16, 84])
    slow, fast = np.percentile(speed_of, [10, 90])
    usual = float(np.median(np.abs(factor)))
    spread = float((high - low) / 2 / max(usual, 1e-9))
    return Layers(spread, standard(np.concatenate(differ)), float(slow), float(fast), bool(low < 0))
