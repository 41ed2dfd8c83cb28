"""Planning and learning with a model as a function of batches: an example, not part of the package.

    answer = lipcore.export.function.function(lipcore.load("my-arm"))

The functions of `lipserve models export NAME FOLDER --format torch` and `--format jax` have the same arguments and
results: tau, tau_std = answer(q, dq, ddq).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import torch

Answer = Callable[..., tuple[Any, Any]]
EFFORT = 1e-4
"""Cost of the squared torque, 1/(N·m)², relative to the squared distance."""


def plan_motion(answer: Answer, q: Any, dq: Any, goal: Any, plan: Any, step_s: float = 0.05, samples: int = 128) -> Any:
    """Improve planned accelerations (H, n) towards a goal (n,) by one step of MPPI, in PyTorch.

    Torque is expensive, and so is its uncertainty: the plan stays near states of the training.
    """

    def cost(ddq: Any) -> Any:
        speed = dq + step_s * ddq.cumsum(0)
        position = q + step_s * speed.cumsum(0)
        tau, tau_std = answer(position, speed, ddq)
        return ((position - goal) ** 2).sum() + EFFORT * (tau**2 + tau_std**2).sum()

    tried = plan + torch.randn(samples, *plan.shape, dtype=plan.dtype)
    tried[0] = plan
    costs = torch.vmap(cost)(tried)
    share = torch.softmax((costs.min() - costs) / costs.std(), 0)
    return (share[:, None, None] * tried).sum(0)


def effort_slope(answer: Answer, q: Any, dq: Any, ddq: Any) -> Any:
    """Return the derivative of the effort Σ tau² by the accelerations, (N, n), in JAX with `jax_enable_x64`."""
    return jax.grad(lambda ddq: (answer(q, dq, ddq)[0] ** 2).sum())(ddq)


def residual_torque(answer: Answer, q: Any, dq: Any, ddq: Any, action: Any, factor: float = 3.0) -> Any:
    """Return the torque of a learnt policy, in PyTorch: the model's torque, changed where the model is uncertain.

    action: (n,), of the policy, -1 to 1. ddq: desired accelerations. The change is at most `factor` × tau_std.
    """
    tau, tau_std = answer(q, dq, ddq)
    return tau + factor * tau_std * action.clamp(-1.0, 1.0)
