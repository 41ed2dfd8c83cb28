"""The serial-chain LIP kernel: each link's kinetic energy prior holds only what a serial chain can produce.

In the frame of link l its twist is Σ_a v_a Ad(q_{a+1}..q_l) ξ_a: the column of joint a moves with joints a+1..l alone
and is affine in their cosines and sines. So T_l has the kernel h_l² with

    h_l = Σ_{a≤l} w_{l,a} v_a v'_a R_{l,a},   R_{l,a} = Π_{a<b≤l} p_b(q_b, q'_b)

(docs/method.md, section 4). A prior that does not know where the zero of a joint is has p = σ + α cos(q − q') for
revolute joints; prismatic joints have p = σ + α q q'. All of it is written in products of the p_b and of their
derivatives, never in quotients, so a p_b may pass through zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from array_api_compat import array_namespace, device
from numpy.typing import NDArray

from lipcore.data.motion import Array, Motion, check_joint_types
from lipcore.kernels.base import Params, State, on_last_diagonal
from lipcore.kernels.energy import PRIOR_STD as WEIGHTS_PRIOR_STD
from lipcore.kernels.energy import (
    initial_weights,
    potential_blocks,
    potential_energy_torque,
    velocity_adjoint,
    velocity_weights,
)
from lipcore.kernels.fast.chain import chain_cross, chain_gradient, chain_gram, chain_size
from lipcore.kernels.fast.kernel import CompiledKernel, Driver
from lipcore.kernels.fast.pairs import Hyper
from lipcore.kernels.polynomial import BaseKernels, Derivatives, base_kernels, chain_sum
from lipcore.vocabulary import JointType

SHARE = 2 / 3
"""α of a rotation about an axis that is as likely along as across: E[R c · R'c] = (1 + 2 cos(q − q')) / 3 · |c|²."""
PRIOR_STD = {"chain.logits": 2.0, "potential.log_scales": 2.0, **WEIGHTS_PRIOR_STD}


class ChainKernel(CompiledKernel):
    """One potential and one kinetic energy a link of a serial chain.

    Link l's potential has the kernel s_l Π_{b≤l} p_b. The same joints turn gravity and the twists, so both energies
    share the p_b; the first joint turns gravity alone.

    Hyperparameters: `chain.logits` (n,), logits of each joint's share α, with σ = 1 − α; `potential.log_scales` (n,),
    log s_l; and those of `energy.velocity_weights`.
    """

    driver = Driver(chain_size, chain_gram, chain_gradient, chain_cross)

    def __init__(self, joint_types: Sequence[str]) -> None:
        self.joint_types: tuple[JointType, ...] = check_joint_types(joint_types)
        self.n_joints = len(self.joint_types)

    def blocks(self, params: Params, x: State, y: State) -> Array:
        """Covariance of torque i at x with torque j at y: (n, n, *batch), (N·m)²."""
        chain = _Chain.build(self._base(params["chain.logits"], x, y), self.weights(params), x, y)
        kinetic = array_namespace(x.q).moveaxis(chain.blocks(), (-2, -1), (0, 1))
        return potential_blocks(self.potential(params, x, y)) + kinetic

    def hyper(self, params: Params) -> Hyper:
        """Shares (1, n, 3) of the base kernels, scales of the potentials (n,) and velocity weights (n, n)."""
        shares = self._shares(params["chain.logits"])
        return Hyper(shares[None], np.exp(params["potential.log_scales"]), self.weights(params))

    def hyper_adjoint(self, hyper: Hyper, slopes: Hyper) -> dict[str, Array]:
        """Derivatives by the hyperparameters, given those by what `hyper` makes of them."""
        alpha, (sigma, along, across) = hyper.shares[0, :, 1], slopes.shares[0].T
        share = along - sigma + np.where(self._revolute(), across, 0.0)
        return {
            "chain.logits": share * alpha * (1 - alpha),
            "potential.log_scales": hyper.scales * slopes.scales,
            **velocity_adjoint(hyper.weights, slopes.weights),
        }

    def potential(self, params: Params, x: State, y: State) -> Derivatives:
        """Kernel of the potential energy V and its derivatives."""
        scales = params["potential.log_scales"]
        return chain_sum(self._base(params["chain.logits"], x, y), array_namespace(scales).exp(scales))

    def energies(self, params: Params, x: State, y: State) -> Array:
        """Covariance of the kinetic and the potential energy at x with torque j at y: (2, n, *batch), J·N·m."""
        potential = potential_energy_torque(self.potential(params, x, y))
        chain = _Chain.build(self._base(params["chain.logits"], x, y), self.weights(params), x, y)
        xp = array_namespace(potential)
        return xp.stack([xp.moveaxis(chain.energy_torque(), -1, 0), potential])

    def energy_covariance(self, params: Params, x: State, y: State) -> Array:
        """Covariance of the kinetic energies at x and y, Σ_l h_l², and of the potential ones: (2, *batch), J²."""
        chain = _Chain.build(self._base(params["chain.logits"], x, y), self.weights(params), x, y)
        h = (chain.weights * chain.r * (chain.v * chain.v2)[..., None, :]).sum(-1)
        return array_namespace(h).stack([(h * h).sum(-1), self.potential(params, x, y).value])

    def weights(self, params: Params) -> Array:
        """Velocity weights w_{l,a} as a lower triangular matrix (n, n)."""
        return velocity_weights(params, self.n_joints)

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Potential torques as large as the measured ones; inertia as arms have it that weigh as much."""
        power = np.square(tau).mean(0).clip(1e-12)
        # variance of the gravity torque at joint i: α_i Σ_{l≥i} s_l
        moved = np.maximum.accumulate(power[::-1])[::-1] / SHARE
        scales = np.maximum(moved - np.append(moved[1:], 0.0), 0.1 * moved)
        share = np.full_like(power, SHARE)
        share[0] = max(SHARE * power[0] / power.max(), 1e-6)  # mostly a vertical axis
        logits = np.log(share / (1 - share))
        return {"chain.logits": logits, "potential.log_scales": np.log(scales), **initial_weights(tau)}

    def prior_std(self) -> dict[str, float]:
        """How far the weights may stray from their pattern, and the pattern from its start."""
        return dict(PRIOR_STD)

    def _base(self, logits: Array, x: State, y: State) -> BaseKernels:
        return base_kernels(self._shares(logits), self.joint_types, x.q, y.q)

    def _shares(self, logits: Array) -> Array:
        xp = array_namespace(logits)
        alpha = 1 / (1 + xp.exp(-logits))
        revolute = xp.asarray(self._revolute(), device=device(logits))
        return xp.stack([1 - alpha, alpha, xp.where(revolute, alpha, xp.zeros_like(alpha))], axis=1)

    def _revolute(self) -> NDArray[np.bool_]:
        return np.array([kind == "revolute" for kind in self.joint_types])


@dataclass(frozen=True)
class _Chain:
    """h_l and what Lagrange's equations need of it. Vectors over joints: (*batch, n); matrices: (*batch, n, n).

    weights: w (l, a). r, r1, r2, r12: R_{l,a}, its time derivative along the first argument, along the second, and
    along both. m, m1, m2: the products between two joints, M_{i,a} = Π_{a<b<i} p_b, likewise.
    """

    v: Array
    a: Array
    v2: Array
    a2: Array
    left: Array
    right: Array
    mixed: Array
    weights: Array
    r: Array
    r1: Array
    r2: Array
    r12: Array
    m: Array
    m1: Array
    m2: Array

    @classmethod
    def build(cls, base: BaseKernels, weights: Array, x: State, y: State) -> _Chain:
        """Products of the base kernels along the chain, link by link."""
        xp = array_namespace(base.value)
        p, left, right, mixed = base.value, base.left, base.right, base.mixed
        v, a, v2, a2 = (xp.broadcast_to(part, p.shape) for part in (x.v, x.a, y.v, y.a))
        p1, p2, p12 = left * v, right * v2, mixed * v * v2
        n, one, zero = p.shape[0], xp.ones_like(p[:1]), xp.zeros_like(p)
        row = [one, zero[:1], zero[:1], zero[:1]]
        rows = [[xp.concat([part, zero[1:]]) for part in row]]
        for b in range(1, n):
            r, r1, r2, r12 = row
            grown = [
                r * p[b],
                r1 * p[b] + r * p1[b],
                r2 * p[b] + r * p2[b],
                r12 * p[b] + r1 * p2[b] + r2 * p1[b] + r * p12[b],
            ]
            row = [xp.concat([part, new]) for part, new in zip(grown, (one, *[zero[:1]] * 3), strict=True)]
            rows.append([xp.concat([part, zero[b + 1 :]]) for part in row])
        full = [xp.moveaxis(xp.stack([link[k] for link in rows]), (0, 1), (-2, -1)) for k in range(4)]
        between = [xp.concat([xp.zeros_like(part[..., :1, :]), part[..., :-1, :]], axis=-2) for part in full[:3]]
        v, a, v2, a2, left, right, mixed = (xp.moveaxis(part, 0, -1) for part in (v, a, v2, a2, left, right, mixed))
        return cls(v, a, v2, a2, left, right, mixed, weights, *full, *between)

    def blocks(self) -> Array:
        """T'_j T_i Σ_l h_l², with T_i = d/dt ∂/∂v_i − ∂/∂q_i: (*batch, n, n).

        For one link, with e_i = T_i h, f_j = T'_j h, u_i = ∂h/∂v_i and dots and primes for time derivatives along the
        first and second argument:

            2 [e fᵀ + e' (∂'_v h)ᵀ + u ḟᵀ + u' (∂'_v ḣ)ᵀ + h T'e + h' ∂'_v e + ḣ T'u + ḣ' ∂'_v u]
        """
        xp, w, r, r1, r2 = array_namespace(self.r), self.weights, self.r, self.r1, self.r2
        v, a, v2, a2 = (part[..., None, :] for part in (self.v, self.a, self.v2, self.a2))
        g, g1, g2, g12 = w * r, w * r1, w * r2, w * self.r12
        gv, gv2 = g * v, g * v2
        ga_v, ga_v2 = g * a + g1 * v, g * a2 + g2 * v2  # time derivatives of gv and gv2
        h, dh = (gv * v2).sum(-1), (ga_v * v2).sum(-1)
        dh2 = (ga_v2 * v).sum(-1)
        ddh = (ga_v * a2 + (g2 * a + g12 * v) * v2).sum(-1)
        before, before1, before2 = self._before()

        left, right, mixed = (part[..., None, :] for part in (self.left, self.right, self.mixed))
        e = g1 * v2 - left * r * before
        f = g2 * v - right * r * before
        e2 = g1 * a2 + g12 * v2 - (mixed * v2 * r + left * r2) * before - left * r * before2
        f1 = g2 * a + g12 * v - (mixed * v * r + right * r1) * before - right * r * before1
        rank_one = xp.concat([e, e2, gv2, ga_v2], axis=-2).mT @ xp.concat([f, gv, f1, ga_v], axis=-2)

        # sums over links of the parts of T'e, ∂'_v e and T'u off the diagonal: joint i of R, joint j of w
        hr, hw = h[..., None] * r, xp.broadcast_to(w, r.shape)
        rw, cross = hr.mT @ hw, hr.mT @ before
        lower = (h[..., None] * r2 + dh2[..., None] * r).mT @ hw
        upper = (h[..., None] * r1 + dh[..., None] * r).mT @ hw
        left_i, right_i, mixed_i = (part[..., :, None] for part in (self.left, self.right, self.mixed))
        v_i, v2_i = self.v[..., :, None], self.v2[..., :, None]
        below = left_i * right * self.m * cross - v * (
            (mixed_i * v2_i * rw + left_i * lower) * self.m + left_i * rw * self.m2
        )
        above = right_i * left * self.m * cross - v2 * (
            (mixed_i * v_i * rw + right_i * upper) * self.m + right_i * rw * self.m1
        )
        diagonal = (h[..., None] * g12 + dh2[..., None] * g1 + dh[..., None] * g2 + ddh[..., None] * g).sum(
            -2
        ) + self.mixed * xp.linalg.diagonal(cross)
        return 2 * (rank_one + below + above.mT + on_last_diagonal(diagonal))

    def energy_torque(self) -> Array:
        """T'_j Σ_l h_l²: covariance of the kinetic energy at x with torque j at y, (*batch, n)."""
        v, v2, a2 = (part[..., None, :] for part in (self.v, self.v2, self.a2))
        g, g2 = self.weights * self.r, self.weights * self.r2
        f = g2 * v - self.right[..., None, :] * self.r * self._before()[0]
        h, dh2 = (g * v * v2).sum(-1), ((g * a2 + g2 * v2) * v).sum(-1)
        return 2 * (dh2[..., None] * g * v + h[..., None] * f).sum(-2)

    def _before(self) -> tuple[Array, Array, Array]:
        """∂h_l/∂p_i over R_{l,i}: Σ_{a<i} w_{l,a} v_a v'_a M_{i,a}, (*batch, l, i), and its time derivatives."""
        w = self.weights
        vv, av, va = ((s * t)[..., None, :] for s, t in ((self.v, self.v2), (self.a, self.v2), (self.v, self.a2)))
        both = w * vv
        before = both @ self.m.mT
        return before, (w * av) @ self.m.mT + both @ self.m1.mT, (w * va) @ self.m.mT + both @ self.m2.mT
