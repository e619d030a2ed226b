"""Pieces of one outline, as they are seen by an observer who goes along with the object.

The edge that goes ahead of an object and the one that follows change the light in opposite ways:
what is left behind is as bright as what was there before. So a target whose events are nearly all
of one polarity may be a piece, and its object has the events of the other polarity too. Where few
events come from each pixel of an outline, a window shows pieces of it. Events of all windows,
at their places relative to a common path, show whether and where an outline connects the pieces.
"""

import dataclasses

import numpy as np
from scipy import ndimage

from jaxevent.blob.search.background import Background
from jaxevent.blob.search.config import CONFIG
from jaxevent.blob.search.detection import (
    Scale,
    clutter_model,
    detect,
    larger_variance,
    measure_blobs,
)
from jaxevent.blob.search.paths import (
    TargetPath,
    interpolate_path,
    merge_paths,
    tabulate_paths,
)
from jaxevent.blob.search.stream import Stream, WindowEvents


@dataclasses.dataclass(frozen=True)
class OwnFrame:
    """Events of a stream in the frames of its targets, all seen in windows of one length.

    Attributes:
        stream: Events.
        background: Their background, at rest.
        scale: Windows and cells in which the targets were seen.
    """

    stream: Stream
    background: Background
    scale: Scale

    def balances(self, paths: list[TargetPath]) -> list[float]:
        """Compute the balance of polarities of each path's events: 1 if all are ON, -1 if OFF."""
        sums = np.zeros((2, len(paths) + 1))
        for part, owner in self.stream.near(tabulate_paths(paths), CONFIG.gate_sigmas):
            owners, signs = owner[:, 0] + 1, np.where(part.p, 1, -1)
            sums += [np.bincount(owners, weights, len(sums[0])) for weights in (signs, signs**2)]
        return (sums[0] / np.maximum(sums[1], 1))[1:].tolist()

    def mark_lone_edges(self, paths: list[TargetPath]) -> list[TargetPath]:
        """Mark paths that are long across their way and have nearly all events of one polarity."""
        sizes = [np.median(path.size, 0) for path in paths]
        across = [
            wide < CONFIG.majority * long and path.is_across_way
            for (long, wide), path in zip(sizes, paths, strict=True)
        ]
        if not any(across):
            return paths
        # The balance is the difference of both shares.
        marks = across & (np.abs(self.balances(paths)) > 2 * CONFIG.nearly_all - 1)
        pairs = zip(paths, marks.tolist(), strict=True)
        return [dataclasses.replace(path, lone_edge=mark) for path, mark in pairs]

    def whole(
        self, one: TargetPath, other: TargetPath, others: list[TargetPath]
    ) -> TargetPath | None:
        """Return the path of the object of which two paths are pieces.

        Args:
            one: Path of a piece.
            other: That of another piece.
            others: Paths of other targets, whose events connect nothing.

        Returns:
            A path with the place and shape of what connects the pieces; None if nothing does.
        """
        found = self._connect(one, other)
        if found is None or not others:  # to leave out events takes long
            return found
        stream = self.stream.without(others, CONFIG.gate_sigmas)
        return dataclasses.replace(self, stream=stream)._connect(one, other)

    def _connect(self, one: TargetPath, other: TargetPath) -> TargetPath | None:
        """Return the path of what connects two pieces by all events of the stream."""
        rows = merge_paths(one, other)
        both = [interpolate_path(path, rows.t).p for path in (one, other)]
        # Means of several windows, for pieces slide along their outline.
        way = np.average(both, 0, [np.median(path.n) for path in (one, other)])
        width = min(CONFIG.min_windows, len(rows.t)) | 1
        way = ndimage.uniform_filter1d(way, width, axis=0, mode="nearest")
        size, shape = np.array(self.stream.shape[::-1]), self.stream.shape
        begin, end = ((at - self.stream.start) * 1e-6 for at in (rows.begin, rows.end))
        events, t = self.stream.window(begin, end), (rows.t - self.stream.start) * 1e-6
        x, y = (
            np.rint(xy - np.interp(events.t, t, along) + half).astype(np.int32)
            for xy, along, half in zip((events.x, events.y), way.T, size // 2, strict=True)
        )
        inside = (x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1])
        moved = WindowEvents(events.t[inside], x[inside], y[inside])
        # Cells no larger than the larger piece.
        large = max(float(np.median(path.size[:, 0])) for path in (one, other))
        cell = max(self.scale.cell, 2 ** int(np.log2(max(large, 1))))
        life = dataclasses.replace(self.scale, window=end - begin, cell=cell)
        clutter = clutter_model(self.background, life, shape, (begin + end) / 2)
        labels, number = detect(moved, clutter, shape)
        if number == 0:
            return None
        _, p, C = measure_blobs(moved, labels, number)
        places = np.stack([np.median(path - way, 0) for path in both]) + size // 2
        away = places[:, None] - p
        squared = np.einsum("kbi,bij,kbj->kb", away, np.linalg.inv(C), away).max(0)
        k = int(squared.argmin())
        # What is much larger than what the pieces span is something else that goes along.
        span = float(np.median(np.hypot(*(both[0] - both[1]).T))) / 2 + large
        if squared[k] >= CONFIG.contact_distance**2 or larger_variance(C)[k] > span**2:
            return None
        C = np.broadcast_to(C[k], rows.C.shape)
        return dataclasses.replace(rows, p=way + p[k] - size // 2, C=C)


def differ(balance: float, other: float) -> bool:
    """Return whether two balances of polarities are those of different parts of an outline."""
    return abs(balance - other) > CONFIG.majority
