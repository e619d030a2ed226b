"""Events gathered into images: counts, event images, time surfaces, voxel grids.

Each is written once, for events on the host, which NumPy sums exactly and block by block, and for
`DeviceEvents`, which JAX sums within `jit`, `vmap` and `scan`.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.events.parts import Size, blocks, duration, size_of, source_of
from jaxevent.recording import Events, Recording, Times, microseconds

Numeric = Array | np.ndarray


class DeviceEvents(eqx.Module):
    """Events of a fixed number for `jax.jit`: those that fill up are not valid.

    Times are int32 us since an origin; all times that go with them are too.
    """

    t: Int[Numeric, "*batch n"]
    x: Int[Numeric, "*batch n"]
    y: Int[Numeric, "*batch n"]
    p: Bool[Numeric, "*batch n"]
    valid: Bool[Numeric, "*batch n"]
    size: Size = eqx.field(static=True)  # width, height


Given = Events | Recording | DeviceEvents


def to_device(
    part: Events | Recording,
    length: int | None = None,
    *,
    origin: Times | None = None,
    size: Size | None = None,
) -> DeviceEvents:
    """The events in arrays of `length`, filled up with events that are not valid.

    `origin` is the time that becomes 0, by default that of the first event; `length` is by default
    the next power of two, so that few programs are compiled. Raises `InputError` for more events
    than `length` and for times more than 2^31 us, 35 minutes, from the origin.
    """
    width, height = size_of(part, size)
    events = source_of(part)[:]
    count = len(events)
    length = 1 << max(count - 1, 0).bit_length() if length is None else length
    if count > length:
        raise InputError(f"{count} events do not fit into arrays of {length}; give a larger length")
    zero = int(events.t[0]) if count and origin is None else 0
    since = events.t - (zero if origin is None else int(microseconds(origin, "the origin")))
    if count and max(abs(int(since[0])), abs(int(since[-1]))) >= 2**31:
        raise InputError(
            f"events from {events.t[0]} to {events.t[-1]} us are more than 2^31 us from the "
            "origin; take a shorter part, or an origin in it"
        )

    def filled(values: NDArray, kind: type) -> NDArray:
        return np.pad(values.astype(kind), (0, length - count))

    # What fills up has the last event's time, so that times stay sorted.
    t = np.pad(since.astype(np.int32), (0, length - count), mode="edge" if count else "constant")
    return DeviceEvents(
        t, filled(events.x, np.int32), filled(events.y, np.int32), filled(events.p, np.bool_),
        np.arange(length) < count, (width, height),
    )  # fmt: skip


class _Added(NamedTuple):
    """What some events add: `weight` to the image `plane`; numbers or (events,)."""

    plane: Any
    weight: Any


def _sum(
    part: Given, size: Size | None, planes: int, kind: Any, added: Callable, *span: Any
) -> Any:
    """The sums (planes, H, W) of what `added(events, xp)` says; `xp` is numpy or jax.numpy.

    `added` returns several `_Added`. `span` limits the times (us), start <= t <= stop, of events
    that are read from a recording; it need not be exact.
    """
    if isinstance(part, DeviceEvents):
        width, height = part.size
        total = jnp.zeros(planes * height * width, kind)
        for plane, weight in added(part, jnp):
            weight = jnp.where(part.valid, weight, 0).astype(kind)
            at = (plane * height + part.y) * width + part.x
            total = total.at[at].add(weight, mode="drop")
        return total.reshape(planes, height, width)
    width, height = size_of(part, size)
    total = np.zeros(planes * height * width, np.float64 if kind == np.float32 else kind)
    for events in _read(part, *span):
        pixel = events.y.astype(np.intp) * width + events.x
        for plane, weight in added(events, np):
            weight = np.broadcast_to(weight, len(events)).astype(total.dtype)
            np.add.at(total, pixel + plane * (height * width), weight)
    return total.astype(kind).reshape(planes, height, width)


def _read(part: Events | Recording, *span: Any) -> Iterator[Events]:
    source = source_of(part)
    rows = [source.index(int(span[0])), source.index(int(span[1]) + 1)] if span else []
    return blocks(source, *rows)


def count_events(part: Given, *, size: Size | None = None) -> Any:
    """How many events each pixel fired, (H, W) integers."""
    return _sum(part, size, 1, _whole(part), lambda e, xp: [_Added(0, 1)])[0]


def event_image(part: Given, *, size: Size | None = None) -> Any:
    """ON events less OFF events of each pixel, (H, W) integers."""
    return _sum(part, size, 1, _whole(part), lambda e, xp: [_Added(0, _sign(e, xp))])[0]


def count_frames(part: Given, edges: Any, *, size: Size | None = None) -> Any:
    """How many OFF and how many ON events each pixel fired between times, (n, 2, H, W) integers.

    `edges` are n + 1 rising times; frame i counts edges[i] <= t < edges[i + 1]. Frames of 10 ms:
    `count_frames(recording, np.arange(recording.start, recording.stop, 10_000))`.
    """
    if not isinstance(part, DeviceEvents):
        edges = np.atleast_1d(microseconds(edges, "edges of frames"))
        if len(edges) < 2 or (np.diff(edges) <= 0).any():
            raise InputError("edges of frames must be two or more rising times; sort them")
    n = len(edges) - 1

    def added(e: Any, xp: Any) -> list[_Added]:
        place = xp.searchsorted(edges, e.t, "right") - 1
        inside = (place >= 0) & (place < n)
        return [_Added(xp.clip(place, 0, n - 1) * 2 + e.p, inside * 1)]

    span = () if isinstance(part, DeviceEvents) else (edges[0], edges[-1])
    counts = _sum(part, size, 2 * n, _whole(part), added, *span)
    return counts.reshape(n, 2, *counts.shape[1:])


def voxel_grid(
    part: Given,
    bins: int,
    start: Times | None = None,
    stop: Times | None = None,
    *,
    size: Size | None = None,
) -> Any:
    """Polarities shared out to the nearest two of `bins` times, (bins, H, W) float32.

    An event at t lies at (bins - 1) (t - start) / (stop - start) and adds its sign to the bins
    before and after in proportion. `start` and `stop` are by default the times of the first and the
    last event; events outside do not count. (Zhu et al., "Unsupervised Event-Based Learning of
    Optical Flow, Depth, and Egomotion", CVPR 2019, equations 1 and 2; as E2VID has it. tonic has
    `bins` in place of bins - 1.)
    """
    if bins < 1:
        raise InputError(f"a voxel grid of {bins} bins is not possible; give 1 or more")
    first, last = _ends(part, start, stop)

    def added(e: Any, xp: Any) -> list[_Added]:
        length = xp.maximum(last - first, 1)
        inside = (e.t >= first) & (e.t <= last)
        at = (bins - 1) * xp.clip((e.t - first) / length, 0, 1)
        before = xp.clip(xp.floor(at).astype(int), 0, bins - 1)
        sign, share = _sign(e, xp) * inside, at - before
        after = xp.minimum(before + 1, bins - 1)
        return [_Added(before, sign * (1 - share)), _Added(after, sign * share)]

    span = () if isinstance(part, DeviceEvents) else (first, last)
    return _sum(part, size, bins, np.float32, added, *span)


def time_surface(
    part: Given, tau: int | float, at: Times | None = None, *, size: Size | None = None
) -> Any:
    """How recently each pixel fired an OFF and an ON event, (2, H, W) float32.

    exp(-(at - t) / tau), t the last such event's time at or before `at`, by default the last
    event's. 0 where there was none. `tau` is in us or s. (Lagorce et al., "HOTS", TPAMI 2017.)
    """
    us = duration(tau, "the time constant of a time surface")
    _, now = _ends(part, None, at)
    if isinstance(part, DeviceEvents):
        width, height = part.size
        place = (part.p * height + part.y) * width + part.x
        # No int32 is earlier than this one, which stands for never.
        never = jnp.iinfo(part.t.dtype).min
        t = jnp.where(part.valid & (part.t <= now), part.t, never)
        last = jnp.full(2 * height * width, never).at[place].max(t)
        surface = jnp.where(last == never, 0, jnp.exp((last - now) / us))
        return surface.astype(jnp.float32).reshape(2, height, width)
    width, height = size_of(part, size)
    source = source_of(part)
    last = np.full(2 * height * width, np.inf)
    for events in blocks(source, 0, source.index(int(now) + 1)):
        place = (events.p.astype(np.intp) * height + events.y) * width + events.x
        last[place] = now - events.t  # the last of several counts
    return np.exp(-last / us).astype(np.float32).reshape(2, height, width)


def _whole(part: Given) -> Any:
    return jnp.int32 if isinstance(part, DeviceEvents) else np.int64


def _sign(e: Any, xp: Any) -> Any:
    return xp.where(e.p, 1, -1)


def _ends(part: Given, start: Any, stop: Any) -> tuple[Any, Any]:
    """The two times, those of the first and the last event where they are None."""
    if isinstance(part, DeviceEvents):
        limits = jnp.iinfo(part.t.dtype)
        first = jnp.where(part.valid, part.t, limits.max).min() if start is None else start
        last = jnp.where(part.valid, part.t, limits.min).max() if stop is None else stop
        return first, last
    source, us = source_of(part), []
    for time, row in ((start, 0), (stop, len(source) - 1)):
        if time is not None:
            us.append(int(microseconds(time)))
        else:
            us.append(int(source[row : row + 1].t[0]) if len(source) else 0)
    return us[0], us[1]
