"""Refusals of bad input."""

from collections.abc import Callable
from typing import Any

import pytest

from jaxevent.errors import InputError


def refuses(message: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> str:
    """Check that a call raises an `InputError` of one line that matches; return its text."""
    with pytest.raises(InputError, match=message) as error:
        function(*arguments, **options)
    text = str(error.value)
    del error  # its traceback would keep files open
    assert "\n" not in text
    return text
