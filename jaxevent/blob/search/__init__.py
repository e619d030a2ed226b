"""Targets of a recording found without settings: see `find`."""

from jaxevent.blob.search.found import Found
from jaxevent.blob.search.search import find

__all__ = ["Found", "find"]
