"""Torque kernels from energy kernels: Lagrange's equations applied to both arguments, in closed form.

tau_i = d/dt(∂L/∂dq_i) − ∂L/∂q_i with L = T − V (TR2023-063). The functions accept any position kernel with its
derivatives, so all estimators built on energies share them. The velocity weights w_{l,a} of the links' kinetic energies
are pooled, so that few data cannot overfit them.
"""

from __future__ import annotations

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from lipcore.data.motion import Array
from lipcore.kernels.arrays import on_diagonal
from lipcore.kernels.base import Params, State
from lipcore.kernels.polynomial import Product


def potential_blocks(position: Product) -> Array:
    """Return the torque covariance of V with kernel K(q, q'), ∂²K/∂q_i∂q'_j, (n, n, *batch)."""
    return position.mixed


def kinetic_blocks(position: Product, weights: Array, x: State, y: State) -> Array:
    """Return the torque covariance of T with kernel K(q, q') h², h = Σ_a w_a v_a v'_a, (n, n, *batch).

    Primes mark the second argument. With A = Σ ∂_iK v_i, B = Σ ∂'_jK v'_j, C = vᵀHv' (each contains the factor K), H
    the mixed derivatives, ḣ, h', ḣ' the time derivatives of h along the first, second and both arguments:

        2 (w a')(K w a + A w v)ᵀ + 2 (w v')(B w a + C w v − ḣ ∂'K − h Hᵀv)ᵀ − 2 (h' ∂K + h H v')(w v)ᵀ
        + h² H + 2 diag(w (K ḣ' + A h' + B ḣ + C h))

    weights: (n,), the velocity weights w of this link; x, y: the same n joints. The formula uses ∂K and H instead of
    the logarithmic derivatives ∂K / K, so that K may be zero.
    """
    n = weights.shape[0]
    w = weights.reshape((n,) + (1,) * (x.q.ndim - 1))
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
    return block + on_diagonal(diagonal)


def potential_energy_torque(position: Product) -> Array:
    """Return the covariance of V at x with its torque j at y, ∂K/∂q'_j, (n, *batch)."""
    return position.right


def kinetic_energy_torque(position: Product, weights: Array, x: State, y: State) -> Array:
    """Return the covariance of T at x with its torque j at y, 2 (B h + K h') w v − h² ∂'K, (n, *batch)."""
    w = weights.reshape((weights.shape[0],) + (1,) * (x.q.ndim - 1))
    wv = w * x.v
    h, h2 = (wv * y.v).sum(0), (wv * y.a).sum(0)
    b = (position.right * y.v).sum(0)
    return 2 * (b * h + position.value * h2) * wv - h * h * position.right


PRIOR_STD = {
    "kinetic.log_scale": 2.0,
    "kinetic.log_link": 1.0,
    "kinetic.log_joint": 0.5,
    "kinetic.log_gap": 0.7,
    "kinetic.log_deviation": 0.4,
}
"""Prior standard deviations, tuned on fits to rich simulated data of a Panda and a Kinova.

Weights differ by orders of magnitude between links, but little within a link.
"""


def velocity_weights(params: Params, n: int) -> Array:
    """Return the lower triangular (n, n) matrix of w_{l,a} with log w_{l,a} = s + s_l + u_a + g_{l−a} + δ_{l,a}.

    - `kinetic.log_scale` (): s;
    - `kinetic.log_link` (n,): s_l;
    - `kinetic.log_joint` (n,): u_a;
    - `kinetic.log_gap` (n,): g, the growth of levers with the number of joints in between;
    - `kinetic.log_deviation` (n (n+1) / 2,): δ, specific to a link and a joint.

    If the data hardly determine a weight, its neighbours do. Fitted alone it would become zero, and the model
    overconfident.
    """
    scale, gap, deviation = (params[f"kinetic.log_{name}"] for name in ("scale", "gap", "deviation"))
    xp = array_namespace(scale)
    lower, between, number = (xp.asarray(each) for each in _triangle(n))
    pattern = params["kinetic.log_link"][:, None] + params["kinetic.log_joint"] + scale
    log_weights = pattern + (xp.take(gap, between) + xp.take(deviation, number)).reshape((n, n))
    return xp.where(lower, xp.exp(log_weights), xp.zeros_like(log_weights))


def velocity_adjoint(weights: Array, slopes: Array) -> dict[str, Array]:
    """Return the derivatives by the hyperparameters of `velocity_weights`, given those by the weights; both (n, n)."""
    n = len(weights)
    logs = np.tril(weights * slopes)
    return {
        "kinetic.log_scale": np.asarray(logs.sum()),
        "kinetic.log_link": logs.sum(1),
        "kinetic.log_joint": logs.sum(0),
        "kinetic.log_gap": np.array([np.trace(logs, -apart) for apart in range(n)]),
        "kinetic.log_deviation": logs[np.tril_indices(n)],
    }


def _triangle(n: int) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """Return the mask l ≥ a, (n, n), and two flat index arrays, (n²,).

    The first array is |l − a|. The second is the number of (l, a) among the pairs with l ≥ a, and 0 for other pairs.
    """
    link, joint = np.indices((n, n))
    number = np.zeros((n, n), np.int64)
    number[np.tril_indices(n)] = np.arange(n * (n + 1) // 2)
    return link >= joint, np.abs(link - joint).reshape(-1), number.reshape(-1)


def initial_weights(tau: Array) -> dict[str, Array]:
    """Start with the inertia of a typical arm of this torque, divided equally between the links. tau: (N, n)."""
    n, torque = tau.shape[1], np.sqrt(np.square(tau).mean(0).clip(1e-12))
    return {
        # 0.1 kg·m² per N·m: m d² over m g d, for an arm of length d about a metre
        "kinetic.log_scale": np.asarray(np.log(0.1 * torque.max() / n)),
        **{f"kinetic.log_{name}": np.zeros(n) for name in ("link", "joint", "gap")},
        "kinetic.log_deviation": np.zeros(n * (n + 1) // 2),
    }
