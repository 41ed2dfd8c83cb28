"""The serial-chain LIP kernel: the kinetic energy prior of each link contains only energies of a serial chain.

In the frame of link l its twist is Σ_a v_a Ad(q_{a+1}..q_l) ξ_a. The column of joint a depends on joints a+1..l alone
and is affine in their cosines and sines. So T_l has the kernel h_l² with

    h_l = Σ_{a≤l} w_{l,a} v_a v'_a R_{l,a},   R_{l,a} = Π_{a<b≤l} p_b(q_b, q'_b)

(docs/method.md, section 4). A prior that does not depend on the zero of a joint has p = σ + α cos(q − q') for revolute
joints. Prismatic joints have p = σ + α q q'. All formulas are products of the p_b and their derivatives, never
quotients, so a p_b may pass through zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from lipcore.data.motion import Array, Motion, check_joint_types
from lipcore.kernels.arrays import of_all_joints, on_diagonal
from lipcore.kernels.base import Params, State
from lipcore.kernels.energy import (
    PRIOR_STD,
    initial_weights,
    potential_blocks,
    potential_energy_torque,
    velocity_adjoint,
    velocity_weights,
)
from lipcore.kernels.fast.chain import chain_cross, chain_gradient, chain_gram, chain_size
from lipcore.kernels.fast.kernel import CompiledKernel, Driver
from lipcore.kernels.fast.pairs import Hyper
from lipcore.kernels.polynomial import Product, base_kernels
from lipcore.vocabulary import JointType

ROTATION_SHARE = 2 / 3
"""α of a rotation about an axis with uniformly distributed direction: E[R c · R'c] = (1 + 2 cos(q − q')) / 3 · |c|²."""


class ChainKernel(CompiledKernel):
    """One potential and one kinetic energy for each link of a serial chain.

    Link l's potential has the kernel s_l Π_{b≤l} p_b. Gravity and the twists turn with the same joints, so both
    energies share the p_b. The first joint turns gravity alone.

    Hyperparameters:

    - `chain.logits` (n,): logits of each joint's share α, with σ = 1 − α;
    - `potential.log_scales` (n,): log s_l;
    - those of `energy.velocity_weights`.
    """

    driver = Driver(chain_size, chain_gram, chain_gradient, chain_cross)

    def __init__(self, joint_types: Sequence[str]) -> None:
        self.joint_types: tuple[JointType, ...] = check_joint_types(joint_types)
        self.n_joints = len(self.joint_types)

    def blocks(self, params: Params, x: State, y: State) -> Array:
        """Return the covariance of torque i at x with torque j at y, (n, n, *batch) (N·m)²."""
        links = self._links(params, x, y)
        blocks = (potential_blocks(potential) + kinetic.blocks() for potential, kinetic in links)
        first, *others = (of_all_joints(each, self.n_joints) for each in blocks)
        return sum(others, first)

    def hyper(self, params: Params) -> Hyper:
        """Return the base kernels' shares (1, n, 3), the potentials' scales (n,) and the velocity weights (n, n)."""
        shares = self._shares(params["chain.logits"])
        return Hyper(shares[None], np.exp(params["potential.log_scales"]), self.weights(params))

    def hyper_adjoint(self, hyper: Hyper, slopes: Hyper) -> dict[str, Array]:
        """Return the derivatives by the hyperparameters, given the derivatives by the result of `hyper`."""
        alpha, (sigma, along, across) = hyper.shares[0, :, 1], slopes.shares[0].T
        share = along - sigma + np.where(self._revolute(), across, 0.0)
        return {
            "chain.logits": share * alpha * (1 - alpha),
            "potential.log_scales": hyper.scales * slopes.scales,
            **velocity_adjoint(hyper.weights, slopes.weights),
        }

    def energies(self, params: Params, x: State, y: State) -> Array:
        """Return the covariance of kinetic and potential energy at x with torque j at y, (2, n, *batch) J·N·m."""
        links = self._links(params, x, y)
        xp = array_namespace(x.q)
        total = xp.stack([xp.zeros_like(links[-1][0].right)] * 2)
        for link, (potential, kinetic) in enumerate(links, 1):
            total[0, :link] += kinetic.energy_torque()
            total[1, :link] += potential_energy_torque(potential)
        return total

    def energy_covariance(self, params: Params, x: State, y: State) -> Array:
        """Return the covariance of kinetic energies at x and y, Σ_l h_l², and of potential energies, (2, *batch) J²."""
        links = self._links(params, x, y)
        kinetic = sum(form.value * form.value for _, form in links)
        return array_namespace(x.q).stack([kinetic, sum(potential.value for potential, _ in links)])

    def weights(self, params: Params) -> Array:
        """Return the velocity weights w_{l,a} as a lower triangular matrix, (n, n)."""
        return velocity_weights(params, self.n_joints)

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Start with potential torques as large as the measured ones, and with the inertia of an arm of that weight."""
        power = np.square(tau).mean(0).clip(1e-12)
        # the variance of the gravity torque at joint i is α_i Σ_{l≥i} s_l
        moved = np.maximum.accumulate(power[::-1])[::-1] / ROTATION_SHARE
        scales = np.maximum(moved - np.append(moved[1:], 0.0), 0.1 * moved)
        share = np.full_like(power, ROTATION_SHARE)
        share[0] = max(ROTATION_SHARE * power[0] / power.max(), 1e-6)  # the first axis is mostly vertical
        logits = np.log(share / (1 - share))
        return {"chain.logits": logits, "potential.log_scales": np.log(scales), **initial_weights(tau)}

    def prior_std(self) -> dict[str, float]:
        """Return how far the weights may differ from their pattern, and the pattern from its start."""
        return {"chain.logits": 2.0, "potential.log_scales": 2.0, **PRIOR_STD}

    def _links(self, params: Params, x: State, y: State) -> list[tuple[Product, LinkForm]]:
        """Return each link's potential kernel s_l Π_{b≤l} p_b and the form h_l of its kinetic energy, base to tip."""
        xp, weights = array_namespace(x.q), self.weights(params)
        base = base_kernels(self._shares(params["chain.logits"]), self.joint_types, x.q, y.q)
        scales = xp.exp(params["potential.log_scales"])
        links = []
        for link in range(self.n_joints):
            m = link + 1
            potential = Product(base, range(m), scales[link], m)
            columns = [Product(base, range(a + 1, m), weights[link, a], m) for a in range(m)]
            links.append((potential, LinkForm(columns, x.first(m), y.first(m))))
        return links

    def _shares(self, logits: Array) -> Array:
        xp = array_namespace(logits)
        alpha = 1 / (1 + xp.exp(-logits))
        revolute = xp.asarray(self._revolute())
        return xp.stack([1 - alpha, alpha, xp.where(revolute, alpha, xp.zeros_like(alpha))], axis=1)

    def _revolute(self) -> NDArray[np.bool_]:
        return np.array([kind == "revolute" for kind in self.joint_types])


@dataclass(frozen=True)
class LinkForm:
    """h = Σ_a c_a(q, q') v_a v'_a of a link with m joints. Its square is the kernel of the link's kinetic energy."""

    columns: Sequence[Product]
    """c_a = w_a R_a of the m columns."""
    x: State
    """First argument, m joints."""
    y: State
    """Second argument, m joints."""

    @cached_property
    def c(self) -> Array:
        """c_a, (m, *batch)."""
        return array_namespace(self.x.q).stack([each.value for each in self.columns])

    @cached_property
    def right(self) -> Array:
        """∂c_a/∂q'_j, (j, a, *batch)."""
        return array_namespace(self.x.q).stack([each.right for each in self.columns], axis=1)

    @property
    def value(self) -> Array:
        """h, (*batch)."""
        return (self.c * self.x.v * self.y.v).sum(0)

    def energy_torque(self) -> Array:
        """Return ℒ'_j h² = 2 (h f_j + h' ∂h/∂v'_j), (m, *batch): covariance of the energy at x with torque j at y."""
        c, right, v, v2, a2 = self.c, self.right, self.x.v, self.y.v, self.y.a
        c2 = (right * v2[:, None]).sum(0)
        f = c2 * v - (right * v * v2).sum(1)
        h2 = ((c2 * v2 + c * a2) * v).sum(0)
        return 2 * (self.value * f + h2 * c * v)

    def blocks(self) -> Array:
        """Return ℒ_i ℒ'_j h², (m, m, *batch): eq. 11 of docs/method.md, line by line."""
        xp, c, right = array_namespace(self.x.q), self.c, self.right
        left = xp.stack([each.left for each in self.columns], axis=1)
        mixed = xp.stack([each.mixed for each in self.columns], axis=2)
        v, a, v2, a2 = self.x.v, self.x.a, self.y.v, self.y.a
        # the suffixes mark time derivatives along the first argument (1), the second (2) and both (12)
        c1, c2 = (left * v[:, None]).sum(0), (right * v2[:, None]).sum(0)
        left2, right1 = (mixed * v2[:, None]).sum(1), (mixed * v[:, None, None]).sum(0)
        c12 = (left2 * v[:, None]).sum(0)
        h, h1 = self.value, ((c1 * v + c * a) * v2).sum(0)
        h2, h12 = ((c2 * v2 + c * a2) * v).sum(0), ((c12 * v + c2 * a) * v2 + (c1 * v + c * a) * a2).sum(0)

        u, u2 = c * v2, c2 * v2 + c * a2
        w, w1 = c * v, c1 * v + c * a
        e, f = c1 * v2 - (left * v * v2).sum(1), c2 * v - (right * v * v2).sum(1)
        e2 = c12 * v2 + c1 * a2 - (left2 * v * v2 + left * v * a2).sum(1)
        f1 = c12 * v + c2 * a - (right1 * v * v2 + right * a * v2).sum(1)

        turned, turned1 = (xp.moveaxis(each, 1, 0) for each in (right, right1))
        x = on_diagonal(c12) - left2 * v - turned1 * v2[:, None] + (mixed * v * v2).sum(2)
        y, z = on_diagonal(c1) - left * v, on_diagonal(c2) - turned * v2[:, None]
        rank_one = e[:, None] * f + e2[:, None] * w + u[:, None] * f1 + u2[:, None] * w1
        return 2 * (rank_one + h * x + h2 * y + h1 * z + h12 * on_diagonal(c))
