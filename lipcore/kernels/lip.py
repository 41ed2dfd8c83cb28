"""The Lagrangian Inspired Polynomial kernel of the paper (eqs. 9, 11, 15 of TR2023-063)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from array_api_compat import array_namespace

from lipcore.data.motion import Array, Motion, check_joint_types
from lipcore.kernels.arrays import of_all_joints
from lipcore.kernels.base import Params, State
from lipcore.kernels.energy import (
    PRIOR_STD,
    initial_weights,
    kinetic_blocks,
    kinetic_energy_torque,
    potential_blocks,
    potential_energy_torque,
    velocity_adjoint,
    velocity_weights,
)
from lipcore.kernels.fast.kernel import CompiledKernel, Driver
from lipcore.kernels.fast.lip import lip_cross, lip_gradient, lip_gram, lip_size
from lipcore.kernels.fast.pairs import Hyper
from lipcore.kernels.polynomial import Product, base_kernels
from lipcore.vocabulary import JointType


class LipKernel(CompiledKernel):
    """Potential energy over all joints, plus one kinetic energy for each link over the joints that move it.

    Hyperparameters:

    - `potential.log_scale` ();
    - `potential.logits` (n, 2);
    - `kinetic.<i>.logits` (i, 2) of link i in 1..n;
    - those of `energy.velocity_weights`.

    Logits give each joint's shares (σ, α, β), which sum to one: the scale of the energies is in the scale and the
    weights alone. If `tied`, all links share one `kinetic.logits` (n, 2), which overfits less. Otherwise every link has
    its own, as in the paper.
    """

    driver = Driver(lip_size, lip_gram, lip_gradient, lip_cross)

    def __init__(self, joint_types: Sequence[str], tied: bool = True) -> None:
        self.joint_types: tuple[JointType, ...] = check_joint_types(joint_types)
        self.n_joints = len(self.joint_types)
        self.tied = tied

    def blocks(self, params: Params, x: State, y: State) -> Array:
        """Return the covariance of torque i at x with torque j at y, (n, n, *batch) (N·m)²."""
        total = potential_blocks(self.potential(params, x, y))
        for link in range(1, self.n_joints + 1):
            kinetic = kinetic_blocks(
                self.kinetic(params, link, x, y),
                self.weights(params)[link - 1, :link],
                x.first(link),
                y.first(link),
            )
            # a link's kinetic energy loads only the joints before it
            total = total + of_all_joints(kinetic, self.n_joints)
        return total

    def hyper(self, params: Params) -> Hyper:
        """Return the shares, scales and velocity weights for compiled code.

        Shares: (n + 1 or 2, n, 3), those of the kinetic energies, link by link or one for all, then those of the
        potential. Scales: (n,), of which a product over all joints has only the last. Velocity weights: (n, n).
        """
        potential, n = params["potential.logits"], self.n_joints
        links = [params[name] for name in self._kinetic_logits()]
        logits = np.zeros((len(links) + 1, n, 2))
        for row, each in zip(logits, (*links, potential), strict=True):
            row[: len(each)] = each
        scales = np.zeros(n)
        scales[-1] = np.exp(params["potential.log_scale"])
        return Hyper(shares(logits.reshape(-1, 2)).reshape(len(logits), n, 3), scales, self.weights(params))

    def hyper_adjoint(self, hyper: Hyper, slopes: Hyper) -> dict[str, Array]:
        """Return the derivatives by the hyperparameters, given the derivatives by the result of `hyper`."""
        sizes = {**self._kinetic_logits(), "potential.logits": self.n_joints}
        logits = shares_adjoint(hyper.shares, slopes.shares)
        return {
            "potential.log_scale": np.asarray(hyper.scales[-1] * slopes.scales[-1]),
            **{name: each[:size] for (name, size), each in zip(sizes.items(), logits, strict=True)},
            **velocity_adjoint(hyper.weights, slopes.weights),
        }

    def potential(self, params: Params, x: State, y: State) -> Product:
        """Return the kernel of the potential energy V and its derivatives."""
        base = base_kernels(shares(params["potential.logits"]), self.joint_types, x.q, y.q)
        scale = params["potential.log_scale"]
        return Product(base, range(self.n_joints), array_namespace(scale).exp(scale), self.n_joints)

    def kinetic(self, params: Params, link: int, x: State, y: State) -> Product:
        """Return the position factor of the kinetic energy kernel of `link` (1-based) and its derivatives."""
        logits = params["kinetic.logits"][:link] if self.tied else params[f"kinetic.{link}.logits"]
        base = base_kernels(shares(logits), self.joint_types[:link], x.q[:link], y.q[:link])
        return Product(base.squared(), range(link), array_namespace(logits).ones_like(logits[0, 0]), link)

    def energies(self, params: Params, x: State, y: State) -> Array:
        """Return the covariance of kinetic and potential energy at x with torque j at y, (2, n, *batch) J·N·m."""
        potential = potential_energy_torque(self.potential(params, x, y))
        xp = array_namespace(potential)
        kinetic = xp.zeros_like(potential)
        for link in range(1, self.n_joints + 1):
            weights = self.weights(params)[link - 1, :link]
            position = self.kinetic(params, link, x, y)
            kinetic[:link] += kinetic_energy_torque(position, weights, x.first(link), y.first(link))
        return xp.stack([kinetic, potential])

    def energy_covariance(self, params: Params, x: State, y: State) -> Array:
        """Return the covariance of kinetic energies at x and y, Σ_l K_l h_l², and of potential ones, (2, *batch) J²."""
        potential = self.potential(params, x, y).value
        xp = array_namespace(potential)
        kinetic = xp.zeros_like(potential)
        for link in range(1, self.n_joints + 1):
            weights = self.weights(params)[link - 1, :link].reshape((-1,) + (1,) * (x.q.ndim - 1))
            h = (weights * x.v[:link] * y.v[:link]).sum(0)
            kinetic = kinetic + self.kinetic(params, link, x, y).value * h * h
        return xp.stack([kinetic, potential])

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Start with potential torques as large as the measured ones, and with the inertia of an arm of that weight."""
        power = np.square(tau).mean(0).clip(1e-12)
        # a joint's potential torque grows with its share α or β: they start at the ratio of the torques
        ratio = np.log((power / power.max()).clip(1e-6))
        return {
            "potential.log_scale": np.asarray(np.log(power.max() * 3)),
            "potential.logits": np.stack([ratio, ratio], axis=1),
            **{name: np.zeros((size, 2)) for name, size in self._kinetic_logits().items()},
            **initial_weights(tau),
        }

    def weights(self, params: Params) -> Array:
        """Return the velocity weights w_{l,a} as a lower triangular matrix, (n, n)."""
        return velocity_weights(params, self.n_joints)

    def _kinetic_logits(self) -> dict[str, int]:
        """Return the names of the kinetic energies' logits, and the number of joints of each."""
        n = self.n_joints
        return {"kinetic.logits": n} if self.tied else {f"kinetic.{link}.logits": link for link in range(1, n + 1)}

    def prior_std(self) -> dict[str, float]:
        """Return the prior standard deviations.

        Weights are pooled between links and joints; a share may move far from its start.
        """
        return dict(PRIOR_STD)


def shares(logits: Array) -> Array:
    """Return the softmax of (0, logits): (n, 2) to the shares (σ, α, β) of each joint, (n, 3)."""
    xp = array_namespace(logits)
    every = xp.concat([xp.zeros_like(logits[:, :1]), logits], axis=1)
    powers = xp.exp(every - xp.max(every, axis=1, keepdims=True))
    return powers / xp.sum(powers, axis=1, keepdims=True)


def shares_adjoint(share: Array, slopes: Array) -> Array:
    """Return the derivatives by the logits, (…, 2), given the shares and the derivatives by them, (…, 3)."""
    logits: Array = share * (slopes - (share * slopes).sum(-1, keepdims=True))
    return logits[..., 1:]
