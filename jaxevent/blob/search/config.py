"""Choices of the target search, in one table."""

from typing import NamedTuple


class SearchConfig(NamedTuple):
    """Numbers that the search rests on; one set serves all recordings.

    A "size" is the larger standard deviation of a target's events, a "window" the time in which
    events are gathered at the selected scale, and a "slice" one of equal parts of the recording.
    """

    # Shares with one meaning everywhere
    nearly_all: float = 0.9  # share that is nearly all of something; what is left is hardly any
    majority: float = 0.5  # share that is most of something
    considerable: float = 0.25  # share that is a considerable part of something
    resolution_px: float = 0.5  # px; less is no size and no motion

    # Background
    bright_ratio: float = 4.0  # rate of a bright background, in medians of the sensor
    min_fine_events: int = 12  # events per slice and cell from which cells are halved
    max_dispersion_windows: int = 400  # windows in which the dispersion is measured
    min_dispersion_events: float = 5.0  # expected events of a cell whose dispersion is measured

    # Detection of blobs
    false_alarms: float = 0.1  # expected false detections of one recording
    contact_distance: float = 2.0  # sums of sizes within which two blobs are in contact
    min_blob_events: int = 3  # events of a blob, or of a part of one

    # Selection of the scale
    max_scored_events: int = 2000  # events of a window that are scored
    free_shape_gain: float = 0.07  # share of the score that free shapes gain over ellipses at most
    split_loss: float = 0.2  # share of the score lost if all events are in touching blobs
    min_windows: int = 8  # windows, or slices, in a recording or a part of it; a path seen in fewer
    # than twice as many may not be erratic
    scale_trials: int = 24  # places of a recording in which scales are compared; half in later ones
    first_trial_step: int = 4  # every fourth place is evaluated first, to drop worse scales
    dropped_score: float = 0.85  # share of the best score below which a scale is dropped
    dropped_sigmas: float = 2.0  # ... by so many standard deviations of the difference
    equal_score_loss: float = 0.03  # share of the best score that an equally good scale may lose,
    equal_window_loss: float = 0.005  # and among windows of one cell size

    # Tracking from window to window
    gate_sigmas: float = 3.0  # standard deviations
    max_coast_windows: int = 24  # windows without events until a confirmed track ends
    still_windows: int = 2  # windows without events after which a target stands still,
    # and a tentative track ends
    false_alarm_known: float = 1e-3  # probability of a false detection in a confirmed track's gate,
    false_alarm_new: float = 1e-5  # and in the gate of a tentative track
    min_event_share: float = 0.02  # share of a track's largest count that is a detection
    update_gain: float = 0.2  # gain of size and event count
    prior_size_events: float = 8.0  # events that the known size counts for
    part_offset_sizes: float = 0.5  # sizes by which the mean of a few events may be off
    min_motion_windows: int = 3  # windows after which a track's motion is known
    mean_error_sizes: float = 0.05  # sizes; error of a window's mean, as events are not independent
    claimed_share: float = 0.3  # share of a blob in gates that assigns the rest of it to tracks;
    # with less a new track begins
    min_confirm_windows: int = 4  # windows with events until a track and its noise are known, and
    # without them until one before a moving scene ends
    max_squared_innovation: float = 16.0  # variances that an innovation counts at most

    # Likelihoods of one target or two
    resume_probability: float = 0.021  # of going on, or ending, per window of silence
    new_target_volume: float = 2.7  # ln rate times ln area over which new targets spread, times the
    # probability of falling silent
    rate_change: float = 1.0  # standard deviation of ln rate from window to window
    area_change: float = 0.5  # and of ln area
    log_bayes_factor: float = 3.0  # nats from which one hypothesis is taken
    slide_share: float = 0.15  # of its way, by which parts of an object slide along its edges; of
    # their size, by which their middles are off; and of their distance, by which it changes

    # Passes over the recording, and their paths
    max_passes: int = 4
    min_recording_events: int = 100  # events of a recording, or of a window that shows a lag
    min_gain: float = 0.05  # nats per event from which a texture moves; twice for a pass before a
    # moving scene, whose map is inexact everywhere
    erratic_sizes: float = 0.4  # sizes by which a path that is seen in few windows leaves its way
    # in a window at most

    # Parts of one object
    common_way_sizes: float = 2.0  # sizes; least way of what goes along, or a way of its own
    edge_aspect: float = 3.0  # aspect from which a part is a piece of an edge

    # Motion of the scene
    max_image_bins: int = 240  # bins along a side of an aligned image
    outlier_scale: float = 1.5  # rms differences at which a bin has half the weight
    reference_gain: float = 0.07  # share of the newest window in the reference image
    min_rate_share: float = 0.05  # rate of a place without events, in mean rates
    edge_rate: float = 1.5  # mean rates from which a place is bright
    side_width: int = 16  # a strip along a side is this part of the sensor
    edge_min_size_cells: float = 1.5  # size of an edge in fine cells; two stars have 1 to 1.5
    scene_edge_share: float = 0.15  # share of the bright that is edges in a scene, and of a
    # texture that is bright; where a fine cell has few events,
    scene_edge_share_few: float = 0.7  # chance makes edges
    min_travel_px: float = 2.0  # px that a moving scene travels
    own_way_erratic_sizes: float = 0.2  # sizes by which it may leave its way in a window

    # Objects that turn in place
    connected_share: float = 0.96  # connected share of the bright: discs 0.97, blobs up to 0.95
    connected_rate: float = 0.07  # rate of a bright cell, in mean rates of the events

    # Lamps on the mains
    lamp_piece_us: int = 250_000  # us; at 0.5 Hz off the mains 1/8 turn
    lamp_coherence: float = 0.36  # coherence with the mains; targets before lamps have below 0.3
    lamp_sigmas: float = 5.0  # standard deviations of chance coherence

    # Polarity whose events lag
    lag_ratio: float = 1.8  # size of the lagging polarity's events, in those of the other


CONFIG = SearchConfig()
