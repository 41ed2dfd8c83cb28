"""The samples in the layout of both kernels, and the joints' base kernels of two samples.

Each joint enters as x = (cos q, sin q), or as (q, 1) if it is prismatic. With the shares σ, α and β, its base kernel is
p = σ + α x₁ x₁' + β x₂ x₂' (docs/method.md, eqs. 4 and 10). The type of a joint is not needed after this. A prime marks
the second argument, one in each lane.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.fast.compile import compiled, inlined
from lipcore.kernels.fast.lanes import LANES, Lanes

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Four = tuple[Lanes, Lanes, Lanes, Lanes]
"""p, ∂p/∂q, ∂p/∂q' and ∂²p/∂q∂q', as in `polynomial.BaseKernels`; or a jet."""

F, G, DF, DG, V, A = range(6)  # rows of a sample: x₁, x₂, their derivatives, dq and ddq
VALUE, LEFT, RIGHT, MIXED = range(4)


@compiled
def read(motion: Array, prismatic: Flags, x: Array) -> None:
    """Write x₁, x₂, their derivatives, dq and ddq of each joint, (6, n), for a sample (3, n)."""
    for b in range(prismatic.shape[0]):
        q, straight = motion[0, b], prismatic[b]
        cos, sin = np.cos(q), np.sin(q)
        x[F, b] = q if straight else cos
        x[G, b] = 1.0 if straight else sin
        x[DF, b] = 1.0 if straight else -sin
        x[DG, b] = 0.0 if straight else cos
        x[V, b] = motion[1, b]
        x[A, b] = motion[2, b]


@compiled
def read_rows(motions: Array, prismatic: Flags) -> Array:
    """Return the rows of N samples, (N, 3, n) to (N, 6, n); see `read`."""
    x = np.empty((motions.shape[0], 6, motions.shape[2]))
    for k in range(motions.shape[0]):
        read(motions[k], prismatic, x[k])
    return x


def columns(x: Array, room: int) -> Array:
    """Return samples as second arguments, LANES at a time, (blocks, 6, n, LANES), with space for `room` more.

    Zeros fill the last block. x: (M, 6, n) of `read_rows`.
    """
    size, _, n = x.shape
    blocks = -(-(size + room) // LANES)
    padded = np.zeros((blocks * LANES, 6, n))
    padded[:size] = x
    return np.ascontiguousarray(padded.reshape(blocks, LANES, 6, n).transpose(0, 2, 3, 1))


@inlined
def base_kernels(shares: Array, x: Array, y: Array, base: Array) -> None:
    """Write p_b and its derivatives, (n, 4). shares: (n, 3), σ, α and β; x: (6, n); y: (6, n) Lanes."""
    for b in range(base.shape[0]):
        f, g, df, dg = shares[b, 1] * x[F, b], shares[b, 2] * x[G, b], shares[b, 1] * x[DF, b], shares[b, 2] * x[DG, b]
        base[b, VALUE] = shares[b, 0] + f * y[F, b] + g * y[G, b]
        base[b, LEFT] = df * y[F, b] + dg * y[G, b]
        base[b, RIGHT] = f * y[DF, b] + g * y[DG, b]
        base[b, MIXED] = df * y[DF, b] + dg * y[DG, b]


@inlined
def base_adjoint(x: Array, y: Array, b: int, d: Four, dshares: Array) -> None:
    """Add the derivatives by joint b's shares, (n, 3), given the derivatives by its base kernel."""
    value, left, right, mixed = d
    dshares[b, 0] += value
    dshares[b, 1] += y[F, b] * (x[F, b] * value + x[DF, b] * left) + y[DF, b] * (x[F, b] * right + x[DF, b] * mixed)
    dshares[b, 2] += y[G, b] * (x[G, b] * value + x[DG, b] * left) + y[DG, b] * (x[G, b] * right + x[DG, b] * mixed)


@inlined
def row(p: Array, b: int) -> Four:
    """Return row b of (n, 4)."""
    return p[b, 0], p[b, 1], p[b, 2], p[b, 3]


@inlined
def add_row(p: Array, b: int, d: Four) -> None:
    """Add to row b of (n, 4)."""
    p[b, 0] += d[0]
    p[b, 1] += d[1]
    p[b, 2] += d[2]
    p[b, 3] += d[3]
