"""The loop that all kernels share: over a band's events, pieces and images, in order of time.

A band is a few rows of pixels with one more on each side, whose events tell of the neighbourhood.
All numbers of a pixel lie at the same place of arrays of `stride` numbers, one after another in
`cells`: they stay in the processor's cache while the band's images are made. What differs from
method to method are the four functions of `Functions`, which `source` writes, and the places of
fields; so this module is compiled once.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined

# Kinds of steps, and what they are given; fields are places in `cells`.
MOVE = 0  # to a field, from another
LOAD = 1  # into a field, which of `FrameRows.tables`, and of which frame
FILL = 2  # a field, with half of a number
SUM = 3  # into a column of `Given.totals`, the segments of a frame's exposure
COUNT = 4  # into two fields, of ON and OFF, events from a time on and until another


class Bands(NamedTuple):
    """A window's events, divided among bands, and where the bands lie."""

    events: NDArray[np.int64]  # time since the recording's start (us), place in the band, polarity
    weights: NDArray  # what each event stands for; empty: for one
    first: NDArray[np.int64]  # of each band's events, and one more
    edges: NDArray[np.int64]  # rows of the image, and one more
    width: int


class Line(NamedTuple):
    """The stretches of a window in which points lie in one piece, after one frame."""

    start: NDArray[np.int64]  # us since the recording's start
    frame: NDArray[np.int64]  # of the piece, -1 before the first exposure
    variant: NDArray[np.int64]
    begin: NDArray[np.float64]  # of the piece, us
    rate: NDArray[np.float64]  # 1/us
    mid: NDArray[np.float64]  # of the frame before, us
    blend_rate: NDArray[np.float64]  # 1/us
    uniform: NDArray  # [stretches, ...], what tables need to know, equal for all pixels
    opening: int  # us, the window's start


class FrameRows(NamedTuple):
    """The frames that a window uses; the number of the first is `number`."""

    images: NDArray  # [frames, pixels], levels; or empty
    tables: NDArray  # [3, levels]: grey value, intensity, certainty
    values: NDArray  # [3, frames, pixels], the same where there are no levels
    gain: NDArray
    left: NDArray[np.float64]  # us, exact
    mid: NDArray[np.float64]
    right: NDArray[np.float64]
    number: int


class Memory(NamedTuple):
    """What bands remember."""

    cells: NDArray  # [bands, fields * STRIDE], real numbers of pixels
    whole: NDArray[np.int64]  # [bands, fields * STRIDE], whole numbers of pixels' states
    last: NDArray[np.float64]  # [bands, STRIDE], us, of the pixels' last events
    place: NDArray[np.int64]  # [bands, 2]: next event and stretch
    room: NDArray  # [bands, ...], for a row's numbers while images and tables are made
    bound: NDArray[np.float64]  # [bands, STRIDE], see `sum_segments`
    counts: NDArray  # [bands, 3, STRIDE], see `sum_segments`


class Images(NamedTuple):
    """Images [times, pixels], and derivatives of those that have any."""

    mean: NDArray
    variance: NDArray
    valid: NDArray[np.uint8]
    slopes: NDArray  # [times, pixels, images, lanes]


class Steps(NamedTuple):
    """What bands do at the beginning of each stretch, in order (`entering`)."""

    step: NDArray[np.int64]  # [steps, 5]: its kind, and what it is given
    end: NDArray[np.int64]  # [stretches + 1], of the steps of the stretch before


class Given(NamedTuple):
    """What a pass over a window rests on."""

    bands: Bands
    line: Line
    steps: Steps
    frames: FrameRows
    totals: NDArray[np.int64]  # [sums, rows], where sums over exposures lie in `cells`, in strides
    stride: int
    functions: "Functions"
    numbers: NDArray


class Functions(NamedTuple):
    """What is a method's own (`source`)."""

    events: Any
    images: Any
    tables: Any
    excess: Any


@njit_noalloc_inlined
def _take(steps, begin, end, given, band, memory):
    """Take the steps from begin to end, of a band."""
    bands, frames, stride, cells = given.bands, given.frames, given.stride, memory.cells[band]
    events, weights, edges = bands.events, bands.weights, bands.edges
    a, b = bands.first[band], bands.first[band + 1]
    for i in range(begin, end):
        kind, at, of, left, right = (
            steps[i, 0], steps[i, 1], steps[i, 2], steps[i, 3], steps[i, 4]
        )  # fmt: skip
        if kind == MOVE:
            copy(cells, at, of, stride)
        elif kind == LOAD:
            load_image(
                frames.images, frames.tables, frames.values, frames.gain[left], of, left,
                bands.width, edges[band], edges[band + 1], cells, at,
            )  # fmt: skip
        elif kind == FILL:
            fill(cells, at, stride, 0.5 * of)
        elif kind == SUM:
            sum_segments(
                events, weights, a, b, frames.left[of], frames.mid[of], frames.right[of],
                given.functions.excess, given.numbers, cells, given.totals[:, at], stride,
                memory.counts[band], memory.bound[band],
            )  # fmt: skip
        else:
            count_events(events, weights, a, b, left, right, cells, at, of, stride)


# Compilers take several numbers at once where no place can be negative: in parts from 0 on.
@njit_noalloc_inlined
def copy(cells, to, of, count):
    """Copy some numbers from one place to another."""
    out, given = cells[to : to + count], cells[of : of + count]
    for z in range(len(out)):
        out[z] = given[z]


@njit_noalloc_inlined
def fill(cells, at, count, value):
    """Set some numbers to one value."""
    out = cells[at : at + count]
    for z in range(len(out)):
        out[z] = value


@njit_noalloc_inlined
def edge_of(time):
    """Events earlier than this whole number of us are before the time."""
    return np.int64(np.ceil(time))


@njit_noalloc_inlined
def load_image(images, tables, values, gain, kind, k, width, top, bottom, cells, at):
    """A frame's grey values, intensities or certainties, into a field of `cells`."""
    is_plain = kind != 1 or gain == 1  # divisions take longest
    for line in range(top, bottom):
        z, pixel = at + (line - top + 1) * (width + 2) + 1, line * width
        out = cells[z : z + width]
        if len(values) == 0:
            table, levels = tables[kind], images[k, pixel : pixel + width]
            for column in range(len(out)):
                out[column] = table[levels[column]]
        else:
            given = values[kind, k, pixel : pixel + width]
            for column in range(len(out)):
                out[column] = given[column]
        if not is_plain:
            for column in range(len(out)):
                out[column] /= gain


@njit_noalloc_inlined
def find(events, begin, end, time):
    """The first of a band's events, from begin to end, that is not before a time."""
    while begin < end:
        middle = (begin + end) >> 1
        if events[middle] >> 17 < time:
            begin = middle + 1
        else:
            end = middle
    return begin


@njit_noalloc_inlined
def count_events(events, weights, begin, end, left, right, cells, on, off, stride):
    """Count the ON and OFF events of every pixel with left <= t < right into two fields."""
    weighted = len(weights) > 0
    fill(cells, on, stride, 0.0)
    fill(cells, off, stride, 0.0)
    for i in range(find(events, begin, end, left), end):
        event = events[i]
        if event >> 17 >= right:
            break
        z = np.uint64(((event >> 1) & 0xFFFF) + (on if event & 1 else off))
        cells[z] += weights[i] if weighted else 1


@njit_noalloc_inlined
def sum_segments(
    events,
    weights,
    begin,
    end,
    left,
    mid,
    right,
    excess,
    numbers,
    cells,
    totals,
    stride,
    counts,
    bound,
):
    """Add up what the segments of constant brightness of an exposure say, into fields `totals`.

    These are in strides. `counts` [3, stride] and `bound` [stride] are room.
    """
    length = right - left
    a, b = find(events, begin, end, edge_of(left)), find(events, begin, end, edge_of(right))
    middle = find(events, begin, end, edge_of(mid))
    if length <= 0 or a == b:
        return
    added = counts[2]
    for half in range(2):  # backwards from the middle to the left edge, then forwards
        for z in range(stride):
            counts[0, z] = counts[1, z] = 0
            bound[z] = np.nan
        for j in range(b - middle if half else middle - a):
            i = middle + j if half else middle - 1 - j
            z, now = (events[i] >> 1) & 0xFFFF, np.float64(events[i] >> 17)
            if bound[z] == bound[z]:
                share = abs(now - bound[z]) / length
                excess(share, 0.0, counts[0, z], counts[1, z], numbers.ctypes, added.ctypes)
                for k in range(len(totals)):
                    cells[totals[k] * stride + z] += added[k]
            bound[z] = now
            one = np.float64(weights[i]) if len(weights) else 1.0
            counts[0 if events[i] & 1 else 1, z] += one if half else -one
        outer, edge = (right, 1e6 / length) if half else (left, -1e6 / length)
        for z in range(stride):
            if bound[z] == bound[z]:
                share = abs(outer - bound[z]) / length
                excess(share, edge, counts[0, z], counts[1, z], numbers.ctypes, added.ctypes)
                for k in range(len(totals)):
                    cells[totals[k] * stride + z] += added[k]


@njit_noalloc
def run(begin, end, given, memory, enter, times, until, images):
    """Pass over the events before `until` (us) of some bands, and make images at `times` (us).

    Before that the bands enter a window at the time `enter[1]`, in the stretch `enter[0]`, unless
    this is -1.
    """
    bands, line, functions, steps = given.bands, given.line, given.functions, given.steps.step
    first, edges, starts, ends = bands.first, bands.edges, line.start, given.steps.end
    width, weighted = np.int64(bands.width), np.int64(len(bands.weights) > 0)
    padded, pixels, places = width + 2, images.mean.shape[1], memory.place
    size = np.int64(images.slopes.shape[2] * images.slopes.shape[3])
    numbers, events, weights = given.numbers.ctypes, bands.events.ctypes, bands.weights.ctypes
    mean, variance, valid = images.mean.ctypes, images.variance.ctypes, images.valid.ctypes
    slopes, uniform = images.slopes.ctypes, line.uniform.ctypes
    for band in range(begin, end):
        place, rows, row = places[band], edges[band + 1] - edges[band], 0
        last_own, finish = (rows + 1) * padded, first[band + 1]
        cells, whole = memory.cells[band].ctypes, memory.whole[band].ctypes
        last, room = memory.last[band].ctypes, memory.room[band].ctypes
        i, s, entering = place[0], place[1], enter[0] >= 0
        if entering:
            i, s = find(bands.events, first[band], finish, np.int64(enter[1])), np.int64(enter[0])
        while True:
            if entering:
                _take(steps, ends[s], ends[s + 1], given, band, memory)
                functions.tables(
                    line.variant[s], cells, padded, last_own, numbers, uniform,
                    s * line.uniform.shape[1], room,
                )  # fmt: skip
                entering = False
            stop = np.int64(until)
            if s + 1 < len(starts) and starts[s + 1] < stop:
                stop = starts[s + 1]
            reading = row < len(times) and times[row] < stop
            till = times[row] + 1 if reading else stop
            opening, rate = line.begin[s], line.rate[s]
            mid, blend_rate = line.mid[s], line.blend_rate[s]
            i = functions.events(
                cells, whole, last, events, weights, weighted, i, finish, till, padded, last_own,
                padded, opening, rate, mid, blend_rate, numbers,
            )  # fmt: skip
            if reading:
                t = np.float64(times[row])
                functions.images(
                    cells, whole, last, rows, width, padded, t, (t - opening) * rate,
                    (t - mid) * blend_rate, numbers, mean, variance, valid, slopes, room, size,
                    row * pixels + edges[band] * width,
                )  # fmt: skip
                row += 1
            elif s + 1 < len(starts) and starts[s + 1] < until:
                s += 1
                entering = True
            else:
                break
        place[0], place[1] = i, s
