"""Features: all that estimators need to know of a recording's events and frames, as pytrees.

Events lie in tiles of 32768 slots, [ranks, lanes] (`layout`). Each slot holds what depends on data
alone: times since the pixel's and the neighbourhood's last event, polarity, and where the event
lies among the frames. The frames cut time into *pieces*: before the first exposure, within exposure
f, in the gap after it. In each piece the augmented frame is a blend of two integrations of events
(`augment`), and a piece's event counts start at the left edge of its exposure.

On several devices (`Features.over`) each has a share of the lanes of every block of 64, which all
kinds of tile are made of: as much work for each, and none waits for another.
"""

import abc
import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from jaxevent.deprecated import renamed_methods
from jaxevent.devices import AXIS, make_mesh, shard
from jaxevent.estimator import ShortRepr

SHAPES = ((8, 4096), (64, 512), (512, 64))  # ranks, lanes of the three kinds of tile
SLOTS = 8 * 4096
LANES = 64  # of the narrowest tile; on several devices each has a part of every so many lanes

# Prepared on the host, where they stay until a jitted function takes them.
if TYPE_CHECKING:
    from typing import Any as Numeric
else:
    Numeric = Array | np.ndarray


@renamed_methods(
    of_frame="gather_frame", of_piece="gather_piece", of_piece_alone="gather_piece_value"
)
class Points(eqx.Module):
    """Where points lie among the frames, and how to look a table [rows, pixels] up at them."""

    weight: Float[Numeric, "*#points"]  # position in the piece, 0 to 1
    blend: Float[Numeric, "*#points"]  # position between the mid-exposures of two frames, 0 to 1
    on: Float[Numeric, "*points"]  # ON events since the left edge of the piece's exposure
    off: Float[Numeric, "*points"]

    @abc.abstractmethod
    def gather_piece(self, table: Float[Array, "pieces pixels"]) -> Float[Array, "..."]:
        """The table's entries for the points' pieces and pixels."""

    @abc.abstractmethod
    def gather_frame(self, table: Float[Array, "frames pixels"]) -> Float[Array, "..."]:
        """The table's entries for the frames before the points."""

    @abc.abstractmethod
    def gather_piece_value(
        self, values: Float[Array, " pieces"], pixels: int
    ) -> Float[Array, "..."]:
        """The values of the points' pieces, equal for all pixels."""


class EventPoints(Points):
    """Points that each have their own pixel and time."""

    piece_cell: Int[Numeric, "*points"]  # piece * pixels + pixel
    frame_cell: Int[Numeric, "*points"]  # frame before the point * pixels + pixel

    def gather_piece(self, table: Float[Array, "pieces pixels"]) -> Float[Array, "..."]:
        return table.reshape(-1).at[self.piece_cell].get(mode="clip")

    def gather_frame(self, table: Float[Array, "frames pixels"]) -> Float[Array, "..."]:
        return table.reshape(-1).at[self.frame_cell].get(mode="clip")

    def gather_piece_value(
        self, values: Float[Array, " pieces"], pixels: int
    ) -> Float[Array, "..."]:
        return values.at[self.piece_cell // pixels].get(mode="clip")


class ImagePoints(Points):
    """All pixels at a few times; weights are (times, 1)."""

    piece: Int[Numeric, " times"]
    frame: Int[Numeric, " times"]  # the frame before
    elapsed: Float[Numeric, " times"]  # s since mid-exposure of the frame before; negative: none is

    def gather_piece(self, table: Float[Array, "pieces pixels"]) -> Float[Array, "..."]:
        return table.at[self.piece].get(mode="clip")

    def gather_frame(self, table: Float[Array, "frames pixels"]) -> Float[Array, "..."]:
        return table.at[self.frame].get(mode="clip")

    def gather_piece_value(
        self, values: Float[Array, " pieces"], pixels: int
    ) -> Float[Array, "..."]:
        return values.at[self.piece].get(mode="clip")[:, None]


class Tiles(ShortRepr):
    """The events of a window; slots without an event have polarity 0 and change nothing.

    Shared out over a mesh, the arrays' last axis is cut into blocks of `LANES`, which become the
    last axis, and that is what is shared out.
    """

    pixel: Int[Numeric, "*lanes"]  # the pixel of each lane
    kind: Int[Numeric, " tiles"]  # place in `layout.SHAPES`; their number: the tile is not used
    lane: Int[Numeric, " tiles"]  # the tile's first lane
    points: EventPoints
    since: Float[Numeric, "tiles *slots"]  # s since the pixel's previous event
    near: Float[Numeric, "tiles *slots"]  # s since the 3x3 neighbourhood's previous event
    polarity: Int[Numeric, "tiles *slots"]  # +1, -1, or 0 where there is no event
    mesh: Mesh | None = eqx.field(static=True, default=None)

    def over(self, mesh: Mesh) -> "Tiles":
        """The same, lanes shared out over a mesh whose size divides `LANES`."""

        def put(leaf: Any, spec: PartitionSpec) -> Any:
            if len(spec):
                leaf = leaf.reshape(*leaf.shape[:-1], -1, LANES)
            return jax.device_put(leaf, NamedSharding(mesh, spec))

        placed = jax.tree.map(put, self, self._specs())
        return dataclasses.replace(placed, mesh=mesh)

    def _specs(self) -> Any:
        """How every array is shared out; empty: not at all."""
        slots = PartitionSpec(None, None, AXIS)
        others = {
            "kind": PartitionSpec(),
            "lane": PartitionSpec(),
            "pixel": PartitionSpec(None, AXIS),
        }
        return jax.tree_util.tree_map_with_path(
            lambda path, _: others.get(path[0].name, slots), self
        )

    def each(self, function: Callable[..., Any], *whole: Any) -> Any:
        """`function(tiles, *whole)`, arrays (tiles, slots), on every device with its lanes.

        Nothing passes between devices but, backwards, the sum of derivatives by `whole`.
        """
        if self.mesh is None:
            return function(self, *whole)

        def here(tiles: Tiles, *whole: Any) -> Any:
            def flat(leaf: Array, spec: PartitionSpec) -> Array:
                return leaf.reshape(*leaf.shape[:-2], -1) if len(spec) else leaf

            mine = jax.tree.map(flat, tiles, tiles._specs())
            out = function(dataclasses.replace(mine, mesh=None), *whole)
            return jax.tree.map(lambda v: v.reshape(*v.shape[:-1], -1, lanes), out)

        lanes = LANES // self.mesh.size
        return jax.shard_map(
            here,
            mesh=self.mesh,
            in_specs=(self._specs(), *[PartitionSpec()] * len(whole)),
            out_specs=PartitionSpec(None, None, AXIS),
            check_vma=False,  # branches that skip a tile give zeros, which are the same everywhere
        )(self, *whole)


class Segments(eqx.Module):
    """Events inside exposures: each bounds one segment of constant brightness (EDI)."""

    frame_cell: Int[Numeric, " segments"]  # frame * pixels + pixel
    share: Float[Numeric, " segments"]  # of the exposure that the segment fills
    edge: Float[Numeric, " segments"]  # growth of `share` per second of later frame clock
    on: Float[Numeric, " segments"]  # ON events from mid-exposure to the segment, negative before
    off: Float[Numeric, " segments"]


class FrameFeatures(ShortRepr):
    """Frames of a window and the event counts that tie them together; spare rows repeat the last.

    Counts are [frames, pixels]: `head` from the left edge to mid-exposure, `tail` from there to the
    right edge, `span` from the left edge to the right edge of the next exposure; `before` counts
    from the window's start to the first right edge.
    """

    grey: Float[Numeric, "frames pixels"]  # in [0, 1], as the camera gave it
    intensity: Float[Numeric, "frames pixels"]  # the grey values through the inverse response
    certainty: Float[Numeric, "frames pixels"]  # w of the response, at most 1
    response: Float[Numeric, " 256"]  # intensities of evenly spaced grey values
    gain: Float[Numeric, " frames"]  # the frames' exposure relative to the common one
    span: Float[Numeric, "2 frames pixels"]  # ON, OFF
    before: Float[Numeric, "2 pixels"]
    head: Float[Numeric, "2 frames pixels"] | None  # None where no exposure is known
    tail: Float[Numeric, "2 frames pixels"] | None
    segments: Segments | None
    weight_rate: Float[Numeric, " pieces"]  # d weight / dt of each piece, 1/s
    blend_rate: Float[Numeric, " frames"]  # d blend / dt after each frame, 1/s
    present: Float[Numeric, ""]  # 1, or 0 if the recording has no frames
    rows: Int[Numeric, " 3"]  # number of frames; rows of the last one before, of the next's first
    clock_offset: Float[Numeric, ""]  # s, for which the positions were prepared
    width: int = eqx.field(static=True)  # of the sensor, whose pixels are in rows


class DeadTimeDerivative(eqx.Module):
    """Derivatives of event counts with respect to the dead time `rho_ref` (1/s), array by array.

    Counts are made for one dead time; around it they are continued linearly.
    """

    counts: list[Float[Numeric, "..."]]
    rho_ref: Float[Numeric, ""]  # s, for which the counts were made


class Features(ShortRepr):
    """All that `run` needs to know about a window of a recording; a pytree of arrays."""

    frames: FrameFeatures
    tiles: Tiles | None  # None where the estimator does not filter
    start: ImagePoints  # every pixel at the recording's start
    last: Int[Numeric, " pixels"]  # the slot of each pixel's last event, -1 if it has none
    growth: DeadTimeDerivative | None = None

    def counts(self) -> list[Any]:
        """The arrays that count events."""
        f, s = self.frames, self.frames.segments
        tiles = [] if self.tiles is None else [self.tiles.points.on, self.tiles.points.off]
        exposed = [] if s is None else [f.head, f.tail, s.on, s.off]
        return [f.span, f.before, *exposed, *tiles]

    def at(self, rho_ref: Array) -> "Features":
        """The features for a dead time near the one that they were made for."""
        return _grown(self, rho_ref)

    def weighted(self, factors: Float[Numeric, "2 pixels"]) -> "Features":
        """The same with every pixel's ON and OFF events times its factor; without tiles."""
        if self.tiles is not None:
            raise ValueError("the events of tiles cannot be weighted")
        segments = self.frames.segments
        cell = None if segments is None else segments.frame_cell % self.last.shape[0]
        by_frame = factors[:, None]
        exposed = [] if cell is None else [by_frame, by_frame, factors[0][cell], factors[1][cell]]
        return _weighted(self, [by_frame, factors, *exposed])

    def over(self, devices: Sequence[Any]) -> "Features":
        """The features on several devices: lanes of tiles and pixels of images shared out."""
        mesh = pixel_mesh(devices)
        if mesh is None:
            return self
        pixels = self.last.shape[0]
        growth = self.growth
        if growth is not None:
            counts = list(growth.counts)
            if self.tiles is not None:
                at = eqx.tree_at(lambda t: (t.points.on, t.points.off), self.tiles, counts[-2:])
                points = at.over(mesh).points
                counts[-2:] = [points.on, points.off]
                counts[:-2] = over_pixels(counts[:-2], mesh, pixels)
            else:
                counts = over_pixels(counts, mesh, pixels)
            growth = DeadTimeDerivative(counts, over_pixels(growth.rho_ref, mesh, pixels))
        rest = (self.frames, self.start, self.last)
        frames, start, last = over_pixels(rest, mesh, pixels)
        tiles = None if self.tiles is None else self.tiles.over(mesh)
        return Features(frames, tiles, start, last, growth)


class ReadOut(ShortRepr):
    """Images to be read: one time each, and for every pixel its last event before it."""

    points: ImagePoints
    slot: Int[Numeric, "times pixels"]  # of the pixel's last event in the window, -1 if none
    since: Float[Numeric, "times pixels"]  # s since the pixel's last event
    growth: DeadTimeDerivative | None = None

    def counts(self) -> list[Any]:
        """The arrays that count events."""
        return [self.points.on, self.points.off]

    def images(self, rows: NDArray) -> "ReadOut":
        """Those of its images, in that order; chosen on the host."""
        parts = (self.points, self.slot, self.since)
        counts = None if self.growth is None else self.growth.counts
        # JAX takes 4 ms of CPU for each array, a quarter of a fit that searches.
        chosen, counts = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], (parts, counts))
        growth = None if self.growth is None else DeadTimeDerivative(counts, self.growth.rho_ref)
        points, slot, since = chosen
        return ReadOut(points, slot, since, growth)

    def at(self, rho_ref: Array) -> "ReadOut":
        """The read-out for a dead time near the one that it was made for."""
        return _grown(self, rho_ref)

    def weighted(self, factors: Float[Numeric, "2 pixels"]) -> "ReadOut":
        """The same with every pixel's ON and OFF events times its factor."""
        return _weighted(self, list(factors))

    def over(self, devices: Sequence[Any]) -> "ReadOut":
        """The read-out on several devices, pixels shared out."""
        mesh = pixel_mesh(devices)
        return self if mesh is None else over_pixels(self, mesh, self.slot.shape[1])


def pixel_mesh(devices: Sequence[Any]) -> Mesh | None:
    """The mesh that pixels are shared out over; None where there is but one device."""
    return make_mesh(devices, LANES)


def over_pixels(tree: Any, mesh: Mesh, pixels: int) -> Any:
    """Arrays [..., pixels] shared out along pixels, all others whole on every device."""

    def put(leaf: Any) -> Any:
        return shard(mesh, leaf, -1 if np.shape(leaf)[-1:] == (pixels,) else None)

    return jax.tree.map(put, tree)


Counting = TypeVar("Counting", Features, ReadOut)


def _grown(counting: Counting, rho_ref: Array) -> Counting:
    growth = counting.growth
    if growth is None:
        return counting
    change = rho_ref - growth.rho_ref
    moved = [n + change * g for n, g in zip(counting.counts(), growth.counts, strict=True)]
    return eqx.tree_at(lambda c: c.counts(), counting, moved)


def _weighted(counting: Counting, factors: list[Any]) -> Counting:
    def times(counts: list[Any]) -> list[Any]:
        return [n * factor for n, factor in zip(counts, factors, strict=True)]

    growth = counting.growth
    weighted = eqx.tree_at(lambda c: c.counts(), counting, times(counting.counts()))
    if growth is None:
        return weighted
    return dataclasses.replace(
        weighted, growth=DeadTimeDerivative(times(growth.counts), growth.rho_ref)
    )


_count_arrays = itertools.count()


def aligned(shape: tuple[int, ...], dtype: Any, empty: bool = False) -> NDArray:
    """An array of zeros (or anything) whose data start at a multiple of 64 bytes.

    XLA takes it without a copy.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    # Large arrays all begin at the same place of a memory page. Written side by side they would
    # share one set of the cache; every array begins some lines further than the one before.
    stagger = 64 * (next(_count_arrays) * 5 % 64)
    memory = (np.empty if empty else np.zeros)(size + stagger + 64, np.uint8)
    begin = -memory.ctypes.data % 64 + stagger
    return memory[begin : begin + size].view(dtype).reshape(shape)
