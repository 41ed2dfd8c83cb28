"""Velocity weights w_{l,a} of the links' kinetic energies, pooled so that little data cannot overfit them."""

from __future__ import annotations

import torch
from torch import Tensor

from lipcore.kernels.base import Params

INERTIA_PER_TORQUE = 0.1
"""kg·m² per N·m: m d² over m g d, for an arm of length d about a metre."""
PRIOR_STD = {
    "kinetic.log_scale": 2.0,
    "kinetic.log_link": 1.0,
    "kinetic.log_joint": 0.5,
    "kinetic.log_gap": 0.7,
    "kinetic.log_deviation": 0.4,
}
"""Chosen on fits to rich simulated data of a Panda and a Kinova: weights differ by orders of magnitude between links,
and within a link by little."""


def velocity_weights(params: Params, n: int) -> Tensor:
    """Lower triangular (n, n) matrix of w_{l,a} with log w_{l,a} = s + s_l + u_a + g_{l−a} + δ_{l,a}.

    `kinetic.log_scale` (), `kinetic.log_link` (n,), `kinetic.log_joint` (n,), `kinetic.log_gap` (n,): how levers grow
    with the joints in between, and `kinetic.log_deviation` (n (n+1) / 2,): what is particular to a link and a joint. A
    weight that the data say little of is guessed from its neighbours instead of fitted to zero, which would make the
    model too sure of itself.
    """
    scale = params["kinetic.log_scale"]
    link, joint = torch.tril_indices(n, n, device=scale.device)
    log_weights = (
        scale
        + params["kinetic.log_link"][link]
        + params["kinetic.log_joint"][joint]
        + params["kinetic.log_gap"][link - joint]
        + params["kinetic.log_deviation"]
    )
    return torch.zeros((n, n), dtype=scale.dtype, device=scale.device).index_put((link, joint), torch.exp(log_weights))


def initial_weights(tau: Tensor) -> dict[str, Tensor]:
    """Inertia as arms have it that need as much torque, shared out between the links. tau: (N, n)."""
    n, torque = tau.shape[1], tau.square().mean(0).clamp_min(1e-12).sqrt()
    zeros = torch.zeros(n, dtype=tau.dtype, device=tau.device)
    return {
        "kinetic.log_scale": torch.log(INERTIA_PER_TORQUE * torque.max() / n),
        "kinetic.log_link": zeros,
        "kinetic.log_joint": zeros,
        "kinetic.log_gap": zeros,
        "kinetic.log_deviation": zeros.new_zeros(n * (n + 1) // 2),
    }
