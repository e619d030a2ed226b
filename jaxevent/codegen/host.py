"""The part of a traced function that rests on parameters alone, in NumPy, and run again for others.

A few hundred operations on single numbers: XLA would compile longer than they take.
"""

import dataclasses
import os
import threading
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr
from numpy.typing import NDArray

from jaxevent.codegen.expressions import ELEMENTWISE, Untranslatable
from jaxevent.codegen.support import compiler_lock

T = TypeVar("T")
_making = threading.RLock()  # of what all threads use


def _wait_to_fork() -> None:
    _making.acquire()
    compiler_lock.acquire()


def _go_on() -> None:
    compiler_lock.release()
    _making.release()


# A thread that had them would keep them in the child for ever.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_wait_to_fork, after_in_parent=_go_on, after_in_child=_go_on)

CALLS = ("jaxpr", "call_jaxpr", "fun_jaxpr")


def inner(eqn: Any) -> Any | None:
    """The closed jaxpr that an equation only calls; None where it does more."""
    if eqn.primitive.name in ("scan", "while", "cond"):
        return None
    for name in CALLS:
        if name in eqn.params:
            called = eqn.params[name]
            return called if hasattr(called, "consts") else ClosedJaxpr(called, [])
    return None


def rearranged(eqn: Any, values: list[Any]) -> NDArray | None:
    """What a primitive makes that only moves elements, of any kind; None for other primitives.

    Indices are known numbers.
    """
    name, p = eqn.primitive.name, eqn.params
    x = np.asarray(values[0]) if values else None
    if name == "iota":
        shape = [1] * len(p["shape"])
        shape[p["dimension"]] = -1
        count = np.arange(p["shape"][p["dimension"]], dtype=p["dtype"])
        return np.broadcast_to(count.reshape(shape), p["shape"])
    if x is None:
        return None
    if name == "broadcast_in_dim":
        shape = [1] * len(p["shape"])
        for axis, size in zip(p["broadcast_dimensions"], x.shape, strict=True):
            shape[axis] = size
        return np.broadcast_to(x.reshape(shape), p["shape"])
    if name == "reshape":
        return x.reshape(p["new_sizes"])
    if name in ("squeeze", "expand_dims"):
        return x.reshape(eqn.outvars[0].aval.shape)
    if name == "transpose":
        return x.transpose(p["permutation"])
    if name == "rev":
        return np.flip(x, p["dimensions"])
    if name == "slice":
        steps = p["strides"] or [1] * x.ndim
        bounds = zip(p["start_indices"], p["limit_indices"], steps, strict=True)
        return x[tuple(slice(*bound) for bound in bounds)]
    if name == "concatenate":
        return np.concatenate([np.asarray(v) for v in values], p["dimension"])
    if name == "stack":
        return np.stack([np.asarray(v) for v in values], p["axis"])
    if name == "pad" and all(size >= 0 for sizes in p["padding_config"] for size in sizes):
        out = np.full(eqn.outvars[0].aval.shape, np.asarray(values[1]).item(), x.dtype)
        steps = zip(p["padding_config"], x.shape, strict=True)
        within = (slice(low, low + n + max(n - 1, 0) * gap, gap + 1) for (low, _, gap), n in steps)
        out[tuple(within)] = x
        return out
    if name == "dynamic_slice":
        starts = [
            int(np.clip(int(start), 0, n - size))
            for start, n, size in zip(values[1:], x.shape, p["slice_sizes"], strict=True)
        ]
        return x[tuple(slice(s, s + n) for s, n in zip(starts, p["slice_sizes"], strict=True))]
    if name == "gather":
        return _gather(eqn, x, np.asarray(values[1]))
    return None


def _gather(eqn: Any, x: NDArray, indices: NDArray) -> NDArray:
    numbers, sizes = eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    if numbers.operand_batching_dims or numbers.start_indices_batching_dims:
        raise Untranslatable("a gather with batch dimensions")
    batch = indices.shape[:-1]
    kept = [size for axis, size in enumerate(sizes) if axis not in numbers.collapsed_slice_dims]
    start = [np.zeros(batch, np.int64)] * x.ndim
    for axis, values in zip(numbers.start_index_map, np.moveaxis(indices, -1, 0), strict=True):
        start[axis] = np.clip(values.astype(np.int64), 0, x.shape[axis] - sizes[axis])
    within = np.ogrid[tuple(slice(size) for size in sizes)]
    along = tuple(s.reshape(*batch, *[1] * x.ndim) + w for s, w in zip(start, within, strict=True))
    out = x[along].reshape(*batch, *kept)
    axes = list(range(len(batch), out.ndim))
    order = [0] * out.ndim
    at_offset, rest = iter(axes), iter(range(len(batch)))
    for axis in range(out.ndim):
        order[axis] = next(at_offset) if axis in numbers.offset_dims else next(rest)
    return out.transpose(order)


def evaluate(eqn: Any, values: list[NDArray]) -> list[NDArray]:
    """What an equation makes of numbers."""
    name = eqn.primitive.name
    called = inner(eqn)
    if called is not None:
        return run(called, values)
    if name == "scan":
        return _scan(eqn, values)
    with np.errstate(all="ignore"):
        made = rearranged(eqn, values)
        if made is None and name in ELEMENTWISE:
            made = ELEMENTWISE[name](*values)
        elif made is None and name == "div":
            whole = np.asarray(values[0]).dtype.kind in "iu"
            made = values[0] // values[1] if whole else values[0] / values[1]
        elif made is None and name == "integer_pow":
            made = np.power(np.asarray(values[0]), float(eqn.params["y"]))
        elif made is None and name == "select_n" and len(values) == 3:
            made = np.where(values[0], values[2], values[1])
        elif made is None and name == "convert_element_type":
            made = np.asarray(values[0]).astype(eqn.params["new_dtype"])
    if made is None:
        made = eqn.primitive.bind(*values, **eqn.params)
        many = made if eqn.primitive.multiple_results else [made]
        return [np.asarray(v) for v in many]
    return [np.asarray(made, eqn.outvars[0].aval.dtype)]


def run(closed: Any, values: list[NDArray]) -> list[NDArray]:
    """What a closed jaxpr makes of numbers."""
    known: dict[Any, NDArray] = dict(zip(closed.jaxpr.invars, values, strict=True))
    known |= dict(zip(closed.jaxpr.constvars, map(np.asarray, closed.consts), strict=True))

    def of(atom: Any) -> NDArray:
        return np.asarray(atom.val) if hasattr(atom, "val") else known[atom]

    for eqn in closed.jaxpr.eqns:
        made = evaluate(eqn, [of(a) for a in eqn.invars])
        known |= dict(zip(eqn.outvars, made, strict=True))
    return [of(a) for a in closed.jaxpr.outvars]


def evaluated(function: Callable[..., Any], *arrays: NDArray) -> NDArray:
    """What a function makes of arrays, one array; traced by JAX, and not compiled."""
    closed = jax.make_jaxpr(function)(*arrays)
    given = [np.asarray(a, v.aval.dtype) for a, v in zip(arrays, closed.jaxpr.invars, strict=True)]
    (made,) = run(closed, given)
    return made


def _scan(eqn: Any, values: list[NDArray]) -> list[NDArray]:
    """A scan step by step; by JAX where the steps take slices, or their results are stacked."""
    p = eqn.params
    body = p["jaxpr"].jaxpr
    ends = zip([*eqn.invars, *eqn.outvars], [*body.invars, *body.outvars], strict=True)
    if any(whole.aval.ndim != part.aval.ndim for whole, part in ends):
        made = eqn.primitive.bind(*values, **p)
        return [np.asarray(v) for v in made]
    fixed = len(values) - len(eqn.outvars)
    carry = values[fixed:]
    for _ in range(p["length"]):
        carry = run(p["jaxpr"], [*values[:fixed], *carry])
    return carry


@dataclasses.dataclass
class HostProgram:
    """Numbers known with the parameters: inputs, and the equations that make others of them."""

    values: list[NDArray] = dataclasses.field(default_factory=list)
    inputs: int = 0
    steps: list[tuple[Any, list[Any], list[int]]] = dataclasses.field(default_factory=list)
    decided: list[int] = dataclasses.field(default_factory=list)  # truth values that chose a way
    zeros: dict[int, NDArray] = dataclasses.field(default_factory=dict)  # where values must be 0
    _known: dict[Any, list[int]] = dataclasses.field(default_factory=dict)

    def add_input(self, value: NDArray) -> int:
        assert not self.steps
        self.values.append(np.asarray(value))
        self.inputs += 1
        return len(self.values) - 1

    def add(self, eqn: Any, arguments: list[Any]) -> list[int]:
        """Arguments are numbers of values (int), or arrays. The same again gives the same."""
        what = eqn.primitive.name, str(eqn.params)
        key = (what, *(a if isinstance(a, int) else (a.tobytes(), a.shape) for a in arguments))
        if key in self._known:
            return self._known[key]
        made = evaluate(eqn, [self.values[a] if isinstance(a, int) else a for a in arguments])
        first = len(self.values)
        self.values += made
        numbers = list(range(first, first + len(made)))
        self.steps.append((eqn, arguments, numbers))
        self._known[key] = numbers
        return numbers

    def again(self, inputs: list[NDArray]) -> list[NDArray] | None:
        """All values for other inputs; None where one that chose a way is another."""
        values: list[NDArray] = [*inputs]
        for eqn, arguments, _ in self.steps:
            values += evaluate(eqn, [values[a] if isinstance(a, int) else a for a in arguments])
        same = all(np.array_equal(values[n], self.values[n]) for n in self.decided)
        same = same and all(np.array_equal(values[n] == 0, z) for n, z in self.zeros.items())
        return values if same else None


def once(known: dict[Any, T], key: Any, make: Callable[[], T]) -> T:
    """Return the value of a key; the first thread that asks makes it, while others wait."""
    if key not in known:
        with _making:
            if key not in known:
                known[key] = make()
    return known[key]


class Programs:
    """Programs of the same functions, each for a way that conditions on parameters chose.

    A program has its `HostProgram` as `host`. With it is kept what was made of it.
    """

    def __init__(self) -> None:
        self._made: list[tuple[Any, Any]] = []

    def get(
        self,
        inputs: list[NDArray],
        translate: Callable[[], Any],
        make: Callable[[Any], Any] = lambda program: {},
    ) -> tuple[Any, Any, list[NDArray]]:
        """The program for some inputs, what `make` made of it, and the values of its host program.

        It is translated if there is none yet.
        """
        found = self._find(inputs)
        if found is not None:
            return found
        with _making:
            found = self._find(inputs)
            if found is not None:
                return found
            program = translate()
            made = make(program)
            self._made.append((program, made))
        return program, made, program.host.values

    def _find(self, inputs: list[NDArray]) -> tuple[Any, Any, list[NDArray]] | None:
        for program, made in self._made:
            values = program.host.again(inputs)
            if values is not None:
                return program, made, values
        return None
