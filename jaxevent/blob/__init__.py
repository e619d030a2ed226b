"""Tracking of blobs: bright spots and other compact sources of events.

    tracks = blob.moment.estimate(recording)    # targets and parameters are found
    mean, covariance, valid = tracks(times)

Every method is used in this way, each with its own `Params`.
"""

from jaxevent.blob import quantities
from jaxevent.blob.filter import Filter
from jaxevent.blob.filters.chi2 import chi2, chi2_split
from jaxevent.blob.filters.constant_velocity import constant_velocity
from jaxevent.blob.filters.moment import moment
from jaxevent.blob.filters.moving_moments import moving_moments
from jaxevent.blob.losses import negative_log_likelihood, position_error, prepare_positions
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.search import TargetSearchResult, find
from jaxevent.blob.track import TrackStates
from jaxevent.blob.tracker import Tracker
from jaxevent.blob.tracks import Tracks
from jaxevent.deprecated import renamed_names

__all__ = [
    "Filter",
    "TargetSearchResult",
    "TrackStates",
    "Tracker",
    "TrackerParams",
    "Tracks",
    "chi2",
    "chi2_split",
    "constant_velocity",
    "find",
    "moment",
    "moving_moments",
    "negative_log_likelihood",
    "position_error",
    "prepare_positions",
    "quantities",
]

__getattr__ = renamed_names(__name__)
