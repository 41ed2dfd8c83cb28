"""Choosing few samples that tell much."""

from __future__ import annotations

import torch
from torch import Tensor

from lipcore.kernels.friction import friction_features
from lipcore.motion import Motion


def spread_out(motion: Motion, count: int) -> Tensor:
    """Indices of `count` samples that lie far from each other, sorted; all where there are no more.

    Farthest-point selection on (cos q, sin q, q − mean, dq, sign dq, ddq), each scaled to the motion's spread:
    every region of positions and every regime of speed that occurs is represented.
    """
    size = len(motion)
    if size <= count:
        return torch.arange(size, device=motion.device)
    angle = (motion.q - motion.q.mean(0)) / motion.q.std(0).clamp_min(1.0)
    features = torch.cat(
        [
            torch.cos(motion.q),
            torch.sin(motion.q),
            angle,
            motion.dq / motion.dq.std(0).clamp_min(1e-6),
            0.5 * friction_features(motion.dq)[1],
            motion.ddq / motion.ddq.std(0).clamp_min(1e-6),
        ],
        dim=1,
    )
    chosen = [int((features - features.mean(0)).square().sum(1).argmax())]
    distance = torch.full((size,), torch.inf, dtype=torch.float64, device=motion.device)
    while len(chosen) < count:
        distance = torch.minimum(distance, (features - features[chosen[-1]]).square().sum(1))
        distance[chosen] = -1.0  # a sample that repeats a chosen one is new, a chosen one is not
        chosen.append(int(distance.argmax()))
    return torch.tensor(sorted(chosen), device=motion.device)
