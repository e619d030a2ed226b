"""Path and smooth depths together, solved exactly: what eases the equations' solution, compiled.

A turn and depths that are all nearer or farther move the image about alike. So little tells them
apart that conjugate gradients come to it last, unless the preconditioner knows both: smooth depths
are those between coarse nodes, each `SPAN` nodes apart, by bilinear interpolation. With P for that,
the matrix P' H P of path and coarse depths is made and taken apart (Cholesky).
"""

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined

SPAN = 4  # nodes, 16 px


def coarse_shape(rows: int, columns: int) -> tuple[int, int]:
    """Rows and columns of coarse nodes."""
    return (rows - 1) // SPAN + 2, (columns - 1) // SPAN + 2


@njit_fastmath_inlined
def share_of(u, v, corner):
    """Of one of four corners in a place u, v cells from the first."""
    return (u if corner % 2 else 1 - u) * (v if corner > 1 else 1 - v)


@njit_fastmath_inlined
def _corner(j, i, corner, columns):
    """The coarse node at one of four corners about a node, and its share."""
    row, column = j // SPAN, i // SPAN
    share = share_of((i - column * SPAN) / SPAN, (j - row * SPAN) / SPAN, corner)
    return (row + corner // 2) * columns + column + corner % 2, share


@njit_fastmath
def add_priors(hold, across, down, begin, out):
    """Add to P' H P what holds depths and binds them to those before, from a row on."""
    rows, columns = hold.shape
    wide = (columns - 1) // SPAN + 2
    for j in range(rows):
        for i in range(columns):
            for p in range(4):
                k, a = _corner(j, i, p, wide)
                for q in range(4):
                    m, b = _corner(j, i, q, wide)
                    out[begin + k, begin + m] += hold[j, i] * a * b
            for axis in range(2):
                bond = (down[j, i] if j else 0.0) if axis else (across[j, i] if i else 0.0)
                if bond == 0:
                    continue
                before = (j - 1, i) if axis else (j, i - 1)
                for p in range(8):
                    k, a = _corner(j, i, p, wide) if p < 4 else _corner(*before, p - 4, wide)
                    a = a if p < 4 else -a
                    for q in range(8):
                        m, b = _corner(j, i, q, wide) if q < 4 else _corner(*before, q - 4, wide)
                        out[begin + k, begin + m] += bond * a * (b if q < 4 else -b)


@njit_fastmath
def factorise(matrix):
    """A matrix's factor of Cholesky, in place below the diagonal; on it one over it."""
    for i in range(len(matrix)):
        row = matrix[i]
        for k in range(i + 1):
            other, s = matrix[k], row[k]
            for m in range(k):
                s -= row[m] * other[m]
            if k < i:
                row[k] = s * other[k]
            else:
                row[k] = 1 / np.sqrt(max(s, 1e-12 * row[k], 1e-30))


@njit_fastmath
def substitute(lower, side):
    """Solve for a side, in place, by the factor of a matrix."""
    for i in range(len(side)):
        row, s = lower[i], side[i]
        for k in range(i):
            s -= row[k] * side[k]
        side[i] = s * row[i]
    for i in range(len(side) - 1, -1, -1):
        row, s = lower[i], side[i] * lower[i, i]
        side[i] = s
        for k in range(i):
            side[k] -= row[k] * s


@njit_fastmath
def ease_rest(lower, ease_nodes, t, depth, side, out_t, out_depth):
    """Write about H^-1 of path and depths; `side` is room for path and coarse depths."""
    n, (rows, columns) = len(t), depth.shape
    wide = (columns - 1) // SPAN + 2
    for i in range(n):
        side[i] = t[i]
    for i in range(n, len(side)):
        side[i] = 0
    for j in range(rows):
        for i in range(columns):
            out_depth[j, i] = depth[j, i] * ease_nodes[j, i]
            for p in range(4):
                k, share = _corner(j, i, p, wide)
                side[n + k] += share * depth[j, i]
    substitute(lower, side)
    for i in range(n):
        out_t[i] = side[i]
    for j in range(rows):
        for i in range(columns):
            for p in range(4):
                k, share = _corner(j, i, p, wide)
                out_depth[j, i] += share * side[n + k]


def factored(
    upper: NDArray[np.float64],
    mixed: NDArray[np.float64],
    smooth: NDArray[np.float64],
    hold: NDArray[np.float64],
    across: NDArray[np.float64],
    down: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The factor of P' H P: of the path's block, coarse depths with path, and coarse depths.

    Nodes are held and bound to those before by so much.
    """
    lower = np.block([[upper, mixed.T], [mixed, smooth]])
    add_priors(hold, across, down, len(upper), lower)
    # What single precision leaves of the smallest eigenvalues.
    diagonal = np.arange(len(lower))
    lower[diagonal, diagonal] *= 1 + 1e-5
    lower[diagonal, diagonal] += 1e-3
    factorise(lower)
    return lower
