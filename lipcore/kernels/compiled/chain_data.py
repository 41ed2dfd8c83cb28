"""What the functions of the compiled chain kernel work on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Four = tuple[Array, Array, Array, Array]
"""A jet, or a base kernel as (p, ∂p/∂q, ∂p/∂q', ∂²p/∂q∂q')."""

LANES = 16
"""Pairs computed together. With 8, LLVM unrolls the loops over lanes instead of using SIMD; more outgrow the cache."""


class Samples(NamedTuple):
    """One argument of the kernel. c = x·x' with x = (cos q, sin q) or (q, 0): x and dx/dq, then v and a."""

    x1: Array
    x2: Array
    d1: Array
    d2: Array
    v: Array
    a: Array


class Hyper(NamedTuple):
    """Hyperparameters, or the sums of the derivatives by them, which have an axis of lanes more."""

    alpha: Array
    weights: Array
    scales: Array


class Potential(NamedTuple):
    """The potential energy's part. Last axis: lanes."""

    before: Array  # Π_{b<i} p_b, (n,)
    after: Array  # Σ_{l≥i} s_l Π_{i<b≤l} p_b, (n,)
    between: Array  # Π_{i<b<j} p_b, (n, n)
    block: Array  # of the Gram matrix, (n, n)


class Sums(NamedTuple):
    """What the recursions along the chain compute, in the notation of `chain`. Last axis: lanes."""

    r: Four  # (n, n)
    b: Four  # (n, n + 1)
    s: Four  # (n, n)
    c: Array  # (n, n)


class Terms(NamedTuple):
    """Vectors of one link's rank-one terms Σ_k e_k f_kᵀ, in the notation of `ChainKernel`; (n,), last axis: lanes."""

    e: Four  # e, e', u', u̇'
    f: Four  # f, u, ḟ, u̇


class Work(NamedTuple):
    """What the forward pass leaves for LANES pairs, or the derivatives by it. Last axis: lanes."""

    unit: Four  # base kernels for α = 1, (n,)
    base: Four  # base kernels, (n,)
    jet: Four  # their jets, (n,)
    sums: Sums
    terms: Terms
    kinetic: Array  # half the kinetic block of the Gram matrix, (n, n)
    potential: Potential


def samples(q: Array, v: Array, a: Array, prismatic: NDArray[np.bool_]) -> Samples:
    """The first argument, from positions, velocities and accelerations (N, n); prismatic: (n,)."""
    cos, sin = np.cos(q), np.sin(q)
    return Samples(
        np.where(prismatic, q, cos),
        np.where(prismatic, 0.0, sin),
        np.where(prismatic, 1.0, -sin),
        np.where(prismatic, 0.0, cos),
        np.ascontiguousarray(v),
        np.ascontiguousarray(a),
    )


def columns(samples: Samples) -> Samples:
    """The second argument, LANES at a time: (blocks, n, LANES); zeros fill the last block."""
    size, n = samples.v.shape
    blocks = -(-size // LANES)
    padded = np.zeros((6, blocks * LANES, n))
    padded[:, :size] = samples
    return Samples(*np.ascontiguousarray(padded.reshape(6, blocks, LANES, n).swapaxes(2, 3)))


def workspace(n: int) -> Work:
    """Zeros for n joints."""

    def zeros(*shape: int) -> Array:
        return np.zeros((*shape, LANES))

    def four(*shape: int) -> Four:
        return zeros(*shape), zeros(*shape), zeros(*shape), zeros(*shape)

    return Work(
        unit=four(n),
        base=four(n),
        jet=four(n),
        sums=Sums(r=four(n, n), b=four(n, n + 1), s=four(n, n), c=zeros(n, n)),
        terms=Terms(e=four(n), f=four(n)),
        kinetic=zeros(n, n),
        potential=Potential(before=zeros(n), after=zeros(n), between=zeros(n, n), block=zeros(n, n)),
    )
