"""Shapes and types are checked as jaxtyping does: what `checked` lets through is seen nowhere."""

import dataclasses
from typing import Any

import checked
import numpy as np
import pytest
from jaxtyping import Float

from jaxevent import camera


def decorated(one):
    return checked.jaxtyped(typechecker=checked.check)(one)


@decorated
def add(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    return np.concatenate([a, b])[: len(a) + int(b[0])]


@decorated
def count(a: Any) -> int:
    return a


@decorated
def double(a: int) -> int:
    return 2 * a


@decorated
@dataclasses.dataclass
class Pair:
    a: Float[np.ndarray, " n"]
    b: Float[np.ndarray, " n"]


def test_axes_and_types_are_checked():
    zeros, ones = np.zeros(2), np.ones(2)
    assert len(add(ones, zeros)) == 2
    assert count(1) == 1
    assert double(1) == 2
    Pair(zeros, ones)
    for wrong in (
        lambda: add(np.zeros(3), zeros),
        lambda: add(ones, ones),  # what comes back is longer
        lambda: double("one"),
        lambda: count(0.5),  # what comes back is no integer
        lambda: Pair(np.zeros(3), zeros),
        lambda: camera.UnknownResponse().grey("bright"),  # the library's own
    ):
        with pytest.raises(Exception, match=r"(?i)type hint|type-check"):
            wrong()
