"""Compiled twin of `lip.LipKernel`: the Gram matrix pair by pair, and its derivative by hand-written reverse mode.

One row sample meets a block of column samples at a time. The pairs of a block lie innermost in memory, so that the
compiler turns every formula into vector instructions, and all that a block needs stays in the core's cache.

Samples enter through six numbers a joint: f, g, f', g', v, a with the base kernel p = c + α f f̃ + β g g̃ (a tilde marks
the column sample), where f = cos q, g = sin q of a revolute joint and f = q, g = 0 of a prismatic one. Everything after
p is the same for both, and free of division as in `polynomial`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.compile import compiled

Array = NDArray[np.float64]

PAIRS = 64
"""Pairs of samples evaluated together: long enough to fill vectors, short enough for a core's own cache."""

F, G, DF, DG, V, A = range(6)  # what a sample knows of each joint: p's two factors, their derivatives, dq and ddq
VALUE, LEFT, RIGHT, MIXED = range(4)  # p, ∂p/∂q, ∂p/∂q', ∂²p/∂q∂q' of one joint, as in `polynomial.BaseKernels`
# Numbers of one link and pair, in the names of `energy.kinetic_blocks`: h, ḣ, h', ḣ', A, B, C, K and h²
H, HX, HY, HXY, KX, KY, KXY, K, HH = range(9)


class _Scratch(NamedTuple):
    """Memory of one block of pairs, allocated once; the last axis counts the pairs."""

    block: Array  # (6, n, ·) what the column samples know
    base: Array  # (n, 4, ·) p_b and derivatives
    power: Array  # (n, 4, ·) p_b² and derivatives
    before: Array  # (n + 1, ·) product of the joints before b
    after: Array  # (n + 1, ·) product of the joints from b on
    left: Array  # (n + 1, n, ·) derivatives by q_i of `before`, [b, i]
    right: Array  # (n + 1, n, ·) derivatives by q'_j of `before`, [b, j]
    mixed: Array  # (n, n, ·) mixed derivatives of the product of all joints: the H of `energy.kinetic_blocks`
    terms: Array  # (9, ·)
    x_mixed: Array  # (n, ·) Hᵀv
    mixed_y: Array  # (n, ·) H v'
    alpha: Array  # (n, ·) factor of w_j a_j in block [i, j]
    gamma: Array  # (n, ·) factor of w_j v_j
    rho: Array  # (n, ·) ḣ ∂'K + h Hᵀv, which −2 w_i v'_i multiplies
    total: Array  # (n, n, ·) the block of the Gram matrix, or its adjoint


class _Adjoints(NamedTuple):
    """Derivatives of the weighted sum by what `_Scratch` holds, and what the reverse recursion remembers."""

    base: Array  # (n, 4, ·) by the factors of a product
    value: Array  # (·)
    left: Array  # (n, ·) by the derivatives of the whole product
    right: Array  # (n, ·)
    mixed: Array  # (n, n, ·)
    left_before: Array  # (n, ·) by the derivatives of the product of the first joints
    right_before: Array  # (n, ·)
    partial: Array  # (n + 1, ·) the weighted sum of derivatives over the first b joints alone
    new_right: Array  # (n, ·) Σ_{i<b} adjoint of H_ib · ∂_i before
    new_left: Array  # (n, ·) Σ_{j<b} adjoint of H_bj · ∂'_j before
    terms: Array  # (9, ·)
    row: Array  # (3, ·) by alpha, gamma and −2 w v' of one joint
    rho: Array  # (n, ·)


@compiled
def lip_gram(
    q: Array,
    v: Array,
    a: Array,
    q2: Array,
    v2: Array,
    a2: Array,
    prismatic: NDArray[np.bool_],
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
    x, y = _features(q, v, a, prismatic), _features(q2, v2, a2, prismatic)
    out, s, changes = np.empty((rows, n, columns, n)), _scratch(n), _changes(kinetic_shares)
    for row in range(rows):
        for start in range(row if symmetric else 0, columns, PAIRS):
            width = min(PAIRS, columns - start)
            _load_columns(y, start, width, s.block)
            _potential(potential_shares, prismatic, x[row], n, width, s)
            for i in range(n):
                for j in range(n):
                    for k in range(width):
                        s.total[i, j, k] = potential_scale * s.mixed[i, j, k]
            for link in range(n - 1, -1, -1):
                _kinetic(kinetic_shares[link], prismatic, weights[link], x[row], link + 1, width, changes[link], s)
                _add_kinetic(weights[link], x[row], link + 1, width, s)
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
    prismatic: NDArray[np.bool_],
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
    x, y = _features(q, v, a, prismatic), _features(q2, v2, a2, prismatic)
    s, d, changes = _scratch(n), _adjoints(n), _changes(kinetic_shares)
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
            _potential(potential_shares, prismatic, x[row], n, width, s)
            _potential_reverse(prismatic, x[row], potential_scale, n, width, s, d, d_potential, d_scale)
            for link in range(n - 1, -1, -1):
                _kinetic(kinetic_shares[link], prismatic, weights[link], x[row], link + 1, width, changes[link], s)
                _kinetic_reverse(weights[link], x[row], link + 1, width, s, d, d_weights[link])
                _product_reverse(s.power, link + 1, width, s, d)
                _square_reverse(link + 1, width, s.base, d.base)
                _base_reverse(prismatic, x[row], link + 1, width, s.block, d.base, d_kinetic[link])
    return (
        _sum_pairs(d_kinetic).reshape(n, n, 3),
        _sum_pairs(d_weights).reshape(n, n),
        _sum_pairs(d_potential).reshape(n, 3),
        d_scale.sum(),
    )


@compiled
def _scratch(n: int) -> _Scratch:
    return _Scratch(
        np.empty((6, n, PAIRS)),
        np.empty((n, 4, PAIRS)),
        np.empty((n, 4, PAIRS)),
        np.empty((n + 1, PAIRS)),
        np.empty((n + 1, PAIRS)),
        np.empty((n + 1, n, PAIRS)),
        np.empty((n + 1, n, PAIRS)),
        np.empty((n, n, PAIRS)),
        np.empty((9, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, n, PAIRS)),
    )


@compiled
def _adjoints(n: int) -> _Adjoints:
    return _Adjoints(
        np.empty((n, 4, PAIRS)),
        np.empty(PAIRS),
        np.empty((n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n + 1, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((9, PAIRS)),
        np.empty((3, PAIRS)),
        np.empty((n, PAIRS)),
    )


@compiled
def _changes(shares: Array) -> NDArray[np.bool_]:
    """Whether a link's shares differ from the next link's: where not, its products are those already computed."""
    n = shares.shape[0]
    changes = np.ones(n, dtype=np.bool_)
    for link in range(n - 1):
        changes[link] = np.any(shares[link, : link + 1] != shares[link + 1, : link + 1])
    return changes


@compiled
def _features(q: Array, v: Array, a: Array, prismatic: NDArray[np.bool_]) -> Array:
    """f, g, f', g', v, a of every sample and joint: (N, 6, n)."""
    samples, n = q.shape
    x = np.empty((samples, 6, n))
    for i in range(samples):
        for b in range(n):
            straight, cos, sin = prismatic[b], np.cos(q[i, b]), np.sin(q[i, b])
            x[i, F, b] = q[i, b] if straight else cos
            x[i, G, b] = 0.0 if straight else sin
            x[i, DF, b] = 1.0 if straight else -sin
            x[i, DG, b] = 0.0 if straight else cos
            x[i, V, b] = v[i, b]
            x[i, A, b] = a[i, b]
    return x


@compiled
def _load_columns(y: Array, start: int, width: int, block: Array) -> None:
    for c in range(6):
        for b in range(block.shape[1]):
            for k in range(width):
                block[c, b, k] = y[start + k, c, b]


@compiled
def _base_kernels(
    shares: Array, prismatic: NDArray[np.bool_], x: Array, y: Array, m: int, width: int, base: Array
) -> None:
    """The first m joints' base kernels and their derivatives."""
    for b in range(m):
        sigma = shares[b, 0] + shares[b, 2] if prismatic[b] else shares[b, 0]
        f, g, df, dg = shares[b, 1] * x[F, b], shares[b, 2] * x[G, b], shares[b, 1] * x[DF, b], shares[b, 2] * x[DG, b]
        for k in range(width):
            base[b, VALUE, k] = sigma + f * y[F, b, k] + g * y[G, b, k]
            base[b, LEFT, k] = df * y[F, b, k] + dg * y[G, b, k]
            base[b, RIGHT, k] = f * y[DF, b, k] + g * y[DG, b, k]
            base[b, MIXED, k] = df * y[DF, b, k] + dg * y[DG, b, k]


@compiled
def _base_reverse(
    prismatic: NDArray[np.bool_], x: Array, m: int, width: int, y: Array, d_base: Array, d_shares: Array
) -> None:
    """Add the derivatives by the shares, given those by the base kernels."""
    for b in range(m):
        f, g, df, dg, straight = x[F, b], x[G, b], x[DF, b], x[DG, b], 1.0 if prismatic[b] else 0.0
        for k in range(width):
            value, left, right, mixed = d_base[b, 0, k], d_base[b, 1, k], d_base[b, 2, k], d_base[b, 3, k]
            d_shares[b, 0, k] += value
            d_shares[b, 1, k] += y[F, b, k] * (f * value + df * left) + y[DF, b, k] * (f * right + df * mixed)
            d_shares[b, 2, k] += (
                y[G, b, k] * (g * value + dg * left) + y[DG, b, k] * (g * right + dg * mixed) + straight * value
            )


@compiled
def _square(m: int, width: int, base: Array, power: Array) -> None:
    """p² and its derivatives from those of p."""
    for b in range(m):
        for k in range(width):
            value, left, right, mixed = base[b, 0, k], base[b, 1, k], base[b, 2, k], base[b, 3, k]
            power[b, VALUE, k] = value * value
            power[b, LEFT, k] = 2.0 * value * left
            power[b, RIGHT, k] = 2.0 * value * right
            power[b, MIXED, k] = 2.0 * (value * mixed + left * right)


@compiled
def _square_reverse(m: int, width: int, base: Array, d: Array) -> None:
    """Turn derivatives by p² and its derivatives into those by p's, in place."""
    for b in range(m):
        for k in range(width):
            value, left, right, mixed = base[b, 0, k], base[b, 1, k], base[b, 2, k], base[b, 3, k]
            d_value, d_left, d_right, d_mixed = d[b, 0, k], d[b, 1, k], d[b, 2, k], d[b, 3, k]
            d[b, VALUE, k] = 2.0 * (d_value * value + d_left * left + d_right * right + d_mixed * mixed)
            d[b, LEFT, k] = 2.0 * (d_left * value + d_mixed * right)
            d[b, RIGHT, k] = 2.0 * (d_right * value + d_mixed * left)
            d[b, MIXED, k] = 2.0 * d_mixed * value


@compiled
def _prefixes(p: Array, m: int, width: int, before: Array, left: Array, right: Array) -> None:
    """Products of the first joints, every number of them up to m, with their derivatives by each joint."""
    for k in range(width):
        before[0, k] = 1.0
    for b in range(m):
        for k in range(width):
            left[b + 1, b, k] = before[b, k] * p[b, LEFT, k]
            right[b + 1, b, k] = before[b, k] * p[b, RIGHT, k]
            before[b + 1, k] = before[b, k] * p[b, VALUE, k]
        for i in range(b):
            for k in range(width):
                left[b + 1, i, k] = left[b, i, k] * p[b, VALUE, k]
                right[b + 1, i, k] = right[b, i, k] * p[b, VALUE, k]


@compiled
def _mixed(p: Array, m: int, width: int, s: _Scratch) -> None:
    """Mixed derivatives of the product over m joints: H_ij takes i and j from what comes before the later of them."""
    before, after, left, right, mixed = s.before, s.after, s.left, s.right, s.mixed
    for k in range(width):
        after[m, k] = 1.0
    for b in range(m - 1, -1, -1):
        for k in range(width):
            after[b, k] = after[b + 1, k] * p[b, VALUE, k]
            mixed[b, b, k] = before[b, k] * p[b, MIXED, k] * after[b + 1, k]
        for i in range(b):
            for k in range(width):
                mixed[i, b, k] = left[b, i, k] * (p[b, RIGHT, k] * after[b + 1, k])
                mixed[b, i, k] = right[b, i, k] * (p[b, LEFT, k] * after[b + 1, k])


@compiled
def _product_reverse(p: Array, m: int, width: int, s: _Scratch, d: _Adjoints) -> None:
    """Derivatives by each joint's factor of D = d.value K + Σ d.left ∂_iK + Σ d.right ∂'_jK + Σ d.mixed H.

    The part of D that the first b joints make up follows a recursion with as many numbers a joint as the joint has
    rows and columns in H; going back through it costs as much, where undoing `polynomial.product` takes a joint more.
    """
    before, after, left, right, partial = s.before, s.after, s.left, s.right, d.partial
    for k in range(width):
        partial[0, k] = 0.0
    for b in range(m):
        for k in range(width):
            d.new_right[b, k] = 0.0
            d.new_left[b, k] = 0.0
            d.left_before[b, k] = 0.0
            d.right_before[b, k] = 0.0
        for i in range(b):
            for k in range(width):
                d.new_right[b, k] += d.mixed[i, b, k] * left[b, i, k]
                d.new_left[b, k] += d.mixed[b, i, k] * right[b, i, k]
        for k in range(width):
            own = d.left[b, k] * p[b, LEFT, k] + d.right[b, k] * p[b, RIGHT, k] + d.mixed[b, b, k] * p[b, MIXED, k]
            crossed = d.new_right[b, k] * p[b, RIGHT, k] + d.new_left[b, k] * p[b, LEFT, k]
            partial[b + 1, k] = partial[b, k] * p[b, VALUE, k] + before[b, k] * own + crossed
    for b in range(m - 1, -1, -1):
        for k in range(width):
            value, by_left, by_right = d.value[k], d.left_before[b, k], d.right_before[b, k]
            own = d.left[b, k] * p[b, LEFT, k] + d.right[b, k] * p[b, RIGHT, k] + d.mixed[b, b, k] * p[b, MIXED, k]
            first, last = before[b, k], after[b + 1, k]
            d.base[b, VALUE, k] = last * partial[b, k] + value * first
            d.base[b, LEFT, k] = last * (first * d.left[b, k] + d.new_left[b, k]) + by_left * first
            d.base[b, RIGHT, k] = last * (first * d.right[b, k] + d.new_right[b, k]) + by_right * first
            d.base[b, MIXED, k] = last * first * d.mixed[b, b, k]
            d.value[k] = value * p[b, VALUE, k] + last * own + by_left * p[b, LEFT, k] + by_right * p[b, RIGHT, k]
        for i in range(b):
            for k in range(width):
                last, by_left, by_right = after[b + 1, k], d.left_before[i, k], d.right_before[i, k]
                d.base[b, VALUE, k] += by_left * left[b, i, k] + by_right * right[b, i, k]
                d.left_before[i, k] = by_left * p[b, VALUE, k] + last * p[b, RIGHT, k] * d.mixed[i, b, k]
                d.right_before[i, k] = by_right * p[b, VALUE, k] + last * p[b, LEFT, k] * d.mixed[b, i, k]


@compiled
def _potential(shares: Array, prismatic: NDArray[np.bool_], x: Array, n: int, width: int, s: _Scratch) -> None:
    """Mixed derivatives of the potential energy's kernel, its scale left out."""
    _base_kernels(shares, prismatic, x, s.block, n, width, s.base)
    _prefixes(s.base, n, width, s.before, s.left, s.right)
    _mixed(s.base, n, width, s)


@compiled
def _potential_reverse(
    prismatic: NDArray[np.bool_],
    x: Array,
    scale: float,
    n: int,
    width: int,
    s: _Scratch,
    d: _Adjoints,
    d_shares: Array,
    d_scale: Array,
) -> None:
    """Add the derivatives by the potential energy's shares and scale."""
    for k in range(width):
        d.value[k] = 0.0
    for i in range(n):
        for k in range(width):
            d.left[i, k] = 0.0
            d.right[i, k] = 0.0
        for j in range(n):
            for k in range(width):
                d_scale[k] += s.total[i, j, k] * s.mixed[i, j, k]
                d.mixed[i, j, k] = scale * s.total[i, j, k]
    _product_reverse(s.base, n, width, s, d)
    _base_reverse(prismatic, x, n, width, s.block, d.base, d_shares)


@compiled
def _kinetic(
    shares: Array,
    prismatic: NDArray[np.bool_],
    w: Array,
    x: Array,
    m: int,
    width: int,
    changed: bool,
    s: _Scratch,
) -> None:
    """All that the block of a link with m joints is made of; its products are taken over unless `changed`."""
    if changed:
        _base_kernels(shares, prismatic, x, s.block, m, width, s.base)
        _square(m, width, s.base, s.power)
        _prefixes(s.power, m, width, s.before, s.left, s.right)
    _mixed(s.power, m, width, s)
    terms, y, left, right, mixed = s.terms, s.block, s.left, s.right, s.mixed
    for c in range(9):
        for k in range(width):
            terms[c, k] = 0.0
    for i in range(m):
        wv, wa, v = w[i] * x[V, i], w[i] * x[A, i], x[V, i]
        for k in range(width):
            s.x_mixed[i, k] = 0.0
            s.mixed_y[i, k] = 0.0
            terms[H, k] += wv * y[V, i, k]
            terms[HX, k] += wa * y[V, i, k]
            terms[HY, k] += wv * y[A, i, k]
            terms[HXY, k] += wa * y[A, i, k]
            terms[KX, k] += v * left[m, i, k]
            terms[KY, k] += y[V, i, k] * right[m, i, k]
    for i in range(m):
        v = x[V, i]
        for j in range(m):
            for k in range(width):
                s.mixed_y[i, k] += mixed[i, j, k] * y[V, j, k]
                s.x_mixed[j, k] += mixed[i, j, k] * v
        for k in range(width):
            terms[KXY, k] += v * s.mixed_y[i, k]
    for k in range(width):
        terms[K, k] = s.before[m, k]
        terms[HH, k] = terms[H, k] * terms[H, k]
    for i in range(m):
        w2 = 2.0 * w[i]
        for k in range(width):
            wv, wa = w2 * y[V, i, k], w2 * y[A, i, k]
            s.alpha[i, k] = wa * terms[K, k] + wv * terms[KY, k]
            moved = terms[HY, k] * left[m, i, k] + terms[H, k] * s.mixed_y[i, k]
            s.gamma[i, k] = wa * terms[KX, k] + wv * terms[KXY, k] - 2.0 * moved
            s.rho[i, k] = terms[HX, k] * right[m, i, k] + terms[H, k] * s.x_mixed[i, k]


@compiled
def _add_kinetic(w: Array, x: Array, m: int, width: int, s: _Scratch) -> None:
    """Add the torque covariance of one link's kinetic energy, `energy.kinetic_blocks`, to s.total."""
    y, mixed, terms, alpha, gamma, rho, total = s.block, s.mixed, s.terms, s.alpha, s.gamma, s.rho, s.total
    for i in range(m):
        w2 = 2.0 * w[i]
        for j in range(m):
            wv, wa = w[j] * x[V, j], w[j] * x[A, j]
            for k in range(width):
                total[i, j, k] += (
                    alpha[i, k] * wa + gamma[i, k] * wv - w2 * y[V, i, k] * rho[j, k] + terms[HH, k] * mixed[i, j, k]
                )
        for k in range(width):
            total[i, i, k] += w2 * (
                terms[K, k] * terms[HXY, k]
                + terms[KX, k] * terms[HY, k]
                + terms[KY, k] * terms[HX, k]
                + terms[KXY, k] * terms[H, k]
            )


@compiled
def _kinetic_reverse(w: Array, x: Array, m: int, width: int, s: _Scratch, d: _Adjoints, d_weights: Array) -> None:
    """From the adjoint s.total of a link's block to those of its product's derivatives; adds those by its weights."""
    y, mixed, terms, total, by, row = s.block, s.mixed, s.terms, s.total, d.terms, d.row
    for k in range(width):
        for c in range(9):
            by[c, k] = 0.0
        d.value[k] = 0.0
    for i in range(m):
        for k in range(width):
            d.rho[i, k] = 0.0
    for i in range(m):
        w2 = 2.0 * w[i]
        for k in range(width):
            row[0, k] = 0.0
            row[1, k] = 0.0
            row[2, k] = 0.0
        for j in range(m):
            wv, wa, v, a = w[j] * x[V, j], w[j] * x[A, j], x[V, j], x[A, j]
            for k in range(width):
                g = total[i, j, k]
                row[0, k] += g * wa
                row[1, k] += g * wv
                row[2, k] -= g * s.rho[j, k]
                d.rho[j, k] -= g * w2 * y[V, i, k]
                by[HH, k] += g * mixed[i, j, k]
                d_weights[j, k] += g * (s.alpha[i, k] * a + s.gamma[i, k] * v)
        for k in range(width):
            alpha, gamma, v2, a2 = row[0, k], row[1, k], y[V, i, k], y[A, i, k]
            diagonal = w2 * total[i, i, k]
            both = (
                terms[K, k] * terms[HXY, k]
                + terms[KX, k] * terms[HY, k]
                + terms[KY, k] * terms[HX, k]
                + terms[KXY, k] * terms[H, k]
            )
            d_weights[i, k] += 2.0 * (
                a2 * (terms[K, k] * alpha + terms[KX, k] * gamma)
                + v2 * (terms[KY, k] * alpha + terms[KXY, k] * gamma + row[2, k])
                + total[i, i, k] * both
            )
            by[K, k] += w2 * a2 * alpha + diagonal * terms[HXY, k]
            by[KX, k] += w2 * a2 * gamma + diagonal * terms[HY, k]
            by[KY, k] += w2 * v2 * alpha + diagonal * terms[HX, k]
            by[KXY, k] += w2 * v2 * gamma + diagonal * terms[H, k]
            by[HXY, k] += diagonal * terms[K, k]
            by[HY, k] += diagonal * terms[KX, k] - 2.0 * s.left[m, i, k] * gamma
            by[HX, k] += diagonal * terms[KY, k]
            by[H, k] += diagonal * terms[KXY, k] - 2.0 * s.mixed_y[i, k] * gamma
            d.left[i, k] = -2.0 * terms[HY, k] * gamma
            d.right_before[i, k] = -2.0 * terms[H, k] * gamma  # by H v', until the product's recursion takes over
    for i in range(m):
        for k in range(width):
            by[HX, k] += d.rho[i, k] * s.right[m, i, k]
            by[H, k] += d.rho[i, k] * s.x_mixed[i, k]
    for k in range(width):
        by[H, k] += 2.0 * terms[H, k] * by[HH, k]
        d.value[k] = by[K, k]
    for i in range(m):
        v, a = x[V, i], x[A, i]
        for k in range(width):
            v2, a2 = y[V, i, k], y[A, i, k]
            d_weights[i, k] += v2 * (by[H, k] * v + by[HX, k] * a) + a2 * (by[HY, k] * v + by[HXY, k] * a)
            d.left[i, k] += by[KX, k] * v
            d.right[i, k] = by[KY, k] * v2 + terms[HX, k] * d.rho[i, k]
            d.right_before[i, k] += by[KXY, k] * v
            d.rho[i, k] *= terms[H, k]  # from here on by Hᵀv
    for i in range(m):
        v = x[V, i]
        for j in range(m):
            for k in range(width):
                d.mixed[i, j, k] = terms[HH, k] * total[i, j, k] + d.right_before[i, k] * y[V, j, k] + v * d.rho[j, k]


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
