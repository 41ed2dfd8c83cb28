"""Potential energy of the chain: block of the Gram matrix, and the way back."""

from __future__ import annotations

from lipcore.kernels.compiled.chain_data import LANES, Array, Four, Potential, Work
from lipcore.kernels.compiled.compile import compiled, inlined


@inlined
def products(p: Array, scales: Array, out: Potential) -> None:
    """The products of base kernels before, after and between joints."""
    before, after, between, _ = out
    n = p.shape[0]
    before[0] = 1.0
    after[n - 1] = scales[n - 1]
    for b in range(n - 1):
        for s in range(LANES):
            before[b + 1, s] = before[b, s] * p[b, s]
        for s in range(LANES):
            after[n - 2 - b, s] = scales[n - 2 - b] + after[n - 1 - b, s] * p[n - 1 - b, s]
        between[b, b + 1] = 1.0
        for j in range(b + 1, n - 1):
            for s in range(LANES):
                between[b, j + 1, s] = between[b, j, s] * p[j, s]


@inlined
def potential_blocks(base: Four, potential: Potential) -> None:
    """∂²K/∂q_i∂q'_j of K = Σ_l s_l Π_{b≤l} p_b."""
    before, after, between, out = potential
    _, left, right, mixed = base
    for i in range(before.shape[0]):
        for s in range(LANES):
            out[i, i, s] = before[i, s] * mixed[i, s] * after[i, s]
        for j in range(i + 1, before.shape[0]):
            for s in range(LANES):
                others = before[i, s] * between[i, j, s] * after[j, s]
                out[i, j, s] = left[i, s] * right[j, s] * others
            for s in range(LANES):
                others = before[i, s] * between[i, j, s] * after[j, s]
                out[j, i, s] = right[i, s] * left[j, s] * others


@compiled
def potential_adjoint(work: Work, back: Work) -> None:
    """Derivatives by the base kernels and, as those by `after`, by the scales, from those by the block."""
    _blocks_adjoint(work.base, work.potential, back.base, back.potential)
    _products_adjoint(work.base[0], work.potential, back.base[0], back.potential)


@inlined
def _blocks_adjoint(base: Four, potential: Potential, dbase: Four, dpotential: Potential) -> None:
    before, after, _, _ = potential
    dbefore, dafter, _, dout = dpotential
    mixed, dmixed = base[3], dbase[3]
    for i in range(before.shape[0]):
        for s in range(LANES):
            dmixed[i, s] += dout[i, i, s] * before[i, s] * after[i, s]
            dbefore[i, s] += dout[i, i, s] * mixed[i, s] * after[i, s]
            dafter[i, s] += dout[i, i, s] * mixed[i, s] * before[i, s]
        for j in range(i + 1, before.shape[0]):
            _pair_adjoint(base, potential, dbase, dpotential, i, j)


@inlined
def _pair_adjoint(base: Four, potential: Potential, dbase: Four, dpotential: Potential, i: int, j: int) -> None:
    _, left, right, _ = base
    _, dleft, dright, _ = dbase
    before, after, between, _ = potential
    dbefore, dafter, dbetween, dout = dpotential
    for s in range(LANES):
        upper, lower = dout[i, j, s], dout[j, i, s]
        ends, middle = before[i, s] * after[j, s], between[i, j, s]
        slopes = upper * left[i, s] * right[j, s] + lower * right[i, s] * left[j, s]
        dbetween[i, j, s] = slopes * ends
        dbefore[i, s] += slopes * middle * after[j, s]
        dafter[j, s] += slopes * middle * before[i, s]
        upper, lower = upper * ends * middle, lower * ends * middle
        left_i, right_i = upper * right[j, s], lower * left[j, s]
        left_j, right_j = lower * right[i, s], upper * left[i, s]
        dleft[i, s] += left_i
        dright[i, s] += right_i
        dleft[j, s] += left_j
        dright[j, s] += right_j


@inlined
def _products_adjoint(p: Array, potential: Potential, dp: Array, dpotential: Potential) -> None:
    before, after, between, _ = potential
    dbefore, dafter, dbetween, _ = dpotential
    n = p.shape[0]
    for b in range(n - 2, -1, -1):
        for j in range(n - 2, b, -1):
            for s in range(LANES):
                dp[j, s] += dbetween[b, j + 1, s] * between[b, j, s]
                dbetween[b, j, s] += dbetween[b, j + 1, s] * p[j, s]
        up = n - 1 - b
        for s in range(LANES):
            dp[b, s] += dbefore[b + 1, s] * before[b, s]
            dbefore[b, s] += dbefore[b + 1, s] * p[b, s]
        for s in range(LANES):
            dp[up, s] += dafter[up - 1, s] * after[up, s]
            dafter[up, s] += dafter[up - 1, s] * p[up, s]
