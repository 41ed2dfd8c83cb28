"""Base kernels of the joints, their squares and products, with derivatives; and the way back."""

from __future__ import annotations

from lipcore.kernels.compiled.compile import compiled
from lipcore.kernels.compiled.lip_data import DF, DG, LEFT, MIXED, RIGHT, VALUE, Adjoints, Array, F, Flags, G, Scratch


@compiled
def base_kernels(shares: Array, prismatic: Flags, x: Array, y: Array, m: int, width: int, base: Array) -> None:
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
def base_reverse(prismatic: Flags, x: Array, m: int, width: int, y: Array, d_base: Array, d_shares: Array) -> None:
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
def square(m: int, width: int, base: Array, power: Array) -> None:
    """p² and its derivatives from those of p."""
    for b in range(m):
        for k in range(width):
            value, left, right, mixed = base[b, 0, k], base[b, 1, k], base[b, 2, k], base[b, 3, k]
            power[b, VALUE, k] = value * value
            power[b, LEFT, k] = 2.0 * value * left
            power[b, RIGHT, k] = 2.0 * value * right
            power[b, MIXED, k] = 2.0 * (value * mixed + left * right)


@compiled
def square_reverse(m: int, width: int, base: Array, d: Array) -> None:
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
def prefixes(p: Array, m: int, width: int, before: Array, left: Array, right: Array) -> None:
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
def mixed_derivatives(p: Array, m: int, width: int, s: Scratch) -> None:
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
def product_reverse(p: Array, m: int, width: int, s: Scratch, d: Adjoints) -> None:
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
