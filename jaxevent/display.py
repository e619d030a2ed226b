"""Words for messages, and objects that notebooks show as HTML."""

from collections.abc import Callable
from typing import Any

as_html: Callable[[Any], str] = repr  # `jaxevent` sets that of `jaxevent.show.figures`


class HtmlRepr:
    """An object that notebooks show as a table and a picture."""

    def _repr_html_(self) -> str:
        return as_html(self)


def describe_type(thing: Any) -> str:
    """Return the type of an object in words: "a Filter", "an array", "the class Filter", "None"."""
    if isinstance(thing, type):
        return f"the class {thing.__qualname__}"
    name = type(thing).__name__
    return {"NoneType": "None", "ndarray": "an array", "ArrayImpl": "an array"}.get(
        name, with_article(name)
    )


def with_article(name: str) -> str:
    """Return a name with its article: "a dict", "an Estimate"."""
    return f"a{'n' * (name[0] in 'AEIOUaeiou')} {name}"


def plural(noun: str, number: int) -> str:
    """Return the word for a number of things: one track, two tracks."""
    return noun if number == 1 else noun + "s"


def format_count(number: int, noun: str) -> str:
    """Write a number of things: "1 track", "2,000 tracks"."""
    return f"{number:,} {plural(noun, number)}"


def format_seconds(us: Any) -> str:
    """Write a time of microseconds in seconds, to the microsecond: 250000 is "0.25"."""
    return f"{int(us) / 1e6:.6f}".rstrip("0").removesuffix(".")


def format_span(t: Any) -> str:
    """Write the first and last of sorted times (us) in seconds: "0.1 to 0.2 s"."""
    return f"{format_seconds(t[0])} to {format_seconds(t[-1])} s"
