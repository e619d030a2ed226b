"""Figures of recordings, reconstructions, tracks, motions and fits.

    from jaxevent import show

    show.plot_events(recording)  # shown as it is in a notebook
    show.plot_image(video, 1.0).savefig("image.png")
    show.save_video(video, [1.0, 1.04, 1.08], "video.mp4")  # or a folder, or .h5
    show.view(recording, video, tracks)  # all on one timeline, in the Rerun viewer

Every `plot_` function returns a `matplotlib.figure.Figure` and raises `InputError` without the
extra "plot". The other modules here write what the commands write.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxevent.show.export import save_video
    from jaxevent.show.figures import (
        as_html,
        plot_events,
        plot_events_3d,
        plot_image,
        plot_losses,
        plot_motion,
        plot_tracks,
    )
    from jaxevent.show.viewer import view

__all__ = [
    "as_html",
    "plot_events",
    "plot_events_3d",
    "plot_image",
    "plot_losses",
    "plot_motion",
    "plot_tracks",
    "save_video",
    "view",
]


def __getattr__(name: str) -> Any:
    """Load the figures when first used: they know all families, which commands need not."""
    if name not in __all__:
        raise AttributeError(f"module 'jaxevent.show' has no attribute {name!r}")
    from jaxevent.show import export, figures, viewer

    home = {"view": viewer, "save_video": export}.get(name, figures)
    return getattr(home, name)


def __dir__() -> list[str]:
    return __all__
