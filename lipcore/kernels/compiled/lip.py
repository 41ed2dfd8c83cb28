"""Compiled twin of `LipKernel`: the Gram matrix pair by pair, and its derivative by hand-written reverse mode.

One row sample meets a block of column samples at a time. The pairs of a block lie innermost in memory, so that the
compiler turns every formula into vector instructions, and all that a block needs stays in the core's cache.

Samples enter through six numbers a joint: f, g, f', g', v, a with the base kernel p = c + α f f̃ + β g g̃ (a tilde marks
the column sample), where f = cos q, g = sin q of a revolute joint and f = q, g = 0 of a prismatic one. Everything after
p is the same for both, and free of division as in `polynomial`.
"""

from __future__ import annotations

import numpy as np

from lipcore.kernels.compiled.compile import compiled
from lipcore.kernels.compiled.lip_data import PAIRS, Array, Flags, adjoints, features, scratch
from lipcore.kernels.compiled.lip_energies import add_kinetic, kinetic, kinetic_reverse, potential, potential_reverse
from lipcore.kernels.compiled.lip_products import base_reverse, product_reverse, square_reverse


@compiled
def lip_gram(
    q: Array,
    v: Array,
    a: Array,
    q2: Array,
    v2: Array,
    a2: Array,
    prismatic: Flags,
    kinetic_shares: Array,
    weights: Array,
    potential_shares: Array,
    potential_scale: float,
    symmetric: bool,
) -> Array:
    """Torque covariance of every row sample with every column sample, (N, n, M, n), (N·m)².

    q, v, a: (N, n) positions, velocities, accelerations of the rows; q2, v2, a2: (M, n) of the columns; prismatic: (n,)
    joint types; kinetic_shares: (n, n, 3), the (σ, α, β) of joint b for link l at [l, b], b ≤ l; weights: (n, n) lower
    triangular, velocity weights w of link l in row l; potential_shares: (n, 3); potential_scale: positive.

    The sum of the torque kernels of every link's Π p_b² h² and of scale Π p_b. With `symmetric` both arguments are
    the same samples: only half of the pairs is evaluated, and the result is symmetric to the last bit.
    """
    rows, n = q.shape
    columns = q2.shape[0]
    x, y = features(q, v, a, prismatic), features(q2, v2, a2, prismatic)
    out, s, changes = np.empty((rows, n, columns, n)), scratch(n), changed_links(kinetic_shares)
    for row in range(rows):
        for start in range(row if symmetric else 0, columns, PAIRS):
            width = min(PAIRS, columns - start)
            _load_columns(y, start, width, s.block)
            potential(potential_shares, prismatic, x[row], n, width, s)
            for i in range(n):
                for j in range(n):
                    for k in range(width):
                        s.total[i, j, k] = potential_scale * s.mixed[i, j, k]
            for link in range(n - 1, -1, -1):
                kinetic(kinetic_shares[link], prismatic, weights[link], x[row], link + 1, width, changes[link], s)
                add_kinetic(weights[link], x[row], link + 1, width, s)
            for i in range(n):
                for k in range(width):
                    for j in range(n):
                        out[row, i, start + k, j] = s.total[i, j, k]
    if symmetric:
        _mirror(out.reshape(rows * n, rows * n))
    return out


@compiled
def lip_gradient(
    q: Array,
    v: Array,
    a: Array,
    q2: Array,
    v2: Array,
    a2: Array,
    prismatic: Flags,
    kinetic_shares: Array,
    weights: Array,
    potential_shares: Array,
    potential_scale: float,
    symmetric: bool,
    weight: Array,
) -> tuple[Array, Array, Array, float]:
    """Derivative of Σ weight · lip_gram(...) by kinetic_shares, weights, potential_shares and potential_scale.

    Arguments as of `lip_gram`; weight: (N, n, M, n), a symmetric matrix if `symmetric`. Returns (n, n, 3), (n, n),
    (n, 3) and a number. The shares of a joint count as independent; joints past a link get zero.
    """
    rows, n = q.shape
    columns = q2.shape[0]
    x, y = features(q, v, a, prismatic), features(q2, v2, a2, prismatic)
    s, d, changes = scratch(n), adjoints(n), changed_links(kinetic_shares)
    # one sum for each pair of a block, added up at the very end
    d_kinetic, d_potential = np.zeros((n, n, 3, PAIRS)), np.zeros((n, 3, PAIRS))
    d_weights, d_scale = np.zeros((n, n, PAIRS)), np.zeros(PAIRS)
    for row in range(rows):
        for start in range(row if symmetric else 0, columns, PAIRS):
            width = min(PAIRS, columns - start)
            _load_columns(y, start, width, s.block)
            for i in range(n):
                for k in range(width):
                    factor = 2.0 if symmetric and start + k > row else 1.0
                    for j in range(n):
                        s.total[i, j, k] = factor * weight[row, i, start + k, j]
            potential(potential_shares, prismatic, x[row], n, width, s)
            potential_reverse(prismatic, x[row], potential_scale, width, s, d, d_potential, d_scale)
            for link in range(n - 1, -1, -1):
                kinetic(kinetic_shares[link], prismatic, weights[link], x[row], link + 1, width, changes[link], s)
                kinetic_reverse(weights[link], x[row], link + 1, width, s, d, d_weights[link])
                product_reverse(s.power, link + 1, width, s, d)
                square_reverse(link + 1, width, s.base, d.base)
                base_reverse(prismatic, x[row], link + 1, width, s.block, d.base, d_kinetic[link])
    return (
        _sum_pairs(d_kinetic).reshape(n, n, 3),
        _sum_pairs(d_weights).reshape(n, n),
        _sum_pairs(d_potential).reshape(n, 3),
        d_scale.sum(),
    )


@compiled
def changed_links(shares: Array) -> Flags:
    """Whether a link's shares differ from the next link's: where not, its products are those already computed."""
    n = shares.shape[0]
    changes = np.ones(n, dtype=np.bool_)
    for link in range(n - 1):
        changes[link] = np.any(shares[link, : link + 1] != shares[link + 1, : link + 1])
    return changes


@compiled
def _load_columns(y: Array, start: int, width: int, block: Array) -> None:
    for c in range(6):
        for b in range(block.shape[1]):
            for k in range(width):
                block[c, b, k] = y[start + k, c, b]


@compiled
def _mirror(matrix: Array) -> None:
    """Copy the upper triangle onto the lower one, tile by tile to spare the cache."""
    size, tile = matrix.shape[0], 32
    for i0 in range(0, size, tile):
        for j0 in range(i0, size, tile):
            for i in range(i0, min(i0 + tile, size)):
                for j in range(max(j0, i + 1), min(j0 + tile, size)):
                    matrix[j, i] = matrix[i, j]


@compiled
def _sum_pairs(values: Array) -> Array:
    """Sum over the last axis, all others flattened: a loop compiles in a tenth of the time that `sum(axis)` takes."""
    rows = values.reshape(-1, PAIRS)
    total = np.zeros(rows.shape[0])
    for i in range(rows.shape[0]):
        for k in range(PAIRS):
            total[i] += rows[i, k]
    return total
