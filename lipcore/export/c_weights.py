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
from lipcore.kernels.geometry import Geometry
from lipcore.model.body import LOWER_TRIANGLE
from lipcore.model.torque_model import TorqueModel

MASS, HX, HY, HZ, XX, XY, YY, XZ, YZ, ZZ = range(PARAMETERS)


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


def axes_of(geometry: Geometry) -> Array:
    """Return the axes of the written frames in those of the geometry, the joint's axis last: (n, 3, 3)."""
    return np.concatenate([geometry.across, geometry.axis[:, None]], axis=1).mT


def move_parameters(turn: Array, place: Array, body: Array) -> Array:
    """Return ten parameters of a body in another frame.

    The body's own frame has (3, 3) axes turned by `turn` and lies at `place`, (3,) m.
    """
    about = np.zeros((3, 3))
    about[LOWER_TRIANGLE] = body[XX:]
    about = about + np.tril(about, -1).T
    mass, first = body[MASS], turn @ body[HX:XX]
    # second moments, which transform as those of points
    second = turn @ (0.5 * np.trace(about) * np.eye(3) - about) @ turn.T
    second = second + np.outer(place, first) + np.outer(first, place) + mass * np.outer(place, place)
    return np.concatenate([[mass], first + mass * place, (np.trace(second) * np.eye(3) - second)[LOWER_TRIANGLE]])


def group_parameters(learnt: LinearWeights) -> tuple[list[list[int]], Array]:
    """Return which of each body's ten parameters torque depends on, and T: (p, p_b), rows as the model's weights.

    A body that is symmetric about a joint's axis may as well be fixed to the previous link. Three parameters of a body
    behind a revolute joint, and all inertia behind a prismatic one, are therefore sums of those of the previous link.
    """
    arm = learnt.arm.arm
    n, axes, unit = arm.n_joints, axes_of(arm.geometry), np.eye(PARAMETERS)
    before = np.concatenate([np.eye(3)[None], axes[:-1]])
    slides = [kind == "prismatic" for kind in arm.geometry.joint_types]
    # the first joint moves its body about, or along, one axis only
    kept = [[MASS] if slides[0] else [HX, HY, ZZ]]
    kept += [[MASS, HX, HY, HZ] if each else [HX, HY, XX, XY, XZ, YZ, ZZ] for each in slides[1:]]
    size = sum(map(len, kept))
    expand, at = np.zeros((n, PARAMETERS, size)), 0
    for j, names in enumerate(kept):
        expand[j, names, at + np.arange(len(names))] = 1.0
        at += len(names)
        if j == 0:
            continue
        turn = before[j].T @ arm.geometry.rotation[j] @ axes[j]
        place = before[j].T @ arm.geometry.translation[j]
        if slides[j]:
            for name in range(XX, PARAMETERS):
                expand[j, name] = move_parameters(turn, place, unit[name]) @ expand[j - 1]
        else:
            for name in (MASS, HZ):
                expand[j, name] = move_parameters(turn, place, unit[name]) @ expand[j - 1]
            round_ = move_parameters(turn, place, unit[XX] + unit[YY]) @ expand[j - 1]
            expand[j, YY] = round_ - expand[j, XX]
    return kept, _in_weights(learnt, axes, expand)


def _in_weights(learnt: LinearWeights, axes: Array, expand: Array) -> Array:
    """Return T of all weights. expand: (n, 10, b), features of the bodies in their written frames."""
    arm, n, size = learnt.arm.arm, learnt.arm.n_joints, expand.shape[2]
    rubbing = len(learnt.friction.drive.terms)
    rest = learnt.arm.size - (PARAMETERS + 1) * n
    out = np.zeros((len(learnt.mean), n * (1 + rubbing) + size + rest))
    first = n * (1 + rubbing)
    for j, joint in enumerate(arm.order):
        # features turn as the parameters' dual: Y' π' = Y π for π' = M π, so Y = Y' M
        turned = np.stack([move_parameters(axes[j].T, np.zeros(3), each) for each in np.eye(PARAMETERS)], axis=1)
        out[PARAMETERS * joint : PARAMETERS * (joint + 1), first : first + size] = turned.T @ expand[j]
        own = j * (1 + rubbing)
        out[PARAMETERS * n + joint, own] = 1.0
        for term in range(rubbing):
            out[learnt.arm.size + rubbing * joint + term, own + 1 + term] = 1.0
    steps = learnt.arm.steps
    out[steps, first + size : first + size + arm.steps] = np.eye(arm.steps)
    if learnt.arm.others is not None:
        out[steps.stop : learnt.arm.size, first + size + arm.steps :] = learnt.arm.others.mixing.T
    return out
