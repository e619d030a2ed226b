"""Words for messages, and objects that notebooks show as HTML."""

from collections.abc import Callable
from typing import Any

as_html: Callable[[Any], str] = repr  # `jaxevent` sets that of `jaxevent.show.figures`


class HtmlRepr:
    """An object that notebooks show as a table and a picture."""

    def _repr_html_(self) -> str:
        return as_html(self)


def describe_type(thing: Any) -> str:
    """Return the type of an object with its article: a Filter, an int."""
    return "None" if thing is None else with_article(type(thing).__name__)


def with_article(name: str) -> str:
    """Return a name with its article: "a dict", "an Estimate"."""
    return f"a{'n' * (name[0] in 'AEIOUaeiou')} {name}"


def plural(noun: str, number: int) -> str:
    """Return the word for a number of things: one track, two tracks."""
    return noun if number == 1 else noun + "s"
