"""Physical parameters that a model has learnt, with uncertainty: friction coefficients and inertial parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lipcore.estimators import Estimator
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.base import LinearKernel
from lipcore.kernels.friction import FRICTION_TERMS, FrictionKernel
from lipcore.posterior import Posterior
from lipcore.robots import pinocchio
from lipcore.samples import Array
from lipcore.urdf import PARAMETERS

LEAST_MASS, MOST_MASS = 1e-4, 1e2
"""Mass of a plausible body, as a share of the whole arm's: the search must neither vanish nor run away."""
LEAST_EXTENT, MOST_EXTENT = 1e-3, 1e2
"""Spread of a plausible body's mass along each axis, m: no real body is a point."""
STEPS = ("turn 1", "turn 2", "shift 1", "shift 2")
"""Names of a joint's numbers of geometry: about, and along, the two vectors across its axis."""
UNDETERMINED = 0.5
"""Torque does not tell what is still as uncertain as this share of what was expected beforehand."""
LEAST_VARIANCE = 1e-10
"""Smallest posterior variance relative to the prior's that rounding leaves meaningful."""

SEARCH: dict[str, Any] = {"x_scale": "jac", "ftol": 1e-4, "max_nfev": 1000}
"""Ends within a few percent of the least squared distance; the rest would take ten times as long."""


@dataclass(frozen=True)
class WeightPosterior:
    """Gaussian posterior of the weights of one linear term. mean: (p,); covariance: (p, p); scale: (p,) prior std."""

    mean: Array
    covariance: Array
    scale: Array

    @property
    def std(self) -> Array:
        """Standard deviations, (p,)."""
        return np.sqrt(np.maximum(self.covariance.diagonal(), 0.0))


@dataclass(frozen=True)
class Friction:
    """Coefficients per joint and their standard deviations, each (n,).

    viscous: N·m·s/rad (N·s/m); coulomb, offset: N·m (N).
    """

    viscous: Array
    viscous_std: Array
    coulomb: Array
    coulomb_std: Array
    offset: Array
    offset_std: Array


@dataclass(frozen=True)
class InertialParameters:
    """Ten parameters of each of n bodies, (n, 10): mass kg, first moment (3) kg·m, inertia (6) kg·m².

    The inertia, xx, xy, yy, xz, yz, zz, is about the frame of the joint that moves the body. mean, std: of the
    posterior; many are known from torques only in combinations, which std shows. scale: standard deviations
    beforehand. plausible: the physically possible
    parameters nearest to the mean in the posterior's metric; mean_is_plausible: whether the mean is possible itself.
    """

    mean: Array
    std: Array
    scale: Array
    plausible: Array
    mean_is_plausible: bool


def weight_posterior(posterior: Posterior, term: LinearKernel) -> WeightPosterior:
    """Posterior of a linear term's weights, whose prior is N(μ, Λ)."""
    prior = term.covariance(posterior.params).detach()
    cross = posterior.with_weights(term, prior)  # (M, p)
    white = posterior.whiten(cross)
    mean = cross.T @ posterior.weights
    if (centre := term.prior_weights()) is not None:
        mean = mean + centre.to(mean.device)
    covariance = posterior.std_factor**2 * (prior - white.T @ white)
    return WeightPosterior(_numpy(mean), _numpy(0.5 * (covariance + covariance.T)), _numpy(prior.diagonal().sqrt()))


def friction_coefficients(posterior: Posterior, estimator: Estimator) -> Friction:
    """Friction of each joint with standard deviations; raise ValueError for an estimator without friction."""
    term = estimator.terms.get("friction")
    if not isinstance(term, FrictionKernel):
        raise ValueError(f"estimator {estimator.name!r} has no friction term")
    weights = weight_posterior(posterior, term)
    shape = (term.n_joints, len(FRICTION_TERMS))
    mean, std = weights.mean.reshape(shape).T, weights.std.reshape(shape).T
    named = dict(zip(FRICTION_TERMS, mean, strict=True))
    named |= {f"{name}_std": value for name, value in zip(FRICTION_TERMS, std, strict=True)}
    return Friction(**named)


def inertial_parameters(posterior: Posterior, estimator: Estimator) -> InertialParameters:
    """Inertial parameters of each body; raise ValueError for an estimator without rigid bodies."""
    term = _arm_kernel(estimator)
    every = weight_posterior(posterior, term)
    size = PARAMETERS * term.n_joints
    weights = WeightPosterior(every.mean[:size], every.covariance[:size, :size], every.scale[:size])
    mean, std = (part.reshape(-1, PARAMETERS) for part in (weights.mean, weights.std))
    plausible = all(is_plausible(body) for body in mean)
    nearest = mean if plausible else nearest_plausible(weights, term.arm.centre[term.arm.place])
    return InertialParameters(mean, std, weights.scale.reshape(-1, PARAMETERS), nearest, plausible)


def report(posterior: Posterior, estimator: Estimator, joint_names: Sequence[str]) -> dict[str, Any]:
    """All parameters of an estimator as plain numbers, for a manifest."""
    friction = friction_coefficients(posterior, estimator)
    out: dict[str, Any] = {
        "friction": {
            name: {"mean": getattr(friction, name).tolist(), "std": getattr(friction, f"{name}_std").tolist()}
            for name in FRICTION_TERMS
        }
    }
    if "rigid_body" in estimator.terms:
        inertia = inertial_parameters(posterior, estimator)
        out["inertia"] = {
            "mean_is_plausible": inertia.mean_is_plausible,
            "bodies": [
                {
                    "joint": name,
                    "mean": _body(inertia.mean[j]),
                    "std": _body(inertia.std[j]),
                    "plausible": _body(inertia.plausible[j]),
                    "undetermined": _open(inertia.std[j], inertia.scale[j]),
                }
                for j, name in enumerate(joint_names)
            ],
        }
        out |= _of_arm(posterior, _arm_kernel(estimator), joint_names)
    return out


def _of_arm(posterior: Posterior, term: ArmKernel, joint_names: Sequence[str]) -> dict[str, Any]:
    """Rotor inertias and the geometry as the posterior has it."""
    weights, arm = weight_posterior(posterior, term), term.arm
    n = term.n_joints
    rotors = slice(PARAMETERS * n, (PARAMETERS + 1) * n)
    steps, step_std = weights.mean[term.steps], weights.std[term.steps]
    geometry = arm.geometry if arm.mode == "fixed" else arm.geometry.moved(steps)
    joints, at = [], 0
    for place, count in enumerate(geometry.screws):
        std = step_std[at : at + count] if arm.steps else np.zeros(0)
        usual = arm.widths[at : at + count]
        at += count
        joints.append(
            {
                "joint": joint_names[arm.order[place]],
                "type": geometry.joint_types[place],
                "rotation": geometry.rotation[place].tolist(),
                "translation": geometry.translation[place].tolist(),
                "axis": geometry.axis[place].tolist(),
                "across": geometry.across[place].tolist(),
                "turn_std": std[:2].tolist(),
                "shift_std": std[2:].tolist(),
                "undetermined": [
                    name for name, one, other in zip(STEPS, std, usual, strict=False) if one > UNDETERMINED * other
                ],
            }
        )
    return {
        "rotor": {"mean": weights.mean[rotors].tolist(), "std": weights.std[rotors].tolist()},
        "geometry": {
            "mode": arm.mode,
            "gravity": geometry.gravity.tolist(),
            "order": arm.order.tolist(),
            "joints": joints,
        },
    }


def _arm_kernel(estimator: Estimator) -> ArmKernel:
    term = estimator.terms.get("rigid_body")
    if not isinstance(term, ArmKernel):
        raise ValueError(f"estimator {estimator.name!r} has no rigid bodies")
    return term


def _open(std: Array, scale: Array) -> list[str]:
    """Which of a body's parameters the samples leave as they were expected."""
    left = std > UNDETERMINED * scale
    parts = {"mass": left[0], "first_moment": left[1:4].any(), "inertia": left[4:].any()}
    return [name for name, is_open in parts.items() if is_open]


def pseudo_inertia(body: Array) -> Array:
    """The pseudo-inertia [[Σ, h], [hᵀ, m]] of ten parameters, (4, 4): positive definite for every real body."""
    mass, moment = body[0], body[1:4]
    xx, xy, yy, xz, yz, zz = body[4:]
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    out = np.empty((4, 4))
    out[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    out[:3, 3] = out[3, :3] = moment
    out[3, 3] = mass
    return out


def is_plausible(body: Array) -> bool:
    """Whether ten parameters belong to a body that can exist: its pseudo-inertia is positive definite."""
    return bool(np.linalg.eigvalsh(pseudo_inertia(body))[0] > 0)


def nearest_plausible(weights: WeightPosterior, start: Array) -> Array:
    """Plausible parameters (n, 10) nearest to the posterior mean in the posterior's metric.

    Least squares over the log-Cholesky coordinates of each pseudo-inertia (Rucker & Wensing 2022), which no implausible
    body has; start: (n, 10), from which the search starts, made plausible where it is not.
    """
    log_cholesky = pinocchio().LogCholeskyParameters
    n = len(start)
    total = max(float(weights.mean.reshape(n, PARAMETERS)[:, 0].sum()), float(start[:, 0].sum()), 1e-3)
    # whitened by the prior first: posterior variances span many orders of magnitude
    scaled = weights.covariance / np.outer(weights.scale, weights.scale)
    values, vectors = np.linalg.eigh(scaled)
    metric = (vectors / np.sqrt(np.maximum(values, LEAST_VARIANCE))).T / weights.scale
    low, high = np.full((2, n, PARAMETERS), MOST_EXTENT) * np.array([-1, 1])[:, None, None]
    low[:, 0], high[:, 0] = 0.5 * np.log([LEAST_MASS * total, MOST_MASS * total])
    low[:, 1:4], high[:, 1:4] = np.log([LEAST_EXTENT, MOST_EXTENT])

    def residual(flat: Array) -> Array:
        bodies = [log_cholesky(part).toDynamicParameters() for part in flat.reshape(n, PARAMETERS)]
        return np.asarray(metric @ (np.concatenate(bodies) - weights.mean))

    def jacobian(flat: Array) -> Array:
        out = np.empty((n * PARAMETERS, n * PARAMETERS))
        for index, part in enumerate(flat.reshape(n, PARAMETERS)):
            columns = slice(index * PARAMETERS, (index + 1) * PARAMETERS)
            out[:, columns] = metric[:, columns] @ log_cholesky(part).calculateJacobian()
        return out

    from scipy.optimize import least_squares  # noqa: PLC0415 - serving does without it

    limits = (low.reshape(-1), high.reshape(-1))
    begin = np.array([_log_cholesky(body, total / n) for body in start])
    begin = np.clip(begin, low + 1e-3, high - 1e-3)
    found = least_squares(residual, begin.reshape(-1), jacobian, bounds=limits, **SEARCH)
    return np.array([log_cholesky(part).toDynamicParameters() for part in found.x.reshape(n, PARAMETERS)])


def _log_cholesky(body: Array, usual_mass: float) -> Array:
    """Log-Cholesky coordinates [α, d1, d2, d3, s12, s23, s13, t1, t2, t3] of a body, of a small ball where it is none.

    Its pseudo-inertia is U Uᵀ with U = e^α [[e^d1, s12, s13, t1], [0, e^d2, s23, t2], [0, 0, e^d3, t3], [0, 0, 0, 1]].
    """
    if not is_plausible(body):
        radius = 0.05
        ball = 0.4 * usual_mass * radius**2
        body = np.array([usual_mass, 0, 0, 0, ball, 0, ball, 0, 0, ball])
    flip = np.eye(4)[::-1]
    upper = flip @ np.linalg.cholesky(flip @ pseudo_inertia(body) @ flip) @ flip
    unit = upper / upper[3, 3]
    logs = np.log([upper[3, 3], unit[0, 0], unit[1, 1], unit[2, 2]])
    return np.concatenate([logs, [unit[0, 1], unit[1, 2], unit[0, 2]], unit[:3, 3]])


def _body(values: Array) -> dict[str, Any]:
    return {"mass": float(values[0]), "first_moment": values[1:4].tolist(), "inertia": values[4:].tolist()}


def _numpy(values: Tensor) -> Array:
    out: Array = values.to(torch.float64).cpu().numpy()
    return out
