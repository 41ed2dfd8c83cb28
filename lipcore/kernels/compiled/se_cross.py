"""Cross covariances of `SquaredExponentialKernel`, compiled."""

from __future__ import annotations

import numpy as np

from lipcore.data.motion import Motion
from lipcore.kernels.compiled.compile import compiled, inlined
from lipcore.kernels.compiled.cross import Array
from lipcore.kernels.compiled.lane_cross import LANES, SIN, A, Flags, LaneCross, Lanes, V, place


class SquaredExponentialCross(LaneCross):
    """k_i = exp(log s_i² − ½ Σ_d (x_d − x'_d)² / ℓ_{i,d}²) of a query with every inducing sample.

    log_scales: (n,), log s²; lengthscales: (n, 3 n), ℓ by q, dq and ddq of every joint.
    """

    def __init__(self, inducing: Motion, log_scales: Array, lengthscales: Array) -> None:
        n = inducing.n_joints
        super().__init__(inducing, np.zeros(n, dtype=np.bool_), 1.0, joint_rows=4, sum_rows=1)
        self.log_scales = np.array(log_scales)
        self.factors = np.ascontiguousarray(-0.5 / lengthscales.reshape(n, 3, n) ** 2)

    def evaluate(self, motion: Array, lanes: Lanes, out: Array) -> None:
        """Compiled `fill`; lanes: the memory of this thread."""
        fill_se(motion, self.turning, self.log_scales, self.factors, lanes.samples, lanes.joints, out)


@compiled
def fill_se(
    motion: Array, turning: Flags, log_scales: Array, factors: Array, samples: Array, joints: Array, out: Array
) -> None:
    """Write the covariances of `motion` with all samples and itself into `out`; factors: (n, 3, n), −½ / ℓ²."""
    count = out.shape[0]
    place(motion, turning, 1.0, count - 1, samples)
    out[:] = 0.0
    for block in range(samples.shape[0]):
        start = block * LANES
        _exponents(motion, log_scales, factors, samples[block], joints)
        for lane in range(min(LANES, count - start)):
            for i in range(out.shape[1]):
                out[start + lane, i, i] = np.exp(joints[i, 3, lane])


@inlined
def _exponents(motion: Array, log_scales: Array, factors: Array, x: Array, joints: Array) -> None:
    """Squared differences of the inputs into the first three numbers of each joint, its exponent into the fourth."""
    n = joints.shape[0]
    for b in range(n):
        for k in range(LANES):
            joints[b, 0, k] = (x[b, SIN, k] - motion[0, b]) ** 2
            joints[b, 1, k] = (x[b, V, k] - motion[1, b]) ** 2
            joints[b, 2, k] = (x[b, A, k] - motion[2, b]) ** 2
            joints[b, 3, k] = log_scales[b]
    for i in range(n):
        for b in range(n):
            for k in range(LANES):
                joints[i, 3, k] += (
                    factors[i, 0, b] * joints[b, 0, k]
                    + factors[i, 1, b] * joints[b, 1, k]
                    + factors[i, 2, b] * joints[b, 2, k]
                )
