"""Paths of tracks in the image, and their size, time to contact and range over time.

Arrays as in `jaxevent.show.track_tables`.
"""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike, NDArray

from jaxevent.blob.quantities import SIZE_FACTORS, growth, inverse_ttc, size_range
from jaxevent.errors import InputError, require
from jaxevent.events import count_events
from jaxevent.io.output import complete
from jaxevent.recording import Recording, Times
from jaxevent.show.track_pictures import outline, track_colour
from jaxevent.show.track_tables import check_tracks

_BEHIND = 1_000_000  # most events behind the paths
_ELLIPSES = 6  # along a path
_TELLS, _OFTEN = 3.0, 0.2  # standard deviations of a growth from 0, and share of its times
_CHANGED, _ALIKE = 1.2, 0.5  # ratio of sizes of what grows, least of the axes' changes over most
_ONE_WAY = 0.8  # of all changes is one of growth or of shrinking
_RESOLVED = 2.0  # px, the least size along the shorter axis: smaller spots are as large as pixels
_PARTS = 8  # of a life, whose median sizes are compared
_SURE = 2.0  # standard deviations of the change: errors within a part are alike
_CURVES = 6  # most tracks in the panels over time
_SIZE, _TTC, _RANGE = "lambda (px)", "1 / TTC (1/s)", "range (m)"
_FAINT = 0.2  # of bands
_LEGEND = 16  # most lines that a legend lists
_PAIRS = ("-", "--", ":", "-.")  # lines of pairs


def write_track_plot(
    path: str | Path,
    recording: Recording,
    times: Times,
    ids: ArrayLike,
    mean: ArrayLike,
    covariance: ArrayLike,
    valid: ArrayLike,
    *,
    pairs: Sequence[tuple[int, int]] = (),
    extent: float | int | None = None,
    focal: float | int | None = None,
    size_factor: float | int = SIZE_FACTORS["ring"],
    Q: float | int = 0.01,
    Q_lambda: float | int | None = None,
    total: int | None = None,
) -> None:
    """Draw where tracks went and, over time, their size, with bands of two standard deviations.

    Over time are the six tracks that are seen longest, and those of pairs. Paths are drawn over the
    events, coloured by time, with ellipses of two standard deviations at intervals. 1 / TTC is that
    of a track's growth (`quantities.growth`, smoothed, with Q and Q_lambda), if it differs from 0
    and both axes, larger than pixels, grow alike and one way, as those of what comes nearer do;
    and, of `pairs` of ids, that of the two blobs. Range is drawn where `extent` (m) and `focal`
    (px) are given. Time counts from the recording's start. `total` is of how many tracks these are
    a part. The suffix of `path` chooses the format (PNG, PDF, SVG). Raises `InputError` without the
    extra "plot", for unknown ids and suffixes and for arrays that do not fit.
    """
    require("matplotlib", "plot")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    t, number, mean, covariance, valid = check_tracks(path, times, ids, mean, covariance, valid)
    known = number.tolist()
    for pair in pairs:
        if not (len(set(pair)) == 2 and set(pair) <= set(known)):
            raise InputError(f"{path}: the pair {pair} is not two of the tracks {known}")
    if (extent is None) != (focal is None):
        raise InputError(f"{path}: range needs both the extent (m) and the focal length (px)")
    paths = t, known, mean, valid
    shown = _longest(valid, [known.index(one) for pair in pairs for one in pair])
    known, mean, covariance, valid = (
        number[shown].tolist(), mean[:, shown], covariance[:, shown], valid[:, shown],
    )  # fmt: skip
    filled = np.where(valid[..., None], mean, 1.0)
    filled_P = np.where(valid[..., None, None], covariance, np.eye(8))
    m, P = jnp.asarray(filled), jnp.asarray(filled_P)
    grown, spread, grows = _growths(t, m, P, valid, Q, Q_lambda)
    sizes = filled[..., 4:6], np.diagonal(filled_P, axis1=2, axis2=3)[..., 4:6]
    grows &= _scales(*sizes, valid)

    asked = [_TTC] * bool(grows.any() or len(pairs)) + [_RANGE] * (extent is not None)
    names = [_SIZE, *asked] if valid.any() else []
    high = 7.0 * min(recording.height / recording.width, 1.2)
    figure = Figure(figsize=(8, high + 2.2 * len(names)), layout="constrained")
    suffix = Path(path).suffix.lstrip(".").lower()
    if suffix not in FigureCanvasAgg(figure).get_supported_filetypes():
        raise InputError(
            f"{path}: a figure cannot be stored as {suffix or 'a file without suffix'}; "
            "end the name in .png, .pdf or .svg"
        )
    grid = figure.add_gridspec(1 + len(names), 1, height_ratios=[high, *([2.2] * len(names))])
    seconds = (t - recording.start) * 1e-6
    draw_paths(figure.add_subplot(grid[0]), recording, *paths, total=total)
    bands = _Bands({name: figure.add_subplot(grid[k + 1]) for k, name in enumerate(names)}, seconds)
    ranges = None
    if extent is not None and focal is not None:
        ranges = jax.jit(size_range)(m, P, extent, focal, size_factor)
    _draw_states(bands, known, valid, sizes, (grown, spread, grows), ranges)
    for pair, ls in zip(pairs if names else (), itertools.cycle(_PAIRS)):
        a, b = (known.index(one) for one in pair)
        value, variance = jax.jit(inverse_ttc)(m[:, a], P[:, a], m[:, b], P[:, b])
        line = {"color": "black", "ls": ls, "label": f"{pair[0]} and {pair[1]}"}
        bands.add(_TTC, value, variance, valid[:, a] & valid[:, b], **line)
    bands.finish(len(known), len(number) if total is None else total)
    with complete(Path(path)) as temporary:
        figure.savefig(temporary, format=suffix, dpi=150)


def _draw_states(
    bands: "_Bands",
    known: Sequence[int],
    valid: NDArray[np.bool_],
    sizes: tuple[NDArray, NDArray],
    growths: tuple[NDArray, NDArray, NDArray],
    ranges: tuple[Array, Array] | None,
) -> None:
    """Draw both sizes (T, N, 2) of tracks, their growth and range (T, N), each with its variance.

    The growth is drawn of those tracks (N) that the last of `growths` names.
    """
    grown, spread, grows = growths
    for i in np.flatnonzero(valid.any(0)).tolist():
        one, seen, label = known[i], valid[:, i], f"{known[i]}"
        colour = "#{:02x}{:02x}{:02x}".format(*track_colour(one, dark=True))
        for axis, more in enumerate(({"label": label}, {"ls": "--"})):
            size, variance = (part[:, i, axis] for part in sizes)
            bands.add(_SIZE, size, variance, seen, colour, **more)
        if grows[i]:
            bands.add(_TTC, grown[:, i], spread[:, i], seen, colour, label=f"{one}, growth")
        if ranges is not None:
            value, variance = ranges
            bands.add(_RANGE, value[:, i], variance[:, i], seen, colour, label=label)


def _longest(valid: NDArray[np.bool_], also: Sequence[int]) -> NDArray[np.bool_]:
    """Which tracks are seen at the most times; and some others."""
    shown = np.zeros(valid.shape[1], bool)
    shown[np.argsort(-valid.sum(0), kind="stable")[:_CURVES]] = True
    shown[list(also)] = True
    return shown


def _scales(sizes: NDArray, variances: NDArray, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Of which tracks (T, N) both sizes (T, N, 2) change alike: they come nearer or go away.

    What turns, or comes into sight, changes one of them; what flickers, or takes events of others
    for a while, grows and shrinks by turns; and what is as small as pixels has their size. What is
    seen shortly changes by no more than its errors.
    """
    told = np.zeros(valid.shape[1], bool)
    for i, seen in enumerate(valid.T):
        parts = np.array_split(np.log(sizes[seen, i]), _PARTS)
        errors = np.array_split((variances[seen, i] / sizes[seen, i] ** 2).sum(1), _PARTS)
        if len(parts[-1]):
            medians = np.array([np.median(part, axis=0) for part in parts])
            if np.median(medians.min(1)) < np.log(_RESOLVED):
                continue
            mean = medians.sum(1)
            most, least = mean.argmax(), mean.argmin()
            change = medians[most] - medians[least]
            error = np.sqrt(np.median(errors[most]) + np.median(errors[least]))
            alike = change.min() > _ALIKE * change.max() > _ALIKE * np.log(_CHANGED)
            alike = alike and change.sum() > _SURE * error
            told[i] = alike and np.ptp(mean) > _ONE_WAY * abs(np.diff(mean)).sum()
    return told


def _growths(
    t: NDArray[np.int64],
    m: Array,
    P: Array,
    valid: NDArray[np.bool_],
    Q: float | int,
    Q_lambda: float | int | None,
) -> tuple[NDArray, NDArray, NDArray]:
    """1 / TTC of each growth (T, N), its variance, and of which tracks it differs from 0."""
    since = jnp.asarray((t - t[0]) * 1e-6, m.dtype)
    grown, spread = jax.vmap(
        lambda m, P, seen: growth(since, m, P, seen, Q=Q, Q_lambda=Q_lambda), in_axes=1, out_axes=1
    )(m, P, jnp.asarray(valid))
    grown, spread = np.asarray(grown, np.float64), np.asarray(spread, np.float64)
    clear = valid & (np.abs(grown) > _TELLS * np.sqrt(np.maximum(spread, 0)))
    return grown, spread, clear.sum(0) > _OFTEN * np.maximum(valid.sum(0), 1)


class _Bands:
    """Panels of lines over time, with bands of two standard deviations."""

    def __init__(self, axes: Mapping[str, Any], seconds: NDArray[np.float64]):
        self.axes, self.seconds = axes, seconds
        self.bounds: list[float] = []
        for axis in list(axes.values())[1:]:
            axis.sharex(axes[_SIZE])

    def add(self, name: str, value: Any, variance: Any, seen: NDArray, color: str, **line: Any):
        deviation = np.sqrt(np.maximum(np.asarray(variance, np.float64), 0))
        value = np.where(seen & np.isfinite(deviation), np.asarray(value, np.float64), np.nan)
        self.axes[name].plot(self.seconds, value, color=color, lw=1.3, **line)
        low, high = value - 2 * deviation, value + 2 * deviation
        self.axes[name].fill_between(self.seconds, low, high, color=color, alpha=_FAINT, lw=0)
        if name == _TTC and np.isfinite(value).any():
            # Before anything has been measured a band reaches beyond every scale.
            clear = np.isfinite(value) & (deviation <= 3 * np.nanmedian(deviation[seen]))
            self.bounds += [float(np.nanmin(low[clear])), float(np.nanmax(high[clear]))]

    def finish(self, shown: int, total: int) -> None:
        legend = 0 < shown <= _LEGEND
        some = "" if shown == total else f" of the {shown} tracks seen longest"
        if not self.axes:
            return
        for name, axis in self.axes.items():
            axis.set_ylabel(name)
            axis.spines[["top", "right"]].set_visible(False)
            if legend:
                axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
        if self.bounds:
            self.axes[_TTC].set_ylim(min(self.bounds), max(self.bounds) + 1e-9)
        title = f"lambda1 solid, lambda2 dashed{some}; bands: 2 standard deviations"
        self.axes[_SIZE].set_title(title, fontsize=9)
        list(self.axes.values())[-1].set_xlabel("t (s) from the recording's start")


def draw_paths(
    axis: Any,
    recording: Recording,
    t: NDArray[np.int64],
    known: Sequence[int],
    mean: NDArray,
    valid: NDArray[np.bool_],
    total: int | None = None,
) -> None:
    """Draw paths in the image plane over the number of events of each pixel; time is colour.

    `mean` (T, N, 8) and `valid` (T, N) at sorted times (us) of the tracks `known`. Ellipses of two
    standard deviations stand at intervals, a track's number where it ends. Behind are the events of
    that time, at most a million in its middle. `total` is of how many tracks these are a part.
    """
    from matplotlib.collections import LineCollection

    seconds = (t - recording.start) * 1e-6
    first, last = (recording.events.index(int(at)) for at in (t[0], t[-1] + 1))
    middle = max(first, (first + last - _BEHIND) // 2)
    events = recording.events[middle : min(last, middle + _BEHIND)]
    behind = np.log1p(count_events(events, size=(recording.width, recording.height)))
    axis.imshow(behind, "Greys", vmin=0, vmax=2 * max(float(np.percentile(behind, 99.9)), 0.5))
    lines = None
    for i, one in enumerate(known):
        seen = np.flatnonzero(valid[:, i] & np.isfinite(mean[:, i]).all(1))
        if not len(seen):
            continue
        places = mean[seen, i, :2]
        parts = np.stack([places[:-1], places[1:]], 1)[np.diff(seen) == 1]
        lines = LineCollection(list(parts), lw=1.5, cmap="viridis")
        lines.set_array(seconds[seen[:-1]][np.diff(seen) == 1])
        lines.set_clim(seconds[0], max(float(seconds[-1]), float(seconds[0]) + 1e-9))
        axis.add_collection(lines)
        for k in np.unique(np.linspace(0, len(seen) - 1, _ELLIPSES).astype(np.int64)):
            colour = lines.to_rgba(seconds[seen[k]])
            axis.plot(*outline(mean[seen[k], i], 2.0).T, color=colour, lw=0.8)
        dark = "#{:02x}{:02x}{:02x}".format(*track_colour(one, dark=True))
        axis.annotate(
            str(one), places[-1], (4, 4), textcoords="offset points", color=dark, fontsize=9,
            weight="bold",
        )  # fmt: skip
    if lines is not None:
        axis.figure.colorbar(lines, ax=axis, fraction=0.03, pad=0.01, label="t (s)")
    axis.set(xlim=(-0.5, recording.width - 0.5), ylim=(recording.height - 0.5, -0.5))
    axis.set(xlabel="x (px)", ylabel="y (px)")
    some = ""
    if total is not None and total > len(known):
        some = f" of the {len(known)} of {total} tracks seen longest"
    title = f"paths{some}, ellipses of 2 standard deviations, numbers where they end"
    axis.set_title("events; no track" if lines is None else title, fontsize=9)
