"""Refusals of bad input."""

from collections.abc import Callable
from typing import Any

import pytest

from jaxevent.errors import InputError


def refuses(message: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> str:
    """Check that a call raises an `InputError` of one line that matches; return its text."""
    with pytest.raises(InputError, match=message) as error:
        function(*arguments, **options)
    assert "\n" not in str(error.value)
    return str(error.value)
