"""What is known of a robot's torques before the planned motion: a model's posterior, or a prior alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from lipcore.compact.posterior import CompactPosterior
from lipcore.estimators import make_estimator
from lipcore.excitation.limits import Limits
from lipcore.excitation.reference import draw
from lipcore.fit_options import FitOptions
from lipcore.fitting import fit
from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.kernels.base import Params, TorqueKernel
from lipcore.model import TorqueModel
from lipcore.motion import Motion
from lipcore.robots import Robot
from lipcore.samples import Array, Samples
from lipcore.simulation import inverse_dynamics
from lipcore.urdf import RigidBody

PRIOR_MOTIONS = 80
"""Motions whose torques, as the URDF has them, tell a prior's hyperparameters."""
NOISE_SHARE = 0.01
"""Standard deviation of the noise that is expected, as a share of a joint's torque spread, where none is given."""
PRIOR_FIT = FitOptions(
    hyperparameter_samples=PRIOR_MOTIONS, posterior_samples=PRIOR_MOTIONS, max_iterations=60, starts=1, device="cpu"
)
"""Short: where hyperparameters start, all motions would seem hopeless, and nothing be gained by choosing one."""


@dataclass(frozen=True)
class Belief:
    """Gaussian belief of an n-joint robot's torques: a kernel with its hyperparameters, and what a model has learnt.

    noise_variance: (n,) (N·m)² of a measurement. posterior: None before anything was learnt.
    """

    kernel: TorqueKernel
    params: Params
    noise_variance: Tensor
    posterior: CompactPosterior | None = None

    @classmethod
    def of_model(cls, model: TorqueModel) -> Belief:
        """What a trained model believes. Its calibration factor is left out: it widens all deviations alike."""
        posterior = replace(model.posterior, std_factor=1.0)
        return cls(posterior.kernel, posterior.params, posterior.noise_variance, posterior)

    @classmethod
    def prior(
        cls,
        robot: Robot,
        limits: Limits,
        noise_std: Array | float | None = None,
        estimator: str | None = None,
        bodies: RigidBody | None = None,
        seed: int = 0,
    ) -> Belief:
        """What is believed before any data: an estimator with hyperparameters fitted to what the URDF says.

        The URDF need not be right: it tells how large and how smooth torques are, not what they are.

        noise_std: N·m, of all joints or (n,); NOISE_SHARE of the torque's spread by default. bodies: for estimators
        of rigid bodies. estimator: `rigid-body` with bodies and `lip-chain` without by default.
        """
        estimator = estimator or ("lip-chain" if bodies is None else "rigid-body")
        motion = draw(limits, PRIOR_MOTIONS, seed)
        tau = inverse_dynamics(robot, motion.q.numpy(), motion.dq.numpy(), motion.ddq.numpy())
        std = NOISE_SHARE * tau.std(0) if noise_std is None else np.broadcast_to(noise_std, tau.shape[1:])
        if not (np.isfinite(std).all() and (std > 0).all()):
            raise ValueError(f"noise_std is {noise_std}, expected positive numbers, one or one a joint")
        tau += std * np.random.default_rng(seed).standard_normal(tau.shape)
        t, apart = np.arange(len(motion), dtype=np.float64), np.arange(len(motion), dtype=np.int64)
        samples = Samples(robot.joint_names, t, apart, motion.q.numpy(), motion.dq.numpy(), motion.ddq.numpy(), tau)
        kernel = make_estimator(
            estimator, robot.joint_types, arm=None if bodies is None else arm_of_robot(bodies, mode="calibrate")
        ).kernel
        return cls(kernel, fit(kernel, samples, PRIOR_FIT).params, torch.from_numpy(np.square(std)))

    @property
    def floor(self) -> Tensor:
        """Variance that the model's answers never fall below, (n,) (N·m)²."""
        return torch.zeros_like(self.noise_variance) if self.posterior is None else self.posterior.floor

    def cross(self, motion: Motion) -> Tensor:
        """Prior covariance of what the model is made of with all torques of N motions, (M, N n); M = 0 for a prior."""
        if self.posterior is None:
            return torch.zeros((0, len(motion) * self.kernel.n_joints), dtype=torch.float64)
        return self.posterior.cross(self.kernel, motion)

    @property
    def root(self) -> Tensor:
        """Q, (M, M): Q c, of a cross covariance c, has as its square what the model has learnt of those torques."""
        return torch.zeros((0, 0), dtype=torch.float64) if self.posterior is None else self.posterior.root
