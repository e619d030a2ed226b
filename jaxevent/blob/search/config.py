"""Choices of the target search, in one table."""

import math
from typing import NamedTuple


class SearchConfig(NamedTuple):
    """Numbers that the search rests on; one set serves all recordings.

    A "size" is the larger standard deviation of a target's events, a "window" the time in which
    events are gathered at the selected scale, and a "slice" one of equal parts of the recording.
    """

    # Background
    filled_quantile: float = 0.9  # of the counts of a place over slices: its full slices
    bright_ratio: float = 4.0  # rate of a bright background, in medians of the sensor
    steady_ratio: float = 0.5  # least count of a steady cell in nearly all slices, in its medians
    min_fine_events: int = 12  # events per slice and cell from which cells are halved
    min_calm_events: int = 50  # events per slice in calm cells from which activity is measured
    max_dispersion_windows: int = 400  # windows in which the dispersion is measured
    min_dispersion_events: float = 5.0  # expected events of a cell whose dispersion is measured

    # Detection of blobs
    false_alarms: float = 0.1  # expected false detections of one recording
    contact_distance: float = 2.0  # sums of sizes within which two blobs are in contact

    # Selection of the scale
    max_scored_events: int = 2000  # events of a window that are scored
    free_shape_gain: float = 0.07  # share of the score that free shapes gain over ellipses at most
    split_loss: float = 0.2  # share of the score lost if all events are in touching blobs
    min_split_events: int = 3  # events of a blob that may be split
    min_windows: int = 8  # windows in a recording
    scale_trials: int = 24  # places of the recording in which scales are compared,
    later_scale_trials: int = 12  # and for what remains after a pass
    first_trial_step: int = 4  # every fourth place is evaluated first, to drop worse scales
    dropped_score: float = 0.85  # share of the best score below which a scale is dropped
    dropped_sigmas: float = 2.0  # ... by so many standard deviations of the difference
    equal_score_loss: float = 0.03  # share of the best score that an equally good scale may lose,
    equal_window_loss: float = 0.005  # and among windows of one cell size

    # Tracking from window to window
    gate_sigmas: float = 3.0  # standard deviations
    max_coast_windows: int = 24  # windows without events until a confirmed track ends
    max_new_coast_windows: int = 2  # ... until a tentative track ends
    max_moving_coast_windows: int = 4  # ... before a moving scene, which may hide a target
    still_windows: int = 2  # windows without events after which a target stands still
    false_alarm_known: float = 1e-3  # probability of a false detection in a confirmed track's gate,
    false_alarm_new: float = 1e-5  # and in the gate of a tentative track
    min_event_share: float = 0.02  # share of a track's largest count that is a detection
    update_gain: float = 0.2  # gain of size and event count
    prior_size_events: float = 8.0  # events that the known size counts for
    max_turn_sizes: float = 1.0  # sizes by which a target may leave its predicted way in a window
    turn_event_share: float = 0.5  # share of a track's events that allows for such a turn
    part_offset_sizes: float = 0.5  # sizes by which the mean of a few events may be off
    min_motion_windows: int = 3  # windows after which a track's motion is known
    mean_error_sizes: float = 0.05  # sizes; error of a window's mean, as events are not independent
    claimed_share: float = 0.3  # share of a blob in gates that assigns the rest of it to tracks
    owner_share: float = 0.1  # share of a blob in a track's gate that makes the track an owner
    free_share: float = 0.7  # unassigned share of a blob where a track begins
    min_confirm_windows: int = 4  # windows with events until a track is confirmed,
    min_confirm_share: float = 0.5  # and their share of the track's windows
    max_squared_innovation: float = (
        16.0  # variances; larger ones count so much for the velocity noise
    )
    min_noise_windows: int = 4  # windows from which the velocity noise is fitted

    # Likelihoods of one target or two
    stop_probability: float = 0.03  # of falling silent, per window
    start_probability: float = 0.02  # of going on, per window
    end_probability: float = 1e-3  # of an end inside the sensor, per window
    new_target_volume: float = 90.0  # ln rate times ln area over which new targets spread
    rate_change: float = 1.0  # standard deviation of ln rate from window to window
    area_change: float = 0.5  # and of ln area
    log_bayes_factor: float = 3.0  # nats from which one hypothesis is taken
    slide_share: float = 0.15  # of its way, by which parts of an object slide along its edges
    part_error_sizes: float = 0.15  # sizes; error of the middle of a part that is seen by turns
    max_pair_rows: int = 64  # rows of paths on which one object or two is decided

    # Passes over the recording, and their paths
    max_compact_share: float = 0.25  # share of the sensor that a compact target covers at most
    max_passes: int = 4
    min_recording_events: int = 100
    min_gain: float = 0.05  # nats per event from which a pass is made,
    min_moving_gain: float = 0.1  # and before a moving scene, whose map is less exact
    min_size_px: float = 0.5  # px; a smaller target is a pixel
    short_windows: int = 16  # windows; a path seen in fewer may not be erratic:
    erratic_sizes: float = 0.4  # sizes by which it leaves its way in a window
    persistent_share: float = 0.5  # share of a path's windows in which the target is seen
    velocity_windows: int = 8  # windows from which the velocity at an end of a path is measured
    whole_share: float = 0.8  # share of its median size and events at which a target is seen whole
    duplicate_share: float = 0.5  # share of a path near one of an earlier pass: a duplicate

    # Parts of one object
    common_share: float = 0.9  # share of the shorter life in which parts are in contact
    common_way_sizes: float = 2.0  # sizes of the smaller part; least common way
    edge_aspect: float = 3.0  # aspect from which a part is a piece of an edge
    edge_along_share: float = 0.75  # share of its variance along its way: within 30 degrees of it
    edge_event_share: float = 0.25  # events of the piece, as share of a long object's own
    edge_contact: float = 3.0  # contact distance of pieces of an edge
    turning_contact: float = 4.0  # contact distance of parts that turn about each other
    turning_change: float = 0.15  # change of that distance, as share of it
    turning_angle: float = 2 * math.pi  # rad by which they turn

    # Motion of the scene
    max_scene_steps: int = 128  # motions of a recording
    max_step_px: float = 0.5  # px within which a scene is taken as at rest
    max_image_bins: int = 240  # bins along a side of an aligned image
    outlier_scale: float = 1.5  # rms differences at which a bin has half the weight
    reference_gain: float = 0.07  # share of the newest window in the reference image
    calm_share: float = 0.75  # share of the slices that see a place whose counts are used
    min_rate_share: float = 0.05  # rate of a place without events, in mean rates
    filled_tiles: int = 9  # of 4 x 4 tiles in which a scene has blobs
    tile_events: int = 3  # events in blobs of a filled tile
    dark_quantile: float = 0.1  # of the rate; blobs of a scene stand out from it
    edge_rate: float = 1.5  # mean rates from which a place is bright
    side_width: int = 16  # a strip along a side is this part of the sensor
    min_sides: int = 3  # sides that a scene reaches,
    min_side_share: float = 0.25  # in this share of the windows
    edge_length: float = 2.5  # aspect of an edge,
    edge_min_size_cells: float = 1.5  # and its size in fine cells; two stars have 1 to 1.5
    large_share: float = 0.1  # size of a large region, in shorter sides of the map
    scene_edge_share: float = 0.15  # share of the bright that is edges in a scene,
    few_scene_events: int = 3  # where a fine cell has so many events; with fewer
    scene_edge_share_few: float = 0.7  # chance makes edges
    texture_share: float = 0.15  # share of a texture that is bright,
    min_texture_events: int = 20  # with so many events in a fine cell
    texture_gain: float = 0.05  # nats per event that a moving map of a texture gains
    gain_quantile: float = 0.1  # of the gains over windows
    min_travel_px: float = 2.0  # px that a moving scene travels
    pause_level: float = 0.25  # level of a pause, in full slices
    min_pause_slices: int = 8
    dense_level: float = 0.3  # level of a full slice in a dense scene
    own_way_sizes: float = 2.0  # sizes by which a target's own way deviates from its mean
    own_way_erratic_sizes: float = 0.2  # sizes by which it may leave its way in a window

    # Objects that turn in place
    inside_share: float = 0.8  # share of a piece's rows inside the bright place
    turn_search: float = 2.0  # search range beside the expected turn of a window, in such turns
    rim_share: float = 0.98  # share of the events within the outermost ring
    connected_share: float = 0.96  # connected share of the bright: discs 0.97, blobs up to 0.95
    connected_rate: float = 0.07  # rate of a bright cell, in mean rates of the events

    # Lamps on the mains
    lamp_piece_us: int = 250_000  # us; at 0.5 Hz off the mains 1/8 turn
    lamp_coherence: float = 0.36  # coherence with the mains; targets before lamps have below 0.3
    lamp_piece_events: int = 1000  # events of a piece from which its coherence is measured
    lamp_sigmas: float = 5.0  # standard deviations of chance coherence
    lamp_sizes: float = 3.0  # sizes within which a lamp stays
    lamp_quarters: int = 4  # parts of a path, of which a lamp stays in one at least

    # Polarity whose events lag
    lag_ratio: float = 1.8  # size of the lagging polarity's events, in those of the other
    min_sharp_share: float = 0.2  # share of the events of the sharper polarity
    min_sharp_windows: int = 4  # windows with events of the sharper polarity,
    min_sharp_events: int = 2  # and events in each
    lag_test_events: int = 100  # events of a window from which a lag is first sought


CONFIG = SearchConfig()
