"""Video from events and frames: the asynchronous Kalman filter and its baselines."""

import importlib
from typing import TYPE_CHECKING, Any

from jaxevent.deprecated import renamed_names

if TYPE_CHECKING:
    from jaxevent.reconstruction.compensated import mc
    from jaxevent.reconstruction.complementary import cf, cf_augmented, high_pass
    from jaxevent.reconstruction.direct import augmented, blend, edi, last_frame
    from jaxevent.reconstruction.kalman import akf
    from jaxevent.reconstruction.optical_flow import flow
    from jaxevent.reconstruction.smoother import aks

# Loaded when first used: `mc` takes as long to import as all others.
_HOMES = {
    "compensated": ("mc",),
    "complementary": ("cf", "cf_augmented", "high_pass"),
    "direct": ("augmented", "blend", "edi", "last_frame"),
    "kalman": ("akf",),
    "optical_flow": ("flow",),
    "smoother": ("aks",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "akf",
    "aks",
    "augmented",
    "blend",
    "cf",
    "cf_augmented",
    "edi",
    "flow",
    "high_pass",
    "last_frame",
    "mc",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        return renamed_names(__name__)(name)
    return getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
