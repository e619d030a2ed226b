"""Egomotion: how the camera moved, from events alone, and what is true of it.

- `motion`: what every estimator gives, at any time;
- `METHODS`, the estimators: `voting` by particle filters, `batch` by a fit to many events at once,
  `contrast` of warped events, `planes` on the surface of active events, `frames` by optical flow;
- `batch_fit`: what `batch` is made of;
- `flow`: the optical flow of each event, once the motion is known;
- `candidates`: of each event its earlier neighbours, prepared once;
- `geometry`: the flow of a rigid scene, residuals of matched events, rotations and twists;
- `truth`: the camera's twist from poses or a gyro, and the errors of an estimate.

All speak of the camera's own twist (T, Omega) in its axes, x to the right, y down, z forward.

    motion = egomotion.estimate(recording, model="rotation", seed=0)
    mean, covariance, lost = motion(times)
"""

import importlib
from collections.abc import Iterator, Mapping
from types import ModuleType
from typing import TYPE_CHECKING, Any

from jaxevent.egomotion import geometry, truth
from jaxevent.egomotion import particle_filter as voting
from jaxevent.egomotion.motion import COMPONENTS, Motion, States
from jaxevent.egomotion.particle_filter import Params, prepare
from jaxevent.egomotion.truth import Twists, from_gyro, from_poses, gyro_bias, motion_errors
from jaxevent.errors import InputError
from jaxevent.parameters import Parameters, nearest
from jaxevent.recording import Recording

if TYPE_CHECKING:
    from jaxevent.egomotion import flow
    from jaxevent.egomotion.baselines import contrast_maximisation as contrast
    from jaxevent.egomotion.baselines import local_planes as planes
    from jaxevent.egomotion.baselines import tracked_points as frames
    from jaxevent.egomotion.batch_fit import windows as batch

__all__ = [
    "COMPONENTS",
    "METHODS",
    "Motion",
    "Params",
    "States",
    "Twists",
    "batch",
    "contrast",
    "estimate",
    "find_method",
    "flow",
    "frames",
    "from_gyro",
    "from_poses",
    "geometry",
    "gyro_bias",
    "motion_errors",
    "planes",
    "prepare",
    "truth",
    "voting",
]


class _Methods(Mapping[str, ModuleType]):
    """Estimators by name, each loaded when it is first asked for."""

    _homes = {
        "voting": "particle_filter",
        "batch": "batch_fit.windows",
        "contrast": "baselines.contrast_maximisation",
        "planes": "baselines.local_planes",
        "frames": "baselines.tracked_points",
    }

    def __getitem__(self, name: str) -> ModuleType:
        return importlib.import_module(f"{__name__}.{self._homes[name]}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._homes)

    def __len__(self) -> int:
        return len(self._homes)


METHODS: Mapping[str, ModuleType] = _Methods()


def find_method(name: str | None, model: str) -> ModuleType:
    """The estimator of a motion model by name; None: voting, and batch for general motion.

    It has `Params`, `MODELS` and `estimate`. Raises `InputError` for an unknown model or method and
    for a method that does not know the model.
    """
    if model not in COMPONENTS:
        raise InputError(f"there is no motion model {model!r}; {nearest(model, COMPONENTS)}")
    name = name or ("batch" if model == "general" else "voting")
    if name not in METHODS:
        raise InputError(f"there is no method {name!r}; {nearest(name, METHODS)}")
    method = METHODS[name]
    if model not in method.MODELS:
        raise InputError(
            f"the method {name!r} does not know {model} motion but {' and '.join(method.MODELS)}; "
            "choose another model or method"
        )
    return method


def estimate(
    recording: Recording,
    params: Parameters | None = None,
    *,
    method: str | None = None,
    model: str = "planar",
    seed: int = 0,
    progress: bool = False,
    **settings: Any,
) -> Motion:
    """The motion of the camera that made a recording.

    `model` is "planar", "rotation" or "general", see `Motion`. `method` is a name of `METHODS`, by
    default "voting", and "batch" for general motion; `params` are of its `Params`, and what else it
    takes are `settings`, as the `camera` (default: the recording's). The same seed gives the same
    motion. Raises `InputError` for an unknown method or model and as the method does.
    """
    return find_method(method, model).estimate(
        recording, params, model=model, seed=seed, progress=progress, **settings
    )


def __getattr__(name: str) -> Any:
    if name in METHODS:
        return METHODS[name]
    if name == "flow":
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
