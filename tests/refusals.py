"""Refusals of bad input."""

from collections.abc import Callable
from typing import Any

import pytest

from jaxevent.errors import InputError


def refuses(message: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> None:
    """Check that a call raises an `InputError` of one line whose text matches `message`."""
    with pytest.raises(InputError, match=message) as error:
        function(*arguments, **options)
    assert "\n" not in str(error.value)
