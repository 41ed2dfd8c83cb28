"""Sums along the chain of docs/method.md (9), each in one step per link, and their adjoints.

With p_b the jet of joint b's base kernel, three recursions give everything that the block of the kinetic energies
needs:

    R_{l,a} = Π_{a<b≤l} p_b                       R_{l,a} = p_l R_{l-1,a},  R_{a,a} = 1
    B_{l,i} = Σ_{a<i} w_{l,a} v_a v'_a R_{i-1,a}  B_{l,i+1} = p_i B_{l,i} + w_{l,i} v_i v'_i,  h_l = B_{l,l+1}
    S_{i,j} = Σ_{l≥i} h_l R_{l,i} w_{l,j}         S_{i,j} = h_i w_{i,j} + p_{i+1} S_{i+1,j}
    C_{i,j} = Σ_{l≥i} h_l R_{l,i} B_{l,j}         C_{i,j} = h_i B_{i,j} + p_{i+1} C_{i+1,j}    (no derivatives needed)
"""

from __future__ import annotations

from typing import NamedTuple

from lipcore.kernels.fast.compile import inlined
from lipcore.kernels.fast.jets import add, against, constant, dot, get, plus, put, scaled, times, velocity
from lipcore.kernels.fast.joints import VALUE, Array, add_row, row
from lipcore.kernels.fast.lanes import spread
from lipcore.kernels.fast.views import lay


class Sums(NamedTuple):
    """The sums, or the derivatives by them, in Lanes. A last axis of four is a jet."""

    p: Array  # (n, 4)
    r: Array  # (n, n, 4)
    b: Array  # (n, n + 1, 4)
    s: Array  # (n, n, 4)
    c: Array  # (n, n)


@inlined
def lay_sums(m: Array, at: int, n: int) -> tuple[Sums, int]:
    """Lay out memory for n joints."""
    views, at = lay(m, at, ((n, 4), (n, n, 4), (n, n + 1, 4), (n, n, 4), (n, n)))
    return Sums(*views), at


@inlined
def head(weights: Array, x: Array, y: Array, work: Sums) -> None:
    """Compute R and B, from the base to the tip."""
    p, r, b, _, _ = work
    for link in range(weights.shape[0]):
        for j in range(link):
            put(r, link, j, times(row(p, link), get(r, link - 1, j)))
        put(r, link, link, constant(1.0))
        total = constant(0.0)
        put(b, link, 0, total)
        for i in range(link + 1):
            total = plus(times(row(p, i), total), scaled(weights[link, i], velocity(x, y, i)))
            put(b, link, i + 1, total)


@inlined
def head_adjoint(weights: Array, x: Array, y: Array, work: Sums, d: Sums, dweights: Array) -> None:
    """Add the derivatives by p and weights: the adjoint of `head`."""
    for link in range(weights.shape[0] - 1, -1, -1):
        by_total = constant(0.0)
        for i in range(link, -1, -1):
            by_total = plus(by_total, get(d.b, link, i + 1))
            dweights[link, i] += dot(by_total, velocity(x, y, i))
            add_row(d.p, i, against(by_total, get(work.b, link, i)))
            by_total = against(by_total, row(work.p, i))
        for j in range(link):
            by_r = get(d.r, link, j)
            add_row(d.p, link, against(by_r, get(work.r, link - 1, j)))
            add(d.r, link - 1, j, against(by_r, row(work.p, link)))


@inlined
def tail(weights: Array, work: Sums) -> None:
    """Compute S and C, from the tip to the base."""
    p, _, b, s, c = work
    last = weights.shape[0] - 1
    for i in range(last, -1, -1):
        h = get(b, i, i + 1)
        for j in range(i + 1):
            by_weight, by_head = scaled(weights[i, j], h), h[0] * b[i, j, 0]
            if i < last:
                by_weight = plus(by_weight, times(row(p, i + 1), get(s, i + 1, j)))
                by_head += p[i + 1, VALUE] * c[i + 1, j]
            put(s, i, j, by_weight)
            c[i, j] = by_head


@inlined
def tail_adjoint(weights: Array, work: Sums, d: Sums, dweights: Array) -> None:
    """Add the derivatives by p, B and weights: the adjoint of `tail`."""
    last = weights.shape[0] - 1
    for i in range(last + 1):
        h, dh = get(work.b, i, i + 1), constant(0.0)
        for j in range(i + 1):
            by_s, by_c = get(d.s, i, j), d.c[i, j]
            dweights[i, j] += dot(by_s, h)
            dh = plus(dh, scaled(weights[i, j], by_s))
            dh = dh[0] + by_c * work.b[i, j, 0], dh[1], dh[2], dh[3]
            d.b[i, j, 0] += by_c * h[0]
            if i < last:
                add_row(d.p, i + 1, against(by_s, get(work.s, i + 1, j)))
                d.p[i + 1, VALUE] += by_c * work.c[i + 1, j]
                add(d.s, i + 1, j, against(by_s, row(work.p, i + 1)))
                d.c[i + 1, j] += by_c * work.p[i + 1, VALUE]
        add(d.b, i, i + 1, dh)


@inlined
def clear(d: Sums) -> None:
    """Set the derivatives that the adjoints add to to zero."""
    n, zero = d.p.shape[0], constant(0.0)
    for i in range(n):
        for k in range(4):
            d.p[i, k] = spread(0.0)
        for j in range(n + 1):
            put(d.b, i, j, zero)
        for j in range(n):
            put(d.r, i, j, zero)
            put(d.s, i, j, zero)
            d.c[i, j] = spread(0.0)
