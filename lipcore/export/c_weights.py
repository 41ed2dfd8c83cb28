"""The weights of arm and friction as tables for C: tau = Φ w, w ~ N(ŵ, C), in as few features as possible.

φ_b are the features that are not sums of others, Φᵀ = T φ_b, and Tᵀ C T = U Uᵀ, so that φᵀ C φ = |Uᵀ φ_b|².
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.kernels.fast.arm_recursion import PARAMETERS
from lipcore.model.torque_model import TorqueModel


class UnsupportedEstimatorError(ValueError):
    """The model's estimator cannot be written as C."""


@dataclass(frozen=True)
class LinearWeights:
    """The posterior of a model's p weights."""

    arm: ArmKernel
    friction: DriveKernel
    mean: Array
    """Mean of all weights, the arm's first, (p,)."""
    prior_scaled_root: Array
    """Q Λ, (p, p), with the prior variances Λ of the weights. The covariance of the weights is (Q Λ)ᵀ Q Λ."""
    shared: Array
    """Q, (p, m), for the m variables of another term: torques of a nonlinear one, or weights of a residual. If c is
    their covariance with a query, add Q c to Q Λ Φᵀ."""
    factor: float
    """Factor on the weights' deviations."""

    @classmethod
    def of(cls, model: TorqueModel) -> LinearWeights:
        """Return a model's weights; raise UnsupportedEstimatorError unless all are of arm and friction."""
        posterior, terms = model.posterior, model.estimator.terms
        arm, friction = terms["rigid_body"], terms["friction"]
        assert isinstance(arm, ArmKernel)
        assert isinstance(friction, DriveKernel)
        basis = posterior.basis
        if list(basis.linear[-2:]) != [arm, friction] or len(basis.linear) > 2 + (basis.residual is not None):
            raise UnsupportedEstimatorError("the posterior has weights other than those of rigid bodies and friction")
        diagonals = [each.variances(posterior.params) for each in (arm, friction)]
        prior, centre, first = np.concatenate(diagonals), arm.prior_weights(), basis.rows(arm).start
        assert centre is not None
        mean = posterior.weights[first:] * prior
        mean[: arm.size] += centre
        rows = posterior.root[first:]
        return cls(arm, friction, mean, rows[:, first:] * prior, rows[:, :first], posterior.std_factor)

    def root(self, expand: Array) -> tuple[Array, Array]:
        """Return U, upper triangular, with U Uᵀ = Tᵀ C T, and V, (p_b, m): the deviation is |Uᵀ φ_b + V c|.

        expand: T, (p, p_b).
        """
        size = expand.shape[1]
        # columns are reversed to get an upper root; QR avoids the product, which has the squared condition number
        turn, made = np.linalg.qr((self.prior_scaled_root @ expand)[:, ::-1])
        shared = turn.T @ self.shared
        return self.factor * made[::-1, ::-1].T, self.factor * shared[:size][::-1]


def expand_weights(learnt: LinearWeights, bodies: Array) -> Array:
    """Return T, (p, p_b), rows as the model's weights.

    Features are those of drive and rotor joint by joint, base to tip, then those of bodies and geometry, then those of
    other arms. bodies: T of bodies and geometry, (10 n + g, b).
    """
    arm, n, size = learnt.arm.arm, learnt.arm.n_joints, bodies.shape[1]
    rubbing = len(learnt.friction.drive.terms)
    others = 0 if learnt.arm.others is None else learnt.arm.others.size
    first = n * (1 + rubbing)
    out = np.zeros((len(learnt.mean), first + size + others))
    for j, joint in enumerate(arm.order):
        rows = slice(PARAMETERS * joint, PARAMETERS * (joint + 1))
        out[rows, first : first + size] = bodies[PARAMETERS * j : PARAMETERS * (j + 1)]
        own = j * (1 + rubbing)
        out[PARAMETERS * n + joint, own] = 1.0
        for term in range(rubbing):
            out[learnt.arm.size + rubbing * joint + term, own + 1 + term] = 1.0
    steps = learnt.arm.steps
    out[steps, first : first + size] = bodies[PARAMETERS * n :]
    if learnt.arm.others is not None:
        out[steps.stop : learnt.arm.size, first + size :] = learnt.arm.others.mixing.T
    return out
