"""Cross covariances of `GeometricallyInspiredKernel`, compiled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lipcore.data.motion import Motion
from lipcore.kernels.compiled.compile import compiled, inlined
from lipcore.kernels.compiled.cross import Array
from lipcore.kernels.compiled.lane_cross import COS, LANES, SIN, A, Flags, LaneCross, Lanes, V, place, turning_joints

DYNAMIC, VELOCITY, POSITION = range(3)  # the sums and the product over joints that make up a torque's covariance


class GeometricallyInspiredCross(LaneCross):
    """The polynomial kernel of a query with every inducing sample.

    k_i = [c_i + Σ_a w_{i,a} ddq_a ddq'_a + (Σ_a u_{i,a} dq_a dq'_a)²] Π_b p_{i,b,1} p_{i,b,2}

    constants: (n,), c; inertias: (n, n), w; speeds: (n, n), u; shares: (n, n, 2, 3), (σ, α, β) of torque i × joint b ×
    factor.
    """

    def __init__(
        self,
        joint_types: Sequence[str],
        inducing: Motion,
        constants: Array,
        inertias: Array,
        speeds: Array,
        shares: Array,
    ) -> None:
        turning = turning_joints(joint_types)
        super().__init__(inducing, turning, 1.0, joint_rows=4, sum_rows=3)
        self.constants = np.ascontiguousarray(constants)
        self.weights = np.ascontiguousarray(np.stack([inertias, speeds], axis=-1))
        # α weighs the cosines, or q q' where the joint is prismatic; β the sines, or 1
        sigma, alpha, beta = np.moveaxis(shares, -1, 0)
        by_sin, by_cos = (np.where(turning[:, None], *pair) for pair in ((beta, alpha), (alpha, beta)))
        self.shares = np.ascontiguousarray(np.stack([sigma, by_sin, by_cos], axis=-1))

    def evaluate(self, motion: Array, lanes: Lanes, out: Array) -> None:
        """Compiled `fill`; lanes: the memory of this thread."""
        hyper = (self.turning, self.constants, self.weights, self.shares)
        fill_gip(motion, *hyper, lanes.samples, lanes.joints, lanes.sums, out)


@compiled
def fill_gip(
    motion: Array,
    turning: Flags,
    constants: Array,
    weights: Array,
    shares: Array,
    samples: Array,
    joints: Array,
    sums: Array,
    out: Array,
) -> None:
    """Write the covariances of `motion` with all samples and itself into `out`.

    weights: (n, n, 2), (w, u); shares: (n, n, 2, 3), of one, the SIN's product and the COS's.
    """
    last = out.shape[0] - 1
    place(motion, turning, 1.0, last, samples)
    query = samples[last // LANES, :, :, last % LANES]
    out[:] = 0.0
    for block in range(samples.shape[0]):
        start = block * LANES
        _products(samples[block], query, joints)
        for i in range(out.shape[1]):
            _torque(constants[i], weights[i], shares[i], joints, sums)
            for lane in range(min(LANES, last + 1 - start)):
                dynamic = sums[DYNAMIC, lane] + sums[VELOCITY, lane] ** 2
                out[start + lane, i, i] = dynamic * sums[POSITION, lane]


@inlined
def _products(x: Array, query: Array, joints: Array) -> None:
    for b in range(joints.shape[0]):
        for c in range(4):
            for k in range(LANES):
                joints[b, c, k] = x[b, c, k] * query[b, c]


@inlined
def _torque(constant: float, weights: Array, shares: Array, joints: Array, sums: Array) -> None:
    """The sums of one torque, from the products of what the samples know of each joint."""
    for k in range(LANES):
        sums[DYNAMIC, k] = constant
        sums[VELOCITY, k] = 0.0
        sums[POSITION, k] = 1.0
    for b in range(joints.shape[0]):
        for k in range(LANES):
            first = shares[b, 0, 0] + shares[b, 0, 1] * joints[b, SIN, k] + shares[b, 0, 2] * joints[b, COS, k]
            second = shares[b, 1, 0] + shares[b, 1, 1] * joints[b, SIN, k] + shares[b, 1, 2] * joints[b, COS, k]
            sums[POSITION, k] *= first * second
            sums[VELOCITY, k] += weights[b, 1] * joints[b, V, k]
            sums[DYNAMIC, k] += weights[b, 0] * joints[b, A, k]
