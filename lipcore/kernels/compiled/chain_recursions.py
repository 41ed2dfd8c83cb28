"""Recursions along the chain (see `chain`): R and B of the head, S and C of the tail, and the way back."""

from __future__ import annotations

from lipcore.kernels.compiled.chain_base import multiply, multiply_adjoint, set_constant
from lipcore.kernels.compiled.chain_data import LANES, Array, Four, Sums, Work
from lipcore.kernels.compiled.compile import compiled, inlined


@inlined
def head(w: Array, v: Array, a: Array, v2: Array, a2: Array, jet: Four, sums: Sums) -> None:
    """R and B, from the base to the tip."""
    r, b, _, _ = sums
    for link in range(w.shape[0]):
        for j in range(link):
            multiply(jet, link, r, link - 1, j, r, link, j)
        set_constant(r, link, link, 1.0)
        set_constant(b, link, 0, 0.0)
        for i in range(link + 1):
            multiply(jet, i, b, link, i, b, link, i + 1)
            _add_velocity(w[link, i] * v[i], w[link, i] * a[i], v2, a2, i, b, link)


@inlined
def _add_velocity(wv: float, wa: float, v2: Array, a2: Array, i: int, b: Four, link: int) -> None:
    b0, b1, b2, b12 = b
    for s in range(LANES):
        b0[link, i + 1, s] += wv * v2[i, s]
        b1[link, i + 1, s] += wa * v2[i, s]
        b2[link, i + 1, s] += wv * a2[i, s]
        b12[link, i + 1, s] += wa * a2[i, s]


@compiled
def head_adjoint(w: Array, v: Array, a: Array, v2: Array, a2: Array, work: Work, back: Work, dw: Array) -> None:
    """Back through `head`: adds the derivatives by jets and weights."""
    jet, djet, (r, b, _, _), (dr, db, _, _) = work.jet, back.jet, work.sums, back.sums
    for link in range(w.shape[0] - 1, -1, -1):
        for i in range(link, -1, -1):
            _add_velocity_adjoint(v[i], a[i], v2, a2, i, db, link, dw)
            multiply_adjoint(jet, djet, i, b, db, link, i, db, link, i + 1)
        for j in range(link):
            multiply_adjoint(jet, djet, link, r, dr, link - 1, j, dr, link, j)


@inlined
def _add_velocity_adjoint(v: float, a: float, v2: Array, a2: Array, i: int, db: Four, link: int, dw: Array) -> None:
    d0, d1, d2, d12 = db
    for s in range(LANES):
        dv = d0[link, i + 1, s] * v2[i, s] + d2[link, i + 1, s] * a2[i, s]
        da = d1[link, i + 1, s] * v2[i, s] + d12[link, i + 1, s] * a2[i, s]
        dw[link, i, s] += dv * v + da * a


@inlined
def tail(w: Array, jet: Four, sums: Sums) -> None:
    """S and C, from the tip to the base."""
    _, b, s, c = sums
    n = w.shape[0]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1):
            if i + 1 < n:
                multiply(jet, i + 1, s, i + 1, j, s, i, j)
                _carry(jet[0], c, c, i, j)
            else:
                set_constant(s, i, j, 0.0)
                c[i, j] = 0.0
            _add_link(w[i, j], b, s, c, i, j)


@inlined
def _carry(p: Array, c_next: Array, c: Array, i: int, j: int) -> None:
    for s in range(LANES):
        c[i, j, s] = p[i + 1, s] * c_next[i + 1, j, s]


@inlined
def _add_link(w: float, b: Four, out: Four, c: Array, i: int, j: int) -> None:
    h, h1, h2, h12 = b
    out0, out1, out2, out12 = out
    for s in range(LANES):
        out0[i, j, s] += w * h[i, i + 1, s]
        out1[i, j, s] += w * h1[i, i + 1, s]
        out2[i, j, s] += w * h2[i, i + 1, s]
        out12[i, j, s] += w * h12[i, i + 1, s]
        c[i, j, s] += h[i, i + 1, s] * h[i, j, s]


@compiled
def tail_adjoint(w: Array, work: Work, back: Work, dw: Array) -> None:
    """Back through `tail`: adds the derivatives by jets, B and weights."""
    jet, djet, (_, b, s, c), (_, db, ds, dc) = work.jet, back.jet, work.sums, back.sums
    n = w.shape[0]
    for i in range(n):
        for j in range(i + 1):
            _add_link_adjoint(w[i, j], b[0], b, db, db[0], ds, dc, i, j, dw)
            if i + 1 < n:
                multiply_adjoint(jet, djet, i + 1, s, ds, i + 1, j, ds, i, j)
                _carry_adjoint(jet[0], djet[0], c, dc, dc, i, j)


@inlined
def _carry_adjoint(p: Array, dp: Array, c: Array, dc_next: Array, dc: Array, i: int, j: int) -> None:
    for s in range(LANES):
        dp[i + 1, s] += dc[i, j, s] * c[i + 1, j, s]
        dc_next[i + 1, j, s] += dc[i, j, s] * p[i + 1, s]


@inlined
def _add_link_adjoint(
    w: float, b0: Array, b: Four, db: Four, db0: Array, ds: Four, dc: Array, i: int, j: int, dw: Array
) -> None:
    # b0 and db0 are the first of b and db: their column j ≤ i is read and written here, h is column i + 1
    h, h1, h2, h12 = b
    dh, dh1, dh2, dh12 = db
    d0, d1, d2, d12 = ds
    for s in range(LANES):
        t0, t1, t2, t12 = d0[i, j, s], d1[i, j, s], d2[i, j, s], d12[i, j, s]
        first = t0 * h[i, i + 1, s] + t1 * h1[i, i + 1, s]
        dw[i, j, s] += first + t2 * h2[i, i + 1, s] + t12 * h12[i, i + 1, s]
        dh[i, i + 1, s] += t0 * w + dc[i, j, s] * b0[i, j, s]
        dh1[i, i + 1, s] += t1 * w
        dh2[i, i + 1, s] += t2 * w
        dh12[i, i + 1, s] += t12 * w
        db0[i, j, s] += dc[i, j, s] * h[i, i + 1, s]
