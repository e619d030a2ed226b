"""What notebooks show of a recording, a reconstruction, tracks and a motion: HTML.

`import jaxevent` hands `as_html` to `jaxevent.display`, so that recordings know no pictures.
Pictures take at most `MOST` events' work; without the extra "plot" they are left out.
"""

import base64
import functools
import html
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxevent.blob.tracks import Tracks
from jaxevent.display import plural
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.errors import InputError
from jaxevent.reconstruction.video import ImageSequence
from jaxevent.recording import Recording
from jaxevent.show.figures import plot_events, plot_image, plot_motion, plot_tracks

MOST = 1_000_000  # events that a reconstruction passes over for its picture
LINES = 12  # of a table of tracks


@functools.singledispatch
def as_html(thing: Any) -> str:
    """A table of what the thing is and a picture of it, as HTML."""
    return f"<pre>{html.escape(repr(thing))}</pre>"


@as_html.register
def _(recording: Recording) -> str:
    start, stop = recording.start, recording.stop
    rows = [
        ("sensor", f"{recording.width} x {recording.height} px"),
        ("time", f"{start / 1e6:.6g} to {stop / 1e6:.6g} s"),
        ("events", f"{len(recording.events):,}"),
        ("frames", f"{0 if recording.frames is None else len(recording.frames):,}"),
    ]
    also = [name for name in ("camera", "poses", "imu") if getattr(recording, name) is not None]
    rows.append(("also", ", ".join([*also, *recording.extra]) or "-"))
    return _block(recording.name, rows, lambda: plot_events(recording))


@as_html.register
def _(video: ImageSequence) -> str:
    recording = video.recording
    middle = (recording.start + recording.stop) // 2
    if recording.events.index(middle) > MOST:
        middle = int(recording.events[MOST : MOST + 1].t[0])
    rows = [
        ("method", video.estimator.name),
        ("images", f"{recording.width} x {recording.height} px, at any time"),
        ("time", f"{recording.start / 1e6:.6g} to {recording.stop / 1e6:.6g} s"),
    ]
    return _block(recording.name, rows, lambda: plot_image(video, middle))


@as_html.register
def _(tracks: Tracks) -> str:
    order = sorted(np.argsort(tracks.birth - tracks.death, kind="stable")[:LINES].tolist())
    rows = [
        (
            f"track {tracks.id[i]}",
            f"{tracks.birth[i] / 1e6:.6g} to {tracks.death[i] / 1e6:.6g} s, {tracks.ended[i]}",
        )
        for i in order
    ]
    if len(tracks) > len(order):
        rows.append(("", f"and {len(tracks) - len(order)} shorter ones"))
    picture = (lambda: plot_tracks(tracks)) if len(tracks.recording.events) <= MOST else None
    title = f"{len(tracks)} {plural('track', len(tracks))} of {tracks.recording.name}"
    return _block(title, rows, picture)


@as_html.register
def _(motion: MotionEstimate) -> str:
    lost = int((~motion.valid).sum())
    rows = [
        ("motion", motion.model.title),
        ("estimates", f"{len(motion):,}, {lost:,} of them lost"),
    ]
    for i, (name, unit) in enumerate(zip(motion.model.components, motion.model.units, strict=True)):
        if motion.valid.any():
            mean = motion.mean[motion.valid, i].mean()
            rows.append((name, f"{mean:.4g}{'' if unit == '1' else f' {unit}'} on average"))
    return _block(motion.recording, rows, lambda: plot_motion(motion))


def _block(title: str, rows: Sequence[tuple[str, str]], picture: Callable[[], Any] | None) -> str:
    cells = "".join(
        f"<tr><th>{html.escape(name)}</th><td style='text-align:left'>{html.escape(text)}</td></tr>"
        for name, text in rows
    )
    image = ""
    if picture is not None:
        try:
            png = base64.b64encode(picture()._repr_png_()).decode()
            image = f"<img alt='' style='max-width:100%' src='data:image/png;base64,{png}'>"
        except InputError as error:  # no matplotlib, or nothing to draw
            image = f"<p>{html.escape(str(error))}</p>"
    return f"<div><b>{html.escape(title)}</b><table>{cells}</table>{image}</div>"
