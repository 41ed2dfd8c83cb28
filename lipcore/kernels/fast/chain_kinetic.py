"""Kinetic energies of the chain: block of the Gram matrix, docs/method.md (11) summed over links, and its adjoint.

Each link has four rank-one terms. The other terms of all links are computed together, from the sums R, S and C of
`chain_sums`.
"""

from __future__ import annotations

from lipcore.kernels.fast.chain_sums import Sums
from lipcore.kernels.fast.compile import inlined
from lipcore.kernels.fast.joints import LEFT, MIXED, RIGHT, A, Array, Four, V
from lipcore.kernels.fast.lanes import Lanes, spread


@inlined
def couple(x: Array, y: Array, base: Array, sums: Sums, out: Array) -> None:
    """Write h X + h' Y + ḣ Z + ḣ' diag(c) of (11), summed over links: half of the block without its rank-one terms."""
    _, r, _, s, c = sums
    for i in range(base.shape[0]):
        left, right, mixed, v, v2 = base[i, LEFT], base[i, RIGHT], base[i, MIXED], x[V, i], y[V, i]
        out[i, i] = s[i, i, 3] + mixed * c[i, i]
        for j in range(i):
            m, s0 = r[i - 1, j, 0], s[i, j, 0]
            cross, product = m * c[i, j], mixed * s0 * m
            first, second = s[i, j, 1] * m + s0 * r[i - 1, j, 1], s[i, j, 2] * m + s0 * r[i - 1, j, 2]
            out[i, j] = left * base[j, RIGHT] * cross - x[V, j] * (v2 * product + left * second)
            out[j, i] = right * base[j, LEFT] * cross - y[V, j] * (v * product + right * first)


@inlined
def couple_adjoint(x: Array, y: Array, base: Array, sums: Sums, dout: Array, dbase: Array, d: Sums) -> None:
    """Add the derivatives by base kernels and sums, given those by the result of `couple`.

    It is the first to add to S and C.
    """
    _, r, _, s, c = sums
    for i in range(base.shape[0]):
        left, right, mixed, v, v2 = base[i, LEFT], base[i, RIGHT], base[i, MIXED], x[V, i], y[V, i]
        d.s[i, i, 3] += dout[i, i]
        d.c[i, i] += dout[i, i] * mixed
        dleft, dright, dmixed = spread(0.0), spread(0.0), dout[i, i] * c[i, i]
        for j in range(i):
            m, m1, m2, s0, s1, s2 = r[i - 1, j, 0], r[i - 1, j, 1], r[i - 1, j, 2], s[i, j, 0], s[i, j, 1], s[i, j, 2]
            below, above = dout[i, j], dout[j, i]
            below_v, above_v = below * x[V, j], above * y[V, j]
            cross, rate = m * c[i, j], below_v * v2 + above_v * v
            dleft += below * base[j, RIGHT] * cross - below_v * (s2 * m + s0 * m2)
            dright += above * base[j, LEFT] * cross - above_v * (s1 * m + s0 * m1)
            dmixed -= rate * s0 * m
            dbase[j, LEFT] += above * right * cross
            dbase[j, RIGHT] += below * left * cross
            slopes = below * left * base[j, RIGHT] + above * right * base[j, LEFT]
            rate, second, first = rate * mixed, below_v * left, above_v * right
            d.c[i, j] += slopes * m
            d.r[i - 1, j, 0] += slopes * c[i, j] - (rate * s0 + second * s2 + first * s1)
            d.r[i - 1, j, 1] -= first * s0
            d.r[i - 1, j, 2] -= second * s0
            d.s[i, j, 0] -= rate * m + second * m2 + first * m1
            d.s[i, j, 1] -= first * m
            d.s[i, j, 2] -= second * m
        dbase[i, LEFT] += dleft
        dbase[i, RIGHT] += dright
        dbase[i, MIXED] += dmixed


@inlined
def link_terms(link: int, weights: Array, x: Array, y: Array, base: Array, sums: Sums, e: Array, f: Array) -> None:
    """Write the vectors of one link's rank-one terms Σ_k e_k f_kᵀ: (e, e', u', u̇') and (f, u, ḟ, u̇), each (n, 4)."""
    _, r, b, _, _ = sums
    for i in range(link + 1):
        w, v, a, v2, a2 = weights[link, i], x[V, i], x[A, i], y[V, i], y[A, i]
        g, g1, g2, g12 = w * r[link, i, 0], w * r[link, i, 1], w * r[link, i, 2], w * r[link, i, 3]
        h, h1, h2 = _moved(link, i, r, b)
        left, right, mixed = base[i, LEFT], base[i, RIGHT], base[i, MIXED] * h
        e[i, 0] = g1 * v2 - left * h
        e[i, 1] = g1 * a2 + g12 * v2 - mixed * v2 - left * h2
        e[i, 2] = g * v2
        e[i, 3] = g * a2 + g2 * v2
        f[i, 0] = g2 * v - right * h
        f[i, 1] = g * v
        f[i, 2] = g2 * a + g12 * v - mixed * v - right * h1
        f[i, 3] = g * a + g1 * v


@inlined
def _moved(link: int, i: int, r: Array, b: Array) -> tuple[Lanes, Lanes, Lanes]:
    """Return ∂h_l/∂p_i = R_{l,i} B_{l,i} and its time derivatives along either argument."""
    r0, b0 = r[link, i, 0], b[link, i, 0]
    return r0 * b0, r[link, i, 1] * b0 + r0 * b[link, i, 1], r[link, i, 2] * b0 + r0 * b[link, i, 2]


@inlined
def add_terms(link: int, e: Array, f: Array, out: Array) -> None:
    """Add one link's Σ_k e_k f_kᵀ."""
    for i in range(link + 1):
        e0, e1, e2, e3 = e[i, 0], e[i, 1], e[i, 2], e[i, 3]
        for j in range(link + 1):
            out[i, j] += e0 * f[j, 0] + e1 * f[j, 1] + e2 * f[j, 2] + e3 * f[j, 3]


@inlined
def _terms_adjoint(link: int, i: int, e: Array, f: Array, dout: Array) -> tuple[Four, Four]:
    """Return the derivatives by row i of e and of f."""
    e0 = e1 = e2 = e3 = f0 = f1 = f2 = f3 = spread(0.0)
    for j in range(link + 1):
        d = dout[i, j]
        e0, e1, e2, e3 = e0 + d * f[j, 0], e1 + d * f[j, 1], e2 + d * f[j, 2], e3 + d * f[j, 3]
    for j in range(link + 1):
        d = dout[j, i]
        f0, f1, f2, f3 = f0 + d * e[j, 0], f1 + d * e[j, 1], f2 + d * e[j, 2], f3 + d * e[j, 3]
    return (e0, e1, e2, e3), (f0, f1, f2, f3)


@inlined
def link_adjoint(
    link: int,
    weights: Array,
    x: Array,
    y: Array,
    base: Array,
    sums: Sums,
    e: Array,
    f: Array,
    dout: Array,
    dbase: Array,
    d: Sums,
    dweights: Array,
) -> None:
    """Add the derivatives by base kernels, R, B and weights: the adjoint of `add_terms` and `link_terms`."""
    _, r, b, _, _ = sums
    for i in range(link + 1):
        (e0, e1, e2, e3), (f0, f1, f2, f3) = _terms_adjoint(link, i, e, f, dout)
        w, v, a, v2, a2 = weights[link, i], x[V, i], x[A, i], y[V, i], y[A, i]
        # derivatives by g = w R and its time derivatives
        g = f1 * v + f3 * a + e2 * v2 + e3 * a2
        g1 = f3 * v + e0 * v2 + e1 * a2
        g2 = f0 * v + f2 * a + e3 * v2
        rate = e1 * v2 + f2 * v
        dweights[link, i] += g * r[link, i, 0] + g1 * r[link, i, 1] + g2 * r[link, i, 2] + rate * r[link, i, 3]
        # derivatives by −∂h_l/∂p_i and its time derivatives
        left, right = base[i, LEFT], base[i, RIGHT]
        h, h1, h2 = e0 * left + f0 * right + base[i, MIXED] * rate, f2 * right, e1 * left
        moved, moved1, moved2 = _moved(link, i, r, b)
        dbase[i, LEFT] -= e0 * moved + e1 * moved2
        dbase[i, RIGHT] -= f0 * moved + f2 * moved1
        dbase[i, MIXED] -= rate * moved
        d.r[link, i, 0] += w * g - (h * b[link, i, 0] + h1 * b[link, i, 1] + h2 * b[link, i, 2])
        d.r[link, i, 1] += w * g1 - h1 * b[link, i, 0]
        d.r[link, i, 2] += w * g2 - h2 * b[link, i, 0]
        d.r[link, i, 3] += w * rate
        d.b[link, i, 0] -= h * r[link, i, 0] + h1 * r[link, i, 1] + h2 * r[link, i, 2]
        d.b[link, i, 1] -= h1 * r[link, i, 0]
        d.b[link, i, 2] -= h2 * r[link, i, 0]
