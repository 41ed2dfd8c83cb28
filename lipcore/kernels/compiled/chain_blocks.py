"""Kinetic energy of the chain: block of the Gram matrix from the sums of `chain_recursions`, and the way back."""

from __future__ import annotations

from lipcore.kernels.compiled.chain_data import LANES, Array, Four, Sums, Terms, Work
from lipcore.kernels.compiled.compile import compiled, inlined


@compiled
def kinetic_blocks(w: Array, v: Array, a: Array, v2: Array, a2: Array, work: Work) -> None:
    """Half the kinetic block of the Gram matrix."""
    _coupling(v, v2, work.base, work.sums, work.kinetic)
    for link in range(w.shape[0]):
        _link(link, w, v, a, v2, a2, work.base, work.sums, work.terms)
        _outer(link, work.terms, work.kinetic)


@compiled
def blocks_adjoint(w: Array, v: Array, a: Array, v2: Array, a2: Array, work: Work, back: Work, dw: Array) -> None:
    """Adds the derivatives by base kernels, sums and weights."""
    _coupling_adjoint(v, v2, work, back)
    _links_adjoint(w, v, a, v2, a2, work, back, dw)


@inlined
def _coupling(v: Array, v2: Array, base: Four, sums: Sums, out: Array) -> None:
    """The part of the block off the rank-one terms: `below`, `above` and `diagonal` of `ChainKernel`."""
    _, left, right, mixed = base
    (m, m1, m2, _), _, (s0, s1, s2, s12), c = sums
    for i in range(v.shape[0]):
        for t in range(LANES):
            out[i, i, t] = s12[i, i, t] + mixed[i, t] * c[i, i, t]
        for j in range(i):
            for t in range(LANES):
                cross, products = m[i - 1, j, t] * c[i, j, t], s0[i, j, t] * m[i - 1, j, t]
                second = s2[i, j, t] * m[i - 1, j, t] + s0[i, j, t] * m2[i - 1, j, t]
                inertia = v[j] * (mixed[i, t] * v2[i, t] * products + left[i, t] * second)
                out[i, j, t] = left[i, t] * right[j, t] * cross - inertia
            for t in range(LANES):
                cross, products = m[i - 1, j, t] * c[i, j, t], s0[i, j, t] * m[i - 1, j, t]
                first = s1[i, j, t] * m[i - 1, j, t] + s0[i, j, t] * m1[i - 1, j, t]
                inertia = v2[j, t] * (mixed[i, t] * v[i] * products + right[i, t] * first)
                out[j, i, t] = right[i, t] * left[j, t] * cross - inertia


@compiled
def _coupling_adjoint(v: Array, v2: Array, work: Work, back: Work) -> None:
    base, dbase, dout = work.base, back.base, back.kinetic
    for i in range(v.shape[0]):
        _diagonal_adjoint(base[3], work.sums.c, dout, dbase[3], back.sums.s[3], back.sums.c, i)
        for j in range(i):
            _coupling_slopes(v, v2, base, work.sums, dout, dbase, i, j)
            _coupling_sums(v, v2, base, work.sums, dout, back.sums, i, j)


@inlined
def _diagonal_adjoint(mixed: Array, c: Array, dout: Array, dmixed: Array, ds12: Array, dc: Array, i: int) -> None:
    for t in range(LANES):
        ds12[i, i, t] += dout[i, i, t]
        dc[i, i, t] = dout[i, i, t] * mixed[i, t]
        dmixed[i, t] += dout[i, i, t] * c[i, i, t]


@inlined
def _coupling_slopes(v: Array, v2: Array, base: Four, sums: Sums, dout: Array, dbase: Four, i: int, j: int) -> None:
    """Derivatives by the slopes of the base kernels of joints i and j < i."""
    _, left, right, _ = base
    _, dleft, dright, dmixed = dbase
    (m, m1, m2, _), _, (s0, s1, s2, _), c = sums
    for t in range(LANES):
        cross, x, y = m[i - 1, j, t] * c[i, j, t], dout[i, j, t], dout[j, i, t]
        first = s1[i, j, t] * m[i - 1, j, t] + s0[i, j, t] * m1[i - 1, j, t]
        second = s2[i, j, t] * m[i - 1, j, t] + s0[i, j, t] * m2[i - 1, j, t]
        rate = x * v[j] * v2[i, t] + y * v2[j, t] * v[i]
        left_j, right_j = y * right[i, t] * cross, x * left[i, t] * cross
        dleft[i, t] += x * (right[j, t] * cross - v[j] * second)
        dright[i, t] += y * (left[j, t] * cross - v2[j, t] * first)
        dmixed[i, t] -= rate * s0[i, j, t] * m[i - 1, j, t]
        dleft[j, t] += left_j
        dright[j, t] += right_j


@inlined
def _coupling_sums(v: Array, v2: Array, base: Four, sums: Sums, dout: Array, dsums: Sums, i: int, j: int) -> None:
    """Derivatives by R, S and C."""
    _, left, right, mixed = base
    (m, m1, m2, _), _, (s0, s1, s2, _), c = sums
    (dm, dm1, dm2, _), _, (ds0, ds1, ds2, _), dc = dsums
    for t in range(LANES):
        x, y = dout[i, j, t], dout[j, i, t]
        slopes = x * left[i, t] * right[j, t] + y * right[i, t] * left[j, t]
        rate = mixed[i, t] * (x * v[j] * v2[i, t] + y * v2[j, t] * v[i])
        second, first = x * v[j] * left[i, t], y * v2[j, t] * right[i, t]
        dc[i, j, t] = slopes * m[i - 1, j, t]
        rest = rate * s0[i, j, t] + second * s2[i, j, t] + first * s1[i, j, t]
        dm[i - 1, j, t] += slopes * c[i, j, t] - rest
        dm1[i - 1, j, t] -= first * s0[i, j, t]
        dm2[i - 1, j, t] -= second * s0[i, j, t]
        ds0[i, j, t] -= rate * m[i - 1, j, t] + second * m2[i - 1, j, t] + first * m1[i - 1, j, t]
        ds1[i, j, t] -= first * m[i - 1, j, t]
        ds2[i, j, t] -= second * m[i - 1, j, t]


@inlined
def _link(link: int, w: Array, v: Array, a: Array, v2: Array, a2: Array, base: Four, sums: Sums, terms: Terms) -> None:
    """The vectors of one link's four rank-one terms e_k f_kᵀ."""
    _, left, right, mixed = base
    (r0, r1, r2, r12), (b0, b1, b2, _), _, _ = sums
    (e0, e1, e2, e3), (f0, f1, f2, f3) = terms
    for i in range(link + 1):
        wi, vi, ai = w[link, i], v[i], a[i]
        for s in range(LANES):
            g, g1, g2, g12 = wi * r0[link, i, s], wi * r1[link, i, s], wi * r2[link, i, s], wi * r12[link, i, s]
            h = r0[link, i, s] * b0[link, i, s]
            h1 = r1[link, i, s] * b0[link, i, s] + r0[link, i, s] * b1[link, i, s]
            h2 = r2[link, i, s] * b0[link, i, s] + r0[link, i, s] * b2[link, i, s]
            e0[i, s] = g1 * v2[i, s] - left[i, s] * h
            e1[i, s] = g1 * a2[i, s] + g12 * v2[i, s] - mixed[i, s] * v2[i, s] * h - left[i, s] * h2
            e2[i, s] = g * v2[i, s]
            e3[i, s] = g * a2[i, s] + g2 * v2[i, s]
            f0[i, s] = g2 * vi - right[i, s] * h
            f1[i, s] = g * vi
            f2[i, s] = g2 * ai + g12 * vi - mixed[i, s] * vi * h - right[i, s] * h1
            f3[i, s] = g * ai + g1 * vi


@inlined
def _outer(link: int, terms: Terms, out: Array) -> None:
    (e0, e1, e2, e3), (f0, f1, f2, f3) = terms
    for i in range(link + 1):
        for j in range(link + 1):
            for s in range(LANES):
                first = e0[i, s] * f0[j, s] + e1[i, s] * f1[j, s]
                out[i, j, s] += first + e2[i, s] * f2[j, s] + e3[i, s] * f3[j, s]


@compiled
def _links_adjoint(w: Array, v: Array, a: Array, v2: Array, a2: Array, work: Work, back: Work, dw: Array) -> None:
    for link in range(w.shape[0]):
        _link(link, w, v, a, v2, a2, work.base, work.sums, work.terms)
        _outer_adjoint(link, work.terms, back.kinetic, back.terms)
        for i in range(link + 1):
            _link_velocity(link, i, w[link, i], v[i], a[i], v2, a2, work.sums.r, back.terms, back.sums.r, dw)
            _link_position(link, i, v[i], v2, work.base, work.sums, back.terms, back.base, back.sums)


@inlined
def _outer_adjoint(link: int, terms: Terms, dout: Array, dterms: Terms) -> None:
    (e0, e1, e2, e3), (f0, f1, f2, f3) = terms
    (de0, de1, de2, de3), (df0, df1, df2, df3) = dterms
    for i in range(link + 1):
        for s in range(LANES):
            de0[i, s] = de1[i, s] = de2[i, s] = de3[i, s] = 0.0
            df0[i, s] = df1[i, s] = df2[i, s] = df3[i, s] = 0.0
        for j in range(link + 1):
            for s in range(LANES):
                de0[i, s] += dout[i, j, s] * f0[j, s]
                de1[i, s] += dout[i, j, s] * f1[j, s]
                de2[i, s] += dout[i, j, s] * f2[j, s]
                de3[i, s] += dout[i, j, s] * f3[j, s]
                df0[i, s] += dout[j, i, s] * e0[j, s]
                df1[i, s] += dout[j, i, s] * e1[j, s]
                df2[i, s] += dout[j, i, s] * e2[j, s]
                df3[i, s] += dout[j, i, s] * e3[j, s]


@inlined
def _link_velocity(
    link: int, i: int, w: float, v: float, a: float, v2: Array, a2: Array, r: Four, dterms: Terms, dr: Four, dw: Array
) -> None:
    """Adjoint of the terms of `_link` with w R v."""
    r0, r1, r2, r12 = r
    d0, d1, d2, d12 = dr
    (de0, de1, de2, de3), (df0, df1, df2, df3) = dterms
    for s in range(LANES):
        g = df1[i, s] * v + df3[i, s] * a + de2[i, s] * v2[i, s] + de3[i, s] * a2[i, s]
        g1 = df3[i, s] * v + de0[i, s] * v2[i, s] + de1[i, s] * a2[i, s]
        g2 = df0[i, s] * v + df2[i, s] * a + de3[i, s] * v2[i, s]
        g12 = df2[i, s] * v + de1[i, s] * v2[i, s]
        first = g * r0[link, i, s] + g1 * r1[link, i, s]
        dw[link, i, s] += first + g2 * r2[link, i, s] + g12 * r12[link, i, s]
        d0[link, i, s] += w * g
        d1[link, i, s] += w * g1
        d2[link, i, s] += w * g2
        d12[link, i, s] += w * g12


@inlined
def _link_position(
    link: int, i: int, v: float, v2: Array, base: Four, sums: Sums, dterms: Terms, dbase: Four, dsums: Sums
) -> None:
    """Adjoint of the terms of `_link` with ∂p R B."""
    _, left, right, mixed = base
    _, dleft, dright, dmixed = dbase
    (r0, r1, r2, _), (b0, b1, b2, _), _, _ = sums
    (dr0, dr1, dr2, _), (db0, db1, db2, _), _, _ = dsums
    (de0, de1, _, _), (df0, _, df2, _) = dterms
    for s in range(LANES):
        rate = de1[i, s] * v2[i, s] + df2[i, s] * v
        h = de0[i, s] * left[i, s] + df0[i, s] * right[i, s] + mixed[i, s] * rate
        h1, h2 = df2[i, s] * right[i, s], de1[i, s] * left[i, s]
        product = r0[link, i, s] * b0[link, i, s]
        first = r1[link, i, s] * b0[link, i, s] + r0[link, i, s] * b1[link, i, s]
        second = r2[link, i, s] * b0[link, i, s] + r0[link, i, s] * b2[link, i, s]
        dleft[i, s] -= de0[i, s] * product + de1[i, s] * second
        dright[i, s] -= df0[i, s] * product + df2[i, s] * first
        dmixed[i, s] -= rate * product
        dr0[link, i, s] -= h * b0[link, i, s] + h1 * b1[link, i, s] + h2 * b2[link, i, s]
        dr1[link, i, s] -= h1 * b0[link, i, s]
        dr2[link, i, s] -= h2 * b0[link, i, s]
        db0[link, i, s] -= h * r0[link, i, s] + h1 * r1[link, i, s] + h2 * r2[link, i, s]
        db1[link, i, s] -= h1 * r0[link, i, s]
        db2[link, i, s] -= h2 * r0[link, i, s]
