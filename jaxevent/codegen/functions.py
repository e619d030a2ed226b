"""Functions of one single-precision number that compilers can compute for several at once.

Those of the system's library are called number by number. Polynomials are Cephes' (S. Moshier);
errors are below 2e-7 of the result.
"""

import inspect
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxevent.codegen import cache
from jaxevent.codegen.support import intrinsic, ir, types

F = np.float32
INFINITE, NAN = F(np.inf), F(np.nan)
SQRT_HALF = F(0.5**0.5)  # mantissas are taken between it and its double


def compile_function(function: Callable) -> Any:
    """Compile for kernels: divisions by zero are infinite, products are fused to sums."""
    plain = inspect.unwrap(function)
    return cache.njit_cached(plain, error_model="numpy", fastmath={"contract"})


def make_intrinsic(function: Callable) -> Any:
    """Make an operation of the compiler's own.

    Return the function as it is where there is no numba.
    """
    plain = inspect.unwrap(function)
    return plain if intrinsic is None else intrinsic(plain)


@make_intrinsic
def _as_real(context: Any, x: Any):
    """Return the float32 with the bits of an int32.

    Args:
        context: Context of numba's types.
        x: The int32.
    """

    def make(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.float32))

    return types.float32(types.int32), make


@make_intrinsic
def _as_bits(context: Any, x: Any):
    """Return the bits of a float32 as an int32.

    Args:
        context: Context of numba's types.
        x: The float32.
    """

    def make(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.int32))

    return types.int32(types.float32), make


@make_intrinsic
def _select(context: Any, truth: Any, one: Any, other: Any):
    """Select one number or another, without a branch.

    A wait at each costs more than both numbers.

    Args:
        context: Context of numba's types.
        truth: Whether the first is selected.
        one: The first number.
        other: The second, of the same type.
    """

    def make(context, builder, signature, arguments):
        truth = builder.trunc(arguments[0], ir.IntType(1))
        chosen = builder.select(truth, *arguments[1:])
        chosen.set_metadata("unpredictable", builder.module.add_metadata([]))
        return chosen

    return one(types.boolean, one, one), make


@compile_function
def exp32(x):
    n = np.floor(x * F(1.44269504) + F(0.5))
    n = _select(n > F(-126), n, F(-126))
    n = _select(n < F(127), n, F(127))
    r = x - n * F(0.693359375) + n * F(2.12194440e-4)
    p = F(1.9875691500e-4)
    p = p * r + F(1.3981999507e-3)
    p = p * r + F(8.3334519073e-3)
    p = p * r + F(4.1665795894e-2)
    p = p * r + F(1.6666665459e-1)
    p = p * r + F(5.0000001201e-1)
    p = p * r * r + r + F(1)
    p = p * _as_real((np.int32(n) + np.int32(127)) << np.int32(23))
    p = _select(x < F(88.37), p, INFINITE)
    p = _select(x > F(-87.33), p, F(0))
    return _select(x == x, p, x)


@compile_function
def log32(x):
    bits = _as_bits(x)
    n = (bits - _as_bits(SQRT_HALF)) >> np.int32(23)
    m, e = _as_real(bits - (n << np.int32(23))), F(n)
    y = m - F(1)
    z = y * y
    p = F(7.0376836292e-2)
    p = p * y - F(1.1514610310e-1)
    p = p * y + F(1.1676998740e-1)
    p = p * y - F(1.2420140846e-1)
    p = p * y + F(1.4249322787e-1)
    p = p * y - F(1.6668057665e-1)
    p = p * y + F(2.0000714765e-1)
    p = p * y - F(2.4999993993e-1)
    p = p * y + F(3.3333331174e-1)
    p = y * z * p - F(2.12194440e-4) * e - F(0.5) * z
    p = y + p + F(0.693359375) * e
    p = _select(x < INFINITE, p, x)
    p = _select(x > F(0), p, -INFINITE)
    return _select(x >= F(0), p, NAN)


@compile_function
def log1p32(x):
    y = F(1) + x
    lost = (x - (y - F(1))) / y
    return log32(y) + _select((y > F(0)) & (y < INFINITE), lost, F(0))


@compile_function
def logistic32(x):
    return F(1) / (F(1) + exp32(-x))


@compile_function
def _reduced(x):
    """Return x less whole quarter turns, and their number."""
    n = np.floor(x * F(0.636619772) + F(0.5))
    r = x - n * F(1.5703125) - n * F(4.837512969e-4) - n * F(7.549790126e-8)
    return r, np.int32(n)


@compile_function
def _sine(r):
    z = r * r
    p = F(-1.9515295891e-4) * z + F(8.3321608736e-3)
    p = p * z - F(1.6666654611e-1)
    return p * z * r + r


@compile_function
def _cosine(r):
    z = r * r
    p = F(2.443315711809948e-5) * z - F(1.388731625493765e-3)
    p = p * z + F(4.166664568298827e-2)
    return p * z * z - F(0.5) * z + F(1)


@compile_function
def sin32(x):
    if not abs(x) < F(8000):  # the reduction loses digits
        return np.sin(x)
    r, n = _reduced(x)
    value = _select((n & 1) != 0, _cosine(r), _sine(r))
    return _select((n & 2) != 0, -value, value)


@compile_function
def cos32(x):
    if not abs(x) < F(8000):
        return np.cos(x)
    r, n = _reduced(x)
    value = _select((n & 1) != 0, _sine(r), _cosine(r))
    return _select(((n + 1) & 2) != 0, -value, value)


@compile_function
def sin64(x):
    return np.sin(x)


@compile_function
def cos64(x):
    return np.cos(x)


@compile_function
def exp64(x):
    return np.exp(x)


@compile_function
def log64(x):
    return np.log(x)


@compile_function
def log1p64(x):
    return np.log1p(x)


@compile_function
def logistic64(x):
    return 1 / (1 + np.exp(-x))


@compile_function
def erf32(x):
    return F(math.erf(x))


@compile_function
def erfc32(x):
    return F(math.erfc(x))


@compile_function
def erf64(x):
    return math.erf(x)


@compile_function
def erfc64(x):
    return math.erfc(x)
