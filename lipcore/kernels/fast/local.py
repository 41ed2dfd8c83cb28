"""Compiled covariances of queries with the inducing samples, for the local kernel."""

from __future__ import annotations

import numpy as np

from lipcore.kernels.fast.compile import compiled
from lipcore.kernels.fast.joints import Array


@compiled
def local_cross(anchors: Array, rate: Array, scale: Array, sign_width: float, motions: Array, out: Array) -> None:
    """Write the covariances of `Cross.fill_many`. They equal the formula of `LocalKernel`.

    anchors: (S, 4 n), inputs of the inducing samples divided by their lengthscales; rate: (4 n,), inverse lengthscales;
    scale: (n,), s² (N·m)².
    """
    size, inputs, n = anchors.shape[0], anchors.shape[1], scale.shape[0]
    x = np.empty(inputs)
    for query in range(motions.shape[0]):
        for joint in range(n):
            for part in range(3):
                x[part * n + joint] = motions[query, part, joint] * rate[part * n + joint]
            x[3 * n + joint] = np.tanh(motions[query, 1, joint] / sign_width) * rate[3 * n + joint]
        out[query] = 0.0
        for sample in range(size + 1):
            near = 1.0
            if sample < size:
                distance = 0.0
                for at in range(inputs):
                    distance += (x[at] - anchors[sample, at]) ** 2
                near = np.exp(-0.5 * distance)
            for joint in range(n):
                out[query, sample, joint, joint] = scale[joint] * near
