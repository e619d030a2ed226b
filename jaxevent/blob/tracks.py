"""Tracks of many blobs in one stream of events, as a function of time."""

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.engine.tracking import FusedRun
from jaxevent.blob.lifecycle import ENDS, Log
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import Mark, Packing, Stretch
from jaxevent.blob.scan import ScanRun, numbers_in
from jaxevent.blob.states import TrackStates
from jaxevent.blob.steps import Filter
from jaxevent.blob.tables import TABLE_RATE, TABLE_UNITS, evenly, table_columns
from jaxevent.display import HtmlRepr
from jaxevent.errors import InputError
from jaxevent.locks import TurnLock
from jaxevent.progress import bar
from jaxevent.recording import Times, microseconds

if TYPE_CHECKING:
    import pandas

BEGINS = 32  # stretches from which tracking can be taken up again
TOGETHER = 2**12  # states that are told of at once
KEPT = 2**24  # numbers of what later events say that are kept between readings


def _joined(parts: Sequence[TrackStates]) -> TrackStates:
    """States of the same tracks, at the times of all."""
    mean, covariance, valid, idle = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("mean", "covariance", "valid", "idle")
    )
    return TrackStates(mean, covariance, valid, idle, parts[0].id)


class Events(NamedTuple):
    """Whose events are, one entry for each event of a stretch of the recording."""

    row: NDArray[np.int64]  # in `recording.events`
    t: NDArray[np.int64]  # us
    id: NDArray[np.int64]  # the likeliest track that holds it in its gate; -1: none
    weight: NDArray[np.floating]  # how much of the event is this track's


@dataclasses.dataclass
class _History:
    """Births, confirmations and deaths (us) by serial number; of deaths also why, see ENDS."""

    birth: dict[int, int]
    confirmed: dict[int, int]
    death: dict[int, tuple[int, int]] = dataclasses.field(default_factory=dict)

    def add(self, stretch: Stretch, told: Log) -> None:
        """Enter those of a stretch."""
        log = jax.tree.map(np.asarray, told)
        end = stretch.start + stretch.features.stop
        at = np.nonzero(log.confirmed & (log.before >= 0))
        for one, first in zip(*np.unique(log.before[at], return_index=True), strict=True):
            self.confirmed.setdefault(int(one), int(end[at[0][first]]))
        for chunk, slot in zip(*np.nonzero(log.ended), strict=True):
            when = int(stretch.start[chunk]) + int(log.death[chunk, slot])
            self.death[int(log.before[chunk, slot])] = when, int(log.ended[chunk, slot])
        new = (log.after >= 0) & (log.after != log.before)
        for chunk, slot in zip(*np.nonzero(new), strict=True):
            self.birth.setdefault(int(log.after[chunk, slot]), int(end[chunk]))


class Tracks(HtmlRepr):
    """Tracks of a recording: `mean, covariance, valid = tracks(times)`.

    Times, arrays of shape (tracks,): `birth`, `death` (the first moment when it is no more; for a
    track that lives to the end, that of the last event + 1) and `confirmed`, int64 us. `id` are
    whole numbers that are never used again, the seeds' first and in the order given; tracks that
    were never confirmed are left out. `ended` says why: "end" of the events, "idle", "left" the
    image, "size" beyond limits, "uncertain" position, "merged" with an older one, "not finite".

    `smooth` says whether states rest on all events of the recording, those after the time
    included, as `jaxevent.blob.smoother` finds them; `filtered` are the same tracks with states
    that rest on the events up to the time. Births, deaths and whose an event is are the filter's.

    Only the targets at the start of some stretches are kept, and what later events say of them.
    Reading tracks the stretches again that hold the times asked for, so that memory hardly grows
    with the recording's length. Threads may share tracks, and tracks can be pickled and copied.
    """

    def __init__(
        self,
        filter: Filter,
        packing: Packing,
        params: TrackerParams,
        progress: bool | None = None,
        smooth: bool = False,
        fused: FusedRun | None = None,
    ):
        self.recording, self.params, self.smooth = packing.recording, params, smooth
        self._runner: Any = ScanRun(filter, params) if fused is None else fused
        self.start, self.stop = packing.start, packing.stop
        self._packing, self._progress = packing, progress
        self._turns = TurnLock(f"tracks of {packing.recording.name}")
        self._begins: list[tuple[Mark, int, Any]] = []
        self._following: dict[Mark, Any] = {}  # of the last stretches, up to `KEPT`
        self._number(self._follow())

    def __len__(self) -> int:
        return len(self.id)

    def __getstate__(self) -> dict[str, Any]:
        """All but what is found again where it is asked for."""
        return {**{k: v for k, v in vars(self).items() if k != "_later"}, "_following": {}}

    @property
    def filtered(self) -> "Tracks":
        """The same tracks with states that rest on the events up to each time."""
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
        """States at `times`: integers (us) or floats (s), in any order.

        Filtered, what is told of a time is the prediction from the last step at or before it; with
        `events_per_step` above 1, a step has the time of its last event. `ids` chooses tracks, by
        default all. Raises `InputError` for times that are not finite or, unless told to
        `extrapolate`, outside the recording (where no track is valid), and for ids that do not
        exist.
        """
        times = np.atleast_1d(microseconds(times))
        order = np.argsort(times, kind="stable")
        found = self.batches(times[order], ids, extrapolate=extrapolate)
        parts = [states for _, states in found]
        chosen = self._chosen(ids)
        if not parts:
            return self._nothing(times, chosen)
        told = _joined(parts)
        back = np.argsort(order, kind="stable")
        told = (value[back] for value in (told.mean, told.covariance, told.valid, told.idle))
        return TrackStates(*told, self.id[chosen])

    def batches(
        self,
        times: Times,
        ids: Sequence[int] | NDArray[np.integer] | None = None,
        *,
        extrapolate: bool = False,
    ) -> Iterator[tuple[NDArray[np.int64], TrackStates]]:
        """The same, some of the sorted times after others: `times, states`."""
        held: list[tuple[NDArray[np.int64], TrackStates]] = []
        for piece in self._pieces(times, ids, extrapolate):
            held.append(piece)
            if sum(states.valid.size for _, states in held) >= TOGETHER:
                yield np.concatenate([t for t, _ in held]), _joined([now for _, now in held])
                held = []
        if held:
            yield np.concatenate([t for t, _ in held]), _joined([now for _, now in held])

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
            times = evenly(self.start, self.stop, TABLE_RATE)
        times = np.sort(np.atleast_1d(microseconds(times)))
        parts: list[list[NDArray]] = []
        for t, states in self.batches(times, ids):
            row, place = np.nonzero(states.valid)
            own = states.mean[row, place], states.covariance[row, place]
            parts.append([t[row], states.id[place], *own])
        if not parts:
            states = self._nothing(np.zeros(0, np.int64), self._chosen(ids))
            flat = states.mean.reshape(0, 8), states.covariance.reshape(0, 8, 8)
            parts.append([np.zeros(0, np.int64), np.zeros(0, np.int64), *flat])
        joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
        table = pandas.DataFrame(table_columns(*joined))
        table.attrs["units"] = dict(TABLE_UNITS)
        return table

    def _pieces(
        self, times: Times, ids: Sequence[int] | NDArray[np.integer] | None, extrapolate: bool
    ) -> Iterator[tuple[NDArray[np.int64], TrackStates]]:
        """The same, in pieces of one stretch each."""
        times = np.atleast_1d(microseconds(times))
        if (times[1:] < times[:-1]).any():
            raise InputError("times must be sorted to be read in batches; sort them")
        if not extrapolate:
            self._packing.check_times(times)
        chosen = self._chosen(ids)
        first, end = (int(i) for i in np.searchsorted(times, [self.start, self.stop]))
        if first:
            yield times[:first], self._nothing(times[:first], chosen)
        if not len(self) and end > first:
            yield times[first:end], self._nothing(times[first:end], chosen)
            first = end
        at_once = max(TOGETHER // max(len(chosen), 1), 1)
        for stretch, begins, following in self._again(times[first:end]):
            upto = end
            if stretch.next is not None:
                upto = int(np.searchsorted(times[:end], stretch.next.start))
            while first < upto:
                batch = times[first : min(first + at_once, upto)]
                yield batch, self._in_stretch(stretch, begins, following, batch, chosen)
                first += len(batch)
        if first < len(times):
            yield times[first:], self._nothing(times[first:], chosen)

    def events(
        self, start: int | float | None = None, stop: int | float | None = None
    ) -> Iterator[Events]:
        """Whose each event is, one stretch after another; events outside the tracking are left out.

        Events that the prefilter drops are not told of. Raises `InputError` for times that are not
        finite.
        """
        t0 = self.start if start is None else int(microseconds(start, "the start"))
        t1 = self.stop if stop is None else int(microseconds(stop, "the stop"))
        t0, t1 = max(t0, self.start), min(t1, self.stop)
        if t0 >= t1 or not self._begins:
            return
        mark, state = self._begin_of(t0)
        while mark is not None and mark.start < t1:
            stretch = self._packing.pack(mark)
            mark = stretch.next
            if mark is not None and mark.start <= t0:
                state, _ = self._runner.follow(state, stretch.features)
                continue
            state, serial, weight = self._runner.owners(state, stretch.features)
            valid = np.asarray(stretch.features.valid)
            t = (stretch.start[:, None, None] + stretch.features.t)[valid]
            now = (t >= t0) & (t < t1)
            yield Events(
                stretch.row[valid][now], t[now], self._id_of[serial[valid][now]],
                weight[valid][now],
            )  # fmt: skip

    def _chosen(self, ids: Sequence[int] | NDArray[np.integer] | None) -> NDArray[np.int64]:
        """Places of tracks in the arrays."""
        if ids is None:
            return np.arange(len(self))
        for one in ids:
            if one not in self.id:
                raise InputError(
                    f"{self.recording.name}: there is no track {one}; there are "
                    f"{', '.join(map(str, self.id[:20])) or 'none'}"
                )
        return np.array([int(np.flatnonzero(self.id == one)[0]) for one in ids], np.int64)

    def _nothing(self, times: NDArray[np.int64], chosen: NDArray[np.int64]) -> TrackStates:
        shape, real = (len(times), len(chosen)), np.dtype(jnp.result_type(float))
        return TrackStates(
            np.full((*shape, 8), np.nan, real),
            np.full((*shape, 8, 8), np.nan, real),
            np.zeros(shape, bool),
            np.full(shape, np.nan, real),
            self.id[chosen],
        )

    def _in_stretch(
        self,
        stretch: Stretch,
        begins: Any,
        following: Any,
        times: NDArray[np.int64],
        chosen: NDArray[np.int64],
    ) -> TrackStates:
        states = self._nothing(times, chosen)
        alive = (self.birth[chosen] <= times[:, None]) & (times[:, None] < self.death[chosen])
        some = np.flatnonzero(alive.any(0))
        if len(some):
            serial, wanted = self._serial[chosen[some]], alive[:, some]
            told = self._runner.read(stretch, begins, following, times, serial, wanted)
            outs = states.mean, states.covariance, states.idle
            for out, value in zip(outs, told, strict=True):
                out[:, some] = value
        states.valid[:] = alive
        return states

    def _again(self, times: NDArray[np.int64]) -> Iterator[tuple[Stretch, Any, Any]]:
        """The stretches that hold some of the sorted times, with the targets at chunks' starts.

        Smoothed, also what later events say after each chunk.
        """
        if not len(times):
            return
        mark, state = self._begin_of(int(times[0]))
        done = 0
        while done < len(times):
            assert mark is not None
            now, stretch = mark, self._packing.pack(mark)
            mark = stretch.next
            upto = len(times) if mark is None else int(np.searchsorted(times, mark.start))
            if upto == done:  # none of the times
                state, _ = self._runner.follow(state, stretch.features)
            else:
                state, begins = self._runner.play(state, stretch.features)
                following = None
                if self.smooth:
                    with self._turns:
                        later = self._later  # fills what is kept
                    following = self._following.get(now)
                    if following is None:
                        following, _ = self._look_back(stretch, begins, later)
                yield stretch, begins, following
            done = upto
            if done < len(times) and mark is not None:
                later, known = self._begin_of(int(times[done]))
                if later is not None and later.start > mark.start:
                    mark, state = later, known

    def _begin_of(self, time: int) -> tuple[Mark | None, Any]:
        known = [(mark, state) for mark, _, state in self._begins if mark.start <= time]
        return known[-1]

    def _look_back(
        self, stretch: Stretch, begins: Any, known: Mapping[Mark, Any], room: int = 0
    ) -> tuple[Any, Any]:
        """What later events say after each chunk of a stretch, and at the stretch's start.

        `known` is what they say at the start of the next one. Smoothed chunks are kept if all are
        at most `room` numbers.
        """
        later, elapsed = None, 0
        if stretch.next is not None:
            later, elapsed = known[stretch.next], stretch.next.start - stretch.next.previous
        return self._runner.look_back(stretch, begins, later, elapsed, room)

    @functools.cached_property
    def _later(self) -> dict[Mark, Any]:
        """What later events say at the starts of all stretches, found from the last one on."""
        found: dict[Mark, Any] = {}
        room = KEPT
        rows = self._packing.rows
        with bar(
            total=rows[1] - rows[0], unit="event", unit_scale=True, desc="smooth",
            progress=self._progress,
        ) as shown:  # fmt: skip
            for mark, state, packed in self._backwards():
                stretch = self._packing.pack(mark) if packed is None else packed
                _, begins = self._runner.play(state, stretch.features)
                following, found[mark] = self._look_back(stretch, begins, found, room)
                room -= numbers_in(following)
                if room >= 0:
                    self._following[mark] = following
                shown.update(int(np.count_nonzero(stretch.features.valid)))
        return found

    def _backwards(self) -> Iterator[tuple[Mark, Any, Stretch | None]]:
        """All stretches, from the last to the first, with the targets at their starts.

        A stretch that is packed is given too.
        """
        end = None
        for first, _, state in reversed(self._begins):
            mark, starts, stretch = first, [], None
            while mark is not None and mark != end:
                starts.append((mark, state))
                stretch = self._packing.pack(mark)
                mark = stretch.next
                if mark is not None and mark != end:
                    state, _ = self._runner.follow(state, stretch.features)
            for mark, state in reversed(starts):
                yield mark, state, stretch
                stretch = None
            end = first

    def _follow(self) -> _History:
        """The first pass: all births and deaths, and some targets on the way."""
        born = {k: int(t) for k, t in enumerate(self._packing.seeds.t)}
        history = _History(dict(born), dict(born))
        rows = self._packing.rows
        nothing = rows[0] == rows[1] and not born
        mark: Mark | None = None if nothing else self._packing.first
        state, number, every = None, 0, 1
        logs: list[tuple[Stretch, Log]] = []
        with bar(
            total=rows[1] - rows[0],
            desc="follow targets",
            unit="event",
            unit_scale=True,
            progress=self._progress,
        ) as shown:
            while mark is not None:
                stretch = self._packing.pack(mark)
                if state is None:
                    state = self._runner.begin(stretch.features)
                if number % every == 0:
                    self._begins.append((mark, number, state))
                    if len(self._begins) > BEGINS:
                        every *= 2
                        self._begins = [one for one in self._begins if one[1] % every == 0]
                state, told = self._runner.follow(state, stretch.features)
                logs.append((stretch, told))
                if len(logs) > 1:  # while this stretch is on the device
                    history.add(*logs.pop(0))
                shown.update(int(np.count_nonzero(stretch.features.valid)))
                mark, number = stretch.next, number + 1
            for one in logs:
                history.add(*one)
        return history

    def _number(self, history: _History) -> None:
        """Give tracks that were confirmed their numbers."""
        serial = np.array(sorted(history.confirmed), np.int64)
        given = self._packing.seeds.given
        public = np.arange(len(serial))
        public[: len(given)] = given
        order = np.argsort(public, kind="stable")
        self._serial = serial[order]
        self.id = public[order].astype(np.int64)
        self.birth = np.array([history.birth[k] for k in self._serial], np.int64)
        self.confirmed = np.array([history.confirmed[k] for k in self._serial], np.int64)
        ends = [history.death.get(int(k), (self.stop, 0)) for k in self._serial]
        if self._packing.ends is not None:
            found = [(int(end), 1) for end in self._packing.ends]
            ends = [min(e, f) if f[0] < self.stop else e for e, f in zip(ends, found, strict=True)]
        self.death = np.array([when for when, _ in ends], np.int64)
        self.ended = tuple(ENDS[why] for _, why in ends)
        self._id_of = np.full(max([-1, *history.birth]) + 2, -1)  # its last serves the serial -1
        self._id_of[self._serial] = self.id
