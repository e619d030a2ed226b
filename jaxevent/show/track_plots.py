"""Size, time to contact and range of tracks drawn over time.

Arrays as in `jaxevent.show.track_tables`.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent.blob.quantities import SIZE_FACTORS, growth, inverse_ttc, size_range
from jaxevent.errors import InputError, require
from jaxevent.io.output import complete
from jaxevent.recording import Times
from jaxevent.show.track_pictures import track_colour
from jaxevent.show.track_tables import check_tracks


def plot_tracks(
    path: str | Path,
    times: Times,
    ids: ArrayLike,
    mean: ArrayLike,
    covariance: ArrayLike,
    valid: ArrayLike,
    *,
    pair: tuple[int, int] | None = None,
    extent: float | int | None = None,
    focal: float | int | None = None,
    size_factor: float | int = SIZE_FACTORS["ring"],
    Q: float | int = 0.01,
    Q_lambda: float | int | None = None,
) -> None:
    """Draw size and inverse time to contact over time, with bands of two standard deviations.

    1 / TTC is that of each track's growth (`quantities.growth`, smoothed, with Q and Q_lambda) and,
    given the ids of a `pair`, that of the two blobs. Range is drawn where `extent` (m) and `focal`
    (px) are given. The suffix of `path` chooses the format (PNG, PDF, SVG). Raises `InputError`
    without the extra "plot", for unknown ids and suffixes and for arrays that do not fit.
    """
    require("matplotlib", "plot")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    t, number, mean, covariance, valid = check_tracks(path, times, ids, mean, covariance, valid)
    known = number.tolist()
    if pair is not None and not (len(set(pair)) == 2 and set(pair) <= set(known)):
        raise InputError(f"{path}: the pair {pair} is not two of the tracks {known}")
    if (extent is None) != (focal is None):
        raise InputError(f"{path}: range needs both the extent (m) and the focal length (px)")
    names = ["lambda (px)", "1 / TTC (1/s)"] + ["range (m)"] * (extent is not None)
    figure = Figure(figsize=(8, 2.6 * len(names)), layout="constrained")
    suffix = Path(path).suffix.lstrip(".").lower()
    if suffix not in FigureCanvasAgg(figure).get_supported_filetypes():
        raise InputError(
            f"{path}: a figure cannot be stored as {suffix or 'a file without suffix'}; "
            "end the name in .png, .pdf or .svg"
        )
    axes = dict(zip(names, figure.subplots(len(names), 1, sharex=True), strict=True))
    seconds, bounds, faint = t * 1e-6, [], min(0.2, 0.5 / max(len(known), 1))

    def band(name: str, value, variance, seen: NDArray, colour: str, **line) -> None:
        deviation = np.sqrt(np.maximum(np.asarray(variance, np.float64), 0))
        value = np.where(seen & np.isfinite(deviation), np.asarray(value, np.float64), np.nan)
        axes[name].plot(seconds, value, color=colour, lw=1.3, **line)
        low, high = value - 2 * deviation, value + 2 * deviation
        axes[name].fill_between(seconds, low, high, color=colour, alpha=faint, lw=0)
        if name == names[1] and np.isfinite(value).any():
            # Before anything has been measured a band reaches beyond every scale.
            clear = np.isfinite(value) & (deviation <= 3 * np.nanmedian(deviation[seen]))
            bounds.extend([np.nanmin(low[clear]), np.nanmax(high[clear])])

    filled = np.where(valid[..., None], mean, 1.0)
    filled_P = np.where(valid[..., None, None], covariance, np.eye(8))
    m, P = jnp.asarray(filled), jnp.asarray(filled_P)
    since = jnp.asarray((t - t[0]) * 1e-6, m.dtype)
    grown, spread = jax.vmap(
        lambda m, P, seen: growth(since, m, P, seen, Q=Q, Q_lambda=Q_lambda), in_axes=1, out_axes=1
    )(m, P, jnp.asarray(valid))
    ranges = None
    if extent is not None and focal is not None:
        ranges = jax.jit(size_range)(m, P, extent, focal, size_factor)
    for i, one in enumerate(known):
        colour = "#{:02x}{:02x}{:02x}".format(*track_colour(one, dark=True))
        for axis, style in ((4, "-"), (5, "--")):
            label = f"{one}" if axis == 4 else None
            variance = filled_P[:, i, axis, axis]
            band(names[0], filled[:, i, axis], variance, valid[:, i], colour, ls=style, label=label)
        band(names[1], grown[:, i], spread[:, i], valid[:, i], colour, label=f"{one}, growth")
        if ranges is not None:
            value, variance = ranges
            band(names[2], value[:, i], variance[:, i], valid[:, i], colour, label=f"{one}")
    if pair is not None:
        a, b = (known.index(one) for one in pair)
        value, variance = jax.jit(inverse_ttc)(m[:, a], P[:, a], m[:, b], P[:, b])
        both = valid[:, a] & valid[:, b]
        band(names[1], value, variance, both, "black", label=f"{pair[0]} and {pair[1]}")
    for name, axis in axes.items():
        axis.set_ylabel(name)
        axis.spines[["top", "right"]].set_visible(False)
        if 0 < len(known) <= 8:
            axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    if bounds:
        axes[names[1]].set_ylim(min(bounds), max(bounds) + 1e-9)
    axes[names[0]].set_title(
        "lambda1 solid, lambda2 dashed; bands: 2 standard deviations", fontsize=9
    )
    axes[names[-1]].set_xlabel("t (s)")
    with complete(Path(path)) as temporary:
        figure.savefig(temporary, format=suffix, dpi=150)
