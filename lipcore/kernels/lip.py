"""The Lagrangian Inspired Polynomial kernel of the paper (eqs. 9, 11, 15 of TR2023-063)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lipcore.data.motion import Motion, check_joint_types
from lipcore.kernels.base import Params, State
from lipcore.kernels.compiled.kernel import CompiledKernel, Driver
from lipcore.kernels.compiled.lip import lip_cross, lip_gradient, lip_gram, lip_size
from lipcore.kernels.energy import (
    PRIOR_STD,
    initial_weights,
    kinetic_blocks,
    kinetic_energy_torque,
    potential_blocks,
    potential_energy_torque,
    velocity_weights,
)
from lipcore.kernels.polynomial import Derivatives, base_kernels, product
from lipcore.vocabulary import JointType


class LipKernel(CompiledKernel):
    """Potential energy over all joints plus one kinetic energy a link, each over the joints that move it.

    Hyperparameters: `potential.log_scale` (); `potential.logits` (n, 2); `kinetic.<i>.logits` (i, 2) of link i in 1..n;
    and those of `energy.velocity_weights`. Logits give each joint's shares (σ, α, β), which sum to one: the energies'
    scale lives in the scale and the weights alone. With `tied` all links share one `kinetic.logits` (n, 2): fewer
    parameters to overfit with; without, every link has its own as in the paper.
    """

    driver = Driver(lip_size, lip_gram, lip_gradient, lip_cross)

    def __init__(self, joint_types: Sequence[str], tied: bool = True) -> None:
        self.joint_types: tuple[JointType, ...] = check_joint_types(joint_types)
        self.n_joints = len(self.joint_types)
        self.tied = tied

    def blocks(self, params: Params, x: State, y: State) -> Tensor:
        """Covariance of torque i at x with torque j at y: (n, n, *batch), (N·m)²."""
        total = potential_blocks(self.potential(params, x, y))
        for link in range(1, self.n_joints + 1):
            kinetic = kinetic_blocks(
                self.kinetic(params, link, x, y),
                self.weights(params)[link - 1, :link],
                x.first(link),
                y.first(link),
            )
            total[:link, :link] += kinetic  # a link's kinetic energy loads only the joints before it
        return total

    def hyper(self, params: Params) -> tuple[Tensor, Tensor, Tensor]:
        """Shares of the kinetic energies, link by link or one for all, then the potential's: (n + 1 or 2, n, 3).

        Scales (n,), of which a product over all joints has the last alone; velocity weights (n, n).
        """
        potential, n = params["potential.logits"], self.n_joints
        if self.tied:
            logits = torch.stack([params["kinetic.logits"], potential])
        else:
            links = [params[f"kinetic.{link}.logits"] for link in range(1, n + 1)]
            logits = torch.stack(
                [torch.nn.functional.pad(each, (0, 0, 0, n - len(each))) for each in (*links, potential)]
            )
        scale = torch.exp(params["potential.log_scale"])
        scales = torch.nn.functional.pad(scale[None], (n - 1, 0))
        return shares(logits.reshape(-1, 2)).reshape(len(logits), n, 3), scales, self.weights(params)

    def potential(self, params: Params, x: State, y: State) -> Derivatives:
        """Kernel of the potential energy V and its derivatives."""
        base = base_kernels(shares(params["potential.logits"]), self.joint_types, x.q, y.q)
        return product(base, torch.exp(params["potential.log_scale"]))

    def kinetic(self, params: Params, link: int, x: State, y: State) -> Derivatives:
        """Position factor of the kinetic energy kernel of `link` (1-based) and its derivatives."""
        logits = params["kinetic.logits"][:link] if self.tied else params[f"kinetic.{link}.logits"]
        base = base_kernels(shares(logits), self.joint_types[:link], x.q[:link], y.q[:link])
        return product(base.squared(), logits.new_ones(()))

    def energies(self, params: Params, x: State, y: State) -> Tensor:
        """Covariance of the kinetic and the potential energy at x with torque j at y: (2, n, *batch), J·N·m."""
        potential = potential_energy_torque(self.potential(params, x, y))
        kinetic = torch.zeros_like(potential)
        for link in range(1, self.n_joints + 1):
            weights = self.weights(params)[link - 1, :link]
            position = self.kinetic(params, link, x, y)
            kinetic[:link] += kinetic_energy_torque(position, weights, x.first(link), y.first(link))
        return torch.stack([kinetic, potential])

    def energy_covariance(self, params: Params, x: State, y: State) -> Tensor:
        """Covariance of the kinetic energies at x and y, Σ_l K_l h_l², and of the potential ones: (2, *batch), J²."""
        potential = self.potential(params, x, y).value
        kinetic = torch.zeros_like(potential)
        for link in range(1, self.n_joints + 1):
            weights = self.weights(params)[link - 1, :link].reshape((-1,) + (1,) * (x.q.dim() - 1))
            h = (weights * x.v[:link] * y.v[:link]).sum(0)
            kinetic = kinetic + self.kinetic(params, link, x, y).value * h * h
        return torch.stack([kinetic, potential])

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """Potential torques as large as the measured ones; inertia as arms have it that weigh as much."""
        n = self.n_joints
        power = tau.square().mean(0).clamp_min(1e-12)
        # a joint's potential torque grows with its share α or β: start them at the ratio of the torques
        ratio = torch.log((power / power.max()).clamp_min(1e-6))
        kinetic = {"kinetic.logits": n} if self.tied else {f"kinetic.{link}.logits": link for link in range(1, n + 1)}
        return {
            "potential.log_scale": torch.log(power.max() * 3),
            "potential.logits": torch.stack([ratio, ratio], dim=1),
            **{name: torch.zeros((size, 2), dtype=tau.dtype, device=tau.device) for name, size in kinetic.items()},
            **initial_weights(tau),
        }

    def weights(self, params: Params) -> Tensor:
        """Velocity weights w_{l,a} as a lower triangular matrix (n, n)."""
        return velocity_weights(params, self.n_joints)

    def prior_std(self) -> dict[str, float]:
        """Weights are pooled between links and joints; a share may stray far from its start."""
        return dict(PRIOR_STD)


def shares(logits: Tensor) -> Tensor:
    """Softmax of (0, logits): (n, 2) to the shares (σ, α, β) of each joint, (n, 3)."""
    zero = torch.zeros_like(logits[:, :1])
    return torch.softmax(torch.cat([zero, logits], dim=1), dim=1)
