"""Search for the targets of a recording, without settings.

The background is measured, then the scale at which blobs predict the next events best is selected
and targets are tracked at that scale. The events near them are removed, and all is done again for
what remains, so that slow and fast targets are found in one recording.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.params import TrackerParams, check_accuracy, max_events_per_step
from jaxevent.blob.search.background import Background, clutter_evidence, measure_background
from jaxevent.blob.search.config import CONFIG
from jaxevent.blob.search.detection import Scale, clutter_at, clutter_model, larger_variance
from jaxevent.blob.search.merge import OwnFrame, merge_parts, merge_turning, stitch_paths
from jaxevent.blob.search.paths import TargetPath
from jaxevent.blob.search.polarity import drop_lamps, prefer_sharper
from jaxevent.blob.search.scale import ScaleSelection, are_evident, select_scale
from jaxevent.blob.search.scene import drop_edges, find_scene, has_own_motion, split_at_pauses
from jaxevent.blob.search.stream import Stream
from jaxevent.blob.search.window_tracker import WindowTracker
from jaxevent.blob.seeds import tracking_span
from jaxevent.deprecated import RenamedAttribute
from jaxevent.display import plural
from jaxevent.precision import to_jax
from jaxevent.progress import stage
from jaxevent.recording import Recording, check_recording

UNLIMITED = 1e9  # s, px or ratio: the search decides when targets end


@dataclasses.dataclass(frozen=True)
class SearchPass:
    """The scale that one pass over the recording selected, and the number of its targets."""

    selection: ScaleSelection
    targets: int

    choice = RenamedAttribute("selection")


@dataclasses.dataclass(frozen=True, repr=False)
class TargetSearchResult:
    """Targets of a recording, found by `find`.

    Attributes:
        paths: Paths of the targets, by their beginning.
        passes: Selected scales, and the number of targets of each.
        hot_pixels: Number of hot pixels, which are left out.
        background: Events of no target, per s, of the whole sensor.
        recording: The recording.
        camera_moves: Whether the background is a scene that moves past the camera.
        lamps: Number of lamps on the mains, which are left out.
        full: Whether most of the sensor has events most of the time, of whatever source, or a scene
            seems to move over it.
        whole: Result of the whole recording, of which this is a part, and from which settings come;
            None: this is the whole.
        index: (targets,) index of each target in the whole.
    """

    paths: tuple[TargetPath, ...]
    passes: tuple[SearchPass, ...]
    hot_pixels: int
    background: float
    recording: Recording
    camera_moves: bool = False
    lamps: int = 0
    full: bool = False
    whole: "TargetSearchResult | None" = None
    index: NDArray[np.int64] | None = None

    own = RenamedAttribute("per_target_values")

    def __len__(self) -> int:
        return len(self.paths)

    def __repr__(self) -> str:
        return f"<{self.summary()}>"

    @property
    def score(self) -> float:
        """Largest gain of blobs over the background alone, in nats per event; 0 without any."""
        return max((one.selection.score for one in self.passes), default=0.0)

    @property
    def compact(self) -> bool:
        """True if no ellipse of twice a target's sizes covers a quarter of the sensor."""
        quarter = CONFIG.considerable * self.recording.width * self.recording.height
        areas = [4 * np.pi * float(np.median(path.size.prod(1))) for path in self.paths]
        return max(areas, default=0.0) < quarter

    def summary(self) -> str:
        """Summarise the result in one line."""
        text = f"{len(self)} {plural('target', len(self))}, "
        text += f"background of {self.background:,.0f} events/s"
        if self.hot_pixels:
            text += f", {self.hot_pixels} {plural('hot pixel', self.hot_pixels)} left out"
        if self.lamps:
            text += f", {self.lamps} {plural('lamp', self.lamps)} left out"
        if self.camera_moves:
            text += ", the camera moves"
        turns = [f"{path.turn_rate:.3g}" for path in self.paths if path.turn_rate is not None]
        if turns:
            verb = "turns" if len(turns) == 1 else "turn"
            text += f", {len(turns)} {verb} in place at {' and '.join(turns)} rad/s"
        if not len(self):
            return text
        size, speed, rate, _ = (self._quantile(values) for values in self._typical_values())
        windows = dict.fromkeys(
            f"{p.selection.scale.window * 1e3:g}" for p in self.passes if p.targets
        )
        return (
            f"{text}; size {size:.3g} px, speed {speed:.3g} px/s, {rate:,.0f} events/s each; "
            f"seen in windows of {' and '.join(windows)} ms"
        )

    def seeds(self, start: int, stop: int) -> list[tuple[float, float, float, int]]:
        """Return a seed for each target, where it is first seen.

        Args:
            start: Earliest time of a seed, us.
            stop: Latest time, us, which is excluded.

        Returns:
            Position x and y (px), size (px) and time (us) of each target.
        """
        width, height = self.recording.width, self.recording.height
        out = []
        for path in self.paths:
            x, y = path.p[0]
            at = int(np.clip(path.begin, start, stop - 1))
            x, y = np.clip(x, -0.5, width - 0.5), np.clip(y, -0.5, height - 0.5)
            size = np.median(path.size[: CONFIG.min_confirm_windows].mean(1))
            out.append((float(x), float(y), float(size), at))
        return out

    def crop(self, start: int, stop: int) -> "TargetSearchResult":
        """Return the targets that are seen in a span, and their paths in it.

        Args:
            start: Begin of the span, us.
            stop: Its end, us, which is excluded.

        Returns:
            The part; its settings and values of targets are those of the whole.
        """
        rows = [(start <= path.t) & (path.t < stop) for path in self.paths]
        index = np.array([k for k, row in enumerate(rows) if row.any()], np.int64)
        paths = tuple(self.paths[k].take(rows[k]) for k in index)
        return dataclasses.replace(self, paths=paths, whole=self, index=index)

    def settings(self, accuracy: float | int | None = None) -> dict[str, Any]:
        """Return values of a tracker's parameters that suit the targets.

        Values that differ between targets are medians, weighted by events.

        Args:
            accuracy: Share by which the standard deviation of positions may be larger than event
                by event, which sets `events_per_step`; None for about 32 steps in a window.

        Raises:
            InputError: `accuracy` is not above 0 and at most 1.
        """
        check_accuracy(accuracy)
        if self.whole is not None:
            return self.whole.settings(accuracy)
        if not len(self):
            return {}
        sizes, _, rates, windows = self._typical_values()
        largest, smallest = self._quantile(sizes, 0.95), self._quantile(sizes, 0.05)
        W = self._quantile(windows)
        begin, end = self._lives()
        at_once = ((begin <= begin[:, None]) & (end > begin[:, None])).sum(1).max()
        events, rounded = self._quantile(rates) * at_once * W / 32, np.round
        if accuracy is not None:
            events = self._quantile(self._max_events(float(accuracy)), 0.05)
            rounded = np.floor
        events = int(2 ** np.clip(rounded(np.log2(max(events, 1e-9))), 0, 5))
        return {name: self._quantile(values) for name, values in self._target_values().items()} | {
            "events_per_step": events,
            "lambda_min": min(0.5, smallest / 3),
            "lambda_max": 6 * largest,
            **dict.fromkeys(("t_coast", "t_merge", "aspect_max", "sigma_max"), UNLIMITED),
            "cycle": W,
        }

    def per_target_values(
        self, params: TrackerParams, usual: Mapping[str, Any] | None = None
    ) -> dict[str, NDArray]:
        """Return per-target values of parameters, in unconstrained form.

        Args:
            params: The parameters; those that the user changed are left out.
            usual: Settings from which those differ; None: `settings`.

        Returns:
            (targets,) values by name.
        """
        usual, out = self.settings() if usual is None else usual, {}
        if self.whole is not None:
            values = self.whole.per_target_values(params, usual)
            return {name: value[self.index] for name, value in values.items()}
        for name, values in self._target_values().items():
            if np.isclose(float(getattr(params, name)), usual[name], rtol=1e-5):
                stored = to_jax(np.asarray(values, params.raw[name].dtype))
                out[name] = np.asarray(getattr(type(params), name).unconstrained(stored))
        return out

    def _target_values(self) -> dict[str, NDArray[np.float64]]:
        """Values of parameters for each target."""
        L, v, rate, W = self._typical_values()
        sensor = self.recording.width * self.recording.height
        density = self.background / sensor
        # Within three sizes there may be more clutter than events of the target.
        area = np.array([np.pi * path.size.prod(1).mean() for path in self.paths])
        inside = density * np.minimum(CONFIG.gate_sigmas**2 * area, sensor)
        return {
            "clutter": np.where(inside > rate, density / rate, 0.0),
            "Q_p": 1e-4 * L**2 / W,
            "Q_v": np.array([path.velocity_noise for path in self.paths]),
            "Q_lambda": (0.05 * L) ** 2 / W,
            "Q_theta": 0.01 / W,
            "Q_q": 0.01 / W**3,
            "P0_p": L**2 / 4,
            "P0_v": 4 * v**2 + (L / W) ** 2,
            "P0_lambda": (0.5 * L) ** 2,
            "P0_q": (0.1 / W) ** 2,
            "lambda0": L,
            "gate_decay": 1 / W,
            "gate_min": np.maximum(2.0, 3 * L / 2),
            "gate_max": 24 * L,
            "t_still": CONFIG.still_windows * W,
        }

    def _max_events(self, accuracy: float) -> NDArray[np.float64]:
        """Events per step that each target allows, of all targets that live as long as it does."""
        begin, end = self._lives()
        rate = np.array([np.quantile(p.n, 0.25) / (p.window * 1e-6) for p in self.paths])
        along = (begin <= begin[:, None]) & (end >= end[:, None])
        size = np.array([np.median(path.size[:, 1]) for path in self.paths])
        noise = np.array([path.velocity_noise for path in self.paths])
        return max_events_per_step(accuracy, size, rate, noise) * (along @ rate) / rate

    def _typical_values(self) -> NDArray[np.float64]:
        """Longer size (px), speed (px/s), events/s and window (s) of each target, (4, targets)."""
        rows = []
        for path in self.paths:
            size, speed, window = path.size[:, 0], np.hypot(*path.v.T), path.window * 1e-6
            rows.append((np.median(size), np.median(speed), np.median(path.n) / window, window))
        return np.array(rows).T

    def _quantile(self, values: NDArray, part: float | int = 0.5) -> float:
        """Compute a quantile of values of targets, weighted by their events.

        Args:
            values: (targets,).
            part: Share of the events up to the quantile, 0..1.

        Returns:
            The quantile.
        """
        events = np.array([path.n.sum() for path in self.paths])
        order = np.argsort(values)
        total = np.cumsum(events[order])
        return float(values[order][np.searchsorted(total, part * total[-1])])

    def _lives(self) -> NDArray[np.int64]:
        """Beginnings and ends of the targets, us, (2, targets)."""
        return np.array([(path.begin, path.end) for path in self.paths]).T


def find(
    recording: Recording,
    start: int | float | None = None,
    stop: int | float | None = None,
    *,
    progress: bool | None = None,
) -> TargetSearchResult:
    """Find the targets of a recording, without settings.

    Args:
        recording: Events; frames are not needed.
        start: First time of the events that are used, by default that of the first. An integer is
            us, a float s.
        stop: Time before which events are used, by default all.
        progress: Whether a bar is shown; None: in a terminal or notebook.

    Returns:
        Paths of the targets, and the scales at which they were found.

    Raises:
        InputError: There is no time between `start` and `stop`.
    """
    check_recording(recording, "blob.find")
    stream = Stream(recording, *tracking_span(recording, start, stop))
    if len(stream) < CONFIG.min_recording_events:
        return TargetSearchResult((), (), 0, 0.0, recording)
    found: list[TargetPath] = []
    passes: list[SearchPass] = []
    sections = _split_recording(stream, progress)
    for one in sections:
        new, done = _search_section(one, progress)
        found += new
        passes += done
    backgrounds = [one.background for one in sections]
    if len(sections) > 1 and found:
        windows = 1e6 * stream.duration / found[0].window
        found = stitch_paths(found, (stream.width, stream.height), windows)
    stream.hot = hot = np.any([one.stream.hot for one in sections], 0)
    found, lamps = drop_lamps(found, stream)
    found = prefer_sharper(found, stream)
    found.sort(key=lambda path: (path.begin, path.p[0].tolist()))
    events = sum(one.mean_rate * stream.width * stream.height * one.duration for one in backgrounds)
    moves = any(one.scene is not None for one in backgrounds)
    return TargetSearchResult(
        tuple(found), tuple(passes), int(hot.sum()), events / stream.duration, recording, moves,
        lamps, any(one.covered or one.background.is_dense for one in sections),
    )  # fmt: skip


class _Section(NamedTuple):
    """Events that are searched together, their background, and the first scale."""

    stream: Stream
    background: Background
    selection: ScaleSelection | None
    covered: bool  # whether a scene seems to move over most of the sensor


def _split_recording(stream: Stream, progress: bool | None) -> list[_Section]:
    """Return the whole, or each pause of a camera that moves at times and each span between."""
    with stage("find: background", progress):
        background = measure_background(stream)
    spans = split_at_pauses(background)
    if len(spans) > 1:
        streams = [stream.between(*span) for span in spans]
        sections = [
            _prepare_section(one, measure_background(one), progress)
            for one in streams
            if len(one) >= CONFIG.min_recording_events
        ]
        if any(one.background.scene is not None for one in sections):
            return sections
    return [_prepare_section(stream, background, progress)]


def _prepare_section(stream: Stream, background: Background, progress: bool | None) -> _Section:
    """Select the scale of a section, and take its scene as background if it moves."""
    with stage("find: scale", progress):
        selection = select_scale(stream, background)
    if selection is None:
        return _Section(stream, background, None, False)
    with stage("find: the scene's motion", progress):
        covered, moving = find_scene(stream, background, selection)
    if moving is not None:
        background, selection = moving, select_scale(stream, moving)
    return _Section(stream, background, selection, covered)


def _search_section(
    section: _Section, progress: bool | None
) -> tuple[list[TargetPath], list[SearchPass]]:
    """Search a section in passes, of which the first one uses the section's scale."""
    stream, background, selection, covered = section
    found: list[TargetPath] = []
    passes: list[SearchPass] = []
    size, gate = (stream.width, stream.height), CONFIG.gate_sigmas
    for number in range(CONFIG.max_passes):
        name = f"find, pass {number + 1}"
        if number:
            with stage(f"{name}: scale", progress):
                selection = select_scale(stream, background, later=True)
        if not (selection and are_evident(selection.score, selection.nats, background)):
            break
        confirmed = WindowTracker(stream, background, selection.scale).run(name, progress)
        if not confirmed:
            passes.append(SearchPass(selection, 0))
            break
        with stage(f"{name}: beginnings", progress):
            rest = stream.without(confirmed, gate, max(path.begin for path in confirmed))
            whole = [_extend_backwards(one, rest, background, selection.scale) for one in confirmed]
        frame, scene = OwnFrame(stream, background, selection.scale), background.scene
        near = whole = merge_parts(whole, None if scene else frame)
        if scene:
            whole = [one for one in whole if has_own_motion(one, scene, stream.start)]
        else:
            whole = drop_edges(whole, covered)
        lasting = [one for one in whole if _is_persistent(one, stream.duration)]
        new = stitch_paths(lasting, size, stream.duration / selection.scale.window)
        new = [one for one in new if not _is_duplicate(one, found)]
        passes.append(SearchPass(selection, len(new)))
        found += new
        stitched = [one for one in new if all(one is not other for other in near)]
        stream = stream.without([*near, *stitched], 2 * gate)
    with stage("find: what turns in its place", progress):
        return merge_turning(found, section.stream, background), passes


def _is_persistent(path: TargetPath, duration: float | int) -> bool:
    """Return whether a target is larger than a pixel and was seen in enough of its windows.

    A target seen in few windows of the recording, of `duration` s, must go on as it goes: parts of
    a flicker are here and there.
    """
    window, seen = path.window * 1e-6, len(path.t)
    size = np.median(np.trace(path.C, axis1=1, axis2=2))
    leaves = path.velocity_noise * window**3 / 3
    short = seen < min(2 * CONFIG.min_windows, CONFIG.majority * duration / window)
    if short and leaves > (CONFIG.erratic_sizes * np.median(path.size[:, 0])) ** 2:
        return False
    windows = (path.t[-1] - path.t[0]) / path.window + 1
    enough = seen >= CONFIG.majority * windows
    return bool(size > 2 * CONFIG.resolution_px**2 and enough)


def _extend_backwards(
    path: TargetPath, rest: Stream, background: Background, scale: Scale
) -> TargetPath:
    """Extend a path backwards in time.

    The path's initial velocity predicts each window before. The unassigned events in the gate are
    accepted if they exceed the clutter.

    Args:
        path: Path of a target.
        rest: Events that belong to no target.
        background: Background of the stream.
        scale: Windows and cells.
    """
    first = min(CONFIG.min_windows, len(path.t))
    if first < 3:
        return path
    w, times = scale.window, (path.t[:first] - rest.start) * 1e-6
    v, p = np.polyfit(times - times[0], path.p[:first], 1)
    C, usual = path.C[:first].mean(0), float(np.median(path.n[:first]))
    spread = C + np.eye(2) * (0.1 + np.trace(C) / 2 / max(usual, 1))
    gate, threshold = CONFIG.gate_sigmas, -np.log(CONFIG.false_alarm_known)
    farthest = gate**2 * larger_variance(C[None])[0]
    t, misses, rows = float(times[0]), 0, []
    while misses < CONFIG.max_coast_windows and t - 1.5 * w > 0:
        t, p = t - w, p - v * w
        if not (0 <= p[0] < rest.width and 0 <= p[1] < rest.height):
            break
        part = rest.window(t - w / 2, t + w / 2)
        e = np.stack([part.x - p[0], part.y - p[1]], 1) - v * (part.t - t)[:, None]
        S = spread * (1 + 0.2 * misses)
        near = np.einsum("ni,ij,nj->n", e, np.linalg.inv(S), e) < gate**2
        n = int(near.sum())
        area = np.pi * gate**2 * np.sqrt(np.linalg.det(S))
        rate, F = clutter_at(clutter_model(background, scale, rest.shape, t), p[0], p[1])
        enough = n >= 2 and n >= CONFIG.min_event_share * usual
        enough = enough and clutter_evidence(n, max(rate * w * area, 1e-3), F) >= threshold
        z = e[near].mean(0) if enough else np.full(2, np.inf)
        if z @ z > farthest:
            misses += 1
            continue
        p, v, misses = p + 0.5 * z, v - 0.15 * z / w / (1 + misses), 0
        rows.append((t, p, v, n))
    if not rows:
        return path
    t, p, v, n = (np.array(values) for values in zip(*rows[::-1], strict=True))
    us = rest.start + np.rint(t * 1e6).astype(np.int64)
    C = np.broadcast_to(C, (len(rows), 2, 2))
    before = dataclasses.replace(path, t=us, p=p, v=v, C=C, n=n.astype(float))
    return before.followed_by(path)


def _is_duplicate(path: TargetPath, found: list[TargetPath]) -> bool:
    """Return whether a path was near one of an earlier pass for long."""
    for other in found:
        inside = (path.t > other.begin - 2 * other.window) & (path.t < other.end + 2 * other.window)
        row = np.clip(np.searchsorted(other.t, path.t), 0, len(other.t) - 1)
        d = other.at(path.t) - path.p
        reach = sum(np.sqrt(np.einsum("ti,tij,tj->t", d, C, d)) for C in (path.C, other.C[row]))
        near = inside & ((d * d).sum(1) <= 1.5 * CONFIG.contact_distance * reach)
        if near.mean() >= CONFIG.majority:
            return True
    return False
