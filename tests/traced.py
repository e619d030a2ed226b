"""What JAX traces of functions."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr

FULL = (jax.lax.Precision.HIGHEST,) * 2


def products(function: Callable[..., Any], *arguments: Any) -> list[Any]:
    """The precision of each product of matrices that a function asks for, of both factors."""
    eqns = equations(jax.make_jaxpr(function)(*arguments).jaxpr)
    return [eqn.params["precision"] for eqn in eqns if eqn.primitive.name == "dot_general"]


def equations(jaxpr: Any) -> Iterator[Any]:
    """All equations of a jaxpr, and of those that they call."""
    for eqn in jaxpr.eqns:
        yield eqn
        for value in jax.tree.leaves(list(eqn.params.values()), is_leaf=_called):
            if _called(value):
                yield from equations(getattr(value, "jaxpr", value))


def _called(value: Any) -> bool:
    return isinstance(value, Jaxpr | ClosedJaxpr)
