"""From energy kernels to torque kernels: Lagrange's equations applied to both arguments, in closed form.

tau_i = d/dt(∂L/∂dq_i) − ∂L/∂q_i with L = T − V (TR2023-063). Both functions take any position kernel with its
derivatives, so every estimator built on energies shares them, and the velocity weights w_{l,a} of the links' kinetic
energies, pooled so that little data cannot overfit them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lipcore.kernels.base import Params, State
from lipcore.kernels.polynomial import Derivatives


def potential_blocks(position: Derivatives) -> Tensor:
    """Torque covariance of V with kernel K(q, q'): ∂²K/∂q_i∂q'_j, (n, n, *batch)."""
    return position.mixed


def kinetic_blocks(position: Derivatives, weights: Tensor, x: State, y: State) -> Tensor:
    """Torque covariance of T with kernel K(q, q') h², h = Σ_a w_a v_a v'_a: (n, n, *batch).

    Primes mark the second argument. With A = Σ ∂_iK v_i, B = Σ ∂'_jK v'_j, C = vᵀHv' (each carries the factor K),
    H the mixed derivatives, ḣ, h', ḣ' the time derivatives of h along the first, second and both arguments:

        2 (w a')(K w a + A w v)ᵀ + 2 (w v')(B w a + C w v − ḣ ∂'K − h Hᵀv)ᵀ − 2 (h' ∂K + h H v')(w v)ᵀ
        + h² H + 2 diag(w (K ḣ' + A h' + B ḣ + C h))

    weights: (n,) velocity weights w of this link; x, y: the same n joints. Written with
    ∂K and H instead of the logarithmic derivatives ∂K / K, so that K may be zero.
    """
    n = weights.shape[0]
    w = weights.reshape((n,) + (1,) * (x.q.dim() - 1))
    k, left, right, mixed = position.value, position.left, position.right, position.mixed
    wv, wa, wv2, wa2 = w * x.v, w * x.a, w * y.v, w * y.a
    h, dh = (wv * y.v).sum(0), (wa * y.v).sum(0)
    h2, dh2 = (wv * y.a).sum(0), (wa * y.a).sum(0)
    mixed_y = (mixed * y.v).sum(1)
    x_mixed = (mixed * x.v[:, None]).sum(0)
    a, b, c = (left * x.v).sum(0), (right * y.v).sum(0), (x_mixed * y.v).sum(0)

    block = (2 * wa2)[:, None] * (k * wa + a * wv)
    block = block + (2 * wv2)[:, None] * (b * wa + c * wv - dh * right - h * x_mixed)
    block = block - (h2 * left + h * mixed_y)[:, None] * (2 * wv)
    block = block + (h * h) * mixed
    diagonal = (2 * w) * (k * dh2 + a * h2 + b * dh + c * h)
    return block + torch.diag_embed(diagonal.movedim(0, -1)).movedim((-2, -1), (0, 1))


def potential_energy_torque(position: Derivatives) -> Tensor:
    """Covariance of V at x with its torque j at y: ∂K/∂q'_j, (n, *batch)."""
    return position.right


def kinetic_energy_torque(position: Derivatives, weights: Tensor, x: State, y: State) -> Tensor:
    """Covariance of T at x with its torque j at y: 2 (B h + K h') w v − h² ∂'K, (n, *batch)."""
    w = weights.reshape((weights.shape[0],) + (1,) * (x.q.dim() - 1))
    wv = w * x.v
    h, h2 = (wv * y.v).sum(0), (wv * y.a).sum(0)
    b = (position.right * y.v).sum(0)
    return 2 * (b * h + position.value * h2) * wv - h * h * position.right


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
