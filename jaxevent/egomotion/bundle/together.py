"""Several right-hand sides of the photometric fit's equations at once.

Conjugate gradients that search in the span of all sides' directions (O'Leary, "The block conjugate
gradient algorithm and related methods", 1980). What is hardly told is a direction that one side
alone comes to last. Sigma of w_y on slider_depth is within 5 % after 40 steps at 0.1 C, after 120
where path and smooth depths are not solved beforehand (`coarse`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath
from jaxevent.egomotion.bundle.coarse import ease_rest
from jaxevent.egomotion.bundle.solving import System, multiply

# Steps at most, and by what part the sides' own unknowns may still grow in so many steps.
MOST, EVERY, GROWS = 240, 10, 0.1
# Eigenvalues by the largest, of directions that repeat others, and of ones that are all solved:
# these are left out.
REPEATED, NOTHING = 1e-11, 1e-30
PART = 1024  # numbers that are in a core's own memory together, of all columns


class Columns(NamedTuple):
    """Of path and the like (S, n), and of map and depths together, one after another (S, ...)."""

    t: NDArray[np.float64]
    rest: NDArray


@njit_fastmath
def inner(a, b, out):
    """Add a b' of rows (S, N), a part at a time: single precision would not hold all."""
    for begin in range(0, a.shape[1], PART):
        for k in range(len(a)):
            one = a[k, begin : begin + PART]
            for c in range(len(b)):
                other, s = b[c, begin : begin + PART], a.dtype.type(0)
                for i in range(len(one)):
                    s += one[i] * other[i]
                out[k, c] += s


@njit_fastmath
def add(by, a, out):
    """Add by' a, of rows a (S, N) and (S, S)."""
    for begin in range(0, a.shape[1], PART):
        for c in range(len(out)):
            to = out[c, begin : begin + PART]
            for k in range(len(a)):
                one, share = a[k, begin : begin + PART], by[k, c]
                for i in range(len(one)):
                    to[i] += share * one[i]


def product(a: Columns, b: Columns) -> NDArray[np.float64]:
    """a' b, (S, S)."""
    found = a.t @ b.t.T
    inner(a.rest, b.rest, found)
    return found


def advance(to: Columns, by: NDArray, way: Columns) -> None:
    """Add `way` times `by` (S, S)."""
    to.t[:] += by.T @ way.t
    add(by.astype(to.rest.dtype), way.rest, to.rest)


def solve(system: System, sides: NDArray[np.float64]) -> Columns:
    """H^-1 of sides (S, n) of the path and the like, undamped.

    Where single precision does not hold the directions it is what was found before, or NaN. That is
    told by the sides' own unknowns, b' x, which are above 0 and grow from step to step.
    """
    shape, nodes, real = system.ease_map.shape, system.across.shape, system.ease_map.dtype
    size, number = system.ease_map.size, len(sides)
    value = np.empty(len(system.weight), real)

    def blank() -> Columns:
        return Columns(np.zeros(sides.shape), np.zeros((number, size + system.across.size), real))

    def halves(row: NDArray) -> tuple[NDArray, NDArray]:
        return row[:size].reshape(shape), row[size:].reshape(nodes)

    def times(given: Columns, out: Columns) -> None:
        for k in range(number):
            (image, depth), (to_image, to_depth) = halves(given.rest[k]), halves(out.rest[k])
            multiply(system, image, given.t[k], depth, value, to_image, out.t[k], to_depth)

    def ease(given: Columns, out: Columns) -> None:
        for k in range(number):
            (image, depth), (to_image, to_depth) = halves(given.rest[k]), halves(out.rest[k])
            np.multiply(image, system.ease_map, out=to_image)
            ease_rest(
                system.lower, system.ease_nodes, given.t[k], depth, system.side, out.t[k], to_depth
            )

    found, left, better, image = (blank() for _ in range(4))
    left.t[:] = sides
    ease(left, better)
    way, known = Columns(better.t.copy(), better.rest.copy()), np.zeros(number)
    before = Columns(np.full_like(found.t, np.nan), np.full_like(found.rest, np.nan))
    for step in range(1, MOST + 1):
        times(way, image)
        energy = product(way, image)
        if not np.isfinite(energy).all():
            return before
        # Of directions that are about one alone the part that is new.
        sizes, axes = np.linalg.eigh((energy + energy.T) / 2)
        kept = sizes > max(REPEATED * sizes[-1], NOTHING)
        if not kept.any():
            return found
        inverse = axes[:, kept] / sizes[kept] @ axes[:, kept].T
        length = inverse @ product(way, left)
        advance(found, length, way)
        advance(left, -length, image)
        ease(left, better)
        share = -inverse @ product(image, better)
        advance(better, share, way)
        # Each of about size 1, that they neither vanish nor overflow. Of what is about solved
        # hardly any path is left beside map and depths.
        sizes = np.maximum(np.abs(better.t).max(1), [np.abs(row).max() for row in better.rest])
        scale = 1 / np.maximum(sizes, 1e-30)
        np.multiply(better.t, scale[:, None], out=way.t)
        np.multiply(better.rest, scale[:, None].astype(real), out=way.rest)
        if step % EVERY == 0:
            now = (sides * found.t).sum(1)
            if not (now >= (1 - GROWS) * known).all():
                return before
            if (np.abs(now - known) <= GROWS * np.abs(now)).all():
                break
            known, before = now, Columns(found.t.copy(), found.rest.copy())
    return found
