"""The serial-chain LIP kernel and the derivatives by its hyperparameters, compiled (see `chain` for the model).

One sample of the first argument meets LANES samples of the second at a time, and every statement runs over all of them:
arrays end in an axis of LANES pairs, which become the lanes of SIMD instructions.

A *jet* is a tuple of four arrays: a quantity, its time derivative along the first argument, along the second, and along
both. With p_b the jet of joint b's base kernel, three recursions over the links give all sums of the model:

    R_{l,a} = Π_{a<b≤l} p_b                       R_{l,a} = p_l R_{l-1,a},  R_{a,a} = 1
    B_{l,i} = Σ_{a<i} w_{l,a} v_a v'_a R_{i-1,a}  B_{l,i+1} = p_i B_{l,i} + w_{l,i} v_i v'_i,  h_l = B_{l,l+1}
    S_{i,j} = Σ_{l≥i} h_l R_{l,i} w_{l,j}         S_{i,j} = h_i w_{i,j} + p_{i+1} S_{i+1,j}
    C_{i,j} = Σ_{l≥i} h_l R_{l,i} B_{l,j}         C_{i,j} = h_i B_{i,j} + p_{i+1} C_{i+1,j}    (no derivatives needed)

The gradient goes backward through each of these statements. Functions that do so are named `_..._adjoint`; the
derivative by a quantity x is called dx. Nothing is ever divided by p_b.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.compile import compiled, inlined

Array = NDArray[np.float64]
Four = tuple[Array, Array, Array, Array]
"""A jet, or a base kernel as (p, ∂p/∂q, ∂p/∂q', ∂²p/∂q∂q')."""

LANES = 16
"""Pairs computed together. With 8, LLVM unrolls the loops over lanes instead of using SIMD; more outgrow the cache."""


class _Samples(NamedTuple):
    """One argument of the kernel. c = x·x' with x = (cos q, sin q) or (q, 0): x and dx/dq, then v and a."""

    x1: Array
    x2: Array
    d1: Array
    d2: Array
    v: Array
    a: Array


class _Hyper(NamedTuple):
    """Hyperparameters, or the sums of the derivatives by them, which have an axis of lanes more."""

    alpha: Array
    weights: Array
    scales: Array


class _Work(NamedTuple):
    """What the forward pass leaves for LANES pairs, or the derivatives by it. Last axis: lanes."""

    unit: Four  # base kernels for α = 1, (n,)
    base: Four  # of the kinetic energy, (n,)
    jet: Four  # of the kinetic energy, (n,)
    r: Four  # (n, n)
    b: Four  # (n, n + 1)
    s: Four  # (n, n)
    c: Array  # (n, n)
    e: Four  # of one link: e, e', u', u̇' in the notation of `chain`, (n,)
    f: Four  # of one link: f, u, ḟ, u̇, (n,)
    kinetic: Array  # half the kinetic block, (n, n)
    before: Array  # Π_{b<i} p_b, (n,)
    after: Array  # Σ_{l≥i} s_l Π_{i<b≤l} p_b, (n,)
    between: Array  # Π_{i<b<j} p_b, (n, n)
    potential: Array  # the potential block, (n, n)


def chain_gram(
    q: Array,
    v: Array,
    a: Array,
    q2: Array,
    v2: Array,
    a2: Array,
    prismatic: NDArray[np.bool_],
    alpha: Array,
    weights: Array,
    scales: Array,
    symmetric: bool,
) -> Array:
    """Covariance of torque i of sample k with torque j of sample m: (N, n, M, n) at (k, i, m, j), (N·m)².

    q, v, a: (N, n); q2, v2, a2: (M, n); prismatic: (n,), the other joints are revolute. Base kernels are
    1 − α + α cos(q − q') or 1 − α + α q q', α of each joint, (n,). weights: (n, n), w_{l,a} in the
    lower triangle; scales: (n,), s_l of the potential's Σ_l s_l Π_{b≤l} p_b. symmetric: both arguments are the same
    samples; half the work, exactly symmetric.
    """
    x, y = _samples(q, v, a, prismatic), _columns(_samples(q2, v2, a2, prismatic))
    hyper = _Hyper(alpha, weights, scales)
    n = q.shape[1]
    out = np.empty((len(q), n, len(q2), n))
    _gram(x, y, hyper, symmetric, _work(n), out)
    return out


def chain_gradient(
    q: Array,
    v: Array,
    a: Array,
    q2: Array,
    v2: Array,
    a2: Array,
    prismatic: NDArray[np.bool_],
    alpha: Array,
    weights: Array,
    scales: Array,
    symmetric: bool,
    weight: Array,
) -> tuple[Array, Array, Array]:
    """Derivative of Σ weight ∘ `chain_gram` by alpha, weights and scales.

    weight: (N, n, M, n); if symmetric, a symmetric matrix, and only pairs m ≥ k are computed.
    """
    x, y = _samples(q, v, a, prismatic), _columns(_samples(q2, v2, a2, prismatic))
    hyper = _Hyper(alpha, weights, scales)
    n = q.shape[1]
    sums = _Hyper(*(np.zeros((*shape, LANES)) for shape in ((n,), (n, n), (n,))))
    _gradient(x, y, hyper, symmetric, _work(n), _work(n), np.ascontiguousarray(weight), sums)
    total = [part.sum(-1) for part in sums]
    return total[0], total[1], total[2]


def _samples(q: Array, v: Array, a: Array, prismatic: NDArray[np.bool_]) -> _Samples:
    cos, sin = np.cos(q), np.sin(q)
    return _Samples(
        np.where(prismatic, q, cos),
        np.where(prismatic, 0.0, sin),
        np.where(prismatic, 1.0, -sin),
        np.where(prismatic, 0.0, cos),
        np.ascontiguousarray(v),
        np.ascontiguousarray(a),
    )


def _columns(samples: _Samples) -> _Samples:
    """Samples of the second argument, LANES at a time: (blocks, n, LANES); zeros fill the last block."""
    size, n = samples.v.shape
    blocks = -(-size // LANES)
    padded = np.zeros((6, blocks * LANES, n))
    padded[:, :size] = samples
    return _Samples(*np.ascontiguousarray(padded.reshape(6, blocks, LANES, n).swapaxes(2, 3)))


def _work(n: int) -> _Work:
    def zeros(*shape: int) -> Array:
        return np.zeros((*shape, LANES))

    def four(*shape: int) -> Four:
        return zeros(*shape), zeros(*shape), zeros(*shape), zeros(*shape)

    return _Work(
        unit=four(n),
        base=four(n),
        jet=four(n),
        r=four(n, n),
        b=four(n, n + 1),
        s=four(n, n),
        c=zeros(n, n),
        e=four(n),
        f=four(n),
        kinetic=zeros(n, n),
        before=zeros(n),
        after=zeros(n),
        between=zeros(n, n),
        potential=zeros(n, n),
    )


@compiled
def _gram(x: _Samples, y: _Samples, hyper: _Hyper, symmetric: bool, work: _Work, out: Array) -> None:
    rows, size = out.shape[0], out.shape[2]
    # blocks of columns outside: the mirrored blocks then follow each other in memory
    for block in range(y.v.shape[0]):
        start = block * LANES
        for k in range(min(rows, start + LANES) if symmetric else rows):
            _forward(x, k, y, block, hyper, work)
            _kinetic_blocks(hyper.weights, x.v[k], x.a[k], y.v[block], y.a[block], work)
            first = max(0, k - start) if symmetric else 0
            _write(work.kinetic, work.potential, k, start, first, min(LANES, size - start), symmetric, out)


@compiled
def _gradient(
    x: _Samples, y: _Samples, hyper: _Hyper, symmetric: bool, work: _Work, back: _Work, weight: Array, sums: _Hyper
) -> None:
    rows, size = weight.shape[0], weight.shape[2]
    for block in range(y.v.shape[0]):
        start = block * LANES
        for k in range(min(rows, start + LANES) if symmetric else rows):
            v, a, v2, a2 = x.v[k], x.a[k], y.v[block], y.a[block]
            _forward(x, k, y, block, hyper, work)
            _clear(back)
            first = max(0, k - start) if symmetric else 0
            _read(weight, k, start, first, min(LANES, size - start), symmetric, back.potential)
            back.kinetic[:] = 2 * back.potential
            _potential_adjoint(work.base, work.before, work.after, work.between, back)
            sums.scales[:] += back.after

            _coupling_adjoint(v, v2, work.base, work.r, work.s, work.c, back)
            _links_adjoint(hyper.weights, v, a, v2, a2, work, back, sums.weights)
            _tail_adjoint(hyper.weights, work, back, sums.weights)
            _head_adjoint(hyper.weights, v, a, v2, a2, work, back, sums.weights)
            _jet_adjoint(v, v2, back.jet, back.base)
            _share_adjoint(work.unit, back.base, sums.alpha)


@compiled
def _forward(x: _Samples, k: int, y: _Samples, block: int, hyper: _Hyper, work: _Work) -> None:
    """Everything but the kinetic blocks, for sample k of x and one block of y."""
    v, a, v2, a2 = x.v[k], x.a[k], y.v[block], y.a[block]
    _unit(x.x1[k], x.x2[k], x.d1[k], x.d2[k], y.x1[block], y.x2[block], y.d1[block], y.d2[block], work.unit)
    _share(work.unit, hyper.alpha, work.base)
    _products(work.base[0], hyper.scales, work.before, work.after, work.between)
    _potential_blocks(work.base, work.before, work.after, work.between, work.potential)
    _jet(work.base, v, v2, work.jet)
    _head(hyper.weights, v, a, v2, a2, work.jet, work.r, work.b)
    _tail(hyper.weights, work.jet, work.b, work.s, work.c)


@compiled
def _kinetic_blocks(w: Array, v: Array, a: Array, v2: Array, a2: Array, work: _Work) -> None:
    _coupling(v, v2, work.base, work.r, work.s, work.c, work.kinetic)
    for link in range(w.shape[0]):
        _link(link, w, v, a, v2, a2, work.base, work.r, work.b, work.e, work.f)
        _outer(link, work.e, work.f, work.kinetic)


@inlined
def _write(
    kinetic: Array, potential: Array, k: int, start: int, first: int, last: int, mirror: bool, out: Array
) -> None:
    n = kinetic.shape[0]
    for lane in range(first, last):
        for i in range(n):
            for j in range(n):
                value = 2 * kinetic[i, j, lane] + potential[i, j, lane]
                out[k, i, start + lane, j] = value
                if mirror:
                    out[start + lane, j, k, i] = value


@inlined
def _read(weight: Array, k: int, start: int, first: int, last: int, mirrored: bool, out: Array) -> None:
    """Weights of the pairs; zero for lanes that are no pair of their own, twice as much for two mirrored pairs."""
    n = out.shape[0]
    for lane in range(LANES):
        count = 0.0 if lane < first or lane >= last else 2.0 if mirrored and start + lane != k else 1.0
        column = min(start + lane, weight.shape[2] - 1)
        for i in range(n):
            for j in range(n):
                out[i, j, lane] = count * weight[k, i, column, j]


@compiled
def _clear(back: _Work) -> None:
    """Set to zero what the adjoints add to."""
    for k in range(4):
        back.base[k][:] = 0.0
        back.jet[k][:] = 0.0
        back.r[k][:] = 0.0
        back.b[k][:] = 0.0
        back.s[k][:] = 0.0
    back.before[:] = 0.0
    back.after[:] = 0.0


# Base kernels


@inlined
def _unit(x1: Array, x2: Array, d1: Array, d2: Array, y1: Array, y2: Array, g1: Array, g2: Array, unit: Four) -> None:
    """c = cos(q − q') or q q' and its derivatives."""
    c, left, right, mixed = unit
    for b in range(x1.shape[0]):
        for s in range(LANES):
            c[b, s] = x1[b] * y1[b, s] + x2[b] * y2[b, s]
            left[b, s] = d1[b] * y1[b, s] + d2[b] * y2[b, s]
            right[b, s] = x1[b] * g1[b, s] + x2[b] * g2[b, s]
            mixed[b, s] = d1[b] * g1[b, s] + d2[b] * g2[b, s]


@inlined
def _share(unit: Four, alpha: Array, base: Four) -> None:
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
def _share_adjoint(unit: Four, dbase: Four, dalpha: Array) -> None:
    c, left, right, mixed = unit
    dp, dleft, dright, dmixed = dbase
    for b in range(dalpha.shape[0]):
        for s in range(LANES):
            slopes = dleft[b, s] * left[b, s] + dright[b, s] * right[b, s] + dmixed[b, s] * mixed[b, s]
            dalpha[b, s] += dp[b, s] * (c[b, s] - 1) + slopes


@inlined
def _jet(base: Four, v: Array, v2: Array, jet: Four) -> None:
    p, left, right, mixed = base
    p0, p1, p2, p12 = jet
    for b in range(v.shape[0]):
        for s in range(LANES):
            p0[b, s] = p[b, s]
            p1[b, s] = left[b, s] * v[b]
            p2[b, s] = right[b, s] * v2[b, s]
            p12[b, s] = mixed[b, s] * v[b] * v2[b, s]


@inlined
def _jet_adjoint(v: Array, v2: Array, djet: Four, dbase: Four) -> None:
    dp, dleft, dright, dmixed = dbase
    dp0, dp1, dp2, dp12 = djet
    for b in range(v.shape[0]):
        for s in range(LANES):
            dp[b, s] += dp0[b, s]
            dleft[b, s] += dp1[b, s] * v[b]
            dright[b, s] += dp2[b, s] * v2[b, s]
            dmixed[b, s] += dp12[b, s] * v[b] * v2[b, s]


@inlined
def _multiply(jet: Four, b: int, x: Four, k: int, m: int, out: Four, i: int, j: int) -> None:
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
def _multiply_adjoint(
    jet: Four, djet: Four, b: int, x: Four, dx: Four, k: int, m: int, dout: Four, i: int, j: int
) -> None:
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
def _set(out: Four, i: int, j: int, value: float) -> None:
    """A constant jet."""
    out0, out1, out2, out12 = out
    for s in range(LANES):
        out0[i, j, s] = value
        out1[i, j, s] = 0.0
        out2[i, j, s] = 0.0
        out12[i, j, s] = 0.0


# Potential energy


@inlined
def _products(p: Array, scales: Array, before: Array, after: Array, between: Array) -> None:
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
def _potential_blocks(base: Four, before: Array, after: Array, between: Array, out: Array) -> None:
    """∂²K/∂q_i∂q'_j of K = Σ_l s_l Π_{b≤l} p_b."""
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
def _potential_adjoint(base: Four, before: Array, after: Array, between: Array, back: _Work) -> None:
    _potential_blocks_adjoint(
        base,
        before,
        after,
        between,
        back.potential,
        back.base,
        back.before,
        back.after,
        back.between,
    )
    _products_adjoint(base[0], before, after, between, back.before, back.after, back.between, back.base[0])


@inlined
def _potential_blocks_adjoint(
    base: Four,
    before: Array,
    after: Array,
    between: Array,
    dout: Array,
    dbase: Four,
    dbefore: Array,
    dafter: Array,
    dbetween: Array,
) -> None:
    _, left, right, mixed = base
    _, dleft, dright, dmixed = dbase
    for i in range(before.shape[0]):
        for s in range(LANES):
            dmixed[i, s] += dout[i, i, s] * before[i, s] * after[i, s]
            dbefore[i, s] += dout[i, i, s] * mixed[i, s] * after[i, s]
            dafter[i, s] += dout[i, i, s] * mixed[i, s] * before[i, s]
        for j in range(i + 1, before.shape[0]):
            _pair_adjoint(left, right, dleft, dright, before, after, between, dout, dbefore, dafter, dbetween, i, j)


@inlined
def _pair_adjoint(
    left: Array,
    right: Array,
    dleft: Array,
    dright: Array,
    before: Array,
    after: Array,
    between: Array,
    dout: Array,
    dbefore: Array,
    dafter: Array,
    dbetween: Array,
    i: int,
    j: int,
) -> None:
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
def _products_adjoint(
    p: Array,
    before: Array,
    after: Array,
    between: Array,
    dbefore: Array,
    dafter: Array,
    dbetween: Array,
    dp: Array,
) -> None:
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


# Kinetic energy: recursions along the chain


@inlined
def _head(w: Array, v: Array, a: Array, v2: Array, a2: Array, jet: Four, r: Four, b: Four) -> None:
    """R and B, from the base to the tip."""
    for link in range(w.shape[0]):
        for j in range(link):
            _multiply(jet, link, r, link - 1, j, r, link, j)
        _set(r, link, link, 1.0)
        _set(b, link, 0, 0.0)
        for i in range(link + 1):
            _multiply(jet, i, b, link, i, b, link, i + 1)
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
def _head_adjoint(w: Array, v: Array, a: Array, v2: Array, a2: Array, work: _Work, back: _Work, dw: Array) -> None:
    for link in range(w.shape[0] - 1, -1, -1):
        for i in range(link, -1, -1):
            _add_velocity_adjoint(v[i], a[i], v2, a2, i, back.b, link, dw)
            _multiply_adjoint(work.jet, back.jet, i, work.b, back.b, link, i, back.b, link, i + 1)
        for j in range(link):
            _multiply_adjoint(work.jet, back.jet, link, work.r, back.r, link - 1, j, back.r, link, j)


@inlined
def _add_velocity_adjoint(v: float, a: float, v2: Array, a2: Array, i: int, db: Four, link: int, dw: Array) -> None:
    d0, d1, d2, d12 = db
    for s in range(LANES):
        dv = d0[link, i + 1, s] * v2[i, s] + d2[link, i + 1, s] * a2[i, s]
        da = d1[link, i + 1, s] * v2[i, s] + d12[link, i + 1, s] * a2[i, s]
        dw[link, i, s] += dv * v + da * a


@inlined
def _tail(w: Array, jet: Four, b: Four, s: Four, c: Array) -> None:
    """S and C, from the tip to the base."""
    n = w.shape[0]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1):
            if i + 1 < n:
                _multiply(jet, i + 1, s, i + 1, j, s, i, j)
                _carry(jet[0], c, c, i, j)
            else:
                _set(s, i, j, 0.0)
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
def _tail_adjoint(w: Array, work: _Work, back: _Work, dw: Array) -> None:
    n = w.shape[0]
    for i in range(n):
        for j in range(i + 1):
            _add_link_adjoint(w[i, j], work.b[0], work.b, back.b, back.b[0], back.s, back.c, i, j, dw)
            if i + 1 < n:
                _multiply_adjoint(work.jet, back.jet, i + 1, work.s, back.s, i + 1, j, back.s, i, j)
                _carry_adjoint(work.jet[0], back.jet[0], work.c, back.c, back.c, i, j)


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


# Kinetic energy: blocks


@inlined
def _coupling(v: Array, v2: Array, base: Four, r: Four, s: Four, c: Array, out: Array) -> None:
    """The part of the block off the rank-one terms: `below`, `above` and `diagonal` of `chain`."""
    _, left, right, mixed = base
    m, m1, m2, _ = r
    s0, s1, s2, s12 = s
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
def _coupling_adjoint(v: Array, v2: Array, base: Four, r: Four, s: Four, c: Array, back: _Work) -> None:
    for i in range(v.shape[0]):
        _diagonal_adjoint(base[3], c, back.kinetic, back.base[3], back.s[3], back.c, i)
        for j in range(i):
            _coupling_slopes(v, v2, base, r, s, c, back.kinetic, back.base, i, j)
            _coupling_sums(v, v2, base, r, s, c, back.kinetic, back.r, back.s, back.c, i, j)


@inlined
def _diagonal_adjoint(mixed: Array, c: Array, dout: Array, dmixed: Array, ds12: Array, dc: Array, i: int) -> None:
    for t in range(LANES):
        ds12[i, i, t] += dout[i, i, t]
        dc[i, i, t] = dout[i, i, t] * mixed[i, t]
        dmixed[i, t] += dout[i, i, t] * c[i, i, t]


@inlined
def _coupling_slopes(
    v: Array, v2: Array, base: Four, r: Four, s: Four, c: Array, dout: Array, dbase: Four, i: int, j: int
) -> None:
    """Derivatives by the slopes of the base kernels of joints i and j < i."""
    _, left, right, _ = base
    _, dleft, dright, dmixed = dbase
    m, m1, m2, _ = r
    s0, s1, s2, _ = s
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
def _coupling_sums(
    v: Array,
    v2: Array,
    base: Four,
    r: Four,
    s: Four,
    c: Array,
    dout: Array,
    dr: Four,
    ds: Four,
    dc: Array,
    i: int,
    j: int,
) -> None:
    """Derivatives by R, S and C."""
    _, left, right, mixed = base
    m, m1, m2, _ = r
    s0, s1, s2, _ = s
    dm, dm1, dm2, _ = dr
    ds0, ds1, ds2, _ = ds
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
def _link(
    link: int, w: Array, v: Array, a: Array, v2: Array, a2: Array, base: Four, r: Four, b: Four, e: Four, f: Four
) -> None:
    """The vectors of one link's four rank-one terms e_k f_kᵀ."""
    _, left, right, mixed = base
    r0, r1, r2, r12 = r
    b0, b1, b2, _ = b
    e0, e1, e2, e3 = e
    f0, f1, f2, f3 = f
    for i in range(link + 1):
        wi, vi, ai = w[link, i], v[i], a[i]
        for s in range(LANES):
            g, g1, g2, g12 = wi * r0[link, i, s], wi * r1[link, i, s], wi * r2[link, i, s], wi * r12[link, i, s]
            h, h1, h2 = (
                r0[link, i, s] * b0[link, i, s],
                r1[link, i, s] * b0[link, i, s],
                r2[link, i, s] * b0[link, i, s],
            )
            h1, h2 = h1 + r0[link, i, s] * b1[link, i, s], h2 + r0[link, i, s] * b2[link, i, s]
            e0[i, s] = g1 * v2[i, s] - left[i, s] * h
            e1[i, s] = g1 * a2[i, s] + g12 * v2[i, s] - mixed[i, s] * v2[i, s] * h - left[i, s] * h2
            e2[i, s] = g * v2[i, s]
            e3[i, s] = g * a2[i, s] + g2 * v2[i, s]
            f0[i, s] = g2 * vi - right[i, s] * h
            f1[i, s] = g * vi
            f2[i, s] = g2 * ai + g12 * vi - mixed[i, s] * vi * h - right[i, s] * h1
            f3[i, s] = g * ai + g1 * vi


@inlined
def _outer(link: int, e: Four, f: Four, out: Array) -> None:
    e0, e1, e2, e3 = e
    f0, f1, f2, f3 = f
    for i in range(link + 1):
        for j in range(link + 1):
            for s in range(LANES):
                first = e0[i, s] * f0[j, s] + e1[i, s] * f1[j, s]
                out[i, j, s] += first + e2[i, s] * f2[j, s] + e3[i, s] * f3[j, s]


@compiled
def _links_adjoint(w: Array, v: Array, a: Array, v2: Array, a2: Array, work: _Work, back: _Work, dw: Array) -> None:
    for link in range(w.shape[0]):
        _link(link, w, v, a, v2, a2, work.base, work.r, work.b, work.e, work.f)
        _outer_adjoint(link, work.e, work.f, back.kinetic, back.e, back.f)
        for i in range(link + 1):
            _link_velocity(link, i, w[link, i], v[i], a[i], v2, a2, work.r, back.e, back.f, back.r, dw)
            _link_position(link, i, v[i], v2, work.base, work.r, work.b, back.e, back.f, back.base, back.r, back.b)


@inlined
def _outer_adjoint(link: int, e: Four, f: Four, dout: Array, de: Four, df: Four) -> None:
    e0, e1, e2, e3 = e
    f0, f1, f2, f3 = f
    de0, de1, de2, de3 = de
    df0, df1, df2, df3 = df
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
    link: int,
    i: int,
    w: float,
    v: float,
    a: float,
    v2: Array,
    a2: Array,
    r: Four,
    de: Four,
    df: Four,
    dr: Four,
    dw: Array,
) -> None:
    """Adjoint of the terms of `_link` with w R v."""
    r0, r1, r2, r12 = r
    d0, d1, d2, d12 = dr
    de0, de1, de2, de3 = de
    df0, df1, df2, df3 = df
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
    link: int,
    i: int,
    v: float,
    v2: Array,
    base: Four,
    r: Four,
    b: Four,
    de: Four,
    df: Four,
    dbase: Four,
    dr: Four,
    db: Four,
) -> None:
    """Adjoint of the terms of `_link` with ∂p R B."""
    _, left, right, mixed = base
    _, dleft, dright, dmixed = dbase
    r0, r1, r2, _ = r
    b0, b1, b2, _ = b
    dr0, dr1, dr2, _ = dr
    db0, db1, db2, _ = db
    de0, de1, _, _ = de
    df0, _, df2, _ = df
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
