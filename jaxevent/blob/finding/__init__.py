"""Targets of a recording found without settings: see `find`."""

from jaxevent.blob.finding.found import Found
from jaxevent.blob.finding.search import find

__all__ = ["Found", "find"]
