"""Loops over pairs of samples for both kernels: one sample of the first argument with LANES of the second at a time.

All work memory is one flat array, in this order: the samples of the second argument (`joints.columns`), the
hyperparameters, a query if there is one, the block of the Gram matrix, and any other memory of the kernel.

A kernel consists of four functions, which are arguments of the functions here:

    lay_work(m, at, n)                         memory for LANES pairs, their block first; and its end
    lay_back(m, at, n)                         memory for the adjoint, and its end
    covariance(hyper, x, y, work)              computes the block of row sample x, (6, n), with columns y, (6, n) Lanes
    adjoint(hyper, x, y, work, back, dhyper)   adds the derivatives of Σ block ∘ covariance by the hyperparameters
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from lipcore.kernels.fast.compile import inlined, template
from lipcore.kernels.fast.joints import Array, Flags, read
from lipcore.kernels.fast.lanes import LANES
from lipcore.kernels.fast.views import lay, numbers

Function = Callable[..., Any]


class Hyper(NamedTuple):
    """Hyperparameters, or the sums of the derivatives by them in Lanes."""

    shares: Array  # (E, n, 3) σ, α and β of each joint, for E kernels of positions
    scales: Array  # (n,) s_l of the potential
    weights: Array  # (n, n) w_{l,a} in the lower triangle


@template
def work_size(lay_work: Function, lay_back: Function, n: int) -> int:
    """Return the number of elements to work in, for n joints."""
    m = np.empty(1)
    end: int = lay_back(m, lay_work(m, 0, n)[1], n)[1]
    return end


@template
def gram(
    lay_work: Function, covariance: Function, m: Array, kernels: int, x: Array, symmetric: bool, out: Array
) -> None:
    """Write the covariance of torque i of sample k with torque j of sample l, (N, n, M, n) at (k, i, l, j), (N·m)².

    m: work memory, see above; kernels: E of `Hyper`; x: (N, 6, n), rows; symmetric: whether both arguments are the same
    samples, which halves the work and makes the result exactly symmetric.
    """
    rows, n, size = out.shape[0], out.shape[1], out.shape[2]
    blocks = (size + LANES - 1) // LANES
    hyper, at = _hyperparameters(m, blocks, kernels, n)
    block, work = numbers(m, at, (n, n, LANES)), lay_work(m, at, n)[0]
    # columns are the outer loop, so that mirrored blocks follow each other in memory
    for number in range(blocks):
        y, start = _columns(m, number, n), number * LANES
        for k in range(min(rows, start + LANES) if symmetric else rows):
            covariance(hyper, x[k], y, work)
            for lane in range(max(0, k - start) if symmetric else 0, min(LANES, size - start)):
                for i in range(n):
                    for j in range(n):
                        out[k, i, start + lane, j] = block[i, j, lane]
                        if symmetric:
                            out[start + lane, j, k, i] = block[i, j, lane]


@template
def gradient(
    lay_work: Function,
    lay_back: Function,
    adjoint: Function,
    m: Array,
    kernels: int,
    x: Array,
    weight: Array,
    sums: Array,
) -> None:
    """Add the derivatives of Σ weight ∘ gram(x, x) by the hyperparameters to `sums`, LANES numbers of each to add up.

    weight: (N, n, N, n), symmetric; other arguments as in `gram`.
    """
    rows, n = x.shape[0], x.shape[2]
    blocks = (rows + LANES - 1) // LANES
    hyper, at = _hyperparameters(m, blocks, kernels, n)
    block, (work, at) = numbers(m, at, (n, n, LANES)), lay_work(m, at, n)
    back, dhyper = lay_back(m, at, n)[0], Hyper(*lay(sums, 0, ((kernels, n, 3), (n,), (n, n)))[0])
    for number in range(blocks):
        y, start = _columns(m, number, n), number * LANES
        for k in range(min(rows, start + LANES)):
            _read(weight, k, start, block)
            adjoint(hyper, x[k], y, work, back, dhyper)


@template
def cross(
    lay_work: Function, covariance: Function, m: Array, kernels: int, prismatic: Flags, motions: Array, out: Array
) -> None:
    """Write the covariances of `Cross.fill_many`.

    m: work memory with the inducing samples, and space for one more column: the query.
    """
    size, n = out.shape[1] - 1, out.shape[2]
    blocks = size // LANES + 1
    hyper, at = _hyperparameters(m, blocks, kernels, n)
    x, at = numbers(m, at, (6, n)), at + 6 * n
    block, work = numbers(m, at, (n, n, LANES)), lay_work(m, at, n)[0]
    last = numbers(m, (blocks - 1) * 6 * n * LANES, (6, n, LANES))
    for query in range(motions.shape[0]):
        read(motions[query], prismatic, x)
        for c in range(6):
            for b in range(n):
                last[c, b, size % LANES] = x[c, b]
        for number in range(blocks):
            covariance(hyper, x, _columns(m, number, n), work)
            start = number * LANES
            for lane in range(min(LANES, size + 1 - start)):
                for j in range(n):
                    for i in range(n):
                        out[query, start + lane, j, i] = block[i, j, lane]
        symmetrise(out[query, size])


@inlined
def symmetrise(block: Array) -> None:
    """Remove the rounding errors from a matrix that is symmetric except for them."""
    for i in range(block.shape[0]):
        for j in range(i):
            block[i, j] = block[j, i] = 0.5 * (block[i, j] + block[j, i])


@inlined
def _hyperparameters(m: Array, blocks: int, kernels: int, n: int) -> tuple[Hyper, int]:
    shares = blocks * 6 * n * LANES
    scales = shares + 3 * kernels * n
    weights = scales + n
    views = numbers(m, shares, (kernels, n, 3)), numbers(m, scales, (n,)), numbers(m, weights, (n, n))
    return Hyper(*views), weights + n * n


@inlined
def _columns(m: Array, number: int, n: int) -> Array:
    return lay(m, number * 6 * n * LANES, ((6, n),))[0][0]


@inlined
def _read(weight: Array, k: int, start: int, block: Array) -> None:
    """Write the weight of each element of a block in a sum over the symmetric Gram matrix.

    Lanes past its end or below its diagonal have zero weight. Those above the diagonal count twice.
    """
    n = block.shape[0]
    for lane in range(LANES):
        column = start + lane
        count = 0.0 if column < k or column >= weight.shape[2] else 1.0 if column == k else 2.0
        column = min(column, weight.shape[2] - 1)
        for i in range(n):
            for j in range(n):
                block[i, j, lane] = count * weight[k, i, column, j]
