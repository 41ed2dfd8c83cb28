"""What the functions of the compiled LIP kernel work on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.compiled.compile import compiled

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

PAIRS = 64
"""Pairs of samples evaluated together: long enough to fill vectors, short enough for a core's own cache."""

F, G, DF, DG, V, A = range(6)  # what a sample knows of each joint: p's two factors, their derivatives, dq and ddq
VALUE, LEFT, RIGHT, MIXED = range(4)  # p, ∂p/∂q, ∂p/∂q', ∂²p/∂q∂q' of one joint, as in `polynomial.BaseKernels`
# Numbers of one link and pair, in the names of `energy.kinetic_blocks`: h, ḣ, h', ḣ', A, B, C, K and h²
H, HX, HY, HXY, KX, KY, KXY, K, HH = range(9)


class Scratch(NamedTuple):
    """Memory of one block of pairs, allocated once; the last axis counts the pairs."""

    block: Array  # (6, n, ·) what the column samples know
    base: Array  # (n, 4, ·) p_b and derivatives
    power: Array  # (n, 4, ·) p_b² and derivatives
    before: Array  # (n + 1, ·) product of the joints before b
    after: Array  # (n + 1, ·) product of the joints from b on
    left: Array  # (n + 1, n, ·) derivatives by q_i of `before`, [b, i]
    right: Array  # (n + 1, n, ·) derivatives by q'_j of `before`, [b, j]
    mixed: Array  # (n, n, ·) mixed derivatives of the product of all joints: the H of `energy.kinetic_blocks`
    terms: Array  # (9, ·)
    x_mixed: Array  # (n, ·) Hᵀv
    mixed_y: Array  # (n, ·) H v'
    alpha: Array  # (n, ·) factor of w_j a_j in block [i, j]
    gamma: Array  # (n, ·) factor of w_j v_j
    rho: Array  # (n, ·) ḣ ∂'K + h Hᵀv, which −2 w_i v'_i multiplies
    total: Array  # (n, n, ·) the block of the Gram matrix, or its adjoint


class Adjoints(NamedTuple):
    """Derivatives of the weighted sum by what `Scratch` holds, and what the reverse recursion remembers."""

    base: Array  # (n, 4, ·) by the factors of a product
    value: Array  # (·)
    left: Array  # (n, ·) by the derivatives of the whole product
    right: Array  # (n, ·)
    mixed: Array  # (n, n, ·)
    left_before: Array  # (n, ·) by the derivatives of the product of the first joints
    right_before: Array  # (n, ·)
    partial: Array  # (n + 1, ·) the weighted sum of derivatives over the first b joints alone
    new_right: Array  # (n, ·) Σ_{i<b} adjoint of H_ib · ∂_i before
    new_left: Array  # (n, ·) Σ_{j<b} adjoint of H_bj · ∂'_j before
    terms: Array  # (9, ·)
    row: Array  # (3, ·) by alpha, gamma and −2 w v' of one joint
    rho: Array  # (n, ·)


@compiled
def scratch(n: int) -> Scratch:
    """Memory for n joints."""
    return Scratch(
        np.empty((6, n, PAIRS)),
        np.empty((n, 4, PAIRS)),
        np.empty((n, 4, PAIRS)),
        np.empty((n + 1, PAIRS)),
        np.empty((n + 1, PAIRS)),
        np.empty((n + 1, n, PAIRS)),
        np.empty((n + 1, n, PAIRS)),
        np.empty((n, n, PAIRS)),
        np.empty((9, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, n, PAIRS)),
    )


@compiled
def adjoints(n: int) -> Adjoints:
    """Memory for n joints."""
    return Adjoints(
        np.empty((n, 4, PAIRS)),
        np.empty(PAIRS),
        np.empty((n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n + 1, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((n, PAIRS)),
        np.empty((9, PAIRS)),
        np.empty((3, PAIRS)),
        np.empty((n, PAIRS)),
    )


@compiled
def features(q: Array, v: Array, a: Array, prismatic: Flags) -> Array:
    """f, g, f', g', v, a of every sample and joint: (N, 6, n)."""
    samples, n = q.shape
    x = np.empty((samples, 6, n))
    for i in range(samples):
        for b in range(n):
            straight, cos, sin = prismatic[b], np.cos(q[i, b]), np.sin(q[i, b])
            x[i, F, b] = q[i, b] if straight else cos
            x[i, G, b] = 0.0 if straight else sin
            x[i, DF, b] = 1.0 if straight else -sin
            x[i, DG, b] = 0.0 if straight else cos
            x[i, V, b] = v[i, b]
            x[i, A, b] = a[i, b]
    return x
