"""Compiled mean and features of the torque that is learnt beside the arm (see `ResidualKernel`).

Centres are stored LANES at a time, roots as `triangles` says.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.fast.compile import compiled, inlined
from lipcore.kernels.fast.joints import Array
from lipcore.kernels.fast.lanes import LANES, spread, widened
from lipcore.kernels.fast.triangles import HEIGHT, multiply_triangle, triangle_size
from lipcore.kernels.fast.views import lay

Indices = NDArray[np.int64]

FAR = 160.0
"""Squared distance, in lengthscales, from which on the correlation is constant: exp(−80)."""


def pack_centres(centres: Array) -> NDArray[np.float32]:
    """Return centres, (m, D), with the last repeated to fill the Lanes: (G, D, LANES), flat."""
    padded = np.pad(centres, ((0, -len(centres) % LANES), (0, 0)), mode="edge" if len(centres) else "constant")
    return padded.reshape(-1, LANES, centres.shape[1]).transpose(0, 2, 1).reshape(-1).astype(np.float32)


@compiled
def residual_torque(
    rates: Array,
    centres: NDArray[np.float32],
    starts: Indices,
    weights: Array,
    roots: Array,
    sizes: Indices,
    prior: Array,
    taken: Array,
    sign_width: float,
    motions: Array,
    features: Array,
    begin: int,
    mean: Array,
    beyond: Array,
) -> None:
    """Write the prior means of N queries, (N, n), their features, and the variance that these leave, (N, n).

    rates: (n, 4 n), one over each joint's lengthscales; centres: of all joints, as of `pack_centres`;
    starts: (n + 1,), where they begin, in Lanes; weights: of all joints, N·m, with zeros to fill the Lanes; roots: of
    all joints, as of `answer.pack`; sizes: (n,), their numbers of rows; prior: (n,), variance without data; taken:
    (n,), see `JointResidual`; motions: (N, …, n); features: (N, …, n), written from row `begin` on, each joint's after
    those of the joints before it.
    """
    n, total = prior.shape[0], np.sum(sizes)
    x, near = np.empty(4 * n), np.empty(LANES * max(1, np.max(starts[1:] - starts[:-1])))
    learnt = np.empty(np.max(sizes) + HEIGHT)
    for query in range(motions.shape[0]):
        root, at = 0, begin
        features[query, begin : begin + total] = 0.0
        for joint in range(n):
            for other in range(n):
                for part in range(3):
                    x[part * n + other] = motions[query, part, other] * rates[joint, part * n + other]
                x[3 * n + other] = np.tanh(motions[query, 1, other] / sign_width) * rates[joint, 3 * n + other]
            first, groups = starts[joint], starts[joint + 1] - starts[joint]
            _correlate(centres, first * 4 * n * LANES, x, groups, near)
            torque, nearest, explained = 0.0, 0.0, 0.0
            for centre in range(groups * LANES):
                torque += weights[first * LANES + centre] * near[centre]
                nearest = max(nearest, near[centre])
            multiply_triangle(roots, root, near, sizes[joint], learnt)
            for k in range(sizes[joint]):
                features[query, at + k, joint] = learnt[k]
                explained += learnt[k] * learnt[k]
            root, at = root + triangle_size(sizes[joint]), at + sizes[joint]
            mean[query, joint] = torque
            beyond[query, joint] = max(prior[joint] - explained, 0.0) * (1.0 - taken[joint] * nearest * nearest)


@inlined
def _correlate(centres: NDArray[np.float32], at: int, x: Array, groups: int, near: Array) -> None:
    """Write exp(−½ |x − z|²) for the centres z of `groups` Lanes, stored from `at` on."""
    size, (out,) = x.shape[0], lay(near, 0, ((groups,),))[0]
    for group in range(groups):
        one, two, three, four = spread(0.0), spread(0.0), spread(0.0), spread(0.0)
        for d in range(0, size, 4):
            a, b = widened(centres, at) - x[d], widened(centres, at + LANES) - x[d + 1]
            e, f = widened(centres, at + 2 * LANES) - x[d + 2], widened(centres, at + 3 * LANES) - x[d + 3]
            one, two, three, four = one + a * a, two + b * b, three + e * e, four + f * f
            at += 4 * LANES
        out[group] = (one + two) + (three + four)
    for centre in range(groups * LANES):
        # Taylor series of exp(−t / 4096), twelve times squared: without calls, the loop is compiled to SIMD
        t = min(near[centre], FAR) / 8192.0
        value = 1 - t * (1 - t / 2 * (1 - t / 3 * (1 - t / 4 * (1 - t / 5 * (1 - t / 6)))))
        for _ in range(12):
            value *= value
        near[centre] = value
