"""Physical parameters that a model has learnt, with uncertainty: friction coefficients and inertial parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np

from lipcore.data.samples import Array
from lipcore.estimators.catalogue import Estimator
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.base import LinearKernel
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.kernels.drive.terms import KIND_TERMS, passing_row, summary_rows
from lipcore.kernels.geometry import Geometry
from lipcore.model.plausible import is_plausible, nearest_plausible
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.compression import checks
from lipcore.posterior.exact import Posterior
from lipcore.posterior.linalg import eigen
from lipcore.robots.urdf import PARAMETERS

STEPS = ("turn 1", "turn 2", "shift 1", "shift 2")
"""Names of a joint's numbers of geometry: turns about, and shifts along, the two vectors across its axis."""
FrictionName = Literal["viscous", "coulomb", "load"]
"""Names of the coefficients of `Friction` that cannot be negative."""
UNIDENTIFIABLE_SHARE = 0.5
"""A parameter is unidentifiable if its standard deviation is above this share of the prior one."""


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
    """Friction of each joint, with standard deviations, (n,) each. See `summary_rows` if it is not linear in speed."""

    viscous: Array
    """N·m·s/rad (N·s/m)."""
    viscous_std: Array
    coulomb: Array
    """N·m (N)."""
    coulomb_std: Array
    offset: Array
    """N·m (N)."""
    offset_std: Array
    stribeck: Array | None = None
    """Additional friction at low speed, N·m (N); None if the model does not have it."""
    stribeck_std: Array | None = None
    position: Array | None = None
    """Torque that repeats over a turn, root mean square, N·m (N); None if the model does not have it."""
    position_std: Array | None = None
    load: Array | None = None
    """Friction per torque that the bodies need; None if the model does not have it."""
    load_std: Array | None = None
    gain: Array | None = None
    """Error of the torque's gain: 0.05 if torque reads 5 % too high for the masses; None if there is none."""
    gain_std: Array | None = None
    breakaway: Array | None = None
    """Friction of a joint that begins to slip, N·m (N); None if friction remembers nothing."""
    breakaway_std: Array | None = None
    stiffness: Array | None = None
    """Stiffness of a joint that has turned back, before it slips, N·m/rad (N/m); None likewise."""
    stiffness_std: Array | None = None


@dataclass(frozen=True)
class NegativeFriction:
    """A coefficient of friction that is negative, which no joint has."""

    joint: int
    """Place of the joint in the order of the data."""
    name: FrictionName
    mean: float
    std: float

    def is_implausible(self, deviations: float) -> bool:
        """Return whether it lies more than so many standard deviations below zero."""
        return self.mean < -deviations * self.std


@dataclass(frozen=True)
class InertialParameters:
    """Ten parameters of each of n bodies, (n, 10): mass kg, first moment (3) kg·m, inertia (6) kg·m².

    The inertia, xx, xy, yy, xz, yz, zz, is about the frame of the joint that moves the body.
    """

    mean: Array
    """Posterior mean."""
    std: Array
    """Posterior standard deviation. Torques determine many parameters only in combinations, which makes it large."""
    scale: Array
    """Prior standard deviation."""
    plausible: Array
    """Physically possible parameters nearest to the mean, in the metric of the posterior."""
    mean_is_plausible: bool
    """Whether the mean itself is physically possible."""
    geometry: Geometry
    """Geometry for the plausible parameters."""
    deviation: Array
    """Root mean square difference between their torque and the model's, in the range of the training, (n,) N·m."""


def weight_posterior(posterior: Posterior, term: LinearKernel) -> WeightPosterior:
    """Return the posterior N(E w + cᵀα, Λ − |L⁻¹c|²) of a linear term's p weights with the prior N(μ, Λ).

    term: one of the posterior's kernel. The covariance includes the posterior's calibration.
    """
    prior = term.variances(posterior.params)
    cross = posterior.with_weights(term, np.diag(prior))  # (M, p)
    white = posterior.whiten(cross)
    mean = cross.T @ posterior.weights
    if (centre := term.prior_weights()) is not None:
        mean = mean + centre
    covariance = posterior.std_factor**2 * (np.diag(prior) - white.T @ white)
    return WeightPosterior(mean, 0.5 * (covariance + covariance.T), np.sqrt(prior))


def friction_coefficients(posterior: Posterior, estimator: Estimator) -> Friction:
    """Return the friction of each joint with standard deviations, the weights of the friction term.

    Raise ValueError for an estimator without friction.
    """
    term = _drive_kernel(estimator)
    weights, n, f = weight_posterior(posterior, term), term.n_joints, len(term.drive.terms)
    mean, joints = weights.mean.reshape(n, f), np.arange(n)
    covariance = weights.covariance.reshape(n, f, n, f)[joints, :, joints]  # (n, f, f)
    named = {}
    rows = {name: np.tile(row, (n, 1)) for name, row in summary_rows(term.drive.kinds).items()}
    if (elements := term.drive.elements) is not None:
        rows["breakaway"] = rows["coulomb"] + rows.get("stribeck", 0.0)
        rows["stiffness"] = np.zeros((n, f))
        rows["stiffness"][:, -len(elements.widths) :] = 1 / elements.widths.T
    for name, row in rows.items():
        named[name] = np.einsum("nf,nf->n", mean, row)
        named[f"{name}_std"] = np.sqrt(np.maximum(np.einsum("nf,nfg,ng->n", row, covariance, row), 0.0))
    if "position" in term.drive.kinds:
        waves = [term.drive.terms.index(each) for each in KIND_TERMS["position"]]
        size = np.sqrt(0.5 * np.square(mean[:, waves]).sum(axis=1))
        slope = 0.5 * mean[:, waves] / np.maximum(size, 1e-300)[:, None]
        named["position"] = size
        named["position_std"] = np.sqrt(np.einsum("nf,nfg,ng->n", slope, covariance[:, waves][:, :, waves], slope))
    return Friction(**named)


def negative_friction(posterior: Posterior, estimator: Estimator) -> tuple[NegativeFriction, ...]:
    """Return the coefficients of friction that are negative; none for an estimator without friction.

    Viscous friction may be negative if friction is not linear in speed, because it is then the slope of a line.
    """
    if not isinstance(estimator.terms.get("friction"), DriveKernel):
        return ()
    friction, kinds = friction_coefficients(posterior, estimator), _drive_kernel(estimator).drive.kinds
    names: tuple[FrictionName, ...] = ("coulomb", "load") if "speed" in kinds else ("viscous", "coulomb", "load")
    return tuple(
        NegativeFriction(joint, name, float(mean), float(std))
        for name in names
        if (means := getattr(friction, name)) is not None
        for joint, (mean, std) in enumerate(zip(means, getattr(friction, f"{name}_std"), strict=True))
        if mean < 0
    )


def passing_friction(posterior: Posterior, estimator: Estimator) -> Array:
    """Return the Coulomb friction of each joint without the play elements, (n,) N·m (N).

    Raise ValueError for an estimator without friction.
    """
    term = _drive_kernel(estimator)
    mean = weight_posterior(posterior, term).mean.reshape(term.n_joints, -1)
    return np.asarray(mean @ passing_row(term.drive.kinds))


def inertial_parameters(posterior: CompactPosterior, estimator: Estimator) -> InertialParameters:
    """Return the inertial parameters of each of n bodies, with the nearest plausible ones.

    Raise ValueError for an estimator without rigid bodies.
    """
    term = _arm_kernel(estimator)
    weights, size = weight_posterior(posterior, term), PARAMETERS * term.n_joints
    mean, std, scale = (part[:size].reshape(-1, PARAMETERS) for part in (weights.mean, weights.std, weights.scale))
    geometry = term.geometry(weights.mean)
    if all(is_plausible(body) for body in mean):
        return InertialParameters(mean, std, scale, mean, True, geometry, np.zeros(term.n_joints))
    # two options: masses alone, for the geometry of the linearisation, where the torque is exactly linear in them; or
    # masses and geometry together, to first order in the geometry
    start = term.arm.centre[term.arm.place]
    alone = weights.mean.copy()
    metric = precision(posterior, term)
    part, steps = slice(0, size), term.steps
    alone[steps] = 0.0
    moved = np.linalg.solve(metric[part, part], metric[part, steps] @ (weights.mean / weights.scale)[steps])
    given = weights.mean[part] + moved * weights.scale[part]
    alone[part] = nearest_plausible(given, weights.scale[part], metric[part, part], term.n_joints, start)
    options = [alone]
    if term.arm.steps:
        options.append(nearest_plausible(weights.mean, weights.scale, metric, term.n_joints, start))
    asked = checks(posterior.basis.inducing)
    torque = posterior.predict(asked, term).mean
    errors = [np.sqrt(np.mean((term.torque(option, asked) - torque) ** 2, axis=0)) for option in options]
    best = int(np.argmin([np.mean(error / np.maximum(torque.std(0), 1e-12)) for error in errors]))
    plausible = options[best][:size].reshape(-1, PARAMETERS)
    return InertialParameters(mean, std, scale, plausible, False, term.geometry(options[best]), errors[best])


def precision(posterior: CompactPosterior, term: LinearKernel) -> Array:
    """Return the posterior precision of a term's weights, all others at their mean, in units of prior std, (p, p).

    It is I + A of the statistics if the posterior has them. A covariance loses precision beyond eight digits.
    """
    rows = posterior.basis.rows(term)
    if posterior.statistics is not None:
        return posterior.statistics.a[rows, rows] + np.eye(rows.stop - rows.start)
    weights = weight_posterior(posterior, term)
    scaled = weights.covariance / np.outer(weights.scale, weights.scale)
    values, vectors = eigen(0.5 * (scaled + scaled.T))
    return np.asarray((vectors / np.maximum(values, 1e-12)) @ vectors.T)


def report(posterior: CompactPosterior, estimator: Estimator, joint_names: Sequence[str]) -> dict[str, Any]:
    """Return all parameters of an estimator as plain numbers, for a manifest that `files.arm` reads.

    They are friction, and inertia, rotor and geometry of an arm. joint_names: (n,), in the order of the data.
    """
    friction = friction_coefficients(posterior, estimator)
    out: dict[str, Any] = {
        "friction": {
            name: {"mean": getattr(friction, name).tolist(), "std": getattr(friction, f"{name}_std").tolist()}
            for name in (each.name for each in fields(friction) if not each.name.endswith("_std"))
            if getattr(friction, name) is not None
        }
    }
    if "rigid_body" in estimator.terms:
        inertia = inertial_parameters(posterior, estimator)
        out["inertia"] = {
            "mean_is_plausible": inertia.mean_is_plausible,
            "plausible_deviation": inertia.deviation.tolist(),
            "bodies": [
                {
                    "joint": name,
                    "mean": _body(inertia.mean[j]),
                    "std": _body(inertia.std[j]),
                    "plausible": _body(inertia.plausible[j]),
                    "undetermined": _list_unidentifiable(inertia.std[j], inertia.scale[j]),
                }
                for j, name in enumerate(joint_names)
            ],
        }
        out |= _report_arm(posterior, _arm_kernel(estimator), joint_names, inertia.geometry)
    return out


def _report_arm(
    posterior: Posterior, term: ArmKernel, joint_names: Sequence[str], plausible: Geometry
) -> dict[str, Any]:
    """Return the posterior of rotor inertias and geometry. plausible: geometry of the plausible bodies."""
    weights, arm = weight_posterior(posterior, term), term.arm
    n = term.n_joints
    rotors = slice(PARAMETERS * n, (PARAMETERS + 1) * n)
    geometry, step_std = term.geometry(weights.mean), weights.std[term.steps]
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
                "plausible": {
                    "rotation": plausible.rotation[place].tolist(),
                    "translation": plausible.translation[place].tolist(),
                },
                "turn_std": std[:2].tolist(),
                "shift_std": std[2:].tolist(),
                "undetermined": [
                    name
                    for name, one, other in zip(STEPS, std, usual, strict=False)
                    if one > UNIDENTIFIABLE_SHARE * other
                ],
                **({"root": True} if place and place in geometry.roots else {}),
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


def _drive_kernel(estimator: Estimator) -> DriveKernel:
    term = estimator.terms.get("friction")
    if not isinstance(term, DriveKernel):
        raise ValueError(f"estimator {estimator.name!r} has no friction term")
    return term


def _arm_kernel(estimator: Estimator) -> ArmKernel:
    term = estimator.terms.get("rigid_body")
    if not isinstance(term, ArmKernel):
        raise ValueError(f"estimator {estimator.name!r} has no rigid bodies")
    return term


def _list_unidentifiable(std: Array, scale: Array) -> list[str]:
    """Return the names of a body's parameters that the samples do not identify."""
    left = std > UNIDENTIFIABLE_SHARE * scale
    parts = {"mass": left[0], "first_moment": left[1:4].any(), "inertia": left[4:].any()}
    return [name for name, is_open in parts.items() if is_open]


def _body(values: Array) -> dict[str, Any]:
    return {"mass": float(values[0]), "first_moment": values[1:4].tolist(), "inertia": values[4:].tolist()}
