"""Compute how much of a model's torque variance a motion would remove.

The variance of a Gaussian process after more samples depends on where they are, not on the torques measured: it is
known before the robot moves. Let k be the covariance that a model's posterior (or a prior) gives to torques at two
motions. Measuring the motion X with noise R leaves k(r, r) − k(r, X) (k(X, X) + R)⁻¹ k(X, r) at a reference motion r.
Nothing is approximated: X has at most a few hundred samples, each of which represents several.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lipcore.data.motion import Motion
from lipcore.data.samples import Array, Samples
from lipcore.estimators.catalogue import make_estimator
from lipcore.estimators.hyperparameters import fit
from lipcore.estimators.options import FitOptions
from lipcore.excitation.limits import Limits
from lipcore.excitation.motions import draw
from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.kernels.base import Params, TorqueKernel
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.linalg import cholesky, solve_lower
from lipcore.robots.library import Robot
from lipcore.robots.simulation import inverse_dynamics
from lipcore.robots.urdf import RigidBody

PRIOR_FIT = FitOptions(hyperparameter_samples=80, posterior_samples=80, max_iterations=60, starts=1, device="cpu")
"""Short, but necessary: at the initial hyperparameters every motion seems useless, and the choice would not matter."""


@dataclass(frozen=True)
class Belief:
    """Gaussian belief about an n-joint robot's torques: a kernel with its hyperparameters, and what a model has learnt.

    noise_variance: (n,) (N·m)² of a measurement. posterior: None before training.
    """

    kernel: TorqueKernel
    params: Params
    noise_variance: Array
    posterior: CompactPosterior | None = None

    @classmethod
    def of_model(cls, model: TorqueModel) -> Belief:
        """Return the belief of a trained model, without its calibration factor, which scales all deviations alike."""
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
        """Return the belief before any data: an estimator with hyperparameters fitted to the URDF's torques.

        The URDF need not be right: it only shows how large and how smooth torques are.

        noise_std: N·m, of all joints or (n,); 1 % of the torque's spread by default. bodies: for estimators of rigid
        bodies. estimator: `rigid-body` with bodies and `lip-chain` without by default.
        """
        estimator = estimator or ("lip-chain" if bodies is None else "rigid-body")
        motion = draw(limits, PRIOR_FIT.hyperparameter_samples, seed)
        tau = inverse_dynamics(robot, motion.q, motion.dq, motion.ddq)
        std = 0.01 * tau.std(0) if noise_std is None else np.broadcast_to(noise_std, tau.shape[1:])
        if not (np.isfinite(std).all() and (std > 0).all()):
            raise ValueError(f"noise_std is {noise_std}, expected positive numbers, one for all joints or one for each")
        tau += std * np.random.default_rng(seed).standard_normal(tau.shape)
        t, apart = np.arange(len(motion), dtype=np.float64), np.arange(len(motion), dtype=np.int64)
        samples = Samples(robot.joint_names, t, apart, motion.q, motion.dq, motion.ddq, tau)
        kernel = make_estimator(
            estimator, robot.joint_types, arm=None if bodies is None else arm_of_robot(bodies, mode="calibrate")
        ).kernel
        return cls(kernel, fit(kernel, samples, PRIOR_FIT).params, np.square(std))

    @property
    def floor(self) -> Array:
        """Return the min variance of the model's predictions, (n,) (N·m)²."""
        return np.zeros_like(self.noise_variance) if self.posterior is None else self.posterior.floor

    def cross(self, motion: Motion) -> Array:
        """Return the prior covariance of M variables with the torques of N motions, (M, N n); M = 0 for a prior."""
        if self.posterior is None:
            return np.zeros((0, len(motion) * self.kernel.n_joints))
        return self.posterior.cross(self.kernel, motion)

    @property
    def root(self) -> Array:
        """Return Q, (M, M): for a cross covariance c, training removes the variance (Q c)² of these torques."""
        return np.zeros((0, 0)) if self.posterior is None else self.posterior.learnt


@dataclass(frozen=True)
class Information:
    """How much a motion would reduce the variance at R reference motions of an n-joint robot."""

    belief: Belief
    """The belief before the motion."""
    reference: Motion
    learnt: Array
    """Its square is the variance at the references that training has removed, (M, R n)."""
    now: Array
    """Variance at the references, (R, n) (N·m)²."""
    floor: Array
    """Min variance, (n,)."""

    @classmethod
    def about(cls, belief: Belief, reference: Motion) -> Information:
        """Return the information of a belief about `reference`."""
        learnt = belief.root @ belief.cross(reference)
        prior = belief.kernel.variance(belief.params, reference).diagonal(axis1=1, axis2=2)
        now = np.maximum(prior - np.square(learnt).sum(0).reshape(prior.shape), belief.floor)
        return cls(belief, reference, learnt, now, belief.floor)

    def left(self, motion: Motion, repeats: float = 1.0) -> Array:
        """Return the share of the variance at the references that remains after measuring a motion of N samples, (n,).

        It is the geometric mean over the references. repeats: how many samples each of the N represents.
        """
        belief = self.belief
        own = belief.kernel.symmetric_gram(belief.params, motion)
        _, explained = self._explained(own, self._with_reference(motion), belief.root @ belief.cross(motion), repeats)
        return self._share(self._after(explained))

    def slope(self, motion: Motion, repeats: float = 1.0) -> tuple[float, Motion]:
        """Return the mean over joints of log `left`, and its derivatives by the motion, each (N, n).

        With S = k(X, X) + R, D = k(X, r) and α = S⁻¹ D, the variance that X explains at r changes by 2 αᵀ dD − αᵀ dS α.
        """
        belief, kernel, params = self.belief, self.belief.kernel, self.belief.params
        own, other, cross = kernel.gram(params, motion, motion), self._with_reference(motion), belief.cross(motion)
        learnt = belief.root @ cross
        solved, explained = self._explained(own, other, learnt, repeats)
        after = self._after(explained)
        moves = after == self.now - explained  # a variance that has reached its floor stays there
        weight = -np.where(moves, 1 / after, 0.0).reshape(-1) / after.size
        by_other = 2 * solved * weight
        by_own = -(solved * weight) @ solved.T
        by_cross = belief.root.T @ (-2 * learnt @ by_own - self.learnt @ by_other.T)
        size, n = motion.q.shape
        parts = {"q": motion.q, "dq": motion.dq, "ddq": motion.ddq}
        slopes = {name: np.empty_like(part) for name, part in parts.items()}
        step = 1e-6  # rad and its rates: covariances are smooth over far more, all but friction's sign (0.02)
        for name, part in parts.items():
            for joint in range(n):
                moved = part.copy()
                moved[:, joint] += step
                near = Motion(**{**parts, name: moved})
                # a sample moves both its row and its column
                total = 2 * (by_own * (kernel.gram(params, near, motion) - own)).sum(1)
                total += (by_other * (self._with_reference(near) - other)).sum(1)
                total += (by_cross * (belief.cross(near) - cross)).sum(0)
                slopes[name][:, joint] = total.reshape(size, n).sum(1) / step
        return float(np.log(self._share(after)).mean()), Motion(**slopes)

    def _with_reference(self, motion: Motion) -> Array:
        """Return the prior covariance of the motion's torques with those at the references, (N n, R n)."""
        return self.belief.kernel.gram(self.belief.params, motion, self.reference)

    def _explained(self, own: Array, other: Array, learnt: Array, repeats: float) -> tuple[Array, Array]:
        """Return S⁻¹ D, (N n, R n), and the variance that the motion would remove, (R, n), from prior covariances."""
        noise = np.tile(self.belief.noise_variance / repeats, len(own) // len(self.floor))
        factor = cholesky(own - learnt.T @ learnt + np.diag(noise))
        whitened = factor.whiten(other - learnt.T @ self.learnt)
        solved = solve_lower(factor.lower, whitened, transposed=True)
        return solved, np.square(whitened).sum(0).reshape(self.now.shape)

    def _after(self, explained: Array) -> Array:
        return np.maximum(np.maximum(self.now - explained, self.floor), 1e-9 * self.now)

    def _share(self, after: Array) -> Array:
        """Return the geometric mean over the references. The largest variances would dominate an arithmetic mean."""
        return np.asarray(np.exp(np.log(after / self.now).mean(0)))
