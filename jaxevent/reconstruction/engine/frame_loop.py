"""The loops that kernels of smoothers share: over a band's frames, forwards and backwards, and
over images.

All numbers of a pixel lie at the same place of arrays of `stride` numbers, as in `loop`: first
those of the frame that a pass has come to, then those that are kept of each frame. What differs
from method to method are the functions of `FrameFunctions`, which `smoothing` writes, and the
places of fields; so this module is compiled once.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.reconstruction.engine.loop import (
    Bands,
    FrameRows,
    count_events,
    edge_of,
    find,
    load_image,
    sum_segments,
)


class FrameFunctions(NamedTuple):
    """What is a method's own (`smoothing`)."""

    start: Any
    frame: Any
    clipped: Any
    move: Any
    link: Any
    back: Any
    show: Any
    before: Any
    excess: Any


class FramePlaces(NamedTuple):
    """Where fields lie, in strides."""

    stride: int
    work: int  # fields of the frame that a pass has come to
    kept: int  # fields that are kept of each frame
    image: NDArray[np.int64]  # grey value, intensity, certainty
    total: NDArray[np.int64]  # sums over exposures, and their derivatives
    inside: int  # events within exposures; -1: not needed
    side: int
    counts: NDArray[np.int64]  # ON, OFF, and those of the neighbours
    exposed: bool  # whether exposures are known
    sided: bool  # whether clipped frames tell anything


class FrameLine(NamedTuple):
    """A stretch of frames in time (us since the recording's start)."""

    mid: NDArray[np.int64]  # events before it are before the frame
    following: NDArray[np.int64]  # the same of the frame after
    seconds: NDArray[np.float64]  # until then
    exists: NDArray[np.float64]  # 1, or 0 for frames that measure nothing


class Room(NamedTuple):
    """Room for passes: that of the first of the bands that a pass goes over."""

    sums: NDArray  # [bands, 3 * stride], of rows and of events so far
    counts: NDArray  # [bands, 3, stride], see `sum_segments`
    times: NDArray[np.float64]  # [bands, 3, stride]

    @classmethod
    def of(cls, bands: int, stride: int, dtype: np.dtype) -> "Room":
        return cls(
            np.empty((bands, 3 * stride), dtype),
            np.empty((bands, 3, stride), dtype),
            np.empty((bands, 3, stride)),
        )


class GivenFrames(NamedTuple):
    """What passes over a stretch of frames rest on."""

    bands: Bands
    line: FrameLine
    frames: FrameRows
    places: FramePlaces
    functions: FrameFunctions
    numbers: NDArray
    slot: NDArray[np.int64]  # of each band in the memory
    rates: NDArray[np.float64]  # see `follow_events`; empty: no change is spread
    reach: int  # us, the longest time over which a change is spread
    room: Room


class Instants(NamedTuple):
    """Times of images (us since the recording's start) and where they lie among the frames."""

    time: NDArray[np.int64]
    frame: NDArray[np.int64]  # the one before, -1 before the first
    elapsed: NDArray[np.float64]  # s since then
    seconds: NDArray[np.float64]  # until the next; 0 after the last
    here: NDArray[np.float64]  # 1 in the middle of the frame's exposure


class Spreading(NamedTuple):
    """A pixel's last event before the time that a pass has come to, [stride]."""

    last: NDArray[np.float64]  # us
    rate: NDArray[np.float64]  # of its count until the next event, 1/us; of OFF events negative


def follow_events(bands: Bands, stride: int, reach: int) -> NDArray[np.float64]:
    """Of each event the rate (1/us) at which its pixel's count grows until the next, OFF negative.

    An event is late: where no more than `reach` (us) lies between two, the second's change is
    spread over that time (`Timing`). Else the rate is 0, as after one at the recording's start.
    """
    rates = np.zeros(bands.first[-1])
    _follow(bands, reach, np.empty(stride, np.int64), rates)
    return rates


@njit_noalloc
def _follow(bands, reach, ahead, rates):
    events, weights, first = bands.events, bands.weights, bands.first
    for band in range(len(first) - 1):
        for z in range(len(ahead)):
            ahead[z] = -1
        for j in range(first[band + 1] - first[band]):
            i = first[band + 1] - 1 - j
            z, now = (events[i] >> 1) & 0xFFFF, events[i] >> 17
            k = ahead[z]
            ahead[z] = i
            if k >= 0 and now > 0:
                gap = (events[k] >> 17) - now
                if 0 < gap <= reach:
                    one = np.float64(weights[k]) if len(weights) > 0 else 1.0
                    rates[i] = (one if events[k] & 1 else -one) / gap


@njit_noalloc_inlined
def _blank(room, band):
    times = room.times[band]
    for z in range(times.shape[1]):
        times[1, z] = times[2, z] = 0
    return Spreading(times[1], times[2])


@njit_noalloc_inlined
def _advance(given, i, end, until, spreading):
    """Note events from place i on that are before a time; the place of the first that is not."""
    events, rates, last, rate = given.bands.events, given.rates, spreading.last, spreading.rate
    while i < end and events[i] >> 17 < until:
        z = (events[i] >> 1) & 0xFFFF
        last[z] = events[i] >> 17
        rate[z] = rates[i]
        i += 1
    return i


@njit_noalloc_inlined
def _come_to(given, band, time, spreading):
    """The same from as early as matters."""
    for z in range(len(spreading.rate)):
        spreading.rate[z] = 0
    a, b = given.bands.first[band], given.bands.first[band + 1]
    begin = find(given.bands.events, a, b, time - given.reach)
    return _advance(given, begin, b, time, spreading)


@njit_noalloc_inlined
def _add_begun(out, on, off, time, spreading, sign):
    """Add (sign 1) or take away (-1) the parts of pixels' next events that have happened."""
    last, rate = spreading.last, spreading.rate
    for z in range(len(last)):
        begun = sign * rate[z] * (time - last[z])
        out[on + z] += begun if rate[z] > 0 else 0.0
        out[off + z] -= begun if rate[z] < 0 else 0.0


@njit_noalloc_inlined
def _count_between(given, band, left, right, cells, on, off, spreading):
    """`count_events` with changes spread over time."""
    bands, stride, spread = given.bands, given.places.stride, len(given.rates) > 0
    a, b = bands.first[band], bands.first[band + 1]
    count_events(bands.events, bands.weights, a, b, left, right, cells, on, off, stride)
    if spread and right > left:
        i = _come_to(given, band, left, spreading)
        _add_begun(cells, on, off, left, spreading, -1.0)
        _advance(given, i, b, right, spreading)
        _add_begun(cells, on, off, right, spreading, 1.0)


@njit_noalloc_inlined
def _sum_around(cells, of, to, above, width, rows, stride):
    """Sums over the eight neighbours of a band's own pixels, from one field into another."""
    padded, c, out = width + 2, of * stride, to * stride
    for z in range(padded, (rows + 1) * padded):
        above[z] = cells[c + z - padded] + cells[c + z] + cells[c + z + padded]
    for z in range(padded + 1, (rows + 1) * padded - 1):
        cells[out + z] = above[z - 1] + above[z] + above[z + 1] - cells[c + z]


@njit_noalloc_inlined
def _look(band, k, given, cells, spreading, begin):
    """A frame's image, and what events say of its exposure; the room is that of band `begin`."""
    bands, frames, places = given.bands, given.frames, given.places
    stride, top, bottom = places.stride, bands.edges[band], bands.edges[band + 1]
    a, b = bands.first[band], bands.first[band + 1]
    for kind in range(3):
        load_image(
            frames.images, frames.tables, frames.values, frames.gain[k], kind, k,
            bands.width, top, bottom, cells, places.image[kind] * stride,
        )  # fmt: skip
    if not places.exposed:
        return
    left, right = frames.left[k], frames.right[k]
    for total in places.total:
        for z in range(total * stride, (total + 1) * stride):
            cells[z] = 0
    sum_segments(
        bands.events, bands.weights, a, b, left, frames.mid[k], right, given.functions.excess,
        given.numbers, cells, places.total, stride,
        given.room.counts[begin], given.room.times[begin, 0],
    )  # fmt: skip
    if places.inside >= 0:
        inside = places.inside * stride
        _count_between(given, band, edge_of(left), edge_of(right), cells, inside, inside, spreading)


@njit_noalloc_inlined
def _measure_clipped(k, row, given, cells, begin, end):
    """Measure again where a frame is clipped: most pixels are not, and that is dear."""
    places, line, gain = given.places, given.line, np.float64(given.frames.gain[k])
    side = places.side * places.stride
    z = begin
    while z < end:
        while z < end and cells[side + z] == 0:
            z += 1
        first = z
        while z < end and cells[side + z] != 0:
            z += 1
        if z > first:
            given.functions.clipped(
                cells.ctypes, given.numbers.ctypes, row, first, z, gain, line.exists[k], 0.0
            )


@njit_noalloc
def filter_frames(begin, end, given, memory, starts, linked):
    """Pass forwards over a stretch of frames; its state is the one before the first frame.

    Afterwards it is that before the frame after the last. `starts`: the recording does here.
    """
    bands, line, places, functions = given.bands, given.line, given.places, given.functions
    numbers, stride, counts = given.numbers, places.stride, places.counts
    width, padded = np.int64(bands.width), np.int64(bands.width + 2)
    on, off = counts[0] * stride, counts[1] * stride
    above, spreading = given.room.sums[begin, :stride], _blank(given.room, begin)
    for band in range(begin, end):
        cells, rows = memory[given.slot[band]], bands.edges[band + 1] - bands.edges[band]
        first, last = padded, (rows + 1) * padded
        if starts:
            functions.start(cells.ctypes, numbers.ctypes, 0, first, last, 0.0, 0.0, 0.0)
        for k in range(len(line.mid)):
            row = np.int64((places.work + k * places.kept) * stride)
            _look(band, k, given, cells, spreading, begin)
            gain, seconds = np.float64(given.frames.gain[k]), line.seconds[k]
            functions.frame(
                cells.ctypes, numbers.ctypes, row, first, last, gain, line.exists[k], 0.0
            )
            if places.sided:
                _measure_clipped(k, row, given, cells, first, last)
            mid, following = line.mid[k], line.following[k]
            _count_between(given, band, mid, following, cells, on, off, spreading)
            _sum_around(cells, counts[0], counts[2], above, width, rows, stride)
            _sum_around(cells, counts[1], counts[3], above, width, rows, stride)
            functions.move(cells.ctypes, numbers.ctypes, row, first, last, seconds, 0.0, 0.0)
            if linked:
                functions.link(cells.ctypes, numbers.ctypes, row, first, last, seconds, 0.0, 0.0)


@njit_noalloc
def smooth_frames(begin, end, given, memory):
    """Pass backwards; before it is known what frames after the stretch say at the next one."""
    bands, line, places = given.bands, given.line, given.places
    padded = np.int64(bands.width + 2)
    for band in range(begin, end):
        cells, rows = memory[given.slot[band]], bands.edges[band + 1] - bands.edges[band]
        for j in range(len(line.mid)):
            k = len(line.mid) - 1 - j
            row = np.int64((places.work + k * places.kept) * places.stride)
            given.functions.back(
                cells.ctypes, given.numbers.ctypes, row, padded, (rows + 1) * padded,
                line.seconds[k], 0.0, 0.0,
            )  # fmt: skip


@njit_noalloc_inlined
def _count_since(given, band, f, known, i, now, cells, held, spreading):
    """Count the events from the middle of frame f to a time, both given in us.

    The counts so far of the frame `known` are in `held`, the events before place i are in them.
    Returns the next place.
    """
    bands, counts, stride = given.bands, given.places.counts, given.places.stride
    events, weights, spread = bands.events, bands.weights, len(given.rates) > 0
    weighted, b, mid = len(weights) > 0, bands.first[band + 1], given.line.mid[f]
    on, off = counts[0] * stride, counts[1] * stride
    if f != known:
        for z in range(2 * stride):
            held[z] = 0
        i = find(events, bands.first[band], b, mid)
        if spread:
            _come_to(given, band, mid, spreading)
            _add_begun(held, 0, stride, mid, spreading, -1.0)
    begin = i
    while i < b and events[i] >> 17 <= now:
        z = ((events[i] >> 1) & 0xFFFF) + (0 if events[i] & 1 else stride)
        held[z] += weights[i] if weighted else 1
        i += 1
    for z in range(stride):
        cells[on + z], cells[off + z] = held[z], held[stride + z]
    if spread:
        _advance(given, begin, b, now + 1, spreading)
        _add_begun(cells, on, off, now, spreading, 1.0)
    return i


@njit_noalloc_inlined
def _count_until(given, band, now, cells, spreading):
    """Count the events after a time (us) until the middle of the first frame."""
    counts, stride, mid = given.places.counts, given.places.stride, given.line.mid[0]
    bands = given.bands
    a, b = bands.first[band], bands.first[band + 1]
    on, off = counts[0] * stride, counts[1] * stride
    count_events(bands.events, bands.weights, a, b, now + 1, mid, cells, on, off, stride)
    if len(given.rates) > 0 and mid > now:
        i = _come_to(given, band, now + 1, spreading)
        _add_begun(cells, on, off, now, spreading, -1.0)
        _advance(given, i, b, mid, spreading)
        _add_begun(cells, on, off, mid, spreading, 1.0)


@njit_noalloc
def read_images(begin, end, given, memory, instants, images):
    """Images at sorted instants of a smoothed stretch."""
    bands, places, functions = given.bands, given.places, given.functions
    numbers, stride, counts = given.numbers, places.stride, places.counts
    width, pixels = np.int64(bands.width), images.mean.shape[1]
    size = np.int64(images.slopes.shape[2] * images.slopes.shape[3])
    padded, spreading = width + 2, _blank(given.room, begin)
    above, held = given.room.sums[begin, :stride], given.room.sums[begin, stride:]
    for band in range(begin, end):
        cells, rows = memory[given.slot[band]], bands.edges[band + 1] - bands.edges[band]
        known, i = -1, np.int64(0)
        for image in range(len(instants.time)):
            f, now = instants.frame[image], instants.time[image]
            row = np.int64((places.work + max(f, 0) * places.kept) * stride)
            at = np.int64(image * pixels + bands.edges[band] * width)
            if f < 0:
                _count_until(given, band, now, cells, spreading)
            else:
                i = _count_since(given, band, f, known, i, now, cells, held, spreading)
                known = f
            _sum_around(cells, counts[0], counts[2], above, width, rows, stride)
            _sum_around(cells, counts[1], counts[3], above, width, rows, stride)
            if f < 0:
                functions.before(
                    cells.ctypes, numbers.ctypes, row, rows, width, padded,
                    instants.seconds[image], 0.0, 0.0, images.mean.ctypes, images.variance.ctypes,
                    images.valid.ctypes, images.slopes.ctypes, size, at,
                )  # fmt: skip
            else:
                functions.show(
                    cells.ctypes, numbers.ctypes, row, rows, width, padded,
                    instants.elapsed[image], instants.seconds[image], instants.here[image],
                    images.mean.ctypes, images.variance.ctypes, images.valid.ctypes,
                    images.slopes.ctypes, size, at,
                )  # fmt: skip
