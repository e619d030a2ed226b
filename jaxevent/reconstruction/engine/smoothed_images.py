"""A smoother's images and their derivatives by parameters, one band after another."""

import queue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import run_over_rows
from jaxevent.reconstruction.engine.frame_loop import (
    GivenFrames,
    Instants,
    filter_frames,
    read_images,
    smooth_frames,
)
from jaxevent.reconstruction.engine.frame_passes import FramePasses, Stretch
from jaxevent.reconstruction.engine.images import Divided
from jaxevent.reconstruction.engine.loop import Images
from jaxevent.reconstruction.engine.pixel import Directions
from jaxevent.reconstruction.engine.smoothing import LATER
from jaxevent.recording import Recording


class DividedFrames(Divided):
    """Of a smoother, which passes over the frames: all of a recording's, band by band."""

    def __init__(self, method: Any, recording: Recording, times: NDArray[np.int64], params: Any):
        self._passes: dict[Directions, FramePasses] = {}
        super().__init__(method, recording, times, params)
        passes = self._passes_of(params, Directions())
        self._whole = Stretch(0, len(passes.clock))
        self._bands, _ = passes.divide(self._whole, self.recording.windows.initial())

    def check(self, params: Any, directions: Directions) -> None:
        FramePasses(self.recording, self.method, params, self.clock_offset, directions)

    def _passes_of(self, params: Any, directions: Directions) -> FramePasses:
        passes = self._passes.get(directions)
        if passes is None:
            passes = FramePasses(self.recording, self.method, params, self.clock_offset, directions)
            self._passes[directions] = passes
        passes.use(params)
        return passes

    def make(self, times: NDArray[np.int64], params: Any, directions: Directions) -> Images:
        passes = self._passes_of(params, directions)
        images, instants = passes.room(len(times)), passes.instants(times, 0)
        slot = np.zeros(passes.bands, np.int64)
        given = passes.given(self._whole, self._bands, slot)
        run_over_rows(_make, passes.bands, passes, given, instants, images, passes.spare)
        return images


def _make(
    begin: int,
    end: int,
    passes: FramePasses,
    given: GivenFrames,
    instants: Instants,
    images: Images,
    spare: queue.SimpleQueue,
) -> None:
    """Pass over some bands, one after another in the same memory, which is kept."""
    try:
        memory = spare.get_nowait()
    except queue.Empty:
        memory = passes.memory(1, len(given.line.mid))
    later = [name for leaf in LATER for name in (leaf, *passes.kernel.program.slopes(leaf))]
    for band in range(begin, end):
        passes.field(memory, "given")[:] = passes.shares[band]
        filter_frames(band, band + 1, given, memory, True, False)
        for name in later:
            passes.field(memory, name)[:] = 0
        smooth_frames(band, band + 1, given, memory)
        read_images(band, band + 1, given, memory, instants, images)
    spare.put(memory)
