"""Cross covariances of `LagrangianSEKernel`, compiled; the closed form and its symbols are those of `kernels.lse`.

Primes mark the query. With h = sin((q − q')/2) and r = cos((q − q')/2) of a revolute joint, h = (q − q')/2 and r = 1 of
a prismatic one,

    log κ = −2 h² / ℓ²,   e = −2 h r / ℓ²,   d = −(1 − 2 t h²) / ℓ²,   t = 1 revolute, 0 prismatic

so that a pair needs no sine of its own: h and r follow from half the angles' sines and cosines.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lipcore.data.motion import Motion
from lipcore.kernels.compiled.compile import compiled, inlined
from lipcore.kernels.compiled.cross import Array
from lipcore.kernels.compiled.lane_cross import COS, LANES, SIN, A, Flags, LaneCross, Lanes, V, place, turning_joints

HALF = 0.5  # of an angle
G, E, D, LEFT, RIGHT, ROW, SCALED_G, SCALED_RIGHT = range(8)  # numbers a joint; the last four are factors of the block
LOG_K, RATE, RATE2, OMEGA, K = range(5)  # numbers a pair: log K, Λ, Λ', Ω, K


class LagrangianSECross(LaneCross):
    """Torque covariances under K = s² Π_b κ_b(q_b − q'_b) exp(−½ Σ_b c_b (v_b − v'_b)²) of a query with samples.

    log_scale: log s²; position, velocity: (n,), 1/ℓ² and c = 1/m².
    """

    def __init__(
        self, joint_types: Sequence[str], inducing: Motion, log_scale: float, position: Array, velocity: Array
    ) -> None:
        super().__init__(inducing, turning_joints(joint_types), HALF, joint_rows=8, sum_rows=5)
        self.log_scale = log_scale
        self.precisions = np.ascontiguousarray(np.stack([position, velocity], axis=1))

    def evaluate(self, motion: Array, lanes: Lanes, out: Array) -> None:
        """Compiled `fill`; lanes: the memory of this thread."""
        memory = (lanes.samples, lanes.joints, lanes.sums, lanes.block)
        fill_lse(motion, self.turning, self.log_scale, self.precisions, *memory, out)


@compiled
def fill_lse(
    motion: Array,
    turning: Flags,
    log_scale: float,
    precisions: Array,
    samples: Array,
    joints: Array,
    sums: Array,
    block: Array,
    out: Array,
) -> None:
    """Write the covariances of `motion` with all samples and itself into `out`; precisions: (n, 2), (1/ℓ², c)."""
    last, n = out.shape[0] - 1, out.shape[1]
    place(motion, turning, HALF, last, samples)
    query = samples[last // LANES, :, :, last % LANES]
    for number in range(samples.shape[0]):
        start = number * LANES
        _sums(turning, log_scale, precisions, samples[number], query, joints, sums)
        for k in range(LANES):
            sums[K, k] = np.exp(sums[LOG_K, k])
        _factors(precisions, samples[number], query, joints, sums)
        _block(precisions, query, joints, sums, block)
        for lane in range(min(LANES, last + 1 - start)):
            for i in range(n):
                for j in range(n):
                    out[start + lane, i, j] = block[i, j, lane]
    # the query with itself is symmetric but for rounding
    for i in range(n):
        for j in range(i):
            out[last, i, j] = out[last, j, i]


@inlined
def _sums(
    turning: Flags, log_scale: float, precisions: Array, x: Array, query: Array, joints: Array, sums: Array
) -> None:
    """g, e and d of each joint, and the sums over joints."""
    for k in range(LANES):
        sums[LOG_K, k] = log_scale
        sums[RATE, k] = 0.0
        sums[RATE2, k] = 0.0
        sums[OMEGA, k] = 0.0
    for b in range(joints.shape[0]):
        curved = 1.0 if turning[b] else 0.0
        sin, cos, v, a = query[b, SIN], query[b, COS], query[b, V], query[b, A]
        position, velocity = precisions[b, 0], precisions[b, 1]
        for k in range(LANES):
            h = x[b, SIN, k] * cos - x[b, COS, k] * sin
            r = x[b, COS, k] * cos + curved * (x[b, SIN, k] * sin)
            u = x[b, V, k] - v
            g, e, d = -velocity * u, -2.0 * position * h * r, -position * (1.0 - 2.0 * curved * h * h)
            joints[b, G, k] = g
            joints[b, E, k] = e
            joints[b, D, k] = d
            sums[LOG_K, k] += 0.5 * g * u - 2.0 * position * h * h
            sums[RATE, k] += e * x[b, V, k] + g * x[b, A, k]
            sums[RATE2, k] += e * v + g * a
            sums[OMEGA, k] += d * x[b, V, k] * v - velocity * x[b, A, k] * a


@inlined
def _factors(precisions: Array, x: Array, query: Array, joints: Array, sums: Array) -> None:
    """The vectors of the block's rank-one terms."""
    for b in range(joints.shape[0]):
        velocity, a = precisions[b, 1], query[b, A]
        for k in range(LANES):
            g, scale = joints[b, G, k], sums[K, k]
            right = velocity * a - sums[RATE2, k] * g
            joints[b, LEFT, k] = velocity * x[b, A, k] - sums[RATE, k] * g
            joints[b, RIGHT, k] = right
            joints[b, ROW, k] = (sums[OMEGA, k] - sums[RATE, k] * sums[RATE2, k]) * g + joints[b, D, k] * x[b, V, k]
            joints[b, SCALED_G, k] = scale * g
            joints[b, SCALED_RIGHT, k] = scale * right


@inlined
def _block(precisions: Array, query: Array, joints: Array, sums: Array, block: Array) -> None:
    n = joints.shape[0]
    for i in range(n):
        v, velocity = query[i, V], precisions[i, 1]
        for j in range(n):
            for k in range(LANES):
                block[i, j, k] = (
                    sums[K, k] * (joints[i, LEFT, k] + joints[i, E, k]) * (joints[j, RIGHT, k] - joints[j, E, k])
                    + joints[i, SCALED_RIGHT, k] * joints[j, LEFT, k]
                    + joints[i, SCALED_G, k] * joints[j, ROW, k]
                    - joints[i, D, k] * v * joints[j, SCALED_G, k]
                )
        for k in range(LANES):
            both = sums[OMEGA, k] + sums[RATE, k] * sums[RATE2, k]
            block[i, i, k] -= sums[K, k] * (both * velocity + joints[i, D, k])
