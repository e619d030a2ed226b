"""Features: the prepared events and frames of a recording, as pytrees that estimators run on.

Events lie in tiles of 32768 slots, [ranks, lanes] (`tiles`): a lane is a pixel, a rank the number
of an event at that pixel. Each slot holds what depends on data alone: times since the last event of
the pixel and of its neighbourhood, polarity, and the position of the event among the frames.

The frames cut time into *pieces*: before the first exposure, within exposure f, in the gap after
it. In each piece the augmented frame is a blend of two integrals of events (`augment`). Event
counts of a piece start at the left edge of its exposure.
"""

import abc
import dataclasses
import itertools
import math
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from jaxevent.estimator import ShortRepr

TILE_SHAPES = ((8, 4096), (64, 512), (512, 64))  # ranks and lanes of the three kinds of tile
N_TILE_SLOTS = 8 * 4096  # of every tile

# Prepared on the host, where they stay until a jitted function takes them.
if TYPE_CHECKING:
    from typing import Any as Numeric
else:
    Numeric = Array | np.ndarray


class Points(eqx.Module):
    """Positions of points among the frames, which look up tables [rows, pixels]."""

    weight: Float[Numeric, "*#points"]  # position in the piece, 0 to 1
    blend: Float[Numeric, "*#points"]  # position between the mid-exposures of two frames, 0 to 1
    on: Float[Numeric, "*points"]  # ON events since the left edge of the piece's exposure
    off: Float[Numeric, "*points"]  # OFF events, likewise

    @abc.abstractmethod
    def gather_piece(self, table: Float[Array, "pieces pixels"]) -> Float[Array, "..."]:
        """Return the table's entries for the points' pieces and pixels."""

    @abc.abstractmethod
    def gather_frame(self, table: Float[Array, "frames pixels"]) -> Float[Array, "..."]:
        """Return the table's entries for the frames before the points."""

    @abc.abstractmethod
    def gather_piece_value(
        self, values: Float[Array, " pieces"], pixels: int
    ) -> Float[Array, "..."]:
        """Return the values of the points' pieces, which are equal for all pixels.

        Args:
            values: One value for each piece.
            pixels: Number of pixels of the sensor.

        Returns:
            One value for each point.
        """


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
    """All pixels at a few times; `weight` and `blend` are (times, 1)."""

    piece: Int[Numeric, " times"]  # the piece that holds the time
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


class EventTiles(ShortRepr):
    """Events of a window; slots without an event have polarity 0 and change nothing."""

    pixel: Int[Numeric, "*lanes"]  # the pixel of each lane
    kind: Int[Numeric, " tiles"]  # index in `TILE_SHAPES`; len(SHAPES): the tile is not used
    lane: Int[Numeric, " tiles"]  # the tile's first lane
    points: EventPoints
    since: Float[Numeric, "tiles *slots"]  # s since the pixel's previous event
    near: Float[Numeric, "tiles *slots"]  # s since the 3x3 neighbourhood's previous event
    polarity: Int[Numeric, "tiles *slots"]  # +1, -1, or 0 where there is no event


class ExposureSegments(eqx.Module):
    """Events inside exposures: each bounds one segment of constant brightness (EDI)."""

    frame_cell: Int[Numeric, " segments"]  # frame * pixels + pixel
    share: Float[Numeric, " segments"]  # fraction of the exposure that the segment fills
    edge: Float[Numeric, " segments"]  # d share / d clock_offset, 1/s
    on: Float[Numeric, " segments"]  # ON events from mid-exposure to the segment, negative before
    off: Float[Numeric, " segments"]  # OFF events, likewise


class FrameFeatures(ShortRepr):
    """Frames of a window and the event counts between them; spare rows repeat the last frame.

    Counts are [frames, pixels]: `head` from the left edge to mid-exposure, `tail` from there to the
    right edge, `span` from the left edge to the right edge of the next exposure. `before` counts
    from the window's start to the first right edge.
    """

    grey: Float[Numeric, "frames pixels"]  # in [0, 1], as the camera gave it
    intensity: Float[Numeric, "frames pixels"]  # the grey values through the inverse response
    certainty: Float[Numeric, "frames pixels"]  # w of the response, at most 1
    response: Float[Numeric, " 256"]  # intensities of evenly spaced grey values
    gain: Float[Numeric, " frames"]  # the frames' exposure relative to the common one
    white: Float[Numeric, " 2"] | None  # as in `augment.GreyFrames`
    span: Float[Numeric, "2 frames pixels"]  # ON, OFF
    around: Float[Numeric, "frames pixels"] | None  # `span` of 3x3 pixels; None: not counted
    before: Float[Numeric, "2 pixels"]
    head: Float[Numeric, "2 frames pixels"] | None  # None where no exposure is known
    tail: Float[Numeric, "2 frames pixels"] | None
    segments: ExposureSegments | None
    weight_rate: Float[Numeric, " pieces"]  # d weight / dt of each piece, 1/s
    blend_rate: Float[Numeric, " frames"]  # d blend / dt after each frame, 1/s
    present: Float[Numeric, ""]  # 1, or 0 if the recording has no frames
    rows: Int[Numeric, " 3"]  # number of frames; rows of the last one before, of the next's first
    frame_delay: Float[Numeric, ""]  # s, for which the positions were prepared
    flicker: Float[Numeric, ""]  # variance of the intensity that all pixels of a frame share
    movement: Float[Numeric, ""]  # how much of the recording moves, 0 to 1
    width: int = eqx.field(static=True)  # of the sensor, whose pixels are in rows


class DeadTimeDerivative(eqx.Module):
    """Derivatives of event counts with respect to the dead time `rho_ref`, array by array.

    Counts are made for one dead time; around it they are continued linearly.
    """

    counts: list[Float[Numeric, "..."]]  # 1/s
    rho_ref: Float[Numeric, ""]  # s, for which the counts were made


C = TypeVar("C", bound="EventCounts")


class EventCounts(ShortRepr):
    """Prepared arrays of which some count events, perhaps with derivatives by the dead time."""

    derivative: DeadTimeDerivative | None = eqx.field(default=None, kw_only=True)

    @abc.abstractmethod
    def counts(self) -> list[Any]:
        """Return the arrays that count events."""

    def at_dead_time(self: C, rho_ref: Array) -> C:
        """Continue the counts linearly to a dead time (s) near the one that they were made for."""
        derivative = self.derivative
        if derivative is None:
            return self
        change = rho_ref - derivative.rho_ref
        pairs = zip(self.counts(), derivative.counts, strict=True)
        return eqx.tree_at(lambda c: c.counts(), self, [n + change * g for n, g in pairs])

    def _scale(self: C, factors: list[Any]) -> C:
        """Multiply every array of counts, and its derivative, by a factor."""

        def times(counts: list[Any]) -> list[Any]:
            return [n * factor for n, factor in zip(counts, factors, strict=True)]

        scaled = eqx.tree_at(lambda c: c.counts(), self, times(self.counts()))
        if self.derivative is None:
            return scaled
        derivative = DeadTimeDerivative(times(self.derivative.counts), self.derivative.rho_ref)
        return dataclasses.replace(scaled, derivative=derivative)


class Features(EventCounts):
    """A window of a recording, prepared for `run`."""

    frames: FrameFeatures
    tiles: EventTiles | None  # None for estimators that do not pass over single events
    start: ImagePoints  # every pixel at the recording's start
    last: Int[Numeric, " pixels"]  # the slot of each pixel's last event, -1 if it has none

    def counts(self) -> list[Any]:
        f, s = self.frames, self.frames.segments
        tiles = [] if self.tiles is None else [self.tiles.points.on, self.tiles.points.off]
        exposed = [] if s is None else [f.head, f.tail, s.on, s.off]
        around = [] if f.around is None else [f.around]
        return [f.span, f.before, *around, *exposed, *tiles]

    def scale_counts(self, factors: Float[Numeric, "2 pixels"]) -> "Features":
        """Multiply the ON and OFF events of every pixel by its factors; without tiles."""
        if self.tiles is not None:
            raise ValueError("the events of tiles cannot be weighted")
        segments = self.frames.segments
        cell = None if segments is None else segments.frame_cell % self.last.shape[0]
        by_frame = factors[:, None]
        exposed = [] if cell is None else [by_frame, by_frame, factors[0][cell], factors[1][cell]]
        return self._scale([by_frame, factors, *exposed])


class ReadOut(EventCounts):
    """Times of images to read, with the last event of every pixel before each."""

    points: ImagePoints
    slot: Int[Numeric, "times pixels"]  # of the pixel's last event in the window, -1 if none
    since: Float[Numeric, "times pixels"]  # s since the pixel's last event

    def counts(self) -> list[Any]:
        return [self.points.on, self.points.off]

    def take(self, rows: NDArray) -> "ReadOut":
        """Choose some of the images, in the order of `rows`; on the host."""
        rho_ref = None if self.derivative is None else self.derivative.rho_ref
        # JAX takes 4 ms of CPU for each array, a quarter of a fit that searches.
        return jax.tree.map(lambda v: v if v is rho_ref else np.asarray(v)[rows], self)

    def scale_counts(self, factors: Float[Numeric, "2 pixels"]) -> "ReadOut":
        """Multiply the ON and OFF events of every pixel by its factors."""
        return self._scale(list(factors))


_count_arrays = itertools.count()


def allocate_aligned(shape: tuple[int, ...], dtype: Any, empty: bool = False) -> NDArray:
    """Allocate an array that XLA takes without a copy: its data start at a multiple of 64 bytes.

    Args:
        shape: Shape of the array.
        dtype: Type of its numbers.
        empty: Leave the memory as it is; else it is zero.

    Returns:
        The array.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    # Large arrays all begin at the same place of a memory page. Written side by side they would
    # share one set of the cache; every array begins some lines further than the one before.
    stagger = 64 * (next(_count_arrays) * 5 % 64)
    memory = (np.empty if empty else np.zeros)(size + stagger + 64, np.uint8)
    begin = -memory.ctypes.data % 64 + stagger
    return memory[begin : begin + size].view(dtype).reshape(shape)
