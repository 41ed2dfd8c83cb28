"""A position kernel K = Σ_l s_l Π_{b≤l} p_b with its derivatives, and its adjoint. No formula divides by p_b.

With the scales (0, …, 0, s) it is a product over all joints. Both energies of docs/method.md (5) and the potential of
section 4 are such sums. `polynomial.Product` is one term of it as a formula.
"""

from __future__ import annotations

from typing import NamedTuple

from lipcore.kernels.fast.compile import inlined
from lipcore.kernels.fast.joints import LEFT, MIXED, RIGHT, VALUE, Array
from lipcore.kernels.fast.lanes import Lanes, spread
from lipcore.kernels.fast.views import lay


class Products(NamedTuple):
    """Products that the derivatives of K need, in Lanes."""

    before: Array  # (n + 1,) Π_{c<b} p_c
    after: Array  # (n + 1,) ∂K/∂before: Σ_{l≥b−1} s_l Π_{b≤c≤l} p_c
    left: Array  # (n + 1, n) derivatives of `before` by q_i at [b, i]
    right: Array  # (n + 1, n) by q'_j
    mixed: Array  # (n, n) H_ij = ∂²K/∂q_i∂q'_j


class Given(NamedTuple):
    """Derivatives by K, its slopes and H that `product_adjoint` starts from, in Lanes."""

    value: Lanes
    left: Array  # (n,)
    right: Array
    mixed: Array  # (n, n)


class ProductBack(NamedTuple):
    """Intermediate results of `product_adjoint`, in Lanes."""

    partial: Array  # (n + 1,) the part of the sum that the first b joints make up
    new_left: Array  # (n,) Σ_{j<b} d_bj ∂'_j before
    new_right: Array  # (n,) Σ_{i<b} d_ib ∂_i before
    left: Array  # (n,) by the slopes of `before`
    right: Array  # (n,)
    zero: Array  # (n,) never written


@inlined
def lay_products(m: Array, at: int, n: int) -> tuple[Products, int]:
    """Lay out memory for n joints."""
    views, at = lay(m, at, ((n + 1,), (n + 1,), (n + 1, n), (n + 1, n), (n, n)))
    return Products(*views), at


@inlined
def lay_back(m: Array, at: int, n: int) -> tuple[ProductBack, int]:
    """Lay out memory for n joints."""
    views, at = lay(m, at, ((n + 1,), (n,), (n,), (n,), (n,), (n,)))
    return ProductBack(*views), at


@inlined
def prefixes(p: Array, n: int, s: Products) -> None:
    """Write the products of the first b joints for all b up to n, with their slopes. p: (n, 4)."""
    s.before[0] = spread(1.0)
    for b in range(n):
        value, first = p[b, VALUE], s.before[b]
        s.left[b + 1, b] = first * p[b, LEFT]
        s.right[b + 1, b] = first * p[b, RIGHT]
        s.before[b + 1] = first * value
        for i in range(b):
            s.left[b + 1, i] = s.left[b, i] * value
            s.right[b + 1, i] = s.right[b, i] * value


@inlined
def mixed_derivatives(p: Array, scales: Array, n: int, s: Products) -> None:
    """Write H of n joints after `prefixes`. H_ij uses the product before the later of i and j. scales: s, (n,)."""
    last = spread(scales[n - 1])
    s.after[n] = last
    for b in range(n - 1, -1, -1):
        left, right = p[b, LEFT] * last, p[b, RIGHT] * last
        s.mixed[b, b] = s.before[b] * p[b, MIXED] * last
        for i in range(b):
            s.mixed[i, b] = s.left[b, i] * right
            s.mixed[b, i] = s.right[b, i] * left
        last = last * p[b, VALUE]
        if b > 0:
            last += scales[b - 1]
        s.after[b] = last


@inlined
def product_adjoint(p: Array, scales: Array, n: int, s: Products, d: Given, work: ProductBack, dp: Array) -> None:
    """Write the derivatives of d.value K + Σ d.left ∂_iK + Σ d.right ∂'_jK + Σ d.mixed H by p and its own, (n, 4).

    The part of this sum from the first b joints follows a recursion. Its numbers per joint are as many as the joint has
    rows and columns in H. The adjoint of the recursion has the same cost.
    """
    work.partial[0] = spread(0.0)
    for b in range(n):
        new_left, new_right = spread(0.0), spread(0.0)
        for i in range(b):
            new_left += d.mixed[b, i] * s.right[b, i]
            new_right += d.mixed[i, b] * s.left[b, i]
        work.new_left[b], work.new_right[b] = new_left, new_right
        work.left[b], work.right[b] = spread(0.0), spread(0.0)
        crossed = new_right * p[b, RIGHT] + new_left * p[b, LEFT]
        work.partial[b + 1] = work.partial[b] * p[b, VALUE] + s.before[b] * _own(p, b, d) + crossed
    value = d.value * scales[n - 1]  # by before[b + 1]
    for b in range(n - 1, -1, -1):
        first, last, by_left, by_right = s.before[b], s.after[b + 1], work.left[b], work.right[b]
        dvalue = last * work.partial[b] + value * first
        dp[b, LEFT] = last * (first * d.left[b] + work.new_left[b]) + by_left * first
        dp[b, RIGHT] = last * (first * d.right[b] + work.new_right[b]) + by_right * first
        dp[b, MIXED] = last * first * d.mixed[b, b]
        value = value * p[b, VALUE] + last * _own(p, b, d) + by_left * p[b, LEFT] + by_right * p[b, RIGHT]
        if b > 0:
            value += d.value * scales[b - 1]
        for i in range(b):
            by_left, by_right = work.left[i], work.right[i]
            dvalue += by_left * s.left[b, i] + by_right * s.right[b, i]
            work.left[i] = by_left * p[b, VALUE] + last * p[b, RIGHT] * d.mixed[i, b]
            work.right[i] = by_right * p[b, VALUE] + last * p[b, LEFT] * d.mixed[b, i]
        dp[b, VALUE] = dvalue


@inlined
def potential_adjoint(
    p: Array, scales: Array, s: Products, dmixed: Array, work: ProductBack, dp: Array, dscales: Array
) -> None:
    """Write the derivatives by p, (n, 4), and add those by the scales, (n,), given those by H alone."""
    n = p.shape[0]
    product_adjoint(p, scales, n, s, Given(spread(0.0), work.zero, work.zero, dmixed), work, dp)
    for b in range(n):
        dscales[b] += work.partial[b + 1]


@inlined
def _own(p: Array, b: int, d: Given) -> Lanes:
    own: Lanes = d.left[b] * p[b, LEFT] + d.right[b] * p[b, RIGHT] + d.mixed[b, b] * p[b, MIXED]
    return own
