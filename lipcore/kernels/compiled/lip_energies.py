"""Blocks of the Gram matrix from the two energies of the LIP kernel, and the way back."""

from __future__ import annotations

from lipcore.kernels.compiled.compile import compiled
from lipcore.kernels.compiled.lip_data import HH, HX, HXY, HY, KX, KXY, KY, A, Adjoints, Array, Flags, H, K, Scratch, V
from lipcore.kernels.compiled.lip_products import (
    base_kernels,
    base_reverse,
    mixed_derivatives,
    prefixes,
    product_reverse,
    square,
)


@compiled
def potential(shares: Array, prismatic: Flags, x: Array, n: int, width: int, s: Scratch) -> None:
    """Mixed derivatives of the potential energy's kernel, its scale left out."""
    base_kernels(shares, prismatic, x, s.block, n, width, s.base)
    prefixes(s.base, n, width, s.before, s.left, s.right)
    mixed_derivatives(s.base, n, width, s)


@compiled
def potential_reverse(
    prismatic: Flags, x: Array, scale: float, width: int, s: Scratch, d: Adjoints, d_shares: Array, d_scale: Array
) -> None:
    """Add the derivatives by the potential energy's shares and scale."""
    n = s.base.shape[0]
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
    product_reverse(s.base, n, width, s, d)
    base_reverse(prismatic, x, n, width, s.block, d.base, d_shares)


@compiled
def kinetic(shares: Array, prismatic: Flags, w: Array, x: Array, m: int, width: int, changed: bool, s: Scratch) -> None:
    """All that the block of a link with m joints is made of; its products are taken over unless `changed`."""
    if changed:
        base_kernels(shares, prismatic, x, s.block, m, width, s.base)
        square(m, width, s.base, s.power)
        prefixes(s.power, m, width, s.before, s.left, s.right)
    mixed_derivatives(s.power, m, width, s)
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
def add_kinetic(w: Array, x: Array, m: int, width: int, s: Scratch) -> None:
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
def kinetic_reverse(w: Array, x: Array, m: int, width: int, s: Scratch, d: Adjoints, d_weights: Array) -> None:
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
