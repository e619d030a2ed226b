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
from jaxevent.blob.search.stream import Stream, WindowEvents, batches_near_paths


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

    def without(self, paths: list[TargetPath]) -> "OwnFrame":
        """Return the frame of the events of other objects than those of some paths."""
        if not paths:
            return self
        return dataclasses.replace(self, stream=self.stream.without(paths, CONFIG.gate_sigmas))

    def balances(self, paths: list[TargetPath]) -> list[float]:
        """Compute the balance of polarities of each path's events: 1 if all are ON, -1 if OFF."""
        sums = np.zeros((2, len(paths) + 1))
        table, gate = tabulate_paths(paths), CONFIG.gate_sigmas
        for _, part, owner in batches_near_paths(self.stream.recording.events, table, gate):
            seen = ~self.stream.hot[part.y, part.x]
            owners, signs = owner[seen, 0] + 1, np.where(part.p[seen], 1, -1)
            sums += [np.bincount(owners, weights, len(sums[0])) for weights in (signs, signs**2)]
        return (sums[0] / np.maximum(sums[1], 1))[1:].tolist()

    def whole(self, one: TargetPath, other: TargetPath) -> tuple[TargetPath, float] | None:
        """Return the path of the object of which two paths are pieces, and its balance.

        Args:
            one: Path of a piece.
            other: That of another piece, or the same.

        Returns:
            A path with the place and shape of what connects the pieces, and the balance of its
            polarities; None if nothing does.
        """
        rows = merge_paths(one, other)
        both = [interpolate_path(path, rows.t).p for path in (one, other)]
        # Means of several windows, for pieces slide along their outline.
        way = np.average(both, 0, [np.median(path.n) for path in (one, other)])
        width = min(CONFIG.min_windows, len(rows.t)) | 1
        way = ndimage.uniform_filter1d(way, width, axis=0, mode="nearest")
        size, shape = np.array(self.stream.shape[::-1]), self.stream.shape
        events = self.stream.events_between(rows.begin, rows.end)
        middle = [np.interp(events.t, rows.t, along) for along in way.T]
        x, y = (
            np.rint(xy - along + half).astype(np.int32)
            for xy, along, half in zip((events.x, events.y), middle, size // 2, strict=True)
        )
        inside = (x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1])
        moved = WindowEvents(1e-6 * (events.t[inside] - rows.begin), x[inside], y[inside])
        begin, end = ((at - self.stream.start) * 1e-6 for at in (rows.begin, rows.end))
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
        apart = float(np.median(np.hypot(*(both[0] - both[1]).T)))
        most = CONFIG.gate_sigmas * large if one is other else apart / 2 + large
        if squared[k] >= CONFIG.contact_distance**2 or larger_variance(C)[k] > most**2:
            return None
        balance = 2 * float(events.p[inside][labels == k + 1].mean()) - 1
        C = np.broadcast_to(C[k], rows.C.shape)
        n = rows.n if one is not other else one.n
        return dataclasses.replace(rows, p=way + p[k] - size // 2, C=C, n=n), balance

    def completed(self, path: TargetPath, balance: float) -> TargetPath:
        """Return the path of the larger object of which a path is a piece, or the path itself.

        Args:
            path: Path of a target; the frame is without its events and those of all others.
            balance: Balance of its polarities.
        """
        missing = self.whole(path, path) if differ(balance, 0.0) else None
        if missing is None or not differ(balance, missing[1]):
            return path
        known, seen = (np.median(larger_variance(one.C)) for one in (path, missing[0]))
        return path if seen < CONFIG.contact_distance * known else missing[0]


def differ(balance: float, other: float) -> bool:
    """Return whether two balances of polarities are those of different parts of an outline."""
    return abs(balance - other) > CONFIG.majority
