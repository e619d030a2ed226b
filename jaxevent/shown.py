"""What notebooks show, and words for it."""

from collections.abc import Callable
from typing import Any

as_html: Callable[[Any], str] = repr  # `jaxevent` sets that of `jaxevent.show.notebook`


class Shown:
    """Something that notebooks show as a table and a picture."""

    def _repr_html_(self) -> str:
        return as_html(self)


def a_kind(thing: Any) -> str:
    """The kind of a thing with its article: a Filter, an int."""
    return "None" if thing is None else with_article(type(thing).__name__)


def with_article(name: str) -> str:
    """A name with its article: "a dict", "an Estimate"."""
    return f"a{'n' * (name[0] in 'AEIOUaeiou')} {name}"


def plural(what: str, number: int) -> str:
    """The word for so many: one track, two tracks."""
    return what if number == 1 else what + "s"
