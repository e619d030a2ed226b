"""The equations of nodes' Gauss-Newton steps, solved by conjugate gradients, compiled."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined


@njit_noalloc_inlined
def _add_product(a, b, out):
    for x in range(len(out)):
        out[x] += a[x] * b[x]


@njit_noalloc_inlined
def _add_difference(weight, a, b, out):
    for x in range(len(out)):
        out[x] += weight[x] * (a[x] - b[x])


@njit_noalloc_inlined
def _scale_and_add(factor, a, out):
    """out = factor out + a."""
    for x in range(len(out)):
        out[x] = factor * out[x] + a[x]


@njit_noalloc_inlined
def _add_scaled(factor, a, out):
    for x in range(len(out)):
        out[x] += factor * a[x]


@njit_noalloc_inlined
def _times(N, i, q, out):
    """Symmetric 4 x 4 matrices of a row of nodes, times vectors (4, columns)."""
    for c in range(len(out)):  # numbers that are not known are not unrolled: less to compile
        for x in range(out.shape[1]):
            out[c, x] = np.float32(0)
        for e in range(len(out)):
            low, high = min(c, e), max(c, e)
            _add_product(N[low * (7 - low) // 2 + high, i], q[e], out[c])


@njit_noalloc_inlined
def _rough(q, across, down, i, out):
    """The weighted graph Laplacian (columns,) of a channel in a row; all are padded by a node."""
    width = len(out)
    here, left, right = q[i + 1, 1:-1], q[i + 1, :width], q[i + 1, 2:]
    out[:] = np.float32(0)
    _add_difference(across[i, :width], here, left, out)
    _add_difference(across[i, 1:], here, right, out)
    _add_difference(down[i], here, q[i, 1:-1], out)
    _add_difference(down[i + 1], here, q[i + 2, 1:-1], out)


@njit_noalloc_inlined
def _invert(N, added, room, out):
    """The inverse (10 entries) of a symmetric 4 x 4 matrix with `added` on its diagonal."""
    # Cholesky, in double precision: nodes without texture are nearly singular.
    A, C, inverse = room[0], room[1], room[2]
    at = 0
    for i in range(4):
        for j in range(i, 4):
            A[i, j] = N[at]
            A[j, i] = N[at]
            at += 1
        A[i, i] += added[i]
    for i in range(4):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= C[i, k] * C[j, k]
            C[i, j] = np.sqrt(max(total, 1e-12)) if i == j else total / C[j, j]
    for j in range(4):  # the inverse of C
        for i in range(j, 4):
            total = 1.0 if i == j else 0.0
            for k in range(j, i):
                total -= C[i, k] * inverse[k, j]
            inverse[i, j] = total / C[i, i]
    at = 0
    for i in range(4):
        for j in range(i, 4):
            total = 0.0
            for k in range(j, 4):
                total += inverse[k, i] * inverse[k, j]
            out[at] = total
            at += 1


class _Room(NamedTuple):
    """What conjugate gradients need for rows x columns of nodes."""

    blocks: NDArray[np.float32]  # [2, 10, rows, columns], of the equations and their inverses
    beside: NDArray[np.float32]  # [rows, columns + 1], weights of differences, 0 at the ends
    below: NDArray[np.float32]  # [rows + 1, columns], the same
    q: NDArray[np.float32]  # [4, rows + 2, columns + 2], the direction, 0 around the nodes
    vectors: NDArray[np.float32]  # [4, rows, 4, columns]
    lines: NDArray[np.float32]  # [2, columns]
    node: NDArray[np.float32]  # [14]
    inverse: NDArray[np.float64]  # [3, 4, 4]

    @classmethod
    def of(cls, rows: int, columns: int) -> "_Room":
        """All zeros."""
        shapes = (
            (2, 10, rows, columns), (rows, columns + 1), (rows + 1, columns),
            (4, rows + 2, columns + 2), (4, rows, 4, columns), (2, columns), (14,),
        )  # fmt: skip
        single = [np.zeros(shape, np.float32) for shape in shapes]
        return cls._make([*single, np.zeros((3, 4, 4))])


def solve(
    N: NDArray[np.float32],
    b: NDArray[np.float32],
    p: NDArray[np.float32],
    across: NDArray[np.float32],
    down: NDArray[np.float32],
    smooth: NDArray[np.float32],
    ridge: NDArray[np.float32],
    iterations: int,
) -> NDArray[np.float32]:
    """(N + smooth Laplacian + ridge) d = b - smooth Laplacian p - ridge p, by conjugate gradients.

    The preconditioner are the nodes' own 4 x 4 blocks.
    """
    d = np.empty_like(p)
    _solve(N, b, p, across, down, smooth, ridge, iterations, _Room.of(*p.shape[:2]), d)
    return d


@njit_noalloc
def _solve(N, b, p, across, down, smooth, ridge, iterations, room, d):
    # Channels come first here, and rows of nodes are what loops go over at once.
    rows, columns, channels = p.shape
    A, P, beside, below, q = room.blocks[0], room.blocks[1], room.beside, room.below, room.q
    r, found, Aq, z = room.vectors[0], room.vectors[1], room.vectors[2], room.vectors[3]
    rough, sums, added, block = room.lines[0], room.lines[1], room.node[:4], room.node[4:]
    for i in range(rows):
        for j in range(columns):
            beside[i, j + 1] = across[i, j] if j < columns - 1 else np.float32(0)
            below[i + 1, j] = down[i, j] if i < rows - 1 else np.float32(0)
            for c in range(channels):
                q[c, i + 1, j + 1] = p[i, j, c]
    for i in range(rows):
        for c in range(channels):
            _rough(q[c], beside, below, i, rough)
            for j in range(columns):
                pull = smooth[c] * rough[j] + ridge[c] * p[i, j, c]
                r[i, c, j] = b[i, j, c] - pull
        for j in range(columns):
            degree = beside[i, j] + beside[i, j + 1] + below[i, j] + below[i + 1, j]
            for c in range(channels):
                added[c] = smooth[c] * degree + ridge[c] + np.float32(1e-6)
            _invert(N[i, j], added, room.inverse, block)
            for c in range(10):
                P[c, i, j] = block[c]
                A[c, i, j] = N[i, j, c]
    rz = 0.0
    for turn in range(iterations + 1):
        sums[:] = np.float32(0)
        for i in range(rows):
            _times(P, i, r[i], z[i])
            for c in range(channels):
                _add_product(r[i, c], z[i, c], sums)
        following = 0.0
        for j in range(columns):
            following += sums[j]
        share = np.float32(following / (rz + 1e-20)) if turn else np.float32(0)
        rz = following
        if turn == iterations:
            break
        for i in range(rows):
            for c in range(channels):
                if turn == 0:
                    for j in range(columns):  # a slice would take longer to compile
                        q[c, i + 1, j + 1] = z[i, c, j]
                else:
                    _scale_and_add(share, z[i, c], q[c, i + 1, 1:-1])
        sums[:] = np.float32(0)
        for i in range(rows):
            _times(A, i, q[:, i + 1, 1:-1], Aq[i])
            for c in range(channels):
                _rough(q[c], beside, below, i, rough)
                _add_scaled(smooth[c], rough, Aq[i, c])
                _add_scaled(ridge[c], q[c, i + 1, 1:-1], Aq[i, c])
                _add_product(q[c, i + 1, 1:-1], Aq[i, c], sums)
        curvature = 0.0
        for j in range(columns):
            curvature += sums[j]
        step = np.float32(rz / (curvature + 1e-20))
        for i in range(rows):
            for c in range(channels):
                _add_scaled(step, q[c, i + 1, 1:-1], found[i, c])
                _add_scaled(-step, Aq[i, c], r[i, c])
    for i in range(rows):
        for c in range(channels):
            for j in range(columns):
                d[i, j, c] = found[i, c, j]
