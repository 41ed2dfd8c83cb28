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

import torch
from torch import Tensor

from lipcore.data.motion import Motion, check_joint_types
from lipcore.kernels.base import Params, State
from lipcore.kernels.compiled.chain import chain_cross, chain_gradient, chain_gram, chain_size
from lipcore.kernels.compiled.kernel import CompiledKernel, Driver
from lipcore.kernels.energy import PRIOR_STD as WEIGHTS_PRIOR_STD
from lipcore.kernels.energy import initial_weights, potential_blocks, potential_energy_torque, velocity_weights
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

    def blocks(self, params: Params, x: State, y: State) -> Tensor:
        """Covariance of torque i at x with torque j at y: (n, n, *batch), (N·m)²."""
        chain = _Chain.build(self._base(params["chain.logits"], x, y), self.weights(params), x, y)
        return potential_blocks(self.potential(params, x, y)) + chain.blocks().movedim((-2, -1), (0, 1))

    def hyper(self, params: Params) -> tuple[Tensor, Tensor, Tensor]:
        """Shares (1, n, 3) of the base kernels, scales of the potentials (n,) and velocity weights (n, n)."""
        shares = self._shares(params["chain.logits"])
        return shares[None], torch.exp(params["potential.log_scales"]), self.weights(params)

    def potential(self, params: Params, x: State, y: State) -> Derivatives:
        """Kernel of the potential energy V and its derivatives."""
        return chain_sum(self._base(params["chain.logits"], x, y), torch.exp(params["potential.log_scales"]))

    def energies(self, params: Params, x: State, y: State) -> Tensor:
        """Covariance of the kinetic and the potential energy at x with torque j at y: (2, n, *batch), J·N·m."""
        potential = potential_energy_torque(self.potential(params, x, y))
        chain = _Chain.build(self._base(params["chain.logits"], x, y), self.weights(params), x, y)
        return torch.stack([chain.energy_torque().movedim(-1, 0), potential])

    def energy_covariance(self, params: Params, x: State, y: State) -> Tensor:
        """Covariance of the kinetic energies at x and y, Σ_l h_l², and of the potential ones: (2, *batch), J²."""
        chain = _Chain.build(self._base(params["chain.logits"], x, y), self.weights(params), x, y)
        h = (chain.weights * chain.r * (chain.v * chain.v2)[..., None, :]).sum(-1)
        return torch.stack([h.square().sum(-1), self.potential(params, x, y).value])

    def weights(self, params: Params) -> Tensor:
        """Velocity weights w_{l,a} as a lower triangular matrix (n, n)."""
        return velocity_weights(params, self.n_joints)

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """Potential torques as large as the measured ones; inertia as arms have it that weigh as much."""
        power = tau.square().mean(0).clamp_min(1e-12)
        # variance of the gravity torque at joint i: α_i Σ_{l≥i} s_l
        moved = power.flip(0).cummax(0).values.flip(0) / SHARE
        scales = torch.maximum(moved - torch.cat([moved[1:], moved.new_zeros(1)]), 0.1 * moved)
        logits = torch.full_like(power, SHARE).logit()
        logits[0] = (SHARE * power[0] / power.max()).clamp_min(1e-6).logit()  # mostly a vertical axis
        return {"chain.logits": logits, "potential.log_scales": torch.log(scales), **initial_weights(tau)}

    def prior_std(self) -> dict[str, float]:
        """How far the weights may stray from their pattern, and the pattern from its start."""
        return dict(PRIOR_STD)

    def _base(self, logits: Tensor, x: State, y: State) -> BaseKernels:
        return base_kernels(self._shares(logits), self.joint_types, x.q, y.q)

    def _shares(self, logits: Tensor) -> Tensor:
        alpha = torch.sigmoid(logits)
        revolute = torch.tensor([kind == "revolute" for kind in self.joint_types], device=logits.device)
        return torch.stack([1 - alpha, alpha, torch.where(revolute, alpha, 0.0)], dim=1)


@dataclass(frozen=True)
class _Chain:
    """h_l and what Lagrange's equations need of it. Vectors over joints: (*batch, n); matrices: (*batch, n, n).

    weights: w (l, a). r, r1, r2, r12: R_{l,a}, its time derivative along the first argument, along the second, and
    along both. m, m1, m2: the products between two joints, M_{i,a} = Π_{a<b<i} p_b, likewise.
    """

    v: Tensor
    a: Tensor
    v2: Tensor
    a2: Tensor
    left: Tensor
    right: Tensor
    mixed: Tensor
    weights: Tensor
    r: Tensor
    r1: Tensor
    r2: Tensor
    r12: Tensor
    m: Tensor
    m1: Tensor
    m2: Tensor

    @classmethod
    def build(cls, base: BaseKernels, weights: Tensor, x: State, y: State) -> _Chain:
        """Products of the base kernels along the chain, link by link."""
        p, left, right, mixed = base.value, base.left, base.right, base.mixed
        v, a, v2, a2 = (part.expand_as(p) for part in (x.v, x.a, y.v, y.a))
        p1, p2, p12 = left * v, right * v2, mixed * v * v2
        n, one, zero = p.shape[0], torch.ones_like(p[:1]), torch.zeros_like(p)
        row = [one, zero[:1], zero[:1], zero[:1]]
        rows = [[torch.cat([part, zero[1:]]) for part in row]]
        for b in range(1, n):
            r, r1, r2, r12 = row
            grown = [
                r * p[b],
                r1 * p[b] + r * p1[b],
                r2 * p[b] + r * p2[b],
                r12 * p[b] + r1 * p2[b] + r2 * p1[b] + r * p12[b],
            ]
            row = [torch.cat([part, new]) for part, new in zip(grown, (one, *[zero[:1]] * 3), strict=True)]
            rows.append([torch.cat([part, zero[b + 1 :]]) for part in row])
        full = [torch.stack([link[k] for link in rows]).movedim((0, 1), (-2, -1)) for k in range(4)]
        between = [torch.cat([torch.zeros_like(part[..., :1, :]), part[..., :-1, :]], dim=-2) for part in full[:3]]
        v, a, v2, a2, left, right, mixed = (part.movedim(0, -1) for part in (v, a, v2, a2, left, right, mixed))
        return cls(v, a, v2, a2, left, right, mixed, weights, *full, *between)

    def blocks(self) -> Tensor:
        """T'_j T_i Σ_l h_l², with T_i = d/dt ∂/∂v_i − ∂/∂q_i: (*batch, n, n).

        For one link, with e_i = T_i h, f_j = T'_j h, u_i = ∂h/∂v_i and dots and primes for time derivatives along the
        first and second argument:

            2 [e fᵀ + e' (∂'_v h)ᵀ + u ḟᵀ + u' (∂'_v ḣ)ᵀ + h T'e + h' ∂'_v e + ḣ T'u + ḣ' ∂'_v u]
        """
        w, r, r1, r2 = self.weights, self.r, self.r1, self.r2
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
        rank_one = torch.cat([e, e2, gv2, ga_v2], dim=-2).mT @ torch.cat([f, gv, f1, ga_v], dim=-2)

        # sums over links of the parts of T'e, ∂'_v e and T'u off the diagonal: joint i of R, joint j of w
        hr, hw = h[..., None] * r, w.expand_as(r)
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
        ) + self.mixed * cross.diagonal(dim1=-2, dim2=-1)
        return 2 * (rank_one + below + above.mT + torch.diag_embed(diagonal))

    def energy_torque(self) -> Tensor:
        """T'_j Σ_l h_l²: covariance of the kinetic energy at x with torque j at y, (*batch, n)."""
        v, v2, a2 = (part[..., None, :] for part in (self.v, self.v2, self.a2))
        g, g2 = self.weights * self.r, self.weights * self.r2
        f = g2 * v - self.right[..., None, :] * self.r * self._before()[0]
        h, dh2 = (g * v * v2).sum(-1), ((g * a2 + g2 * v2) * v).sum(-1)
        return 2 * (dh2[..., None] * g * v + h[..., None] * f).sum(-2)

    def _before(self) -> tuple[Tensor, Tensor, Tensor]:
        """∂h_l/∂p_i over R_{l,i}: Σ_{a<i} w_{l,a} v_a v'_a M_{i,a}, (*batch, l, i), and its time derivatives."""
        w = self.weights
        vv, av, va = ((s * t)[..., None, :] for s, t in ((self.v, self.v2), (self.a, self.v2), (self.v, self.a2)))
        both = w * vv
        before = both @ self.m.mT
        return before, (w * av) @ self.m.mT + both @ self.m1.mT, (w * va) @ self.m.mT + both @ self.m2.mT
