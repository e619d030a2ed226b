"""Tracking of blobs: bright spots and other compact sources of events."""

from jaxevent.blob.tracker import (
    Params,
    States,
    Tracks,
    negative_log_likelihood,
    position_error,
    prepare,
    prepare_positions,
    track,
)

__all__ = [
    "Params",
    "States",
    "Tracks",
    "negative_log_likelihood",
    "position_error",
    "prepare",
    "prepare_positions",
    "track",
]
