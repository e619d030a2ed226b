"""Candidates: earlier neighbours of events, against which motions are scored. On the host.

A point of the scene that crosses the pixels fires at one after another. So the earlier events of
the same polarity near an event are candidates for its predecessor. Each has a displacement d (px)
and an age dt (s), and a motion with image velocity U explains it if d = U dt. Candidates depend on
the data only. They are sampled once, in batches of fixed shape, for any number of runs.

Several events per pixel are candidates, not only the latest. An edge fires bursts, and the last
event of a burst is late, so with the latest events alone every motion would be too fast.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.codegen import njit_noalloc
from jaxevent.deprecated import renamed_methods
from jaxevent.egomotion.geometry import centred_coordinates
from jaxevent.recording import Recording

EVENTS_PER_READ = 65536  # events read from a file at a time
NEVER_US = np.iinfo(np.int64).min // 2  # us, before all events
# A gap is as long as this and as this many mean intervals between events of the whole sensor.
MIN_GAP_US = 2000
MIN_GAP_INTERVALS = 50
N_MEAN_INTERVALS = 256  # number over which intervals are averaged
FIRST_INTERVAL_NS = 1_000_000
ANY_FLOW = np.array([0, 0, np.inf])[:, None, None]  # gate that lets all candidates in
MAX_GAP_FRACTION = 0.5  # of the range of ages, from which an event says nothing

Numeric = Array | np.ndarray
Ages = float | int | NDArray[np.floating]


class ExpectedFlow(NamedTuple):
    """A range of flows: candidates are at most margin + slack dt (px) from d = U dt.

    Arrays (rows, columns) are for as many equal parts of the sensor.
    """

    U: NDArray[np.floating]  # (2, rows, columns) px/s
    slack: NDArray[np.floating]  # (rows, columns) px/s
    margin: float  # px


@renamed_methods(room="bounds", reach="radius")
class Candidates(eqx.Module):
    """Batches of K events with up to C candidates each; an axis of batches leads where stacked.

    Unused entries have the age 0, as no candidate has; see `mask`. If an event has more than C
    candidates, C of them are sampled in even steps.
    """

    d: Float[Numeric, "*batches K C 2"]  # px, (x, y) of the event less those of the candidate
    age: Float[Numeric, "*batches K C"]  # s
    xi: Float[Numeric, "*batches K 2"]  # px, of the event; see `pixel_coordinates`
    bounds: Float[Numeric, "*batches K 2 2"]  # px, least and largest d within the sensor, (x, y)
    valid: Bool[Numeric, "*batches K"]  # false for padding, and where candidates are missing
    scale: Float[Numeric, "*batches K"]  # number of candidates that each stands for
    rate: Float[Numeric, "*batches K"]  # 1/s, candidates per time of age
    elapsed: Float[Numeric, "*batches"]  # s, from the last event of the batch before to this one's
    history: Float[Numeric, "*batches"]  # s, age up to which all candidates are known
    radius: int = eqx.field(static=True)  # px, largest distance of a candidate in x and y

    @property
    def mask(self) -> Bool[Numeric, "*batches K C"]:
        """Return which entries hold a candidate."""
        return self.age > 0

    @property
    def most_used(self) -> int:
        """Largest number of candidates of an event."""
        return int(np.asarray(self.mask.sum(-1)).max(initial=0))

    def shorten(self, most: int) -> "Candidates":
        """Return the candidates without the entries beyond a number, which none may fill."""
        return dataclasses.replace(self, d=self.d[..., :most, :], age=self.age[..., :most])


class CandidateBatches(NamedTuple):
    """Some batches of candidates, and the events that they belong to.

    Attributes:
        candidates: The candidates.
        t: (batches,) time of the last event, us; empty batches repeat the one before.
        row: (batches, K) rows of the events in the recording, -1 for padding.
    """

    candidates: Candidates
    t: NDArray[np.int64]
    row: NDArray[np.int64]


def pixel_coordinates(
    width: int, height: int, camera: PinholeCamera | None
) -> tuple[NDArray[np.float64], float]:
    """Return undistorted positions of all pixels.

    Args:
        width: Width of the sensor, px.
        height: Height of the sensor, px.
        camera: The camera; without one positions are relative to the middle of the sensor.

    Returns:
        Positions (height, width, 2), px, and their focal length, px; 1 without a camera.

    Raises:
        InputError: The distortion has no inverse; see `geometry.centred_coordinates`.
    """
    y, x = np.mgrid[:height, :width].astype(np.float64)
    if camera is None:
        return np.stack([x - (width - 1) / 2, y - (height - 1) / 2], -1), 1.0
    xi, f = centred_coordinates(camera, x.ravel(), y.ravel())
    return xi.reshape(height, width, 2), f


@renamed_methods(gather="sample", whole="sample_all", done="is_exhausted")
class CandidateSampler:
    """Sampler of the candidates of a recording, some batches after another.

    One event in `every` is scored, all are candidates. The candidates of an event are the
    `per_pixel` latest earlier events of the same polarity at each pixel up to `radius` away in x
    and y. Those of the same timestamp are left out.

    Args:
        recording: The recording.
        camera: The camera that undistorts displacements, or None.
        radius: Largest distance of a candidate in x and y, px.
        per_pixel: Number of latest events of a pixel that may be candidates.
        most: Largest number of candidates of an event; of more these many in even steps.
        every: One event in so many is scored.
        batch: Number of scored events of a batch.
        longest: Largest duration of a batch, s; it may hold fewer events.
        silence: Gap between events after which the history starts anew, s.

    Where the whole sensor is silent, as where a driver drops events, there are no candidates. An
    event is not valid, and says nothing of the motion, if the latest such gap covers more than
    `MAX_GAP_FRACTION` of its range of ages.
    """

    def __init__(
        self,
        recording: Recording,
        camera: PinholeCamera | None = None,
        *,
        radius: int = 6,
        per_pixel: int = 8,
        most: int = 128,
        every: int = 8,
        batch: int = 64,
        longest: float | int = 0.02,
        silence: float | int = 0.1,
    ):
        self.recording, self.radius = recording, radius
        self.most, self.every, self.batch = most, every, batch
        self.longest, self.silence = round(1e6 * longest), round(1e6 * silence)
        shape = recording.height, recording.width
        self.xi, self.f = pixel_coordinates(recording.width, recording.height, camera)
        self._recent = RecentEvents(
            self.xi,
            np.full((2, *shape, per_pixel), NEVER_US),
            np.zeros((2, *shape), np.int16),
            np.zeros((3, (2 * radius + 1) ** 2 * per_pixel)),
        )
        self._row = 0
        self._last = int(recording.events[:1].t[0]) if len(recording.events) else 0
        # Start of the history, last event, mean interval (ns), begin and end of the latest gap.
        self._clock = np.array([self._last, self._last, FIRST_INTERVAL_NS, NEVER_US, NEVER_US])

    @property
    def is_exhausted(self) -> bool:
        """Return whether all events have been sampled."""
        return self._row >= len(self.recording.events)

    @property
    def next_row(self) -> int:
        """Row of the first event that has not been sampled."""
        return self._row

    @property
    def next_time(self) -> int:
        """Time of the first event that has not been sampled, us; that of the last if all have."""
        row = min(self._row, len(self.recording.events) - 1)
        return int(self.recording.events[row : row + 1].t[0]) if row >= 0 else self._last

    def skip(self, until: int) -> None:
        """Make candidates of the next events up to a time, but score none of them.

        Args:
            until: The time, us, of the first event that may be scored.
        """
        no_ages = np.array([[[1]], [[0]]])
        rules = BatchRules(
            no_ages, ANY_FLOW, 0.0, -NEVER_US, self.longest, -NEVER_US, self.radius, self.silence
        )
        unused, stop = self._make_arrays(1), self.recording.events.index(until)
        while self._row < stop:
            events = self.recording.events[self._row : min(self._row + EVENTS_PER_READ, stop)]
            stream = EventStream(events.t, events.x, events.y, events.p, 1)
            cursor = np.array([0, 0, 0, -NEVER_US])
            _fill_batches(stream, rules, self._recent, unused, cursor, self._clock)
            self._row += len(events)
            self._last = int(events.t[-1])

    def _make_arrays(self, batches: int) -> "CandidateArrays":
        """Make the arrays of some batches, empty."""
        real, shape = np.dtype(jnp.result_type(float)), (batches, self.batch)
        return CandidateArrays(
            d=np.zeros((*shape, self.most, 2), real),
            age=np.zeros((*shape, self.most), real),
            xi=np.zeros((*shape, 2), real),
            bounds=np.zeros((*shape, 2, 2), real),
            scale=np.ones(shape, real),
            rate=np.zeros(shape, real),
            valid=np.zeros(shape, bool),
            row=np.full(shape, -1),
            t=np.zeros(batches, np.int64),
            history=np.zeros(batches, real),
        )

    def sample(
        self,
        batches: int,
        youngest: Ages,
        oldest: Ages,
        span: float | int = np.inf,
        expected: ExpectedFlow | None = None,
    ) -> CandidateBatches:
        """Sample the next batches.

        Args:
            batches: Number of batches. The last ones are empty if no event is left.
            youngest: Least age of candidates, s; an array (rows, columns) is for as many equal
                parts of the sensor.
            oldest: Largest age of candidates, s; likewise.
            span: Largest time from the first event to the last, s; later ones are left for the next
                call.
            expected: The flow near which candidates are sampled; by default all are.

        Returns:
            The batches, always of the same shape.
        """
        real, out = np.dtype(jnp.result_type(float)), self._make_arrays(batches)
        young, old = np.broadcast_arrays(np.atleast_2d(youngest), np.atleast_2d(oldest))
        # Single precision may fall short of a whole number of microseconds.
        young, old = 1e6 * (1 - 1e-6) * young, 1e6 * (1 + 1e-6) * old
        limits = np.stack([np.maximum(1, np.ceil(young)), np.floor(old)])
        limits = np.minimum(limits, -NEVER_US / 2).astype(np.int64)
        if expected is None:
            gate, margin = ANY_FLOW, 0.0
        else:
            gate = np.concatenate([expected.U, expected.slack[None]]).astype(np.float64, order="C")
            margin = expected.margin
        span = -NEVER_US if span == np.inf else round(1e6 * span)
        rules = BatchRules(
            limits, gate, margin, self.every, self.longest, span, self.radius, self.silence
        )
        # Batch, events in it, time of its first, and after which no event is used.
        cursor = np.array([0, 0, 0, -NEVER_US])
        full = False
        while not full and not self.is_exhausted:
            events = self.recording.events[self._row : self._row + EVENTS_PER_READ]
            stream = EventStream(events.t, events.x, events.y, events.p, self._row)
            used, full = _fill_batches(stream, rules, self._recent, out, cursor, self._clock)
            self._row += used
        t, history = out.t, out.history
        filled = cursor[0] + (cursor[1] > 0)
        history[filled:] = history[filled - 1] if filled else 0
        t[filled:] = t[filled - 1] if filled else self._last
        history = np.minimum(history, 1e-6 * limits[1].min())
        elapsed = np.diff(t, prepend=self._last) * 1e-6
        self._last = int(t[-1])
        candidates = Candidates(
            out.d, out.age, out.xi, out.bounds, out.valid, out.scale, out.rate,
            elapsed.astype(real), history.astype(real), self.radius,
        )  # fmt: skip
        return CandidateBatches(candidates, t, out.row)

    def sample_all(self, youngest: Ages, oldest: Ages) -> CandidateBatches:
        """Sample all batches that are left, at least one, of a recording that fits into memory.

        Args:
            youngest: Least age of candidates, s.
            oldest: Largest age of candidates, s.

        Returns:
            The batches.
        """
        parts: list[CandidateBatches] = []
        while not parts or not self.is_exhausted:
            parts.append(self.sample(64, youngest, oldest))
        return join_batches(parts)


def join_batches(parts: Sequence[CandidateBatches]) -> CandidateBatches:
    """Join the batches of several calls of `CandidateSampler.sample`, at least one.

    Args:
        parts: The batches, in the order of the calls.

    Returns:
        All of them, without empty ones at the ends of the parts.
    """
    used = [int((part.row >= 0).any(-1).sum()) for part in parts]
    used[0] = max(1, used[0])

    def join(arrays: Iterable[Any]) -> NDArray:
        return np.concatenate([array[:n] for array, n in zip(arrays, used, strict=True)])

    names = {field.name for field in dataclasses.fields(Candidates)} - {"radius"}
    fields = {name: join(getattr(part.candidates, name) for part in parts) for name in names}
    candidates = Candidates(**fields, radius=parts[0].candidates.radius)
    t, row = (join(getattr(part, name) for part in parts) for name in ("t", "row"))
    return CandidateBatches(candidates, t, row)


class EventStream(NamedTuple):
    """Events that were read, and their place in the recording.

    Attributes:
        t: (n,) times, us.
        x: (n,) columns, px.
        y: (n,) rows, px.
        p: (n,) polarities.
        row: Row of the first event in the recording.
    """

    t: NDArray
    x: NDArray
    y: NDArray
    p: NDArray
    row: int


class BatchRules(NamedTuple):
    """Rules by which batches are filled, see `CandidateSampler.sample`.

    Attributes:
        limits: (2, rows, columns) least and largest age of candidates, us.
        gate: (3, rows, columns) expected flow along x and y, and its slack, px/s.
        margin: Displacement that candidates may differ from the expected one beside the slack, px.
        every: One event in so many is scored.
        longest: Largest duration of a batch, us.
        span: Largest time from the first event to the last, us.
        radius: Largest distance of a candidate in x and y, px.
        silence: Gap between events after which the history starts anew, us.
    """

    limits: NDArray[np.int64]
    gate: NDArray[np.float64]
    margin: float
    every: int
    longest: int
    span: int
    radius: int
    silence: int


class RecentEvents(NamedTuple):
    """The latest events of each pixel, in rings, and scratch for the candidates of one event."""

    position: NDArray  # (height, width, 2) px
    ring: NDArray  # (2, height, width, per_pixel) us
    head: NDArray  # (2, height, width) index of the newest in the ring
    scratch: NDArray  # (3, candidates)


class CandidateArrays(NamedTuple):
    """Arrays of `Candidates` and `CandidateBatches`, to be filled.

    Attributes:
        d: (batches, K, C, 2) displacement from candidate to event, px.
        age: (batches, K, C) age of each candidate, s; 0: unused.
        xi: (batches, K, 2) positions of events, px.
        bounds: (batches, K, 2, 2) least and largest displacement within the sensor, px.
        scale: (batches, K) number of candidates that each stands for.
        rate: (batches, K) candidates per time of age, 1/s.
        valid: (batches, K) whether an event is scored.
        row: (batches, K) rows of the events in the recording, -1 for padding.
        t: (batches,) times of the last events, us.
        history: (batches,) age up to which all candidates are known, s.
    """

    d: NDArray
    age: NDArray
    xi: NDArray
    bounds: NDArray
    scale: NDArray
    rate: NDArray
    valid: NDArray
    row: NDArray
    t: NDArray
    history: NDArray


@njit_noalloc
def _fill_batches(stream, rules, recent, out, cursor, clock):
    """Fill batches from events.

    Args:
        stream: Times (us), columns, rows and polarities of events, and the row of the first.
        rules: Limits and numbers of the sampler.
        recent: `RecentEvents`, changed in place.
        out: Arrays of the batches, output.
        cursor: (4,) batch, events in it, its first time, and the last time (us); changed in place.
        clock: (5,) state of the history, see `CandidateSampler`; changed in place.

    Returns:
        Number of events used, and whether all batches are full.
    """
    # Names of their own: numba reads arrays out of tuples anew in every loop.
    t_in, x, y, p, row_in = stream
    limits, gate, margin, every, longest, span, radius, silence = rules
    position, ring, head, scratch = recent
    d, age, xi, bounds, scale, rate, valid, row, t, history = out
    batch, fill, first, until = cursor
    parts_y, parts_x = limits.shape[1:]
    gates_y, gates_x = gate.shape[1:]
    batches, size, most = age.shape
    height, width, kept = ring.shape[1], ring.shape[2], ring.shape[3]
    for i in range(len(t_in)):
        now, column, line, sign = t_in[i], int(x[i]), int(y[i]), int(p[i])
        interval = now - clock[1]
        if interval > silence:
            clock[0] = now
        if interval > MIN_GAP_US and 1000 * interval > MIN_GAP_INTERVALS * clock[2]:
            clock[3], clock[4] = clock[1], now
        else:
            clock[2] += (1000 * interval - clock[2]) // N_MEAN_INTERVALS
        clock[1] = now
        if (row_in + i) % every == 0:
            if fill == size or (fill > 0 and now - first > longest):
                batch, fill = batch + 1, 0
            if batch == batches or now > until:
                cursor[0], cursor[1], cursor[2], cursor[3] = batch, fill, first, until
                return i, True
            if fill == 0:
                if batch == 0:
                    until = now + span
                first = now
            found, number = 0, 0
            part_y, part_x = line * parts_y // height, column * parts_x // width
            youngest, oldest = limits[0, part_y, part_x], limits[1, part_y, part_x]
            part_y, part_x = line * gates_y // height, column * gates_x // width
            flow_x, flow_y, slack = gate[:, part_y, part_x]
            here_x, here_y = position[line, column, 0], position[line, column, 1]
            for v in range(max(0, line - radius), min(height, line + radius + 1)):
                for u in range(max(0, column - radius), min(width, column + radius + 1)):
                    newest = head[sign, v, u]
                    for k in range(kept):
                        past = now - ring[sign, v, u, newest - k]  # from the end below 0
                        if past > oldest:
                            break
                        if past < youngest:
                            continue
                        number += 1
                        dt = past * 1e-6
                        dx, dy = here_x - position[v, u, 0], here_y - position[v, u, 1]
                        off = (dx - flow_x * dt) ** 2 + (dy - flow_y * dt) ** 2
                        if off <= (margin + slack * dt) ** 2:
                            scratch[0, found], scratch[1, found], scratch[2, found] = dx, dy, dt
                            found += 1
            # Steps of found / C from an offset that changes from event to event (multiples of the
            # golden ratio, evenly spread): every candidate is equally probable.
            taken = min(found, most)
            offset = ((row_in + i) * 0.6180339887498949) % 1.0
            for c in range(taken):
                j = c if found <= most else min(int((c + offset) * found / most), found - 1)
                d[batch, fill, c, 0] = scratch[0, j]
                d[batch, fill, c, 1] = scratch[1, j]
                age[batch, fill, c] = scratch[2, j]
            scale[batch, fill] = found / most if found > most else 1.0
            ages = min(oldest, now - clock[0]) - youngest
            rate[batch, fill] = number / (ages * 1e-6) if ages > 0 else 0.0
            xi[batch, fill, 0] = here_x
            xi[batch, fill, 1] = here_y
            # d is the event's position less the candidate's: least for a candidate at the far side.
            bounds[batch, fill, 0, 0] = here_x - position[line, width - 1, 0]
            bounds[batch, fill, 1, 0] = here_x - position[line, 0, 0]
            bounds[batch, fill, 0, 1] = here_y - position[height - 1, column, 1]
            bounds[batch, fill, 1, 1] = here_y - position[0, column, 1]
            missing = min(clock[4], now - youngest) - max(clock[3], now - oldest)
            valid[batch, fill] = missing <= MAX_GAP_FRACTION * (oldest - youngest)
            row[batch, fill] = row_in + i
            t[batch] = now
            history[batch] = (now - clock[0]) * 1e-6
            fill += 1
        at = (head[sign, line, column] + 1) % kept
        head[sign, line, column] = at
        ring[sign, line, column, at] = now
    cursor[0], cursor[1], cursor[2], cursor[3] = batch, fill, first, until
    return len(t_in), False
