"""Figures of matplotlib that need neither a display nor pyplot; notebooks show them."""

import functools
import io
from typing import Any

from jaxevent.errors import require


def new_figure(width: float | int = 7, height: float | int = 4) -> Any:
    """An empty figure of a size in inches; raises `MissingExtra` without the extra "plot"."""
    require("matplotlib", "plot")
    return _kind()(figsize=(width, height), layout="constrained", dpi=120)


@functools.cache
def _kind() -> type:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class Drawn(Figure):
        """A figure that notebooks show where it is the value of a cell."""

        def __init__(self, **options: Any):
            super().__init__(**options)
            FigureCanvasAgg(self)

        def _repr_png_(self) -> bytes:
            held = io.BytesIO()
            self.savefig(held, format="png")
            return held.getvalue()

    return Drawn
