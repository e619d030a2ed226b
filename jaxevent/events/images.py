"""Images of events: counts, event images, time surfaces, voxel grids.

Each is written once: for events on the host, which NumPy sums exactly and block by block, and for
`DeviceEvents`, which JAX sums within `jit`, `vmap` and `scan`.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int
from numpy.typing import NDArray

from jaxevent.arrays import shorten_value
from jaxevent.errors import InputError
from jaxevent.events.blocks import Size, parse_duration, read_blocks, size_of, source_of
from jaxevent.recording import Events, Recording, Times, microseconds, one_time

Numeric = Array | np.ndarray


class DeviceEvents(eqx.Module):
    """A fixed number of events for `jax.jit`; those that pad the number are not valid.

    Times are int32 us since an origin, and so are all times that are passed with them.

    Attributes:
        t: Times, us.
        x: Columns, px.
        y: Rows, px.
        p: Polarities, True for ON.
        valid: Whether an event is real rather than padding.
        size: Width and height of the sensor, px.
    """

    t: Int[Numeric, "*batch n"]
    x: Int[Numeric, "*batch n"]
    y: Int[Numeric, "*batch n"]
    p: Bool[Numeric, "*batch n"]
    valid: Bool[Numeric, "*batch n"]
    size: Size = eqx.field(static=True)


AnyEvents = Events | Recording | DeviceEvents


def to_device(
    part: Events | Recording,
    length: int | None = None,
    *,
    origin: Times | None = None,
    size: Size | None = None,
) -> DeviceEvents:
    """Put events into arrays of a fixed length, padded with events that are not valid.

    Args:
        part: Events, or a recording.
        length: Number of events; None: the next power of two, so that few programs are compiled.
        origin: The time that becomes 0, us or s; None: that of the first event.
        size: Width and height of the sensor, for events alone.

    Returns:
        The events for `jax.jit`.

    Raises:
        InputError: There are more events than `length`, or times more than 2^31 us, 35 minutes,
            from the origin.
    """
    width, height = size_of(part, size)
    events = source_of(part)[:]
    count = len(events)
    length = 1 << max(count - 1, 0).bit_length() if length is None else length
    if count > length:
        raise InputError(f"{count} events do not fit into arrays of {length}; give a larger length")
    zero = int(events.t[0]) if count and origin is None else 0
    since = events.t - (zero if origin is None else one_time(origin, "the origin"))
    if count and max(abs(int(since[0])), abs(int(since[-1]))) >= 2**31:
        raise InputError(
            f"events from {events.t[0]} to {events.t[-1]} us are more than 2^31 us from the "
            "origin; take a shorter part, or an origin in it"
        )

    def pad(values: NDArray, kind: type) -> NDArray:
        return np.pad(values.astype(kind), (0, length - count))

    # Padding has the last event's time, so that times stay sorted.
    t = np.pad(since.astype(np.int32), (0, length - count), mode="edge" if count else "constant")
    return DeviceEvents(
        t, pad(events.x, np.int32), pad(events.y, np.int32), pad(events.p, np.bool_),
        np.arange(length) < count, (width, height),
    )  # fmt: skip


class _Increment(NamedTuple):
    """Amounts that events add to an image; numbers or one for each event.

    Attributes:
        plane: Index of the image in a stack.
        weight: The amount.
    """

    plane: Any
    weight: Any


def _accumulate(
    part: AnyEvents, size: Size | None, planes: int, kind: Any, increments: Callable, *span: Any
) -> Any:
    """Sum the increments of events into images.

    Args:
        part: Events, a recording, or `DeviceEvents`.
        size: Width and height of the sensor, for events alone.
        planes: Number of images.
        kind: Type of the sums.
        increments: Function of events and of numpy or jax.numpy that returns several `_Increment`.
        *span: First and last time, us, of the events that are read from a recording; they need not
            be exact.

    Returns:
        (planes, H, W).

    Raises:
        InputError: The images do not fit in memory.
    """
    if isinstance(part, DeviceEvents):
        width, height = part.size
        total = jnp.zeros(planes * height * width, kind)
        for plane, weight in increments(part, jnp):
            weight = jnp.where(part.valid, weight, 0).astype(kind)
            at = (plane * height + part.y) * width + part.x
            total = total.at[at].add(weight, mode="drop")
        return total.reshape(planes, height, width)
    width, height = size_of(part, size)
    sums = np.dtype(np.float64 if kind == np.float32 else kind)
    try:
        total = np.zeros(planes * height * width, sums)
    except MemoryError:
        needed = planes * height * width * sums.itemsize / 2**30
        raise InputError(
            f"{planes} images of {width}x{height} pixels need {needed:,.0f} GB of memory; ask for "
            "fewer"
        ) from None
    for events in _read(part, *span):
        pixel = events.y.astype(np.intp) * width + events.x
        for plane, weight in increments(events, np):
            weight = np.broadcast_to(weight, len(events)).astype(total.dtype)
            np.add.at(total, pixel + plane * (height * width), weight)
    return total.astype(kind).reshape(planes, height, width)


def _read(part: Events | Recording, *span: Any) -> Iterator[Events]:
    source = source_of(part)
    rows = [source.index(int(span[0])), source.index(int(span[1]) + 1)] if span else []
    return read_blocks(source, *rows)


def count_events(part: AnyEvents, *, size: Size | None = None) -> Any:
    """Count the events of each pixel.

    Args:
        part: Events, a recording, or `DeviceEvents`.
        size: Width and height of the sensor, for events alone.

    Returns:
        (H, W) integers.
    """
    return _accumulate(part, size, 1, _integer_type(part), lambda e, xp: [_Increment(0, 1)])[0]


def event_image(part: AnyEvents, *, size: Size | None = None) -> Any:
    """Count the ON events of each pixel minus its OFF events.

    Args:
        part: Events, a recording, or `DeviceEvents`.
        size: Width and height of the sensor, for events alone.

    Returns:
        (H, W) integers.
    """
    return _accumulate(
        part, size, 1, _integer_type(part), lambda e, xp: [_Increment(0, _sign(e, xp))]
    )[0]


def count_frames(part: AnyEvents, edges: Any, *, size: Size | None = None) -> Any:
    """Count the OFF and ON events of each pixel between times.

    Frames of 10 ms: `count_frames(recording, np.arange(recording.start, recording.stop, 10_000))`.

    Args:
        part: Events, a recording, or `DeviceEvents`.
        edges: (n + 1,) rising times, us or s; frame i counts edges[i] <= t < edges[i + 1].
        size: Width and height of the sensor, for events alone.

    Returns:
        (n, 2, H, W) integers, OFF before ON.

    Raises:
        InputError: The edges do not rise.
    """
    if not isinstance(part, DeviceEvents):
        edges = np.atleast_1d(microseconds(edges, "edges of frames"))
        if len(edges) < 2 or (np.diff(edges) <= 0).any():
            raise InputError("edges of frames must be two or more rising times; sort them")
    n = len(edges) - 1

    def increments(e: Any, xp: Any) -> list[_Increment]:
        index = xp.searchsorted(edges, e.t, "right") - 1
        inside = (index >= 0) & (index < n)
        return [_Increment(xp.clip(index, 0, n - 1) * 2 + e.p, inside * 1)]

    span = () if isinstance(part, DeviceEvents) else (edges[0], edges[-1])
    counts = _accumulate(part, size, 2 * n, _integer_type(part), increments, *span)
    return counts.reshape(n, 2, *counts.shape[1:])


def voxel_grid(
    part: AnyEvents,
    bins: int,
    start: Times | None = None,
    stop: Times | None = None,
    *,
    size: Size | None = None,
) -> Any:
    """Distribute polarities to the nearest two of several times.

    An event at t lies at (bins - 1) (t - start) / (stop - start) and adds its sign to the bins
    before and after in proportion. Events outside do not count. (Zhu et al., "Unsupervised
    Event-Based Learning of Optical Flow, Depth, and Egomotion", CVPR 2019, equations 1 and 2; as
    E2VID has it. tonic has `bins` in index of bins - 1.)

    Args:
        part: Events, a recording, or `DeviceEvents`.
        bins: Number of times.
        start: First time, us or s; None: that of the first event.
        stop: Last time, us or s; None: that of the last event.
        size: Width and height of the sensor, for events alone.

    Returns:
        (bins, H, W) float32.

    Raises:
        InputError: There is no bin, or the bins do not fit in memory.
    """
    if isinstance(bins, bool) or not isinstance(bins, int | np.integer) or bins < 1:
        raise InputError(
            f"a voxel grid of {shorten_value(bins)} bins is not possible; give a whole number "
            "from 1"
        )
    first, last = _fill_ends(part, start, stop)

    def increments(e: Any, xp: Any) -> list[_Increment]:
        length = xp.maximum(last - first, 1)
        inside = (e.t >= first) & (e.t <= last)
        at = (bins - 1) * xp.clip((e.t - first) / length, 0, 1)
        before = xp.clip(xp.floor(at).astype(int), 0, bins - 1)
        sign, share = _sign(e, xp) * inside, at - before
        after = xp.minimum(before + 1, bins - 1)
        return [_Increment(before, sign * (1 - share)), _Increment(after, sign * share)]

    span = () if isinstance(part, DeviceEvents) else (first, last)
    return _accumulate(part, size, bins, np.float32, increments, *span)


def time_surface(
    part: AnyEvents, tau: int | float, at: Times | None = None, *, size: Size | None = None
) -> Any:
    """Make the time surface exp(-(at - t) / tau), t the time of the last event of each polarity.

    It is 0 where there was none. (Lagorce et al., "HOTS", TPAMI 2017.)

    Args:
        part: Events, a recording, or `DeviceEvents`.
        tau: Time constant, us or s.
        at: Time of the surface, us or s; None: that of the last event.
        size: Width and height of the sensor, for events alone.

    Returns:
        (2, H, W) float32, OFF before ON.

    Raises:
        InputError: The time constant is shorter than 1 us.
    """
    tau_us = parse_duration(tau, "the time constant of a time surface")
    _, now = _fill_ends(part, None, at)
    if isinstance(part, DeviceEvents):
        width, height = part.size
        index = (part.p * height + part.y) * width + part.x
        # No int32 is earlier than this one, which stands for never.
        never = jnp.iinfo(part.t.dtype).min
        t = jnp.where(part.valid & (part.t <= now), part.t, never)
        last = jnp.full(2 * height * width, never).at[index].max(t)
        surface = jnp.where(last == never, 0, jnp.exp((last - now) / tau_us))
        return surface.astype(jnp.float32).reshape(2, height, width)
    width, height = size_of(part, size)
    source = source_of(part)
    last = np.full(2 * height * width, np.inf)
    for events in read_blocks(source, 0, source.index(int(now) + 1)):
        index = (events.p.astype(np.intp) * height + events.y) * width + events.x
        last[index] = now - events.t  # the last of several counts
    return np.exp(-last / tau_us).astype(np.float32).reshape(2, height, width)


def _integer_type(part: AnyEvents) -> Any:
    return jnp.int32 if isinstance(part, DeviceEvents) else np.int64


def _sign(e: Any, xp: Any) -> Any:
    """Return the polarities as +1 and -1.

    Args:
        e: Events, as `Events` or `DeviceEvents`.
        xp: NumPy, or JAX's NumPy.

    Returns:
        (n,).
    """
    return xp.where(e.p, 1, -1)


def _fill_ends(part: AnyEvents, start: Any, stop: Any) -> tuple[Any, Any]:
    """Fill in the ends of a span of time.

    Args:
        part: Events.
        start: First time, us; None: that of the first event.
        stop: Last time, us; None: that of the last event.

    Returns:
        Both, us.
    """
    if isinstance(part, DeviceEvents):
        limits = jnp.iinfo(part.t.dtype)
        first = jnp.where(part.valid, part.t, limits.max).min() if start is None else start
        last = jnp.where(part.valid, part.t, limits.min).max() if stop is None else stop
        return first, last
    source, us = source_of(part), []
    for time, row in ((start, 0), (stop, len(source) - 1)):
        if time is not None:
            us.append(one_time(time))
        else:
            us.append(int(source[row : row + 1].t[0]) if len(source) else 0)
    return us[0], us[1]
