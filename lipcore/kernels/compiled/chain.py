"""The serial-chain LIP kernel and the derivatives by its hyperparameters, compiled (see `ChainKernel` for the model).

One sample of the first argument meets LANES samples of the second at a time, and every statement runs over all of them:
arrays end in an axis of LANES pairs, which become the lanes of SIMD instructions.

A *jet* is a tuple of four arrays: a quantity, its time derivative along the first argument, along the second, and along
both. With p_b the jet of joint b's base kernel, three recursions over the links give all sums of the model:

    R_{l,a} = Π_{a<b≤l} p_b                       R_{l,a} = p_l R_{l-1,a},  R_{a,a} = 1
    B_{l,i} = Σ_{a<i} w_{l,a} v_a v'_a R_{i-1,a}  B_{l,i+1} = p_i B_{l,i} + w_{l,i} v_i v'_i,  h_l = B_{l,l+1}
    S_{i,j} = Σ_{l≥i} h_l R_{l,i} w_{l,j}         S_{i,j} = h_i w_{i,j} + p_{i+1} S_{i+1,j}
    C_{i,j} = Σ_{l≥i} h_l R_{l,i} B_{l,j}         C_{i,j} = h_i B_{i,j} + p_{i+1} C_{i+1,j}    (no derivatives needed)

The gradient goes backward through each of these statements. Functions that do so are named `..._adjoint`; the
derivative by a quantity x is called dx. Nothing is ever divided by p_b.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.compiled.chain_base import make_jet, make_jet_adjoint, share, share_adjoint, unit_kernels
from lipcore.kernels.compiled.chain_blocks import blocks_adjoint, kinetic_blocks
from lipcore.kernels.compiled.chain_data import LANES, Array, Hyper, Samples, Work, columns, samples, workspace
from lipcore.kernels.compiled.chain_potential import potential_adjoint, potential_blocks, products
from lipcore.kernels.compiled.chain_recursions import head, head_adjoint, tail, tail_adjoint
from lipcore.kernels.compiled.compile import compiled, inlined


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
    x, y = samples(q, v, a, prismatic), columns(samples(q2, v2, a2, prismatic))
    hyper = Hyper(alpha, weights, scales)
    n = q.shape[1]
    out = np.empty((len(q), n, len(q2), n))
    _gram(x, y, hyper, symmetric, workspace(n), out)
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
    x, y = samples(q, v, a, prismatic), columns(samples(q2, v2, a2, prismatic))
    hyper = Hyper(alpha, weights, scales)
    n = q.shape[1]
    sums = Hyper(*(np.zeros((*shape, LANES)) for shape in ((n,), (n, n), (n,))))
    _gradient(x, y, hyper, symmetric, workspace(n), workspace(n), np.ascontiguousarray(weight), sums)
    total = [part.sum(-1) for part in sums]
    return total[0], total[1], total[2]


@compiled
def _gram(x: Samples, y: Samples, hyper: Hyper, symmetric: bool, work: Work, out: Array) -> None:
    rows, size = out.shape[0], out.shape[2]
    # blocks of columns outside: the mirrored blocks then follow each other in memory
    for block in range(y.v.shape[0]):
        start = block * LANES
        for k in range(min(rows, start + LANES) if symmetric else rows):
            forward(x, k, y, block, hyper, work)
            kinetic_blocks(hyper.weights, x.v[k], x.a[k], y.v[block], y.a[block], work)
            first = max(0, k - start) if symmetric else 0
            _write(work.kinetic, work.potential.block, k, start, first, min(LANES, size - start), symmetric, out)


@compiled
def _gradient(
    x: Samples, y: Samples, hyper: Hyper, symmetric: bool, work: Work, back: Work, weight: Array, sums: Hyper
) -> None:
    rows, size = weight.shape[0], weight.shape[2]
    for block in range(y.v.shape[0]):
        start = block * LANES
        for k in range(min(rows, start + LANES) if symmetric else rows):
            v, a, v2, a2 = x.v[k], x.a[k], y.v[block], y.a[block]
            forward(x, k, y, block, hyper, work)
            _clear(back)
            first = max(0, k - start) if symmetric else 0
            _read(weight, k, start, first, min(LANES, size - start), symmetric, back.potential.block)
            back.kinetic[:] = 2 * back.potential.block
            potential_adjoint(work, back)
            sums.scales[:] += back.potential.after

            blocks_adjoint(hyper.weights, v, a, v2, a2, work, back, sums.weights)
            tail_adjoint(hyper.weights, work, back, sums.weights)
            head_adjoint(hyper.weights, v, a, v2, a2, work, back, sums.weights)
            make_jet_adjoint(v, v2, back.jet, back.base)
            share_adjoint(work.unit, back.base, sums.alpha)


@compiled
def forward(x: Samples, k: int, y: Samples, block: int, hyper: Hyper, work: Work) -> None:
    """Everything but the kinetic blocks, for sample k of x and one block of y."""
    v, a, v2, a2 = x.v[k], x.a[k], y.v[block], y.a[block]
    unit_kernels(x.x1[k], x.x2[k], x.d1[k], x.d2[k], y.x1[block], y.x2[block], y.d1[block], y.d2[block], work.unit)
    share(work.unit, hyper.alpha, work.base)
    products(work.base[0], hyper.scales, work.potential)
    potential_blocks(work.base, work.potential)
    make_jet(work.base, v, v2, work.jet)
    head(hyper.weights, v, a, v2, a2, work.jet, work.sums)
    tail(hyper.weights, work.jet, work.sums)


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
def _clear(back: Work) -> None:
    """Set to zero what the adjoints add to."""
    for k in range(4):
        back.base[k][:] = 0.0
        back.jet[k][:] = 0.0
        back.sums.r[k][:] = 0.0
        back.sums.b[k][:] = 0.0
        back.sums.s[k][:] = 0.0
    back.potential.before[:] = 0.0
    back.potential.after[:] = 0.0
