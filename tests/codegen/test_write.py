import math
from typing import Any

import numba
import numpy as np
from numba.core import types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from jaxevent.codegen.write import arithmetic_block

LINES = """
v1:f = read numbers k 1
v2:f = number 0
v3:f = entry 1 2 k
v4:f = add x v1
v5:f = sub x v2
v6:f = mul x v3
v7:f = div x y
v8:f = neg x
v9:f = max x y
v10:f = min x y
v11:f = abs x
v12:f = sqrt v11
v13:f = rsqrt v11
v14:f = floor x
v15:f = ceil x
v16:b = lt x y
v17:b = is_finite v7
v18:b = and v16 v17
v19:b = not v18
v20:f = select_n v19 x f:0.25
v21:i = to_i x
v22:i = mul v21 k
v23:i = max v22 i:-3
v24:f = to_f v23
v25:b = ne y y
v26:f = to_f v25
"""
RESULTS = "v3 v4 v5 v6 v7 v8 v9 v10 v12 v13 v14 v15 v20 v22 v23 v24 v19 v26"


def by_hand(numbers: np.ndarray, k: int, x: float, y: float) -> list[Any]:
    """What LINES say, in Python."""
    entry = numbers[1 + min(max(k, 0), 2)]
    quotient = x / y
    within = x < y and math.isfinite(quotient)
    whole = int(x) * k
    return [
        *(entry, x + numbers[k + 1], x - numbers[0], x * entry, quotient, -x),
        *(max(x, y), min(x, y), math.sqrt(abs(x)), 1 / math.sqrt(abs(x))),
        *(math.floor(x), math.ceil(x), x if within else 0.25),
        *(whole, max(whole, -3), float(max(whole, -3)), not within, 0.0),
    ]


def pointer(context, array):
    """The address of an array's numbers, as the compiled loops get it."""

    def take(context, builder, signature, values):
        return make_array(signature.args[0])(context, builder, values[0]).data

    return types.CPointer(array.dtype)(array), take


address: Any = intrinsic(pointer)


def test_a_block_computes_what_its_lines_say():
    operation = arithmetic_block(types.float64, "numbers:p k:i x:f y:f", LINES, RESULTS)

    @numba.njit
    def compute(numbers, k, x, y):
        return operation((address(numbers), k, x, y))

    numbers = np.array([0.5, -1.25, 2.0, 7.5, 3.0, 11.0])
    for k, x, y in [(0, 1.5, 2.0), (3, -2.75, 0.125), (1, 4.0, -0.5), (2, -0.1, 1e300)]:
        assert list(compute(numbers, k, x, y)) == by_hand(numbers, k, x, y)


def test_what_is_not_a_number_compares_as_in_ieee():
    lines = "\n".join(f"v{k}:b = {how} x x" for k, how in enumerate(("lt", "ge", "eq", "ne")))
    operation = arithmetic_block(types.float64, "x:f", lines, "v0 v1 v2 v3")
    assert numba.njit(lambda x: operation((x,)))(math.nan) == (False, False, False, True)


def test_reads_are_converted_to_the_kind_of_the_block():
    lines = "v1:f = read cells k 0\nv2:i = read counts k 1\nv3:b = read counts k 0"
    operation = arithmetic_block(types.float64, "cells:p counts:p k:i", lines, "v1 v2 v3")

    @numba.njit
    def compute(cells, counts, k):
        return operation((address(cells), address(counts), k))

    cells, counts = np.array([1.5, 0.25], np.float32), np.array([0, 4, -7], np.int32)
    assert compute(cells, counts, 0) == (1.5, 4, False)
    assert compute(cells, counts, 1) == (0.25, -7, True)
