"""Base kernels of the chain's joints, and products of jets."""

from __future__ import annotations

from lipcore.kernels.compiled.chain_data import LANES, Array, Four
from lipcore.kernels.compiled.compile import inlined


@inlined
def unit_kernels(
    x1: Array, x2: Array, d1: Array, d2: Array, y1: Array, y2: Array, g1: Array, g2: Array, unit: Four
) -> None:
    """c = cos(q − q') or q q' and its derivatives."""
    c, left, right, mixed = unit
    for b in range(x1.shape[0]):
        for s in range(LANES):
            c[b, s] = x1[b] * y1[b, s] + x2[b] * y2[b, s]
            left[b, s] = d1[b] * y1[b, s] + d2[b] * y2[b, s]
            right[b, s] = x1[b] * g1[b, s] + x2[b] * g2[b, s]
            mixed[b, s] = d1[b] * g1[b, s] + d2[b] * g2[b, s]


@inlined
def share(unit: Four, alpha: Array, base: Four) -> None:
    """p = 1 − α + α c and its derivatives."""
    c, c_left, c_right, c_mixed = unit
    p, left, right, mixed = base
    for b in range(alpha.shape[0]):
        for s in range(LANES):
            p[b, s] = 1 - alpha[b] + alpha[b] * c[b, s]
            left[b, s] = alpha[b] * c_left[b, s]
            right[b, s] = alpha[b] * c_right[b, s]
            mixed[b, s] = alpha[b] * c_mixed[b, s]


@inlined
def share_adjoint(unit: Four, dbase: Four, dalpha: Array) -> None:
    """Adds the derivatives by α."""
    c, left, right, mixed = unit
    dp, dleft, dright, dmixed = dbase
    for b in range(dalpha.shape[0]):
        for s in range(LANES):
            slopes = dleft[b, s] * left[b, s] + dright[b, s] * right[b, s] + dmixed[b, s] * mixed[b, s]
            dalpha[b, s] += dp[b, s] * (c[b, s] - 1) + slopes


@inlined
def make_jet(base: Four, v: Array, v2: Array, jet: Four) -> None:
    """Jets of the base kernels."""
    p, left, right, mixed = base
    p0, p1, p2, p12 = jet
    for b in range(v.shape[0]):
        for s in range(LANES):
            p0[b, s] = p[b, s]
            p1[b, s] = left[b, s] * v[b]
            p2[b, s] = right[b, s] * v2[b, s]
            p12[b, s] = mixed[b, s] * v[b] * v2[b, s]


@inlined
def make_jet_adjoint(v: Array, v2: Array, djet: Four, dbase: Four) -> None:
    """Adds the derivatives by the base kernels."""
    dp, dleft, dright, dmixed = dbase
    dp0, dp1, dp2, dp12 = djet
    for b in range(v.shape[0]):
        for s in range(LANES):
            dp[b, s] += dp0[b, s]
            dleft[b, s] += dp1[b, s] * v[b]
            dright[b, s] += dp2[b, s] * v2[b, s]
            dmixed[b, s] += dp12[b, s] * v[b] * v2[b, s]


@inlined
def multiply(jet: Four, b: int, x: Four, k: int, m: int, out: Four, i: int, j: int) -> None:
    """out_{i,j} = p_b x_{k,m}, a product of jets."""
    p, p1, p2, p12 = jet
    x0, x1, x2, x12 = x
    out0, out1, out2, out12 = out
    for s in range(LANES):
        out0[i, j, s] = p[b, s] * x0[k, m, s]
        out1[i, j, s] = p[b, s] * x1[k, m, s] + p1[b, s] * x0[k, m, s]
        out2[i, j, s] = p[b, s] * x2[k, m, s] + p2[b, s] * x0[k, m, s]
        ends = p[b, s] * x12[k, m, s] + p12[b, s] * x0[k, m, s]
        out12[i, j, s] = ends + p1[b, s] * x2[k, m, s] + p2[b, s] * x1[k, m, s]


@inlined
def multiply_adjoint(
    jet: Four, djet: Four, b: int, x: Four, dx: Four, k: int, m: int, dout: Four, i: int, j: int
) -> None:
    """Adds the derivatives by both factors."""
    p, p1, p2, p12 = jet
    dp, dp1, dp2, dp12 = djet
    x0, x1, x2, x12 = x
    dx0, dx1, dx2, dx12 = dx
    d0, d1, d2, d12 = dout
    for s in range(LANES):
        t0, t1, t2, t12 = d0[i, j, s], d1[i, j, s], d2[i, j, s], d12[i, j, s]
        dp[b, s] += t0 * x0[k, m, s] + t1 * x1[k, m, s] + t2 * x2[k, m, s] + t12 * x12[k, m, s]
        dp1[b, s] += t1 * x0[k, m, s] + t12 * x2[k, m, s]
        dp2[b, s] += t2 * x0[k, m, s] + t12 * x1[k, m, s]
        dp12[b, s] += t12 * x0[k, m, s]
        dx0[k, m, s] += t0 * p[b, s] + t1 * p1[b, s] + t2 * p2[b, s] + t12 * p12[b, s]
        dx1[k, m, s] += t1 * p[b, s] + t12 * p2[b, s]
        dx2[k, m, s] += t2 * p[b, s] + t12 * p1[b, s]
        dx12[k, m, s] += t12 * p[b, s]


@inlined
def set_constant(out: Four, i: int, j: int, value: float) -> None:
    """A constant jet."""
    out0, out1, out2, out12 = out
    for s in range(LANES):
        out0[i, j, s] = value
        out1[i, j, s] = 0.0
        out2[i, j, s] = 0.0
        out12[i, j, s] = 0.0
