"""Multi-target tracker on windows of events.

Each track is a Kalman filter of constant velocity in windows of one length; its size follows that
of its events. A window without events is a measurement too: where no more events come than clutter
gives, size and position hold, and a target that has been silent for two windows stands still, for
events need motion.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.background import Background, poisson_nats
from jaxevent.blob.search.config import CONFIG
from jaxevent.blob.search.detection import (
    Blobs,
    ClutterModel,
    Scale,
    add_moments,
    clutter_at,
    clutter_model,
    detect,
    finish_moments,
    in_contact,
    larger_variance,
    larger_variance_of,
    measure_blobs,
    split_blob,
)
from jaxevent.blob.search.paths import TargetPath, fit_velocity_noise
from jaxevent.blob.search.stream import Stream, WindowEvents
from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.progress import bar


class TrackTable(NamedTuple):
    """Tracks of one moment; arrays begin with the number of tracks.

    Attributes:
        id: Serial numbers.
        t: Times of the last detections, s.
        p: (n, 2) positions, px.
        v: (n, 2) velocities, px/s.
        P: (n, 3) variance of p, covariance of p and v, and variance of v, of each axis.
        C: (n, 2, 2) covariances of events, px^2.
        n: Events per window.
        max_n: Largest number of events per window, slowly forgotten.
        q: Velocity noise, px^2/s^3.
        nis: Mean normalised innovation squared.
        born: Times of birth, s.
        hits: Windows with a detection.
        misses: Windows without one since the last detection.
        nats: Evidence against clutter, nats.
        confirmed: Whether the track is confirmed.
    """

    id: NDArray[np.int64]
    t: NDArray[np.float64]
    p: NDArray[np.float64]
    v: NDArray[np.float64]
    P: NDArray[np.float64]
    C: NDArray[np.float64]
    n: NDArray[np.float64]
    max_n: NDArray[np.float64]
    q: NDArray[np.float64]
    nis: NDArray[np.float64]
    born: NDArray[np.float64]
    hits: NDArray[np.int64]
    misses: NDArray[np.int64]
    nats: NDArray[np.float64]
    confirmed: NDArray[np.bool_]

    def take(self, rows: NDArray) -> "TrackTable":
        """Return some of the tracks."""
        return TrackTable._make(value[rows] for value in self)

    def append(self, other: "TrackTable") -> "TrackTable":
        """Return these tracks and others."""
        return TrackTable._make(np.concatenate(pair) for pair in zip(self, other, strict=True))

    @property
    def size(self) -> NDArray[np.float64]:
        """(n,) px, standard deviations along the longer axes."""
        return np.sqrt(larger_variance(self.C))


class TrackGates(NamedTuple):
    """Predictions of tracks for a window, and their gates."""

    t: float  # s, middle of the window
    window: float  # s
    p: NDArray[np.float64]  # (n, 2) px, predicted positions
    P: NDArray[np.float64]  # (n, 3), predicted variances, see `TrackTable`
    v: NDArray[np.float64]  # (n, 2) px/s
    inverse: NDArray[np.float64]  # (n, 4), inverse innovation covariance xx, xy, yy; ln determinant
    penalty: NDArray[np.float64]  # (n,) added to the squared distance of an event
    events: NDArray[np.float64]  # (n,) expected events
    shared: NDArray[np.bool_]  # (n,) whether events are shared with a track in contact
    compact: bool  # whether ellipses describe the targets


class Assignments(NamedTuple):
    """Assignment of a window's events and blobs to tracks, and the moments of their residuals."""

    owner: NDArray[np.int64]  # (events,) track of each event, -1: none
    table: NDArray[np.int64]  # (blobs, tracks) events of a blob in a track's gate
    counts: NDArray[np.int64]  # (blobs,) events of a blob
    owns: NDArray[np.bool_]  # (blobs, tracks) whether a track may own the rest of a blob
    in_blobs: Blobs  # residuals of the tracks' events in blobs
    gated: Blobs  # those of all their events, if some track has fewer than two in blobs


class TrackMeasurements(NamedTuple):
    """Measurements of tracks in a window."""

    detected: NDArray[np.bool_]  # (n,) whether the track has a measurement
    n: NDArray[np.float64]  # (n,) events
    z: NDArray[np.float64]  # (n, 2) px, innovation: mean of the residuals
    R: NDArray[np.float64]  # (n,) px^2, its variance


class WindowTracker:
    """Tracker of all targets in a stream: `WindowTracker(stream, background, scale).run(name)`."""

    def __init__(self, stream: Stream, background: Background, scale: Scale):
        self.stream, self.background, self.scale = stream, background, scale
        self.tracks = init_tracks(np.zeros(0, np.int64), 0.0, Blobs.zeros(0), scale.window)
        self.next_id = 0
        # States of tracks after windows: t, id, p, v, C, events, their mean (px), its variance.
        self.rows: list[tuple[NDArray, ...]] = []
        self.evidence: dict[int, float] = {}  # nats for two targets, of some tracks
        self.confirmed: set[int] = set()
        tests = stream.width * stream.height * stream.duration / scale.window
        self.log_threshold = np.log(tests / CONFIG.false_alarms)

    def run(self, name: str, progress: bool | None = None) -> list[TargetPath]:
        """Track through the stream.

        Args:
            name: Text before the bar of progress.
            progress: Whether a bar is shown; None: in a terminal or notebook.

        Returns:
            Paths of all tracks that were confirmed.
        """
        w = self.scale.window
        windows = int(self.stream.duration / w)
        with bar(total=windows, unit="window", desc=name, progress=progress) as shown:
            for k in range(windows):
                self._step(k * w)
                shown.update(1)
        if not self.rows:
            return []
        t, ids, p, v, C, n, m, R = (
            np.concatenate(column) for column in zip(*self.rows, strict=True)
        )
        us = self.stream.start + np.rint(t * 1e6).astype(np.int64)
        paths, window = [], round(1e6 * w)
        for one in sorted(self.confirmed):
            at = np.flatnonzero(ids == one)
            unit = np.median(larger_variance(C[at])) / w**3
            noise = fit_velocity_noise(t[at], m[at], R[at], unit)
            paths.append(TargetPath(us[at], p[at], v[at], C[at], n[at], window, noise))
        return paths

    def _step(self, begin: float | int) -> None:
        """Track through the window that begins at a time (s)."""
        w, shape = self.scale.window, self.stream.shape
        t = begin + w / 2
        events = self.stream.window(begin, begin + w)
        clutter = clutter_model(self.background, self.scale, shape, t)
        labels, blobs = detect(events, clutter, shape)
        gates = predict_gates(self.tracks, t, w, self.scale.compact)
        assignments = assign(gates, events, labels, blobs)
        if len(self.tracks.id):
            self._update(gates, clutter, assignments)
            if self.scale.compact or self.background.scene is None:
                self._split_tracks(events, gates, assignments)
            self.tracks = self.tracks.take(~self._find_ended())
        free, least = assignments.owner < 0, 1 - CONFIG.claimed_share
        n = np.bincount(labels[free], minlength=blobs + 1)[1:]
        new = (n >= CONFIG.min_blob_events) & (n >= least * assignments.counts)
        if new.any():
            rest = WindowEvents(events.t[free], events.x[free], events.y[free])
            moments = measure_blobs(rest, labels[free], blobs)
            ids = np.arange(self.next_id, self.next_id + new.sum())
            self.next_id += len(ids)
            started = Blobs._make(value[new] for value in moments)
            self._append_tracks(init_tracks(ids, t, started, w), t)

    def _update(self, gates: TrackGates, clutter: ClutterModel, assignments: Assignments) -> None:
        """Update all tracks with a window's events, and confirm some."""
        tracks = self.tracks
        measured = update_tracks(tracks, gates, clutter, assignments.in_blobs, assignments.gated)
        now = measured.detected
        if not tracks.confirmed.all():
            age = np.rint((gates.t - tracks.born) / self.scale.window) + 1
            enough = tracks.hits >= CONFIG.min_confirm_windows
            enough &= tracks.hits >= CONFIG.majority * age
            enough &= tracks.nats > self.log_threshold
            tracks.confirmed[now & enough] = True
            self.confirmed |= set(tracks.id[tracks.confirmed].tolist())
        t, m = np.full(len(now), gates.t), gates.p + measured.z
        columns = (t, tracks.id, tracks.p, tracks.v, tracks.C, measured.n, m, measured.R)
        self.rows.append(tuple(value[now] for value in columns))

    def _split_tracks(self, events: WindowEvents, gates: TrackGates, assigned: Assignments) -> None:
        """Split each track whose events are likelier those of two targets than of one.

        The evidence of windows is summed while it is positive. A part has the history of the whole.
        Where targets are no ellipses, what is no farther apart than pieces of one outline stays
        one, and several windows must show two.
        """
        tracks, before, two = self.tracks, self.evidence, Blobs.zeros(2)
        self.evidence, parts = {}, []
        for i in np.flatnonzero(tracks.confirmed & (tracks.misses == 0) & ~gates.shared):
            nats = split_blob(events, assigned.owner, int(i), two)
            if not gates.compact:
                apart, sizes = np.hypot(*(two.p[1] - two.p[0])), np.sqrt(larger_variance(two.C))
                if apart < 1.5 * CONFIG.contact_distance * sizes.sum():
                    continue
                nats = min(nats, self.log_threshold / CONFIG.min_windows)
            key = int(tracks.id[i])
            nats += before.get(key, 0.0)
            if nats > self.log_threshold:
                part = tracks.take(np.array([i]))
                for k, (one, at) in enumerate(((tracks, i), (part, 0))):
                    one.p[at], one.C[at], one.n[at] = two.p[k], two.C[k], two.n[k]
                part.id[0], self.next_id = self.next_id, self.next_id + 1
                self.confirmed.add(int(part.id[0]))
                parts.append(part)
            elif nats > 0:
                self.evidence[key] = nats
        for part in parts:
            self._append_tracks(part, gates.t)

    def _find_ended(self) -> NDArray[np.bool_]:
        """Find tracks that are outside, or without events for too long."""
        tracks, (rows, columns) = self.tracks, self.stream.shape
        x, y = tracks.p.T
        outside = (x <= -1) | (x >= columns) | (y <= -1) | (y >= rows)
        longest = CONFIG.max_coast_windows
        if self.background.scene is not None:
            longest = CONFIG.min_confirm_windows
        coast = np.minimum(longest, 2 * tracks.hits)
        coast = np.where(tracks.confirmed, coast, CONFIG.still_windows)
        return outside | (tracks.misses > coast)

    def _append_tracks(self, new: TrackTable, t: float | int) -> None:
        """Append tracks, and their states at a time (s) to the rows."""
        self.tracks = self.tracks.append(new)
        R, at = larger_variance(new.C) / 2 / new.n, np.full(len(new.n), t)
        columns = at, new.id, new.p, new.v, new.C, new.n, new.p, R
        self.rows.append(tuple(value.copy() for value in columns))


def init_tracks(ids: NDArray, t: float | int, blobs: Blobs, window: float | int) -> TrackTable:
    """Start a tentative track at each blob.

    Args:
        ids: Serial numbers of the tracks.
        t: Time of the blobs, s.
        blobs: Moments of the blobs.
        window: Length of windows, s.
    """
    n, p, C = blobs
    number, square = len(ids), larger_variance(C)
    zero, none = np.zeros(number), np.zeros(number, np.int64)
    variance = square / np.maximum(n, 1) + CONFIG.mean_error_sizes * square
    P = np.stack([variance, zero, 9 * (square + 1) / window**2], 1)
    # An error of 0.3 sizes after one window.
    q = 0.3**2 * (square + 0.5) * 3 / window**3
    return TrackTable(
        ids, zero + t, p, np.zeros((number, 2)), P, C, n, n.copy(), q, zero + 1, zero + t,
        none + 1, none, zero.copy(), np.zeros(number, bool),
    )  # fmt: skip


def predict_gates(
    tracks: TrackTable, t: float | int, window: float | int, compact: bool = False
) -> TrackGates:
    """Predict all tracks to the middle t (s) of a window, and compute their gates.

    A known target leaves its way by about its size in a window: what is farther is another one.
    Known targets in contact share the events between them.

    Args:
        tracks: Tracks.
        t: Middle of the window, s.
        window: Its length, s.
        compact: Whether ellipses describe the targets: their sizes then follow shared events too.
    """
    n = len(tracks.n)
    gates = TrackGates(
        float(t), float(window), np.empty((n, 2)), np.empty((n, 3)), tracks.v, np.empty((n, 4)),
        np.empty(n), tracks.n, np.zeros(n, bool), compact,
    )  # fmt: skip
    _predict_gates(tracks, gates)
    return gates


@njit_noalloc
def _predict_gates(tracks: Any, gates: Any) -> None:
    """Predict all tracks, and compute their gates.

    Args:
        tracks: `TrackTable`.
        gates: `TrackGates`, output.
    """
    for k in range(len(tracks.n)):
        C, known = tracks.C[k], tracks.confirmed[k]
        _predict_track(tracks, k, gates)
        variance = gates.P[k, 0]
        if known:
            variance = min(variance, larger_variance_of(C))
        more = 1 + 2 / tracks.n[k]
        a, b, c = C[0, 0] * more + variance + 0.1, C[0, 1] * more, C[1, 1] * more + variance + 0.1
        determinant = a * c - b * b
        inverse = gates.inverse[k]
        inverse[0], inverse[1], inverse[2] = c / determinant, -b / determinant, a / determinant
        inverse[3], gates.penalty[k] = np.log(determinant), 0.0 if known else 2.0
        for j in range(k):
            if known and tracks.confirmed[j] and in_contact(gates.p, tracks.C, j, k):
                gates.shared[j] = gates.shared[k] = True


@njit_noalloc_inlined
def _predict_track(tracks: Any, k: int, gates: Any) -> None:
    """Predict one track; no noise drives a target that stands still.

    Args:
        tracks: `TrackTable`.
        k: Index of the track.
        gates: `TrackGates`; fills `p` and `P` of the track.
    """
    dt, q, P = gates.t - tracks.t[k], 0.0, gates.P
    if tracks.misses[k] < CONFIG.still_windows:
        q = tracks.q[k] * min(max(tracks.nis[k], 0.05), 50.0)
    a, b, c = tracks.P[k, 0], tracks.P[k, 1], tracks.P[k, 2]
    P[k, 0] = a + 2 * b * dt + c * dt**2 + q * dt**3 / 3
    P[k, 1], P[k, 2] = b + c * dt + q * dt**2 / 2, c + q * dt
    for i in range(2):
        gates.p[k, i] = tracks.p[k, i] + tracks.v[k, i] * dt


def assign(gates: TrackGates, events: WindowEvents, labels: NDArray, blobs: int) -> Assignments:
    """Assign each event of the window to at most one track.

    Args:
        gates: Predictions of all tracks.
        events: Events of the window.
        labels: (events,) blob of each event, from 1 on; 0 for none.
        blobs: Number of blobs.
    """
    tracks, shared = len(gates.p), np.flatnonzero(gates.shared)
    out = Assignments(
        np.full(len(events), -1), np.zeros((blobs, tracks), np.int64),
        np.bincount(labels, minlength=blobs + 1)[1:], np.zeros((blobs, tracks), bool),
        Blobs.zeros(tracks), Blobs.zeros(tracks),
    )  # fmt: skip
    _assign(events, labels, gates, (shared, np.zeros(len(shared))), out)
    return out


@njit_noalloc
def _assign(events: Any, labels: Any, gates: Any, scratch: Any, out: Any) -> None:
    """Assign events to tracks, and compute the moments of their residuals.

    Args:
        events: `WindowEvents`.
        labels: (events,) blob of each event, from 1 on; 0 for none.
        gates: `TrackGates`.
        scratch: Indices of the tracks that share events, and a number for each.
        out: `Assignments`, output.
    """
    _assign_owners(events, labels, gates, out)
    _sum_residuals(events, labels, True, gates, scratch, out)
    for k in range(len(gates.p)):
        if out.in_blobs.n[k] < 2:
            _sum_residuals(events, labels, False, gates, scratch, out)
            break


@njit_noalloc_inlined
def _residual(gates: Any, k: int, events: Any, i: int) -> tuple[float, float, float]:
    """Return the distance of an event from a track's place at that time, px, and its square.

    Args:
        gates: `TrackGates`.
        k: Index of the track.
        events: `WindowEvents`.
        i: Index of the event.

    Returns:
        Distance along x and y, px, and the squared distance in standard deviations.
    """
    late, inverse = events.t[i] - gates.t, gates.inverse[k]
    ex = events.x[i] - gates.p[k, 0] - gates.v[k, 0] * late
    ey = events.y[i] - gates.p[k, 1] - gates.v[k, 1] * late
    return ex, ey, inverse[0] * ex * ex + 2 * inverse[1] * ex * ey + inverse[2] * ey * ey


@njit_noalloc_inlined
def _assign_owners(events: Any, labels: Any, gates: Any, out: Any) -> None:
    """Assign events to tracks, and the rest of a blob to the tracks that own most of it.

    A target may grow at once or leave its gate.

    Args:
        events: `WindowEvents`.
        labels: (events,) blob of each event, from 1 on; 0 for none.
        gates: `TrackGates`.
        out: `Assignments`; fills `owner`, `table` and `owns`.
    """
    owner, table, counts, owns = out.owner, out.table, out.counts, out.owns
    tracks, inverse, gate = len(gates.p), gates.inverse, CONFIG.gate_sigmas
    for i in range(len(labels)):
        least = np.inf
        for k in range(tracks):
            _, _, squared = _residual(gates, k, events, i)
            distance = squared + inverse[k, 3] + gates.penalty[k]
            if squared < gate * gate and distance < least:
                least, owner[i] = distance, k
        if labels[i] > 0 and owner[i] >= 0:
            table[labels[i] - 1, owner[i]] += 1
    for k in range(len(counts)):
        claimed, most = 0, 0
        for j in range(tracks):
            claimed += table[k, j]
            most = max(most, table[k, j])
        if claimed >= CONFIG.claimed_share * counts[k]:
            for j in range(tracks):
                enough = min((1 - CONFIG.nearly_all) * counts[k], most)
                owns[k, j] = table[k, j] >= enough and table[k, j] > 0
    for i in range(len(labels)):
        blob, k = labels[i] - 1, owner[i]
        if blob < 0:
            continue
        if k >= 0 and (owns[blob, k] or gates.penalty[k] == 0):
            continue
        least = np.inf
        for k in range(tracks):
            if owns[blob, k]:
                _, _, squared = _residual(gates, k, events, i)
                distance = squared + inverse[k, 3] + gates.penalty[k]
                if distance < least:
                    least, owner[i] = distance, k


@njit_noalloc_inlined
def _sum_residuals(
    events: Any, labels: Any, in_blobs: bool, gates: Any, scratch: Any, out: Any
) -> None:
    """Compute the moments of residuals; tracks in contact share events in both gates.

    Args:
        events: `WindowEvents`.
        labels: (events,) blob of each event, from 1 on; 0 for none.
        in_blobs: Whether events outside blobs are left out.
        gates: `TrackGates`.
        scratch: Indices of the tracks that share events, and a number for each.
        out: `Assignments`; fills `in_blobs` or `gated`.
    """
    blobs, gate = out.in_blobs if in_blobs else out.gated, CONFIG.gate_sigmas
    shared, share = scratch
    for i in range(len(labels)):
        if in_blobs and labels[i] <= 0:
            continue
        sharing = 0
        for j in range(len(shared)):
            k = shared[j]
            _, _, squared = _residual(gates, k, events, i)
            share[j] = 0.0
            if squared < gate * gate:
                sharing += 1
                share[j] = np.exp(-0.5 * (squared + gates.inverse[k, 3])) * gates.events[k]
        if sharing > 1:
            total = 0.0
            for j in range(len(shared)):
                total += share[j]
            for j in range(len(shared)):
                if share[j] > 0:
                    ex, ey, _ = _residual(gates, shared[j], events, i)
                    add_moments(blobs, shared[j], share[j] / total, ex, ey)
        elif out.owner[i] >= 0:
            ex, ey, _ = _residual(gates, out.owner[i], events, i)
            add_moments(blobs, out.owner[i], 1.0, ex, ey)
    finish_moments(blobs, len(blobs.n))


def update_tracks(
    tracks: TrackTable, gates: TrackGates, clutter: ClutterModel, in_blobs: Blobs, gated: Blobs
) -> TrackMeasurements:
    """Update all tracks with one window's events, in place.

    Args:
        tracks: Tracks before the window.
        gates: Their predictions.
        clutter: Clutter of the window.
        in_blobs: Moments of the residuals of events in blobs.
        gated: Moments of those of all events. In a known place fewer events are a detection; they
            move a track but do not change its size.

    Returns:
        Measurements of the tracks.
    """
    n = len(tracks.n)
    out = TrackMeasurements(np.zeros(n, bool), np.zeros(n), np.zeros((n, 2)), np.zeros(n))
    _update_tracks(tracks, gates, clutter, in_blobs, gated, out)
    return out


@njit_noalloc_inlined
def _gate_clutter(gates: Any, clutter: Any, x: float, y: float, determinant: float) -> Any:
    """Return the expected clutter events in a gate, and their dispersion.

    Args:
        gates: `TrackGates`.
        clutter: `ClutterModel`.
        x: Column of the gate's middle, px.
        y: Row of the gate's middle, px.
        determinant: Determinant of the gate's covariance, px^4.

    Returns:
        Expected events, and their variance over mean.
    """
    gate = CONFIG.gate_sigmas
    area = np.pi * gate * gate * np.sqrt(max(determinant, 0.0))
    rate, dispersion = clutter_at(clutter, x, y)
    return max(rate * area * gates.window, 1e-3), dispersion


@njit_noalloc
def _update_tracks(
    tracks: Any, gates: Any, clutter: Any, in_blobs: Any, gated: Any, out: Any
) -> None:
    """Compute the measurements, and update each track as detected or missed.

    Args:
        tracks: `TrackTable`, in place.
        gates: `TrackGates`.
        clutter: `ClutterModel`.
        in_blobs: `Blobs` of the residuals of events in blobs.
        gated: `Blobs` of the residuals of all events.
        out: `TrackMeasurements`, output.
    """
    for k in range(len(tracks.n)):
        (n, z, D), in_blob = (in_blobs.n[k], in_blobs.p[k], in_blobs.C[k]), True
        C, variance = tracks.C[k], gates.P[k, 0]
        if n < 2:
            in_blob, more = False, variance + 0.1
            determinant = (C[0, 0] + more) * (C[1, 1] + more) - C[0, 1] * C[0, 1]
            mu, F = _gate_clutter(gates, clutter, gates.p[k, 0], gates.p[k, 1], determinant)
            known = tracks.confirmed[k]
            threshold = -np.log(CONFIG.false_alarm_known if known else CONFIG.false_alarm_new)
            n = 0.0
            if gated.n[k] >= 2 and poisson_nats(gated.n[k], mu) / F >= threshold:
                n, z, D = gated.n[k], gated.p[k], gated.C[k]
        if n >= 2:
            tracks.max_n[k] = max(0.99 * tracks.max_n[k], n)
        known_n = CONFIG.prior_size_events
        square = (n * larger_variance_of(D) + known_n * larger_variance_of(C)) / (n + known_n)
        out.z[k, 0], out.z[k, 1], out.R[k], out.n[k] = z[0], z[1], square / 2 / max(n, 1.0), n
        detected = n >= 2 and n >= CONFIG.min_event_share * tracks.max_n[k]
        out.detected[k] = detected and _passes_gate(tracks, k, n, z, variance + out.R[k])
        if out.detected[k]:
            _update_detected(tracks, gates, clutter, k, (n, z, D, square, in_blob))
        else:
            _update_missed(tracks, gates, k)


@njit_noalloc_inlined
def _passes_gate(tracks: Any, k: int, n: float, z: Any, variance: float) -> bool:
    """Return whether the events of a measurement may be those of a track.

    A known target is not where few events are that its motion does not lead to, except for parts of
    it that are seen by turns. Most of its events may follow a turn, but no farther than it allows.

    Args:
        tracks: `TrackTable`.
        k: Index of the track.
        n: Number of events.
        z: (2,) innovation, px.
        variance: Its variance by the prediction, px^2.

    Returns:
        Whether they may.
    """
    offset, square = CONFIG.part_offset_sizes, larger_variance_of(tracks.C[k])
    if n >= CONFIG.majority * tracks.n[k]:
        variance = max(variance, square)
    gate = CONFIG.gate_sigmas
    most = gate * gate * min(variance + offset * offset * square, 2 * square)
    return tracks.hits[k] < CONFIG.min_motion_windows or z[0] * z[0] + z[1] * z[1] <= most


@njit_noalloc_inlined
def _update_missed(tracks: Any, gates: Any, k: int) -> None:
    """Update a track without detection.

    A target that stands still goes on, if at all, no faster than before.

    Args:
        tracks: `TrackTable`, in place.
        gates: `TrackGates`.
        k: Index of the track.
    """
    tracks.misses[k] += 1
    if tracks.misses[k] == CONFIG.still_windows:
        # Or by its size in the time that it is held.
        fast = tracks.v[k, 0] ** 2 + tracks.v[k, 1] ** 2
        held = CONFIG.max_coast_windows * gates.window
        fast += larger_variance_of(tracks.C[k]) / held**2
        tracks.P[k, 2] = min(tracks.P[k, 2], fast)
        tracks.v[k, 0] = tracks.v[k, 1] = tracks.P[k, 1] = 0


@njit_noalloc_inlined
def _update_detected(tracks: Any, gates: Any, clutter: Any, k: int, measurement: Any) -> None:
    """Update a track with a measurement.

    Args:
        tracks: `TrackTable`, in place.
        gates: `TrackGates`.
        clutter: `ClutterModel`.
        k: Index of the track.
        measurement: Number of events, their mean (2,), px, and covariance (2, 2), px^2, about the
            prediction, the variance of one event, px^2, and whether the events are in blobs.
    """
    (n, z, D, square, in_blob), P, alone = measurement, gates.P[k], not gates.shared[k]
    error = CONFIG.mean_error_sizes
    total = P[0] + square / 2 / max(n, 1.0) + square * error**2 + 1e-3
    if alone:
        nis = min((z[0] * z[0] + z[1] * z[1]) / 2 / total, 30.0)
        tracks.nis[k] += 0.15 * (nis - tracks.nis[k])
    a, b = P[0] / total, P[1] / total
    for i in range(2):
        tracks.p[k, i] = gates.p[k, i] + a * z[i]
        tracks.v[k, i] += b * z[i]
    tracks.P[k, 0], tracks.P[k, 1] = (1 - a) * P[0], (1 - a) * P[1]
    tracks.P[k, 2] = P[2] - b * P[1]
    tracks.t[k], tracks.misses[k] = gates.t, 0
    newer, C = 1 / (tracks.hits[k] + 1), tracks.C[k]
    if (alone or gates.compact) and in_blob:
        gain = max(CONFIG.update_gain * min(1.0, n / tracks.n[k]), newer)
        for i in range(2):
            for j in range(2):
                C[i, j] += gain * (D[i, j] - C[i, j])
    tracks.n[k] += max(CONFIG.update_gain, newer) * (n - tracks.n[k])
    tracks.hits[k] += 1
    determinant = C[0, 0] * C[1, 1] - C[0, 1] * C[0, 1]
    mu, F = _gate_clutter(gates, clutter, tracks.p[k, 0], tracks.p[k, 1], determinant)
    tracks.nats[k] += poisson_nats(n, mu) / F
