"""Video from events and frames: the asynchronous Kalman filter and its baselines."""

from jaxevent.reconstruction.compensated import mc
from jaxevent.reconstruction.complementary import cf, cf_augmented, high_pass
from jaxevent.reconstruction.direct import augmented, blend, edi, last_frame
from jaxevent.reconstruction.kalman import akf
from jaxevent.reconstruction.optical_flow import flow
from jaxevent.reconstruction.smoother import aks

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
