"""Earlier neighbours of events, from which hypotheses of a motion are scored: on the host.

A point of the scene that crosses the pixels fires at one after another. So the earlier events of
the same polarity near an event are candidates for its predecessor: each is a displacement d [px]
and an age dt [s], and a motion with image velocity U explains it if d = U dt. Candidates depend on
the data only. They are gathered once, in batches of fixed shape; filters then run many times.

Several events per pixel are kept, not only the latest: an edge fires bursts, and the last event of
a burst is late, so a surface of latest events makes every motion too fast.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.codegen import njit_noalloc
from jaxevent.egomotion.geometry import undistorted
from jaxevent.recording import Recording

READ_ROWS = 65536  # events read from a file at a time
NEVER = np.iinfo(np.int64).min // 2

Numeric = Array | np.ndarray
Ages = float | int | NDArray[np.floating]


class Expected(NamedTuple):
    """Where candidates are looked for: at most margin + slack dt [px] from the flow's d = U dt.

    Arrays (rows, columns) are by as many equal parts of the sensor.
    """

    U: NDArray[np.floating]  # (2, rows, columns), px/s
    slack: NDArray[np.floating]  # (rows, columns), px/s
    margin: float  # px


class Candidates(eqx.Module):
    """Batches of K events with up to C candidates each; an axis of batches leads where stacked.

    Where there is no candidate the age is 0, as no real one is; see `mask`. Where an event had more
    than C, these are C of them in even steps, and `scale` says how many each stands for.
    """

    d: Float[Numeric, "*batches K C 2"]  # px, x and y: the event's position less the candidate's
    age: Float[Numeric, "*batches K C"]  # s
    xi: Float[Numeric, "*batches K 2"]  # px, of the event; see `coordinates`
    room: Float[Numeric, "*batches K 2 2"]  # px, least and largest d in the sensor, x and y
    valid: Bool[Numeric, "*batches K"]  # an event; others only fill up
    scale: Float[Numeric, "*batches K"]
    rate: Float[Numeric, "*batches K"]  # 1/s of age, candidates wherever in the window
    elapsed: Float[Numeric, "*batches"]  # s from the last event of the batch before to this one's
    history: Float[Numeric, "*batches"]  # s, age up to which there are all candidates; see `gather`
    reach: int = eqx.field(static=True)  # candidates are at most so many pixels away, in x and y

    @property
    def mask(self) -> Bool[Numeric, "*batches K C"]:
        """Which candidates are there."""
        return self.age > 0


class Batches(NamedTuple):
    """Some batches, the times (us) of each one's last event, and which rows the events are."""

    candidates: Candidates
    t: NDArray[np.int64]  # (batches,); batches without any event have the time of the one before
    row: NDArray[np.int64]  # (batches, K), -1 where not valid


def coordinates(
    width: int, height: int, camera: PinholeCamera | None
) -> tuple[NDArray[np.float64], float]:
    """Positions (height, width, 2) of pixels in px, and the focal length (px) they belong to.

    With a camera as `geometry.undistorted` gives them, which says what is raised. Without one they
    are the pixels' own columns and rows, counted from the middle of the sensor, and f is 1.
    """
    y, x = np.mgrid[:height, :width].astype(np.float64)
    if camera is None:
        return np.stack([x - (width - 1) / 2, y - (height - 1) / 2], -1), 1.0
    xi, f = undistorted(camera, x.ravel(), y.ravel())
    return xi.reshape(height, width, 2), f


class Gatherer:
    """Candidates of a recording, some batches after another.

    One event in `every` is scored (the first, then every `every`-th), all are candidates. A batch
    holds `batch` scored events, fewer where they would take longer than `longest` seconds; a gap
    of `silence` seconds between events makes history begin anew. For each
    the `per_pixel` most recent earlier events of the same polarity at every pixel at most `radius`
    away in x and y are looked at; those of the same timestamp never count.
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
        self.xi, self.f = coordinates(recording.width, recording.height, camera)
        self._ring = np.full((2, *shape, per_pixel), NEVER)
        self._head = np.zeros((2, *shape), np.int16)
        window = (2 * radius + 1) ** 2 * per_pixel
        self._scratch = np.zeros((3, window))
        self._row, self._end = 0, len(recording.events)
        self._last = int(recording.events[:1].t[0]) if self._end else 0
        self._clock = np.array([self._last, self._last])  # activity's begin, the last event

    @property
    def done(self) -> bool:
        """Whether all events have been taken."""
        return self._row >= self._end

    def gather(
        self,
        batches: int,
        youngest: Ages,
        oldest: Ages,
        span: float | int = np.inf,
        expected: Expected | None = None,
    ) -> Batches:
        """The next `batches` batches, with candidates from `youngest` to `oldest` seconds of age.

        Ages may be arrays (rows, columns) for as many equal parts of the sensor, and where the flow
        is about known it may be told where they are `expected`. The shape of what
        is given is always the same; batches for which no event is left, or only events more than
        `span` seconds after the first one, hold none. `history` is since when events have come
        without a long silence, but never longer than `oldest`.
        """
        real = np.dtype(jnp.result_type(float))
        size, most = self.batch, self.most
        d, age = np.zeros((batches, size, most, 2), real), np.zeros((batches, size, most), real)
        xi, scale = np.zeros((batches, size, 2), real), np.ones((batches, size), real)
        rate = np.zeros((batches, size), real)
        room = np.zeros((batches, size, 2, 2), real)
        row, t = np.full((batches, size), -1), np.zeros(batches, np.int64)
        history = np.zeros(batches, real)
        young, old = np.broadcast_arrays(np.atleast_2d(youngest), np.atleast_2d(oldest))
        # Single precision may fall short of a whole number of microseconds.
        young, old = 1e6 * (1 - 1e-6) * young, 1e6 * (1 + 1e-6) * old
        limits = np.stack([np.maximum(1, np.ceil(young)), np.floor(old)])
        limits = np.minimum(limits, -NEVER / 2).astype(np.int64)
        if expected is None:
            gate = np.zeros((3, 1, 1))
            gate[2] = np.inf
        else:
            gate = np.concatenate([expected.U, expected.slack[None]]).astype(np.float64)
        margin = 0.0 if expected is None else expected.margin
        # Batch, events in it, time of its first, and after which no event is taken.
        state = np.array([0, 0, 0, -NEVER])
        span = -NEVER if span == np.inf else round(1e6 * span)
        full = False
        while not full and not self.done:
            events = self.recording.events[self._row : self._row + READ_ROWS]
            used, full = _gather(
                Stream(events.t, events.x, events.y, events.p, self._row),
                Rules(self.every, self.longest, span, self.radius, margin, self.silence),
                Latest(self.xi, self._ring, self._head),
                limits,
                gate,
                Filled(d, age, xi, room, scale, rate, row, t, history),
                state,
                self._clock,
                self._scratch,
            )
            self._row += used
        begun = state[0] + (state[1] > 0)
        history[begun:] = history[begun - 1] if begun else 0
        t[begun:] = t[begun - 1] if begun else self._last
        history = np.minimum(history, 1e-6 * limits[1].min())
        elapsed = np.diff(t, prepend=self._last) * 1e-6
        self._last = int(t[-1])
        made = Candidates(
            d, age, xi, room, row >= 0, scale, rate, elapsed.astype(real), history.astype(real),
            self.radius,
        )  # fmt: skip
        return Batches(made, t, row)

    def whole(self, youngest: Ages, oldest: Ages) -> Batches:
        """All batches that are left, at least one, for recordings that fit into memory."""
        parts: list[Batches] = []
        while not parts or not self.done:
            parts.append(self.gather(64, youngest, oldest))
        fields = {}
        used = max(1, sum(int(part.candidates.valid.any(-1).sum()) for part in parts))
        names = {field.name for field in dataclasses.fields(Candidates)} - {"reach"}
        for name in names:
            fields[name] = np.concatenate([getattr(part.candidates, name) for part in parts])[:used]
        t, row = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t", "row"))
        return Batches(Candidates(**fields, reach=self.radius), t[:used], row[:used])


class Stream(NamedTuple):
    """Events (n,), and the row of the first of them."""

    t: NDArray
    x: NDArray
    y: NDArray
    p: NDArray
    row: int


class Rules(NamedTuple):
    """How batches are filled: see `Gatherer`; times in us."""

    every: int
    longest: int
    span: int
    radius: int
    margin: float
    silence: int


class Latest(NamedTuple):
    """Where pixels look, and their latest events."""

    position: NDArray  # (height, width, 2) px
    ring: NDArray  # (2, height, width, kept) us
    head: NDArray  # (2, height, width), the newest's place in the ring


class Filled(NamedTuple):
    """The arrays of `Candidates` and `Batches`, to be filled."""

    d: NDArray
    age: NDArray
    xi: NDArray
    room: NDArray
    scale: NDArray
    rate: NDArray
    row: NDArray
    t: NDArray
    history: NDArray


@njit_noalloc
def _gather(stream, rules, latest, limits, gate, out, state, clock, scratch):
    """Fill batches from events: how many events were used, and whether all batches are full."""
    # Names of their own: numba reads arrays out of tuples anew in every loop.
    t_in, x, y, p, row_in = stream
    every, longest, span, radius, margin, silence = rules
    position, ring, head = latest
    d, age, xi, room, scale, rate, row, t, history = out
    batch, fill, first, until = state
    parts_y, parts_x = limits.shape[1:]
    gates_y, gates_x = gate.shape[1:]
    batches, size, most = age.shape
    height, width, kept = ring.shape[1], ring.shape[2], ring.shape[3]
    for i in range(len(t_in)):
        now, column, line, sign = t_in[i], int(x[i]), int(y[i]), int(p[i])
        if now - clock[1] > silence:
            clock[0] = now
        clock[1] = now
        if (row_in + i) % every == 0:
            if fill == size or (fill > 0 and now - first > longest):
                batch, fill = batch + 1, 0
            if batch == batches or now > until:
                state[0], state[1], state[2], state[3] = batch, fill, first, until
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
            # golden ratio, evenly spread): every candidate is as likely to be taken.
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
            # d is the event's position less the candidate's: the least at the far side.
            room[batch, fill, 0, 0] = here_x - position[line, width - 1, 0]
            room[batch, fill, 1, 0] = here_x - position[line, 0, 0]
            room[batch, fill, 0, 1] = here_y - position[height - 1, column, 1]
            room[batch, fill, 1, 1] = here_y - position[0, column, 1]
            row[batch, fill] = row_in + i
            t[batch] = now
            history[batch] = (now - clock[0]) * 1e-6
            fill += 1
        at = (head[sign, line, column] + 1) % kept
        head[sign, line, column] = at
        ring[sign, line, column, at] = now
    state[0], state[1], state[2], state[3] = batch, fill, first, until
    return len(t_in), False
