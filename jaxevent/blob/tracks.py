"""Tracks of many blobs in one stream of events, as a function of time, and their tables."""

import dataclasses
import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.lifecycle import END_REASONS, LifecycleLog
from jaxevent.blob.prepare import ChunkPacker, PackingCursor, Segment
from jaxevent.blob.run import count_numbers
from jaxevent.blob.shape import N_SHAPE_TIMES, UsualSizes, fit_usual_sizes, shape_covariance
from jaxevent.blob.track import TrackStates, track_params
from jaxevent.display import HtmlRepr
from jaxevent.errors import InputError
from jaxevent.precision import to_jax
from jaxevent.progress import bar
from jaxevent.recording import Times, microseconds, one_time
from jaxevent.threads import TurnLock

if TYPE_CHECKING:
    import pandas

MAX_CHECKPOINTS = 32  # states from which tracking can be taken up again
MAX_STATES_PER_READOUT = 2**12  # states that are read out at once
MAX_CACHED_VALUES = 2**24  # numbers of the backward pass that are kept between readings

STATE_COLUMNS = ("x", "y", "vx", "vy", "lambda1", "lambda2", "theta", "q")
STATE_UNITS = ("px", "px", "px/s", "px/s", "px", "px", "rad", "rad/s")
TABLE_UNITS = {
    "t": "s",
    "id": "1",
    **dict(zip(STATE_COLUMNS, STATE_UNITS, strict=True)),
    **{f"sigma_{name}": unit for name, unit in zip(STATE_COLUMNS, STATE_UNITS, strict=True)},
}
TABLE_RATE_HZ = 1000.0  # times per second of a table


def table_columns(
    t: NDArray[np.int64],
    id: NDArray[np.integer],
    mean: NDArray[np.floating],
    covariance: NDArray[np.floating],
) -> dict[str, NDArray]:
    """Arrange tracks as the columns of a table, one row for each track and time.

    Args:
        t: Times (rows,), us.
        id: Numbers of the tracks (rows,).
        mean: States (rows, 8), in `STATE_UNITS`.
        covariance: Their covariances (rows, 8, 8).

    Returns:
        Arrays (rows,) by the names of `TABLE_UNITS`, in those units. A sigma is the square root of
        a variance.
    """
    deviation = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0))
    columns = [t / 1e6, id, *mean.T, *deviation.T]
    return dict(zip(TABLE_UNITS, columns, strict=True))


def evenly_spaced_times(start: int, stop: int, rate: float) -> NDArray[np.int64]:
    """Return times at a rate.

    Args:
        start: First time, us.
        stop: End, which is not included, us.
        rate: 1/s.

    Returns:
        (n,) times, us.
    """
    count = math.ceil((stop - start) * rate / 1e6)
    times = start + np.rint(np.arange(count) * (1e6 / rate)).astype(np.int64)
    return np.unique(times[times < stop])


class AssociatedEvents(NamedTuple):
    """Events of a segment of the recording with their likeliest tracks, one entry for each.

    Attributes:
        row: (n,) row in `recording.events`.
        t: (n,) times, us.
        id: (n,) the likeliest track with the event in its gate; -1: none.
        weight: (n,) weight of the event for this track.
    """

    row: NDArray[np.int64]
    t: NDArray[np.int64]
    id: NDArray[np.int64]
    weight: NDArray[np.floating]


@dataclasses.dataclass
class _History:
    """Life of tracks, by serial number.

    Attributes:
        birth: Time of birth, us.
        confirmed: Time of confirmation, us.
        death: Time of the end, us, and its reason, an index of `END_REASONS`.
    """

    birth: dict[int, int]
    confirmed: dict[int, int]
    death: dict[int, tuple[int, int]] = dataclasses.field(default_factory=dict)

    def add(self, segment: Segment, log: LifecycleLog) -> None:
        """Add the changes of a segment."""
        log = jax.tree.map(np.asarray, log)
        end = segment.start + segment.features.stop
        at = np.nonzero(log.confirmed & (log.id_before >= 0))
        for one, first in zip(*np.unique(log.id_before[at], return_index=True), strict=True):
            self.confirmed.setdefault(int(one), int(end[at[0][first]]))
        for chunk, entry in zip(*np.nonzero(log.end_reason), strict=True):
            when = int(segment.start[chunk]) + int(log.death[chunk, entry])
            reason = int(log.end_reason[chunk, entry])
            self.death[int(log.id_before[chunk, entry])] = when, reason
        new = (log.id_after >= 0) & (log.id_after != log.id_before)
        for chunk, entry in zip(*np.nonzero(new), strict=True):
            self.birth.setdefault(int(log.id_after[chunk, entry]), int(end[chunk]))


def _concatenate_states(parts: Sequence[TrackStates]) -> TrackStates:
    """Concatenate states of equal tracks along time."""
    mean, covariance, valid, idle = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("mean", "covariance", "valid", "idle")
    )
    return TrackStates(mean, covariance, valid, idle, parts[0].id)


def _add_shape_covariance(
    states: TrackStates, times: NDArray[np.int64], usual: list[UsualSizes | None]
) -> None:
    """Add the uncertainty of positions by changes of shape to the covariance of states, in place.

    Args:
        states: States of tracks, (times, tracks).
        times: (times,) us.
        usual: Usual sizes of each track; None where they are unknown.
    """
    for k, sizes in enumerate(usual):
        alive = states.valid[:, k]
        if sizes is not None and alive.any():
            mean, covariance = states.mean[alive, k], states.covariance[alive, k]
            more = shape_covariance(sizes, times[alive] * 1e-6, mean, covariance)
            covariance[:, :2, :2] += more
            states.covariance[alive, k] = covariance


class Tracks(HtmlRepr):
    """Tracks of a recording: `mean, covariance, valid = tracks(times)`.

    Times, arrays of shape (tracks,): `birth`, `death` (the first moment without the track; for one
    that lives to the end, that of the last event + 1) and `confirmed`, int64 us. `id` are whole
    numbers that are never used again, the seeds' first and in the order given; tracks that were
    never confirmed are left out. `ended` gives the reason of the end: "end" of the events, "idle",
    "left" the image, "size" beyond limits, "uncertain" position, "merged" with an older one, "not
    finite".

    With `smooth` states rest on all events of the recording, those after the time included, see
    `jaxevent.blob.smoother`; `filtered` are these tracks with states that rest on the events up to
    the time. Births, deaths and the association of events are always the filter's.

    Only the state at the start of some segments and the result of the backward pass are kept.
    Reading runs the segments with the requested times again, so that memory hardly grows with the
    recording's length. Threads may share tracks, and tracks can be pickled and copied.
    """

    def __init__(
        self,
        runner: Any,
        packer: ChunkPacker,
        smooth: bool = False,
        progress: bool | None = None,
    ):
        self.recording, self.params, self.smooth = packer.recording, runner.params, smooth
        self.start, self.stop = packer.start, packer.stop
        self._runner, self._packer, self._progress = runner, packer, progress
        self._turns = TurnLock(f"tracks of {packer.recording.name}")
        self._checkpoints: list[tuple[PackingCursor, int, Any]] = []
        # The result of the backward pass in the last segments, up to `MAX_CACHED_VALUES`.
        self._kept_infos: dict[PackingCursor, Any] = {}
        # Times (us) and the filtered sizes at these, (times, tracks, 2) px, by segments.
        self._sizes_read: list[tuple[NDArray[np.int64], NDArray]] = []
        self._assign_ids(self._run_all())

    def __len__(self) -> int:
        return len(self.id)

    def __getstate__(self) -> dict[str, Any]:
        """Return everything but what is computed again on request."""
        state = {k: v for k, v in vars(self).items() if k != "_segment_infos"}
        return {**state, "_kept_infos": {}, "_sizes_read": []}

    def track_params(self, id: int | np.integer) -> Any:
        """Return the parameters of a track; those of targets that were found differ.

        Args:
            id: Number of the track.

        Returns:
            The parameters.
        """
        own = {name: to_jax(values[id]) for name, values in self._packer.overrides.items()}
        return track_params(self.params, own)

    @property
    def filtered(self) -> "Tracks":
        """These tracks with states that rest on the events up to each time."""
        other = object.__new__(Tracks)
        vars(other).update(vars(self), smooth=False)
        return other

    def __repr__(self) -> str:
        return f"Tracks({len(self)} of {self.recording.name}, {self.start} to {self.stop} us)"

    def __call__(
        self,
        times: Times,
        ids: Sequence[int] | NDArray[np.integer] | None = None,
        *,
        extrapolate: bool = False,
    ) -> TrackStates:
        """Read out states at some times.

        A filtered state is the prediction from the last step at or before the time; with
        `events_per_step` above 1, a step has the time of its last event.

        Args:
            times: Integers (us) or floats (s), in any order.
            ids: Tracks to read out; None: all.
            extrapolate: Whether times outside the recording, where no track is valid, are allowed.

        Returns:
            States (times, tracks).

        Raises:
            InputError: A time is not finite or outside the recording, or there is no such track.
        """
        times = np.atleast_1d(microseconds(times))
        order = np.argsort(times, kind="stable")
        parts = [states for _, states in self.batches(times[order], ids, extrapolate=extrapolate)]
        chosen = self._indices_of(ids)
        if not parts:
            return self._invalid_states(times, chosen)
        states = _concatenate_states(parts)
        back = np.argsort(order, kind="stable")
        fields = (value[back] for value in (*states, states.idle))
        return TrackStates(*fields, self.id[chosen])

    def batches(
        self,
        times: Times,
        ids: Sequence[int] | NDArray[np.integer] | None = None,
        *,
        extrapolate: bool = False,
    ) -> Iterator[tuple[NDArray[np.int64], TrackStates]]:
        """Read out states at sorted times, some after others, in bounded memory.

        Args:
            times: Sorted integers (us) or floats (s).
            ids: Tracks to read out; None: all.
            extrapolate: Whether times outside the recording are allowed.

        Yields:
            Times (us) and the states at these.

        Raises:
            InputError: See the call; also times that are not sorted.
        """
        held: list[tuple[NDArray[np.int64], TrackStates]] = []

        def join_held() -> tuple[NDArray[np.int64], TrackStates]:
            return np.concatenate([t for t, _ in held]), _concatenate_states([s for _, s in held])

        usual = [self._usual_sizes[k] for k in self._indices_of(ids)]
        for now, piece in self._read_by_segment(times, ids, extrapolate):
            _add_shape_covariance(piece, now, usual)
            held.append((now, piece))
            if sum(states.valid.size for _, states in held) >= MAX_STATES_PER_READOUT:
                yield join_held()
                held.clear()
        if held:
            yield join_held()

    def to_dataframe(
        self,
        times: Times | None = None,
        ids: Sequence[int] | NDArray[np.integer] | None = None,
    ) -> "pandas.DataFrame":
        """Make a pandas table of the tracks, the one that `jaxevent track` writes as CSV.

        Args:
            times: Integers (us) or floats (s), in any order; by default 1000 per second.
            ids: Which tracks; by default all.

        Returns:
            A row for each time and track that is alive then, by time and then by track. The columns
            are t (s), id, the state x, y, vx, vy, lambda1, lambda2, theta, q and its standard
            deviations sigma_x ... sigma_q. `attrs["units"]` has the unit of each column.

        Raises:
            InputError: A time is outside the recording, or there is no such track.
        """
        import pandas

        if times is None:
            times = evenly_spaced_times(self.start, self.stop, TABLE_RATE_HZ)
        times = np.sort(np.atleast_1d(microseconds(times)))
        nothing = self._invalid_states(np.zeros(0, np.int64), self._indices_of(ids))
        parts: list[list[NDArray]] = []
        for t, states in [(times[:0], nothing), *self.batches(times, ids)]:
            row, place = np.nonzero(states.valid)
            own = states.mean[row, place], states.covariance[row, place]
            parts.append([t[row], states.id[place], *own])
        joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
        table = pandas.DataFrame(table_columns(*joined))
        table.attrs["units"] = dict(TABLE_UNITS)
        return table

    def _read_by_segment(
        self, times: Times, ids: Sequence[int] | NDArray[np.integer] | None, extrapolate: bool
    ) -> Iterator[tuple[NDArray[np.int64], TrackStates]]:
        """Read out states at sorted times, in pieces of one segment each; see `batches`.

        Args:
            times: Sorted times, integers in us or floats in s.
            ids: Numbers of the tracks; None: all.
            extrapolate: Whether times outside the tracked ones are allowed.

        Yields:
            Times, us, and states at these.

        Raises:
            InputError: Times are not sorted, or outside without `extrapolate`.
        """
        times = np.atleast_1d(microseconds(times))
        if (times[1:] < times[:-1]).any():
            raise InputError("times must be sorted to be read in batches; sort them")
        if not extrapolate:
            self._packer.check_times(times)
        chosen = self._indices_of(ids)
        first, end = (int(i) for i in np.searchsorted(times, [self.start, self.stop]))
        if first:
            yield times[:first], self._invalid_states(times[:first], chosen)
        if not len(self) and end > first:
            yield times[first:end], self._invalid_states(times[first:end], chosen)
            first = end
        for segment, record, infos in self._replay(times[first:end]):
            upto = end
            if segment.next is not None:
                upto = int(np.searchsorted(times[:end], segment.next.start))
            yield from self._readout_segment(segment, record, infos, times[first:upto], chosen)
            first = upto
        if first < len(times):
            yield times[first:], self._invalid_states(times[first:], chosen)

    def events(
        self, start: int | float | None = None, stop: int | float | None = None
    ) -> Iterator[AssociatedEvents]:
        """Iterate over the events with their likeliest tracks, one segment after another.

        Events outside the tracking and those that the prefilter drops are left out.

        Args:
            start: Begin, int us or float s; None: begin of tracking.
            stop: End, which is left out; None: end of tracking.

        Yields:
            Events of a segment.

        Raises:
            InputError: A time is not finite.
        """
        t0 = self.start if start is None else one_time(start, "the start")
        t1 = self.stop if stop is None else one_time(stop, "the stop")
        t0, t1 = max(t0, self.start), min(t1, self.stop)
        if t0 >= t1 or not self._checkpoints:
            return
        cursor, state = self._checkpoint_before(t0)
        while cursor is not None and cursor.start < t1:
            segment = self._packer.pack(cursor)
            cursor = segment.next
            if cursor is not None and cursor.start <= t0:
                state, _ = self._runner.run(state, segment.features)
                continue
            state, serial, weight = self._runner.associate(state, segment.features)
            valid = np.asarray(segment.features.valid)
            t = (segment.start[:, None, None] + segment.features.t)[valid]
            now = (t >= t0) & (t < t1)
            yield AssociatedEvents(
                segment.row[valid][now], t[now], self._id_of[serial[valid][now]],
                weight[valid][now],
            )  # fmt: skip

    @functools.cached_property
    def _usual_sizes(self) -> list[UsualSizes | None]:
        """Usual sizes of the tracks of found targets, from filtered states; None where unknown."""
        times = self._shape_times
        if not len(times):
            return [None] * len(self)
        if self.smooth:
            with self._turns:
                _ = self._segment_infos  # also fills `_sizes_read`
            read = sorted(self._sizes_read, key=lambda one: int(one[0][0]))
        else:
            read = [
                (now, states.mean[..., 4:6])
                for now, states in self._read_by_segment(times, None, False)
            ]
        t, sizes = (np.concatenate(column) for column in zip(*read, strict=True))
        alive = (self.birth <= t[:, None]) & (t[:, None] < self.death)
        return [
            fit_usual_sizes(t[alive[:, k]] * 1e-6, sizes[alive[:, k], k], edge)
            for k, edge in enumerate(self._packer.found_edges)
        ]

    @property
    def _shape_times(self) -> NDArray[np.int64]:
        """Times (us) at which sizes of found targets are read; none without such targets."""
        if self._packer.found_ends is None or not len(self):
            return np.zeros(0, np.int64)
        times = np.linspace(self.start, self.stop - 1, N_SHAPE_TIMES).astype(np.int64)
        return np.unique(times)

    def _indices_of(self, ids: Sequence[int] | NDArray[np.integer] | None) -> NDArray[np.int64]:
        """Return the indices of tracks in the arrays."""
        if ids is None:
            return np.arange(len(self))
        for one in ids:
            if one not in self.id:
                raise InputError(
                    f"{self.recording.name}: there is no track {one}; there are "
                    f"{', '.join(map(str, self.id[:20])) or 'none'}"
                )
        return np.array([int(np.flatnonzero(self.id == one)[0]) for one in ids], np.int64)

    def _invalid_states(self, times: NDArray[np.int64], chosen: NDArray[np.int64]) -> TrackStates:
        """Make states that are not valid at any time.

        Args:
            times: (times,) us.
            chosen: (tracks,) indices of tracks.

        Returns:
            The states, all NaN.
        """
        shape, real = (len(times), len(chosen)), np.dtype(jnp.result_type(float))
        return TrackStates(
            np.full((*shape, 8), np.nan, real),
            np.full((*shape, 8, 8), np.nan, real),
            np.zeros(shape, bool),
            np.full(shape, np.nan, real),
            self.id[chosen],
        )

    def _readout_segment(
        self,
        segment: Segment,
        record: Any,
        infos: Any,
        times: NDArray[np.int64],
        chosen: NDArray[np.int64],
    ) -> Iterator[tuple[NDArray[np.int64], TrackStates]]:
        """Read out some tracks at times of a segment, in batches.

        Args:
            segment: The segment.
            record: Its record.
            infos: Result of its backward pass; None: states are filtered.
            times: (times,) us.
            chosen: (tracks,) indices of the tracks.

        Yields:
            Times of a batch, and the states at these.
        """
        at_once = max(MAX_STATES_PER_READOUT // max(len(chosen), 1), 1)
        for first in range(0, len(times), at_once):
            now = times[first : first + at_once]
            states = self._invalid_states(now, chosen)
            alive = (self.birth[chosen] <= now[:, None]) & (now[:, None] < self.death[chosen])
            some = np.flatnonzero(alive.any(0))
            if len(some):
                serial, requested = self._serial[chosen[some]], alive[:, some]
                values = self._runner.readout(segment, record, infos, now, serial, requested)
                outs = states.mean, states.covariance, states.idle
                for out, value in zip(outs, values, strict=True):
                    out[:, some] = value
            states.valid[:] = alive
            yield now, states

    def _replay(self, times: NDArray[np.int64]) -> Iterator[tuple[Segment, Any, Any]]:
        """Run the segments with some of the sorted times again: their records.

        With `smooth` also the result of the backward pass, else None.
        """
        if not len(times):
            return
        cursor, state = self._checkpoint_before(int(times[0]))
        done = 0
        while done < len(times):
            assert cursor is not None
            now, segment = cursor, self._packer.pack(cursor)
            cursor = segment.next
            upto = len(times) if cursor is None else int(np.searchsorted(times, cursor.start))
            if upto == done:  # none of the times
                state, _ = self._runner.run(state, segment.features)
            else:
                state, record = self._runner.record(state, segment.features)
                infos = None
                if self.smooth:
                    with self._turns:
                        segment_infos = self._segment_infos  # also fills `_kept_infos`
                    infos = self._kept_infos.get(now)
                    if infos is None:
                        infos, _ = self._backward_pass(segment, record, segment_infos)
                yield segment, record, infos
            done = upto
            if done < len(times) and cursor is not None:
                later, known = self._checkpoint_before(int(times[done]))
                if later is not None and later.start > cursor.start:
                    cursor, state = later, known

    def _checkpoint_before(self, time: int) -> tuple[PackingCursor | None, Any]:
        known = [(cursor, state) for cursor, _, state in self._checkpoints if cursor.start <= time]
        return known[-1]

    def _backward_pass(
        self,
        segment: Segment,
        record: Any,
        known: Mapping[PackingCursor, Any],
        max_numbers: int = 0,
    ) -> tuple[Any, Any]:
        """Run the backward pass over a segment.

        Args:
            segment: The segment.
            record: Its record.
            known: Backward information at the start of the next segment.
            max_numbers: Smoothed chunks are kept if they hold at most so many numbers.

        Returns:
            The result for the readout, and the information at the segment's start.
        """
        info, elapsed = None, 0
        if segment.next is not None:
            info, elapsed = known[segment.next], segment.next.start - segment.next.previous
        return self._runner.backward_pass(segment, record, info, elapsed, max_numbers)

    @functools.cached_property
    def _segment_infos(self) -> dict[PackingCursor, Any]:
        """Backward information at the starts of all segments, from the last one on.

        On the way the sizes are read that tell the tracks' usual ones.
        """
        found: dict[PackingCursor, Any] = {}
        left, times, every = MAX_CACHED_VALUES, self._shape_times, np.arange(len(self))
        self._sizes_read.clear()
        with self._bar("smooth") as progress:
            for cursor, state, packed in self._segments_backwards():
                segment = self._packer.pack(cursor) if packed is None else packed
                _, record = self._runner.record(state, segment.features)
                infos, found[cursor] = self._backward_pass(segment, record, found, left)
                left -= count_numbers(infos)
                if left >= 0:
                    self._kept_infos[cursor] = infos
                times, own = np.split(times, [np.searchsorted(times, cursor.start)])
                for now, states in self._readout_segment(segment, record, None, own, every):
                    self._sizes_read.append((now, states.mean[..., 4:6].copy()))
                progress.update(int(np.count_nonzero(segment.features.valid)))
        return found

    def _segments_backwards(self) -> Iterator[tuple[PackingCursor, Any, Segment | None]]:
        """Iterate over all segments from the last to the first, with the states at their starts.

        A segment that happens to be packed is given too.
        """
        end = None
        for first, _, state in reversed(self._checkpoints):
            cursor, starts, segment = first, [], None
            while cursor is not None and cursor != end:
                starts.append((cursor, state))
                segment = self._packer.pack(cursor)
                cursor = segment.next
                if cursor is not None and cursor != end:
                    state, _ = self._runner.run(state, segment.features)
            for cursor, state in reversed(starts):
                yield cursor, state, segment
                segment = None
            end = first

    def _bar(self, title: str) -> Any:
        begin, end = self._packer.rows
        return bar(
            total=end - begin, desc=title, unit="event", unit_scale=True, progress=self._progress
        )

    def _run_all(self) -> _History:
        """Run all segments: all births and deaths, and checkpoints on the way."""
        born = {k: int(t) for k, t in enumerate(self._packer.seeds.t)}
        history = _History(dict(born), dict(born))
        rows = self._packer.rows
        nothing = rows[0] == rows[1] and not born
        cursor: PackingCursor | None = None if nothing else self._packer.first
        state, number, every = None, 0, 1
        logs: list[tuple[Segment, LifecycleLog]] = []
        with self._bar("follow targets") as progress:
            while cursor is not None:
                segment = self._packer.pack(cursor)
                if state is None:
                    state = self._runner.init(segment.features)
                if number % every == 0:
                    self._checkpoints.append((cursor, number, state))
                    if len(self._checkpoints) > MAX_CHECKPOINTS:
                        every *= 2
                        self._checkpoints = [c for c in self._checkpoints if c[1] % every == 0]
                state, log = self._runner.run(state, segment.features)
                logs.append((segment, log))
                if len(logs) > 1:  # while this segment is on the device
                    history.add(*logs.pop(0))
                progress.update(int(np.count_nonzero(segment.features.valid)))
                cursor, number = segment.next, number + 1
            for one in logs:
                history.add(*one)
        return history

    def _assign_ids(self, history: _History) -> None:
        """Give the confirmed tracks their numbers."""
        serial = np.array(sorted(history.confirmed), np.int64)
        index = self._packer.seeds.index
        public = np.arange(len(serial))
        public[: len(index)] = index
        order = np.argsort(public, kind="stable")
        self._serial = serial[order]
        self.id = public[order].astype(np.int64)
        self.birth = np.array([history.birth[k] for k in self._serial], np.int64)
        self.confirmed = np.array([history.confirmed[k] for k in self._serial], np.int64)
        ends = [history.death.get(int(k), (self.stop, 0)) for k in self._serial]
        if self._packer.found_ends is not None:
            found = [(int(end), 1) for end in self._packer.found_ends]
            ends = [min(e, f) if f[0] < self.stop else e for e, f in zip(ends, found, strict=True)]
        self.death = np.array([when for when, _ in ends], np.int64)
        self.ended = tuple(END_REASONS[reason] for _, reason in ends)
        self._id_of = np.full(max([-1, *history.birth]) + 2, -1)  # its last serves the serial -1
        self._id_of[self._serial] = self.id
