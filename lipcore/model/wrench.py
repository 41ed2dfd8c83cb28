"""External force and moment at the last link, from the external torque of an arm with a known geometry.

If a wrench F acts on the arm, the motors supply the torque of the model minus Jᵀ F, so that the external torque is
e = −Jᵀ F + ε, ε ~ N(0, C). F is the generalised least squares solution. It is not a safety function: see
docs/safety.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.kernels.geometry import Geometry
from lipcore.model.torque_model import TorqueModel

SINGULAR_RATIO = 0.005
"""Ratio of the smallest to the largest singular value of J, lengths in units of the reach, below which a posture counts
as singular. Of 2000 random postures, 92 % of a Panda's and 86 % of a UR10's are above it."""


class NoWrenchError(ValueError):
    """The external torque does not determine a wrench."""


@dataclass(frozen=True)
class Wrench:
    """Force, N, and moment about the origin of the last link or tool, N·m, that act on the arm: (6,) each."""

    link: Array
    """In the axes of the last link, those of payloads, or in those of the tool."""
    base: Array
    """In the axes of the base."""
    link_covariance: Array
    """(6, 6)."""
    base_covariance: Array
    """(6, 6)."""

    @property
    def link_std(self) -> Array:
        """Standard deviations in the axes of the last link, (6,)."""
        return np.sqrt(self.link_covariance.diagonal())

    @property
    def base_std(self) -> Array:
        """Standard deviations in the axes of the base, (6,)."""
        return np.sqrt(self.base_covariance.diagonal())


def has_wrench(model: TorqueModel) -> bool:
    """Return whether a model has one arm, with the geometry of a URDF and enough joints for a wrench."""
    return model.arm is not None and model.arms == 1 and model.arm.mode != "learn" and model.n_joints >= 6


def external_wrench(
    model: TorqueModel, motion: Array, tau: Array, scale: Array | None = None, tool: Array | None = None
) -> Wrench:
    """Return the wrench at the last link that explains a measured torque.

    Its covariance is that of the torque without contact, C = S (K + Σ) S as in `external`.

    Args:
        model: Model with the geometry of a URDF (`geometry` `fixed` or `calibrate`).
        motion: q, dq and ddq, (3, n).
        tau: Measured torque, (n,) N·m.
        scale: Factor on the half width of intervals, (n,). Default: that of the model.
        tool: Pose of the tool's frame in the last link's, (4, 4), m. Default: the last link's own frame.

    Raises:
        NoWrenchError: The geometry is learnt, the model has several arms, the arm has less than 6 joints, or the
            posture is singular.

    Example:
        >>> external_wrench(model, motion, tau).base_std
    """
    arm, geometry = model.arm, model.geometry
    if arm is None or geometry is None or arm.mode == "learn":
        raise NoWrenchError(
            "the geometry of this model is learnt from torque, which does not determine where its links are. Train "
            "with a URDF and the option geometry fixed or calibrate"
        )
    if model.arms > 1:
        raise NoWrenchError(f"the model has {model.arms} arms; a wrench needs a model of one arm. Train one for each")
    answer = model.answer_fully(motion, covariance=True)
    assert answer.covariance is not None
    factor = model.scale if scale is None else scale
    covariance = factor[:, None] * (answer.covariance + np.diag(np.square(model.noise_std))) * factor
    order = arm.order
    return wrench_of(geometry, motion[0][order], (tau - answer.mean)[order], covariance[np.ix_(order, order)], tool)


def wrench_of(geometry: Geometry, q: Array, torque: Array, covariance: Array, tool: Array | None = None) -> Wrench:
    """Return the wrench of an external torque (n,) N·m with this covariance, (n, n). Joints from base to tip.

    Raise NoWrenchError for less than 6 joints or a singular posture.
    """
    if geometry.n_joints < 6:
        raise NoWrenchError(f"the arm has {geometry.n_joints} joints; six components of a wrench need at least 6")
    jacobian, turn = jacobian_of(geometry, q, tool)
    reach = np.linalg.norm(geometry.translation, axis=1).sum()
    sizes = np.linalg.svd(jacobian / np.repeat([reach, 1.0], 3)[:, None], compute_uv=False)
    if sizes[-1] < SINGULAR_RATIO * sizes[0]:
        raise NoWrenchError(
            f"the posture is singular: in some direction a wrench hardly changes the torque (ratio of singular values "
            f"{sizes[-1] / sizes[0]:.1e}, expected at least {SINGULAR_RATIO}). Move the arm away from it"
        )
    weighted = np.linalg.solve(covariance, jacobian.T)  # C⁻¹ Jᵀ
    found = np.linalg.inv(jacobian @ weighted)
    found = 0.5 * (found + found.T)
    base = -found @ (weighted.T @ torque)
    into = np.kron(np.eye(2), turn.T)
    return Wrench(into @ base, base, into @ found @ into.T, found)


def jacobian_of(geometry: Geometry, q: Array, tool: Array | None = None) -> tuple[Array, Array]:
    """Return the Jacobian (6, n) of the last link's origin in the axes of the base, linear first; and its axes, (3, 3).

    q: (n,), base to tip; tool: pose of another frame in the last link, (4, 4), which then replaces the last link's.
    """
    turns, places = geometry.placements(q)
    pose = np.eye(4) if tool is None else tool
    tip = places[-1] + turns[-1] @ pose[:3, 3]
    axes = (turns @ geometry.axis[..., None])[..., 0]
    slides = np.array([kind == "prismatic" for kind in geometry.joint_types])[:, None]
    linear = np.where(slides, axes, np.cross(axes, tip - places))
    return np.concatenate([linear, np.where(slides, 0.0, axes)], axis=1).T, turns[-1] @ pose[:3, :3]
