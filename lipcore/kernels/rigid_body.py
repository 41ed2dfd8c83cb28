"""The rigid-body kernel: torque is linear in the bodies' inertial parameters, and a URDF tells them beforehand."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lipcore.kernels.base import LinearKernel, Params
from lipcore.kernels.regressor import Regressor
from lipcore.kernels.rigid_body_regressor import RigidBodyRegressor
from lipcore.motion import Motion
from lipcore.robots import pinocchio
from lipcore.samples import Array
from lipcore.urdf import PARAMETERS, RigidBody
from lipcore.vocabulary import PRIORS

START = {"urdf": 0.1, "zero": 1.0}
"""Relative deviation from the prior mean that a fit starts from."""
MASS_FLOOR = 0.02
"""Smallest mass scale of a body, as a share of the whole arm's: a link without mass in the URDF may still have some."""
KINDS = (0, 1, 1, 1, 2, 2, 2, 2, 2, 2)
"""Which scale each of a body's ten parameters has: mass, first moment or inertia."""
REMEMBERED = 4
"""Motions whose regressors are kept: the training samples and the query in work, asked for over and over."""


class RigidBodyKernel(LinearKernel):
    """tau = Y(q, dq, ddq) π with Pinocchio's joint-torque regressor Y and π ~ N(μ, Λ), Λ diagonal.

    π: ten parameters a body in the order of the data's joints, (10 n,). The standard deviations of body i are m_i,
    m_i ℓ and m_i ℓ² for mass, first moment and inertia, times `exp(rigid_body.log_scale)` (3,). gravity: whether
    torques contain it.
    """

    def __init__(self, robot: RigidBody, prior: str = "urdf", gravity: bool = True) -> None:
        if prior not in PRIORS:
            raise ValueError(f"prior is {prior!r}, expected one of {', '.join(PRIORS)}")
        self.robot, self.prior, self.n_joints = robot, prior, robot.n_joints
        self.urdf_parameters = robot.parameters()
        mass = self.urdf_parameters[:, 0]
        total = float(mass.sum())
        if total <= 0 and prior == "urdf":
            raise ValueError(
                f"robot {robot.name!r} has no mass in its URDF, expected inertial parameters or prior 'zero'"
            )
        self._model = robot.model.copy()
        if not gravity:
            self._model.gravity = pinocchio().Motion.Zero()
        scale = np.maximum(mass, MASS_FLOOR * total) if total > 0 else np.ones(self.n_joints)
        powers = robot.length() ** np.array(KINDS)
        self._scale = torch.from_numpy((scale[:, None] * powers).reshape(-1))
        self._kinds = torch.tensor(KINDS * self.n_joints)
        self._order = np.array(robot.order)
        self._recent: tuple[tuple[Motion, Tensor], ...] = ()

    def features(self, x: Motion) -> Tensor:
        """Joint-torque regressor at each sample: (N, n, 10 n)."""
        for seen, features in self._recent:
            if seen.q is x.q and seen.dq is x.dq and seen.ddq is x.ddq:
                return features
        features = torch.from_numpy(self._regressor(*(part.cpu().numpy() for part in (x.q, x.dq, x.ddq)))).to(x.device)
        self._recent = ((x, features), *self._recent[: REMEMBERED - 1])
        return features

    def regressor(self) -> Regressor:
        """The same features of one query, for serving."""
        return RigidBodyRegressor(self._model, self._order)

    def covariance(self, params: Params) -> Tensor:
        """Prior variances of the parameters on the diagonal: (10 n, 10 n)."""
        log_scale = params["rigid_body.log_scale"]
        std = self._scale.to(log_scale.device) * torch.exp(log_scale[self._kinds.to(log_scale.device)])
        return torch.diag(std.square())

    def prior_weights(self) -> Tensor | None:
        """The URDF's parameters, or None around zero."""
        return torch.from_numpy(self.urdf_parameters.reshape(-1)) if self.prior == "urdf" else None

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """The same relative deviation for mass, first moment and inertia: (3,)."""
        return {
            "rigid_body.log_scale": torch.full((3,), float(np.log(START[self.prior])), dtype=torch.float64).to(
                tau.device
            )
        }

    def energy_features(self, x: Motion) -> Tensor:
        """Kinetic and potential energy per unit of each parameter, Pinocchio's regressors: (N, 2, 10 n) J."""
        pin, model, data, n = pinocchio(), self._model, self._model.createData(), self.n_joints
        chain = np.argsort(self._order)
        configuration = self._configuration(x.q.cpu().numpy()[:, chain])
        velocity = np.ascontiguousarray(x.dq.cpu().numpy()[:, chain])
        out = np.empty((len(x), 2, n, PARAMETERS))
        for k in range(len(x)):
            kinetic = pin.computeKineticEnergyRegressor(model, data, configuration[k], velocity[k])
            potential = pin.computePotentialEnergyRegressor(model, data, configuration[k])
            out[k] = np.stack([kinetic, potential]).reshape(2, n, PARAMETERS)
        return torch.from_numpy(out[:, :, self._order].reshape(len(x), 2, n * PARAMETERS)).to(x.device)

    def _regressor(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Y of N samples, rows and bodies in the order of the data's joints: (N, n, 10 n)."""
        pin, model, order = pinocchio(), self._model, self._order
        data, n = model.createData(), self.n_joints  # not kept: threads share the kernel
        chain = np.argsort(order)  # the data's joint at each place of the chain
        configuration = self._configuration(q[:, chain])
        velocity, acceleration = np.ascontiguousarray(dq[:, chain]), np.ascontiguousarray(ddq[:, chain])
        out = np.empty((len(q), n, n * PARAMETERS))
        for k in range(len(q)):
            out[k] = pin.computeJointTorqueRegressor(model, data, configuration[k], velocity[k], acceleration[k])
        if np.array_equal(order, np.arange(n)):
            return out
        bodies = out.reshape(len(q), n, n, PARAMETERS)[:, order][:, :, order]
        return np.ascontiguousarray(bodies).reshape(len(q), n, n * PARAMETERS)

    def _configuration(self, q: Array) -> Array:
        """Pinocchio's configurations of positions in the order of the chain: joints without limits take (cos, sin)."""
        columns: list[Array] = []
        for index, joint in enumerate(tuple(self._model.joints)[1:]):
            angle = q[:, index]
            columns += [angle] if joint.nq == 1 else [np.cos(angle), np.sin(angle)]
        return np.ascontiguousarray(np.stack(columns, axis=1))
