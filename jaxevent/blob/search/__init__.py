"""Search for the targets of a recording without settings: see `find`."""

from jaxevent.blob.search.search import TargetSearchResult, find

__all__ = ["TargetSearchResult", "find"]
