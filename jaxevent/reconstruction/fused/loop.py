"""The loop that all kernels share: over a band's events, pieces and images, in order of time.

A band is a few rows of pixels with one more on each side, whose events tell of the neighbourhood.
All numbers of a pixel lie at the same place of arrays of `stride` numbers, one after another in
`cells`: they stay in the processor's cache while the band's images are made. What differs from
method to method are the four functions of `Functions`, which `source` writes, and the places of
fields; so this module is compiled once.
"""

import warnings
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from jaxevent.kernels import compiled, part

# Functions that are passed as arguments are called through their address.
warnings.filterwarnings("ignore", category=numba.NumbaExperimentalFeatureWarning)


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
    place: NDArray[np.int64]  # [bands, 3]: next event, stretch and frame of the piece


class Images(NamedTuple):
    """Images [times, pixels], and derivatives of those that have any."""

    mean: NDArray
    variance: NDArray
    valid: NDArray[np.uint8]
    slopes: NDArray  # [times, pixels, images, lanes]


class Places(NamedTuple):
    """Where the fields of `cells` lie, in strides; -1 where a method needs none."""

    stride: int
    exposed: bool  # whether frames have exposures
    factors: int  # of derivatives of images, for each pixel of a row
    room: int  # for derivatives of tables
    on: int
    off: int
    before: NDArray[np.int64]  # [2], ON and OFF
    image: NDArray[np.int64]  # [3, rows]: grey value, intensity, certainty
    total: NDArray[np.int64]  # [sums, rows]
    span: NDArray[np.int64]  # [2, rows]
    head: NDArray[np.int64]
    tail: NDArray[np.int64]
    shifted: NDArray[np.int64]  # [:, 2]: to where a field moves, and from, when a frame follows


class Given(NamedTuple):
    """What a pass over a window rests on."""

    bands: Bands
    line: Line
    frames: FrameRows
    places: "Places"
    functions: "Functions"
    numbers: NDArray


class Functions(NamedTuple):
    """What is a method's own (`source`)."""

    events: Any
    images: Any
    tables: Any
    excess: Any


@part
def _enter(band, stretch, now, given, cells, place):
    """Begin a stretch at a time: the numbers of its frames, the counts so far, its tables."""
    bands, line, frames, places = given.bands, given.line, given.frames, given.places
    events, weights, stride = bands.events, bands.weights, places.stride
    a, b, number = bands.first[band], bands.first[band + 1], frames.number
    lefts, mids, rights = frames.left, frames.mid, frames.right
    before, frame, count = place[band, 2], line.frame[stretch], len(lefts) + number
    base = max(frame - 1, 0)
    rows = min(count, max(frame, 0) + 2) - base
    follows = frame == before + 1
    if follows and frame >= 2:
        for k in range(len(places.shifted)):
            copy(cells, places.shifted[k, 0] * stride, places.shifted[k, 1] * stride, stride)
    fresh = 0 if not follows else 3 if frame == 0 else 2
    counted = 0 if not follows else 2 if frame == 0 else 1
    for row in range(fresh, 3):
        k = base + row - number
        for kind in range(3):
            field = places.image[kind, row]
            if field >= 0 and row < rows:
                load_image(
                    frames.images, frames.tables, frames.values, frames.gain[k], kind, k,
                    bands.width, bands.edges[band], bands.edges[band + 1], cells, field * stride,
                )  # fmt: skip
            elif field >= 0 and rows > 0:
                copy(cells, field * stride, places.image[kind, row - 1] * stride, stride)
            elif field >= 0:
                fill(cells, field * stride, stride, 0.5 if kind < 2 else 0.0)
        if len(places.total) > 0:
            for total in places.total[:, row]:
                fill(cells, total * stride, stride, 0.0)
            if row < rows:
                sum_segments(
                    events, weights, a, b, lefts[k], mids[k], rights[k], given.functions.excess,
                    given.numbers, cells, places.total[:, row] * stride, stride,
                )  # fmt: skip
    # Counts of events in eight stretches of time; places in `what` of ON, OFF, left, right.
    what = np.full((10, 4), -1)
    for row in range(3):
        k = base + row - number
        if row >= fresh and row < rows:
            left, mid, right = edge_of(lefts[k]), edge_of(mids[k]), edge_of(rights[k])
        else:
            left = mid = right = np.int64(0)
        if row >= fresh:
            _note(what, row, places.head[0, row], places.head[1, row], left, mid)
            _note(what, 3 + row, places.tail[0, row], places.tail[1, row], mid, right)
        if counted <= row < 2:
            left = right = np.int64(0)
            if row + 1 < rows:  # another frame follows
                left, right = edge_of(lefts[k]), edge_of(rights[k + 1])
            _note(what, 6 + row, places.span[0, row], places.span[1, row], left, right)
    # The piece counts from its exposure's left edge, before the first from the window's start.
    left = edge_of(lefts[frame - number]) if frame >= 0 else now
    _note(what, 8, np.int64(places.on), np.int64(places.off), left, now)
    if frame < 0 and count > 0:
        _note(
            what, 9, places.before[0], places.before[1], np.int64(line.opening), edge_of(rights[0])
        )
    for k in range(10):
        if what[k, 0] >= 0:
            count_events(events, weights, a, b, what[k, 2], what[k, 3], cells, stride, what[k])
    place[band, 2] = frame


# Compilers take several numbers at once where no place can be negative: in parts from 0 on.
@part
def copy(cells, to, of, count):
    """Copy some numbers from one place to another."""
    out, given = cells[to : to + count], cells[of : of + count]
    for z in range(len(out)):
        out[z] = given[z]


@part
def fill(cells, at, count, value):
    """Set some numbers to one value."""
    out = cells[at : at + count]
    for z in range(len(out)):
        out[z] = value


@part
def edge_of(time):
    """Events earlier than this whole number of us are before the time."""
    return np.int64(np.ceil(time))


@part
def _note(what, row, on, off, left, right):
    what[row, 0], what[row, 1], what[row, 2], what[row, 3] = on, off, left, right


@part
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


@part
def find(events, begin, end, time):
    """The first of a band's events, from begin to end, that is not before a time."""
    while begin < end:
        middle = (begin + end) >> 1
        if events[middle] >> 17 < time:
            begin = middle + 1
        else:
            end = middle
    return begin


@part
def count_events(events, weights, begin, end, left, right, cells, stride, what):
    """Count the events of every pixel with left <= t < right into the fields what[:2]."""
    on, off, weighted = what[0] * stride, what[1] * stride, len(weights) > 0
    fill(cells, on, stride, 0.0)
    fill(cells, off, stride, 0.0)
    for i in range(find(events, begin, end, left), end):
        event = events[i]
        if event >> 17 >= right:
            break
        z = np.uint64(((event >> 1) & 0xFFFF) + (on if event & 1 else off))
        cells[z] += weights[i] if weighted else 1


@part
def sum_segments(
    events, weights, begin, end, left, mid, right, excess, numbers, cells, totals, stride
):
    """Add up what the segments of constant brightness of an exposure say, from `totals` on."""
    length = right - left
    a, b = find(events, begin, end, edge_of(left)), find(events, begin, end, edge_of(right))
    middle = find(events, begin, end, edge_of(mid))
    if length <= 0 or a == b:
        return
    counts, bound = np.empty((2, stride), cells.dtype), np.empty(stride, np.float64)
    added = np.empty(len(totals), cells.dtype)
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
                    cells[totals[k] + z] += added[k]
            bound[z] = now
            one = np.float64(weights[i]) if len(weights) else 1.0
            counts[0 if events[i] & 1 else 1, z] += one if half else -one
        outer, edge = (right, 1e6 / length) if half else (left, -1e6 / length)
        for z in range(stride):
            if bound[z] == bound[z]:
                share = abs(outer - bound[z]) / length
                excess(share, edge, counts[0, z], counts[1, z], numbers.ctypes, added.ctypes)
                for k in range(len(totals)):
                    cells[totals[k] + z] += added[k]


@compiled
def run(begin, end, given, memory, enter, times, until, images):
    """Pass over the events before `until` (us) of some bands, and make images at `times` (us).

    Before that the bands enter a window at the time `enter[1]`, in the stretch `enter[0]`, unless
    this is -1.
    """
    bands, line, functions, numbers = given.bands, given.line, given.functions, given.numbers
    events, starts, place, width = bands.events, line.start, memory.place, np.int64(bands.width)
    weighted, padded, pixels = np.int64(len(bands.weights) > 0), width + 2, images.mean.shape[1]
    size = np.int64(images.slopes.shape[2] * images.slopes.shape[3])
    spare = max(given.places.room, (given.places.factors + 1) * width)
    room = np.empty(spare, images.mean.dtype)
    for band in range(begin, end):
        cells, whole, last = memory.cells[band], memory.whole[band], memory.last[band]
        rows, i, s, row = (
            bands.edges[band + 1] - bands.edges[band],
            place[band, 0],
            place[band, 1],
            0,
        )
        entering, now = enter[0] >= 0, np.int64(enter[1])
        if entering:
            i, s = find(events, bands.first[band], bands.first[band + 1], now), np.int64(enter[0])
            place[band, 2] = -9  # no frame is known
        while True:
            if entering:
                if line.frame[s] != place[band, 2]:
                    _enter(band, s, now, given, cells, place)
                functions.tables(
                    line.variant[s], cells.ctypes, padded, (rows + 1) * padded, numbers.ctypes,
                    line.uniform.ctypes, s * line.uniform.shape[1], room.ctypes,
                )  # fmt: skip
                entering = False
            stop = np.int64(until)
            if s + 1 < len(starts) and starts[s + 1] < stop:
                stop = starts[s + 1]
            reading = row < len(times) and times[row] < stop
            till = times[row] + 1 if reading else stop
            i = functions.events(
                cells.ctypes, whole.ctypes, last.ctypes, events.ctypes, bands.weights.ctypes,
                weighted, i, bands.first[band + 1], till, padded, (rows + 1) * padded, padded,
                line.begin[s], line.rate[s], line.mid[s], line.blend_rate[s], numbers.ctypes,
            )  # fmt: skip
            if reading:
                t = np.float64(times[row])
                functions.images(
                    cells.ctypes, whole.ctypes, last.ctypes, rows, width, padded, t,
                    (t - line.begin[s]) * line.rate[s], (t - line.mid[s]) * line.blend_rate[s],
                    numbers.ctypes, images.mean.ctypes, images.variance.ctypes, images.valid.ctypes,
                    images.slopes.ctypes, room.ctypes, size,
                    row * pixels + bands.edges[band] * width,
                )  # fmt: skip
                row += 1
            elif s + 1 < len(starts) and starts[s + 1] < until:
                s += 1
                entering, now = True, starts[s]
            else:
                break
        place[band, 0], place[band, 1] = i, s
