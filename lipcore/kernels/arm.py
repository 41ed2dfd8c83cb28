"""The arm's kernel: torque linear in masses, rotor inertia and small changes of geometry."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import KINDS, Arm
from lipcore.kernels.base import LinearKernel, Params, Regressor
from lipcore.kernels.compiled.arm import (
    arm_differences,
    arm_energies,
    arm_features,
    arm_queries,
    arm_query,
    arm_size,
    arm_torques,
)
from lipcore.kernels.compiled.arm_recursion import PARAMETERS
from lipcore.kernels.compiled.views import Memory
from lipcore.kernels.friction import friction_features
from lipcore.kernels.geometry import Geometry

REMEMBERED = 4
"""Motions whose features are kept: the training samples and the query in work, asked for over and over."""
SCALES = 4
"""Kinds of weights with a scale of their own: masses, first moments, inertias, rotors."""


class ArmKernel(LinearKernel):
    """tau = Y(θ) π + r ∘ ddq + J (δθ) + Σ c_k δ_k around an arm, J = ∂(Y π)/∂θ.

    Weights: π, ten parameters a body (10 n,), and rotor inertias r (n,), in the order of the data's joints; steps of
    the geometry (g,), base to tip; and for each alternative arm how much of it is taken (K,). Standard deviations are
    those of the arm, of π and r times `exp(rigid_body.log_scale)` (4,) by kind.

    An alternative arm has the torque δ_k = τ_k − τ_0 more than the arm itself. With c one of them or none, by their
    probabilities p, c has mean p and covariance C = diag p − p pᵀ = L Lᵀ, so that Σ c_k δ_k has the mean and the
    variance of the mixture of arms. The features are Lᵀ δ, whose weights L⁻¹ c are independent with variance one.
    """

    def __init__(self, arm: Arm) -> None:
        self.arm, self.n_joints = arm, arm.n_joints
        kinds = np.concatenate([np.tile(KINDS, arm.n_joints), np.full(arm.n_joints, SCALES - 1)])
        self._kinds = torch.from_numpy(kinds)
        self._unit = torch.from_numpy(arm.unit)
        shares = _shares(arm)
        mixed = np.linalg.solve(_mixing(shares), shares)
        self._rest = torch.from_numpy(np.concatenate([arm.widths, np.ones(len(shares))]))
        self._mean = torch.from_numpy(np.concatenate([_in_data(arm), arm.rotor, arm.expected, mixed]))
        self._recent: tuple[tuple[Motion, Tensor], ...] = ()

    @property
    def size(self) -> int:
        """Number of weights p."""
        return len(self._mean)

    @property
    def steps(self) -> slice:
        """Places of the geometry's steps among the weights."""
        first = (PARAMETERS + 1) * self.n_joints
        return slice(first, first + self.arm.steps)

    def geometry(self, weights: Array) -> Geometry:
        """The arm's geometry with its steps as these weights, (p,), have them."""
        return self.arm.geometry.moved(weights[self.steps]) if self.arm.steps else self.arm.geometry

    def geometry_step(self, weights: Array) -> Array:
        """Step of the geometry, (g,) rad and m, of whitened weights times their prior deviations, (p,)."""
        return np.asarray(self.arm.expected + weights[self.steps])

    def torque(self, weights: Array, motion: Motion) -> Array:
        """Y(θ + δθ) π + r ∘ ddq of these weights, (p,), not linearised: (N, n) N·m. Alternative arms are left out."""
        n, geometry = self.n_joints, self.geometry(weights)
        bodies = np.ascontiguousarray(weights[: PARAMETERS * n].reshape(n, PARAMETERS)[self.arm.order])
        out = np.zeros((len(motion), n))
        arm_torques(geometry.constants, geometry.gravity, bodies, self.arm.order, motion.arrays(), out)
        return np.asarray(out + weights[PARAMETERS * n : (PARAMETERS + 1) * n] * motion.ddq.numpy())

    def features(self, x: Motion) -> Tensor:
        """Φ at each sample: (N, n, p)."""
        for seen, features in self._recent:
            if seen.q is x.q and seen.dq is x.dq and seen.ddq is x.ddq:
                return features
        # contiguous each: machine code is compiled for the layout of an array
        rows = np.empty((len(x), self.steps.stop, self.n_joints))
        others = np.empty((len(x), self.size - self.steps.stop, self.n_joints))
        motions, arm = x.arrays(), self.arm
        arm_features(arm.geometry.constants, arm.geometry.gravity, arm.parameters, arm.order, motions, rows)
        if arm.alternatives:
            arm_differences(*_stacked(arm), arm.order, motions, _linear_features(motions, arm.stribeck), others)
        transposed = np.concatenate([rows, others], axis=1).transpose(0, 2, 1)
        features = torch.from_numpy(np.ascontiguousarray(transposed)).to(x.device)
        self._recent = ((x, features), *self._recent[: REMEMBERED - 1])
        return features

    def regressor(self) -> Regressor:
        """The same features of one query, for serving."""
        return ArmRegressor(self.arm, self.size)

    def covariance(self, params: Params) -> Tensor:
        """Prior variances of the weights on the diagonal: (p, p)."""
        log_scale = params["rigid_body.log_scale"]
        device = log_scale.device
        std = self._unit.to(device) * torch.exp(log_scale[self._kinds.to(device)])
        return torch.diag(torch.cat([std, self._rest.to(device)]).square())

    def prior_weights(self) -> Tensor | None:
        """Prior mean of the weights, (p,)."""
        return self._mean

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """The arm's own scales: (4,)."""
        return {"rigid_body.log_scale": torch.zeros(SCALES, dtype=torch.float64).to(tau.device)}

    def energy_features(self, x: Motion) -> Tensor:
        """Kinetic and potential energy per unit of each weight: (N, 2, p) J; of alternative arms none is counted."""
        out, arm = np.empty((len(x), 2, self.steps.stop)), self.arm
        arm_energies(arm.geometry.constants, arm.geometry.gravity, arm.parameters, arm.order, x.arrays(), out)
        none = np.zeros((len(x), 2, self.size - self.steps.stop))
        return torch.from_numpy(np.concatenate([out, none], axis=2)).to(x.device)


class ArmRegressor(Regressor):
    """Features of `ArmKernel`, compiled."""

    def __init__(self, arm: Arm, size: int) -> None:
        self.n_joints, self.size = arm.n_joints, size
        self._order = arm.order.astype(np.int64)
        self._first = (PARAMETERS + 1) * arm.n_joints + arm.steps
        self._stribeck = arm.stribeck
        self._others = _stacked(arm) if arm.alternatives else None
        fixed = arm.geometry.constants, arm.geometry.gravity, arm.parameters
        self._memory = Memory(fixed, arm_size(arm.n_joints))

    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of the query, (p, n)."""
        arm_query(self._memory.flat, self._order, motion, out[: self._first])
        if self._others is not None:
            motions = motion[None]
            linear = _linear_features(motions, self._stribeck)
            arm_differences(*self._others, self._order, motions, linear, out[None, self._first :])

    def fill_many(self, motions: Array, out: Array, first: int) -> None:
        """Write Φᵀ of N queries; see `Regressor.fill_many`."""
        if self._others is not None:
            super().fill_many(motions, out, first)
        else:
            arm_queries(self._memory.flat, self._order, motions, out, first, first + self._first)


def _in_data(arm: Arm) -> Array:
    """Prior mean of π, flat, in the order of the data."""
    return np.asarray(arm.centre[arm.place].reshape(-1))


def _shares(arm: Arm) -> Array:
    """Probabilities of the alternatives, (K,), the arm itself left out."""
    return np.array([each.probability for each in arm.alternatives[1:]])


def _mixing(shares: Array) -> Array:
    """L with L Lᵀ = diag p − p pᵀ, (K, K)."""
    return np.ascontiguousarray(np.linalg.cholesky(np.diag(shares) - np.outer(shares, shares)))


def _stacked(arm: Arm) -> tuple[Array, Array, Array, Array, Array]:
    """L (K, K), constants (K + 1, n, …), gravity, parameters (K + 1, n, 10), linear coefficients (K + 1, n, 1 + f)."""
    each = arm.alternatives
    return (
        _mixing(_shares(arm)),
        np.stack([one.geometry.constants for one in each]),
        arm.geometry.gravity,
        np.stack([one.parameters for one in each]),
        np.stack([np.concatenate([one.rotor[:, None], one.friction], axis=1) for one in each]),
    )


def _linear_features(motions: Array, stribeck: bool) -> Array:
    """ddq and friction's features of each joint, (N, n, 1 + f), for motions (N, 3, n)."""
    friction = friction_features(torch.from_numpy(motions[:, 1]), stribeck).numpy()
    return np.ascontiguousarray(np.concatenate([motions[:, 2, :, None], friction.transpose(1, 2, 0)], axis=2))
