"""Weighing whitened features by how well each torque is known, in one pass over them."""

from __future__ import annotations

import numpy as np

from lipcore.kernels.compiled.compile import compiled
from lipcore.kernels.compiled.cross import Array


@compiled
def weigh(
    features: Array, inducing: int, prior: Array, noise: Array, weights: Array, residual: Array, b: Array
) -> None:
    """Scale the features φ of N samples' torques by the square root of their precision, and add Σ φ R⁻¹ residual to b.

    R is the noise and what of the prior variance the first `inducing` features leave open, see `statistics.Statistics`.
    features: (N n, M), in place; prior: (N, n) variances of the nonlinear term; noise: (n,); weights: (N,);
    residual: (N, n); b: (M,).
    """
    count, n = prior.shape
    size = features.shape[1]
    for sample in range(count):
        for joint in range(n):
            row = features[sample * n + joint]
            explained = 0.0
            for k in range(inducing):
                explained += row[k] * row[k]
            precision = weights[sample] / (noise[joint] + max(prior[sample, joint] - explained, 0.0))
            root = np.sqrt(precision)
            said = precision * residual[sample, joint]
            for k in range(size):
                b[k] += said * row[k]
                row[k] *= root
