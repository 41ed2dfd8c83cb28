"""One link's kinetic energy of the paper's kernel, K h²: block of the Gram matrix, docs/method.md (6), and its adjoint.

K = Π_{b≤l} p_b² and its derivatives are those of `products` with p_b² instead of p_b. Primes mark the second argument;
h, ḣ, h', ḣ', A, B and C are those of (6).
"""

from __future__ import annotations

from typing import NamedTuple

from lipcore.kernels.fast.compile import inlined
from lipcore.kernels.fast.joints import LEFT, MIXED, RIGHT, VALUE, A, Array, Four, V
from lipcore.kernels.fast.lanes import Lanes, spread
from lipcore.kernels.fast.products import Given, Products
from lipcore.kernels.fast.views import lay

H, HX, HY, HXY, KX, KY, KXY, K = range(8)  # h, ḣ, h', ḣ', A, B, C and K


class Terms(NamedTuple):
    """Terms of the block of a link with m joints, in Lanes."""

    sums: Array  # (8,) the numbers above
    x_mixed: Array  # (n,) Hᵀv
    mixed_y: Array  # (n,) H v'
    alpha: Array  # (n,) factor of w_j a_j in row i of the block
    gamma: Array  # (n,) factor of w_j v_j
    rho: Array  # (n,) ḣ ∂'K + h Hᵀv, the factor of −2 w_i v'_i


class TermsBack(NamedTuple):
    """Derivatives by `Terms`, in Lanes."""

    rho: Array  # (n,)
    mixed_y: Array  # (n,)
    left: Array  # (n,) by the slopes of K and by H
    right: Array
    mixed: Array  # (n, n)


@inlined
def lay_terms(m: Array, at: int, n: int) -> tuple[Terms, int]:
    """Lay out memory for n joints."""
    views, at = lay(m, at, ((8,), (n,), (n,), (n,), (n,), (n,)))
    return Terms(*views), at


@inlined
def lay_terms_back(m: Array, at: int, n: int) -> tuple[TermsBack, int]:
    """Lay out memory for n joints."""
    views, at = lay(m, at, ((n,), (n,), (n,), (n,), (n, n)))
    return TermsBack(*views), at


@inlined
def square(base: Array, power: Array) -> None:
    """Write p² and its derivatives from p and its derivatives, both (n, 4)."""
    for b in range(base.shape[0]):
        value, left, right = base[b, VALUE], base[b, LEFT], base[b, RIGHT]
        power[b, VALUE] = value * value
        power[b, LEFT] = 2.0 * value * left
        power[b, RIGHT] = 2.0 * value * right
        power[b, MIXED] = 2.0 * (value * base[b, MIXED] + left * right)


@inlined
def square_adjoint(base: Array, b: int, d: Four) -> Four:
    """Return the derivatives by joint b's p and its derivatives, given those by p² and its derivatives."""
    value, left, right, mixed = base[b, VALUE], base[b, LEFT], base[b, RIGHT], base[b, MIXED]
    return (
        2.0 * (d[0] * value + d[1] * left + d[2] * right + d[3] * mixed),
        2.0 * (d[1] * value + d[3] * right),
        2.0 * (d[2] * value + d[3] * left),
        2.0 * d[3] * value,
    )


@inlined
def link_terms(w: Array, x: Array, y: Array, m: int, s: Products, t: Terms) -> None:
    """Write the terms of the block of a link with m joints. w: (n,), its weights."""
    h = hx = hy = hxy = kx = ky = kxy = spread(0.0)
    for i in range(m):
        wv, wa, v, v2, a2 = w[i] * x[V, i], w[i] * x[A, i], x[V, i], y[V, i], y[A, i]
        h, hx, hy, hxy = h + wv * v2, hx + wa * v2, hy + wv * a2, hxy + wa * a2
        kx, ky = kx + v * s.left[m, i], ky + v2 * s.right[m, i]
        mixed_y, x_mixed = spread(0.0), spread(0.0)
        for j in range(m):
            mixed_y += s.mixed[i, j] * y[V, j]
            x_mixed += s.mixed[j, i] * x[V, j]
        t.mixed_y[i], t.x_mixed[i] = mixed_y, x_mixed
        kxy += v * mixed_y
    k = s.before[m]
    t.sums[H], t.sums[HX], t.sums[HY], t.sums[HXY] = h, hx, hy, hxy
    t.sums[KX], t.sums[KY], t.sums[KXY], t.sums[K] = kx, ky, kxy, k
    for i in range(m):
        wv, wa = 2.0 * w[i] * y[V, i], 2.0 * w[i] * y[A, i]
        t.alpha[i] = wa * k + wv * ky
        t.gamma[i] = wa * kx + wv * kxy - 2.0 * (hy * s.left[m, i] + h * t.mixed_y[i])
        t.rho[i] = hx * s.right[m, i] + h * t.x_mixed[i]


@inlined
def add_block(w: Array, x: Array, y: Array, m: int, s: Products, t: Terms, out: Array) -> None:
    """Add the block (6), (n, n)."""
    square, diagonal = t.sums[H] * t.sums[H], _diagonal(t)
    for i in range(m):
        alpha, gamma, wv2 = t.alpha[i], t.gamma[i], 2.0 * w[i] * y[V, i]
        for j in range(m):
            wv, wa = w[j] * x[V, j], w[j] * x[A, j]
            out[i, j] += alpha * wa + gamma * wv - wv2 * t.rho[j] + square * s.mixed[i, j]
        out[i, i] += 2.0 * w[i] * diagonal


@inlined
def _diagonal(t: Terms) -> Lanes:
    """Return K ḣ' + A h' + B ḣ + C h."""
    s = t.sums
    diagonal: Lanes = s[K] * s[HXY] + s[KX] * s[HY] + s[KY] * s[HX] + s[KXY] * s[H]
    return diagonal


@inlined
def block_adjoint(
    w: Array, x: Array, y: Array, m: int, s: Products, t: Terms, dout: Array, d: TermsBack, dw: Array
) -> Given:
    """Return the derivatives by K, its slopes and H, given those by the block.

    Add the derivatives by the weights, (n,).
    """
    h, hx, hy, hxy, kx, ky, kxy, k = (
        t.sums[H], t.sums[HX], t.sums[HY], t.sums[HXY], t.sums[KX], t.sums[KY], t.sums[KXY], t.sums[K]
    )  # fmt: skip
    diagonal, square = _diagonal(t), h * h
    dh = dhx = dhy = dhxy = dkx = dky = dkxy = dk = dsquare = spread(0.0)
    for i in range(m):
        d.rho[i] = spread(0.0)
    for i in range(m):
        v2, a2, w2 = y[V, i], y[A, i], 2.0 * w[i]
        alpha, gamma, by_wv2, wv2 = spread(0.0), spread(0.0), spread(0.0), w2 * y[V, i]
        for j in range(m):
            g = dout[i, j]
            alpha += g * (w[j] * x[A, j])
            gamma += g * (w[j] * x[V, j])
            by_wv2 -= g * t.rho[j]
            d.rho[j] -= g * wv2
            dsquare += g * s.mixed[i, j]
            dw[j] += g * (t.alpha[i] * x[A, j] + t.gamma[i] * x[V, j])
        own = dout[i, i]
        dw[i] += 2.0 * (a2 * (k * alpha + kx * gamma) + v2 * (ky * alpha + kxy * gamma + by_wv2) + own * diagonal)
        own, alpha = w2 * own, w2 * alpha
        by_left, gamma = 2.0 * gamma, w2 * gamma
        dk += a2 * alpha + own * hxy
        dkx += a2 * gamma + own * hy
        dky += v2 * alpha + own * hx
        dkxy += v2 * gamma + own * h
        dhxy += own * k
        dhy += own * kx - by_left * s.left[m, i]
        dhx += own * ky
        dh += own * kxy - by_left * t.mixed_y[i]
        d.left[i] = spread(0.0) - hy * by_left
        d.mixed_y[i] = spread(0.0) - h * by_left
    for i in range(m):
        dhx += d.rho[i] * s.right[m, i]
        dh += d.rho[i] * t.x_mixed[i]
    dh += 2.0 * h * dsquare
    for i in range(m):
        v, a, v2, a2 = x[V, i], x[A, i], y[V, i], y[A, i]
        dw[i] += v2 * (dh * v + dhx * a) + a2 * (dhy * v + dhxy * a)
        d.left[i] += dkx * v
        d.right[i] = dky * v2 + hx * d.rho[i]
        d.mixed_y[i] += dkxy * v
        d.rho[i] = h * d.rho[i]  # from here on the derivative by Hᵀv
    for i in range(m):
        mixed_y, v = d.mixed_y[i], x[V, i]
        for j in range(m):
            d.mixed[i, j] = square * dout[i, j] + mixed_y * y[V, j] + v * d.rho[j]
    return Given(dk, d.left, d.right, d.mixed)
