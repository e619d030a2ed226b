"""Log-likelihoods between nodes that span the cloud.

While the motion is followed a batch's log-likelihood is a smooth function of the motion, sums of
logarithms of sums of Gaussians. So it is computed at the k Chebyshev nodes of each component's
range, and is for particles the polynomial through these: of degree k - 1 in each component. Some
particles, others in every batch, are scored too. Where one of them is off by more than the bound
all are scored, and after that nodes are more, or left out for some batches.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.kernels import fast_part, part

BLOCK = 32  # motions that are scored together; those that are no nodes are particles, as checks
LEAST_CHECKS = 4
FEWEST, MOST = 3, 7  # nodes of a component
GAIN = 0.6  # nodes and checks are fewer than this share of the particles
REST = 16  # batches for which nodes are left out, where the most that there may be were too few
NEARER = 0.05  # of the bound, by which nodes may become fewer
K, WAIT, BATCH, USED = range(4)


class Nodes(NamedTuple):
    """How the log-likelihood is interpolated, and room for it."""

    bound: float  # largest error of a batch's log-likelihood; 0: none are interpolated
    now: NDArray[np.int64]  # nodes of a component, batches to wait, batches, and those with nodes
    basis: NDArray  # (d, MOST, N), what a component's node counts for each particle
    product: NDArray  # (N,)
    checked: NDArray[np.int64]  # particles


def room_for(bound: float, particles: int, dimension: int, dtype: np.dtype) -> Nodes:
    """Nothing interpolated yet."""
    basis, product = np.zeros((dimension, MOST, particles), dtype), np.zeros(particles, dtype)
    checked = np.zeros(BLOCK + LEAST_CHECKS, np.int64)
    return Nodes(bound, np.array([FEWEST, 0, 0, 0]), basis, product, checked)


@part
def lanes_of(nodes, dimension):
    """Nodes and checks together, where k of each component are used."""
    number = nodes.now[K] ** dimension
    return (number + LEAST_CHECKS + BLOCK - 1) // BLOCK * BLOCK


@part
def usable(nodes, dimension, count):
    """Whether nodes are to be used for a batch, and are fewer than particles."""
    nodes.now[BATCH] += 1
    if nodes.now[WAIT] > 0:
        nodes.now[WAIT] -= 1
        return False
    return nodes.bound > 0 and lanes_of(nodes, dimension) <= GAIN * count


@part
def place(nodes, work, rows, count):
    """Write nodes and particles that check them where motions are scored: how many there are.

    A node's weight is what particles between the nodes weigh.
    """
    at, moved, share = rows.at, rows.moved, rows.share
    real, d, k = work.dtype.type, len(moved), nodes.now[K]
    number, lanes = k**d, lanes_of(nodes, d)
    for c in range(d):
        row = work[moved[c]]
        low, high = row[0], row[0]
        for i in range(count):
            low = min(low, row[i])
            high = max(high, row[i])
        middle, half = (low + high) / real(2), (high - low) / real(2)
        half = half if half > 0 else real(1)
        for i in range(number):
            work[at[c], i] = middle + half * real(_chebyshev(k, i // k ** (d - 1 - c) % k))
        for j in range(k):
            _fill_basis(nodes.basis[c, j], row, middle, half, k, real(_chebyshev(k, j)))
    for i in range(number, lanes):
        particle = ((i - number) * count // (lanes - number) + nodes.now[BATCH]) % count
        nodes.checked[i - number] = particle
        for c in range(d):
            work[at[c], i] = work[moved[c], particle]
    work[share, :lanes] = 0
    for j in range(number):
        _fill_product(nodes, j, d)
        work[share, j] = _sum_products(nodes.product, work[rows.weights], count)
    return lanes


@part
def interpolate(nodes, work, rows, lanes, count):
    """Write particles' log-likelihoods from those of nodes; whether they are within the bound."""
    of_particles, at_nodes, d = rows.of_batch, rows.total, len(rows.at)
    number = nodes.now[K] ** d
    work[of_particles, :count] = 0
    for j in range(number):
        _fill_product(nodes, j, d)
        _add_product(work[of_particles], nodes.product, work[at_nodes, j], count)
    top, before = -np.inf, work[rows.log_weights]
    for i in range(number, lanes):
        top = max(top, before[nodes.checked[i - number]] + work[at_nodes, i])
    error = 0.0
    for i in range(number, lanes):
        c = nodes.checked[i - number]
        weight = np.exp(before[c] + work[at_nodes, i] - top)
        off = abs(np.exp(before[c] + work[of_particles, c] - top) - weight)
        error = max(error, off) if off == off else np.inf
    fits = error <= nodes.bound
    if fits:
        nodes.now[USED] += 1
        if error <= NEARER * nodes.bound and nodes.now[K] > FEWEST:
            nodes.now[K] -= 1
    else:
        nodes.now[K] += 1
        if nodes.now[K] > MOST or lanes_of(nodes, d) > GAIN * count:
            nodes.now[K] -= 1
            nodes.now[WAIT] = REST
    return fits


@part
def _chebyshev(k, j):
    """The nodes of k on [-1, 1]."""
    return np.cos((2 * j + 1) * np.pi / (2 * k))


@fast_part
def _fill_basis(basis, row, middle, half, k, z):
    """Lagrange's polynomial of a node z at particles y: 2 / k sum_m' T_m(z) T_m(y)."""
    real = row.dtype.type
    for i in range(len(basis)):
        y = (row[i] - middle) / half
        before, now, of_before, of_now = real(1), y, real(1), z
        total = real(0.5)
        for _ in range(1, k):
            total += now * of_now
            before, now = now, real(2) * y * now - before
            of_before, of_now = of_now, real(2) * z * of_now - of_before
        basis[i] = total * real(2) / real(k)


@fast_part
def _fill_product(nodes, j, d):
    """What node j counts for each particle."""
    k = nodes.now[K]
    product, one = nodes.product, nodes.basis[d - 1, j % k]
    for i in range(len(product)):
        product[i] = one[i]
    for c in range(d - 1):
        one = nodes.basis[c, j // k ** (d - 1 - c) % k]
        for i in range(len(product)):
            product[i] *= one[i]


@fast_part
def _sum_products(one, other, count):
    total = one.dtype.type(0)
    for i in range(count):
        total += one[i] * other[i]
    return total


@fast_part
def _add_product(to, product, value, count):
    for i in range(count):
        to[i] += product[i] * value
