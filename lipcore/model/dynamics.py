"""Dynamics of a torque model: inertia, Coriolis, gravity and friction torques, energies, forward dynamics.

Rigid-body torque is M(q) ddq + c(q, dq) + g(q). It is affine in ddq; at standstill without acceleration it is gravity
alone. So every part is a sum or difference of torques at a few motions, with an exact posterior (`functionals`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lipcore.data.motion import Array, Motion
from lipcore.estimators.catalogue import Estimator
from lipcore.kernels.base import TorqueKernel
from lipcore.kernels.combined import SumKernel
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.kernels.drive.play import deflections_of
from lipcore.model.equation import (
    UnavailableComponentError,
    dynamics_terms,
    gains,
    with_fixed_deflections,
)
from lipcore.model.functionals import (
    Combination,
    EnergyKernel,
    Estimate,
    add_combinations,
    combine_torques,
    kinetic_energy,
    potential_energy,
)
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.exact import Posterior
from lipcore.vocabulary import COMPONENTS, ComponentName, offered_components

_TORQUES: dict[ComponentName, dict[str, float]] = {
    "gravity": {"rest": 1.0},
    "coriolis": {"moving": 1.0, "rest": -1.0},
    "inertial": {"accelerating": 1.0, "rest": -1.0},
}
"""Components as sums of torques at standstill, moving without acceleration, and accelerating from standstill."""
LOAD_STEPS = 4
"""Steps of forward dynamics. Each reduces the remaining torque to a few percent: the share that the load determines."""


class IndefiniteInertiaError(ValueError):
    """The learnt inertia matrix cannot be inverted: the query is far from the training data. index: of the query."""

    def __init__(self, index: int) -> None:
        super().__init__(
            f"the learnt inertia matrix at query {index} is not positive definite, expected a posture near the "
            "training data"
        )
        self.index = index


def components(
    model: TorqueModel, motion: Motion, names: Sequence[str], tau: Array | None = None
) -> dict[str, Estimate]:
    """Return the posterior of components at N queries, by name.

    Only `friction` and `forward_dynamics` contain friction. It depends on the deflections of the motion, if known.
    Torques and the inertia matrix are those that the recording would read, with its gains; energies are physical.

    - `inertia_matrix` (N, n, n): M(q), kg·m² if both joints are revolute;
    - `inertial`, `coriolis`, `gravity`, `friction` (N, n): M(q) ddq, c(q, dq), g(q), f(dq); the torque is their sum;
    - `without_gravity` (N, n): the torque minus g(q), for robots that add gravity to commanded torque;
    - `kinetic_energy` (N,) J: ½ dqᵀ M(q) dq;
    - `potential_energy` (N,) J: V(q) − V(q₀), q₀ the `reference_posture`, with the uncertainty of the difference;
    - `forward_dynamics` (N, n) rad/s²: see `forward_dynamics`; needs `tau`, (N, n) N·m.

    Raise UnavailableComponentError for a name that is unknown or that the estimator does not have. Raise ValueError for
    a wrong number of joints, or if `tau` is missing, of another shape or not needed. Raise IndefiniteInertiaError.
    """
    asked = _check(model, motion, names, tau)
    posterior, terms = model.posterior, dynamics_terms(model.estimator)
    drive = model.estimator.terms.get("friction")
    estimates: dict[str, Estimate] = {}
    torques = [name for name in asked if name in _TORQUES or name == "inertia_matrix"]
    if torques:
        fixed = with_fixed_deflections(model.estimator, motion)
        estimates |= _torque_parts(posterior, SumKernel(*terms, *gains(model.estimator)), fixed, torques)
    if "friction" in asked:
        assert drive is not None  # `_check` has checked it
        friction = drive.friction() if isinstance(drive, DriveKernel) else drive
        estimates["friction"] = combine_torques(posterior, friction, [motion], np.eye(model.n_joints))
    if "without_gravity" in asked:
        estimates["without_gravity"] = _without_gravity(model, motion)
    energetic = _energy_terms(model.estimator)
    if "kinetic_energy" in asked:
        estimates["kinetic_energy"] = kinetic_energy(posterior, energetic, motion)
    if "potential_energy" in asked:
        estimates["potential_energy"] = potential_energy(posterior, energetic, motion, reference_posture(model))
    if "forward_dynamics" in asked and tau is not None:
        estimates["forward_dynamics"] = forward_dynamics(model, motion, tau)
    return {name: estimates[name] for name in asked}


def reference_posture(model: TorqueModel) -> Array:
    """Return the posture of zero potential energy, (n,): the middle of each joint's range in the training samples."""
    q = model.training_range["q"]
    return np.asarray(0.5 * (np.array(q["min"]) + np.array(q["max"])))


def forward_dynamics(model: TorqueModel, motion: Motion, tau: Array) -> Estimate:
    """Return the acceleration under torque tau (N, n) N·m, ddq = M(q)⁻¹ (tau − c − g − f), (N, n) rad/s².

    motion.ddq is not read. LOAD_STEPS fixed-point steps solve for friction and gains that depend on the load, and so
    on ddq. The uncertainty is of first order: an error ε of the whole torque at (q, dq, ddq) changes ddq by −M⁻¹ ε.
    This includes the error of M, and it is valid while the uncertainty of M is small compared with M.
    Raise IndefiniteInertiaError if M is not positive definite.
    """
    posterior = model.posterior
    friction, fixed = model.estimator.terms.get("friction"), with_fixed_deflections(model.estimator, motion)
    inertia = inertia_matrix(posterior, SumKernel(*dynamics_terms(model.estimator)), fixed)
    inertia = 0.5 * (inertia + inertia.mT)
    lowest = np.linalg.eigvalsh(inertia)[:, 0]
    if not (lowest > 0).all():
        raise IndefiniteInertiaError(int(np.argmin(lowest > 0)))
    ddq = np.zeros_like(motion.q)
    for _ in range(LOAD_STEPS if isinstance(friction, DriveKernel) and friction.drive.needs_bodies else 1):
        left = tau - posterior.mean(replace(fixed, ddq=ddq))
        ddq = ddq + np.linalg.solve(inertia, left[:, :, None])[:, :, 0]
    covariance = posterior.predict(replace(motion, ddq=ddq)).covariance
    half = np.linalg.solve(inertia, covariance)  # M⁻¹ Σ
    variance = np.linalg.solve(inertia, half.mT).diagonal(axis1=1, axis2=2)
    return Estimate(ddq, np.sqrt(variance.clip(0.0)))


def inertia_matrix(posterior: Posterior, dynamics: TorqueKernel, motion: Motion) -> Array:
    """Return the posterior mean of M(q), (N, n, n), kg·m² if both joints are revolute.

    dynamics: the kernel's terms without friction; motion: N instants, of which q and fixed deflections are read. Column
    j is the torque per unit acceleration of joint j, f(q, 0, e_j) − f(q, 0, 0). This is exact, since torque is affine
    in ddq.
    """
    zero = np.zeros_like(motion.q)
    rest = posterior.mean(replace(motion, dq=zero, ddq=zero), dynamics)
    pushes = [_push(motion, joint) for joint in range(motion.n_joints)]
    return np.stack([posterior.mean(push, dynamics) - rest for push in pushes], axis=2)


def _torque_parts(
    posterior: Posterior, kernel: TorqueKernel, motion: Motion, names: Sequence[ComponentName]
) -> dict[str, Estimate]:
    """Return the components of `_TORQUES` and the inertia matrix, from one joint posterior."""
    n, zero = motion.n_joints, np.zeros_like(motion.q)
    moves = {"rest": replace(motion, dq=zero, ddq=zero)}
    if "coriolis" in names:
        moves["moving"] = replace(motion, ddq=zero)
    if "inertial" in names:
        moves["accelerating"] = replace(motion, dq=zero)
    if "inertia_matrix" in names:
        moves |= {f"push {joint}": _push(motion, joint) for joint in range(n)}
    at = {move: index for index, move in enumerate(moves)}
    blocks = [_inertia_rows(at, n) if name == "inertia_matrix" else _vector_rows(name, at, n) for name in names]
    every = combine_torques(posterior, kernel, list(moves.values()), np.concatenate(blocks).reshape(-1, len(moves) * n))
    sizes = [len(block) for block in blocks]
    ends = np.cumsum(sizes)[:-1]
    parts = zip(names, np.split(every.mean, ends, axis=1), np.split(every.std, ends, axis=1), strict=True)
    return {
        name: Estimate(_symmetric(mean, n), _symmetric(std, n)) if name == "inertia_matrix" else Estimate(mean, std)
        for name, mean, std in parts
    }


def _without_gravity(model: TorqueModel, motion: Motion) -> Estimate:
    """Return the torque minus gravity, with the std of the difference.

    The errors that no term explains (`Misfit`) count in full: their share in gravity is unknown.
    """
    posterior, terms = model.posterior, model.estimator.terms
    if model.separates_gravity:
        return Estimate(*model.evaluator.without_gravity(motion.arrays()))
    drive, zero, eye = terms.get("friction"), np.zeros_like(motion.q), np.eye(model.n_joints)
    followed = motion
    if isinstance(drive, DriveKernel) and (elements := drive.drive.elements) is not None:
        followed = replace(motion, deflections=deflections_of(motion, elements.widths, elements.acceleration))
    none = None if followed.deflections is None else np.zeros_like(followed.deflections)
    dynamic = dynamics_terms(model.estimator)
    rest = replace(motion, dq=zero, ddq=zero, deflections=none)
    kernel = SumKernel(*dynamic, *gains(model.estimator))
    parts = [Combination(kernel, [followed, rest], np.concatenate([eye, -eye], axis=1))]
    for term in terms.values():
        if term not in dynamic:
            part = term.friction() if isinstance(term, DriveKernel) else term
            parts.append(Combination(part, [followed], eye))
    found = add_combinations(posterior, parts)
    if isinstance(posterior, CompactPosterior):
        variance = np.maximum(found.std**2 + posterior.misfit.variance(motion), posterior.floor)
        found = replace(found, std=np.sqrt(variance))
    return found


def _vector_rows(name: ComponentName, at: dict[str, int], n: int) -> Array:
    """Return the coefficients of a component of `_TORQUES`, (n, S, n)."""
    rows = np.zeros((n, len(at), n))
    for move, sign in _TORQUES[name].items():
        rows[:, at[move]] = sign * np.eye(n)
    return rows


def _inertia_rows(at: dict[str, int], n: int) -> Array:
    """Return the coefficients (n (n+1) / 2, S, n) of ½ (M_ij + M_ji) for i ≤ j.

    Column j of M is f(q, 0, e_j) − f(q, 0, 0).
    """
    i, j = np.triu_indices(n)
    entry, first_push, rest = np.arange(len(i)), at["push 0"], at["rest"]
    rows = np.zeros((len(i), len(at), n))
    for row, column in ((i, j), (j, i)):
        rows[entry, first_push + column, row] += 0.5
        rows[entry, rest, row] -= 0.5
    return rows


def _symmetric(upper: Array, n: int) -> Array:
    """Return symmetric matrices (N, n, n) from their entries i ≤ j, (N, n (n+1) / 2)."""
    i, j = np.triu_indices(n)
    full = np.empty((len(upper), n, n), dtype=upper.dtype)
    full[:, i, j] = full[:, j, i] = upper
    return full


def _push(motion: Motion, joint: int) -> Motion:
    """Return the unit acceleration of one joint from standstill."""
    zero = np.zeros_like(motion.q)
    push = zero.copy()
    push[:, joint] = 1.0
    return replace(motion, dq=zero, ddq=push)


def _energy_terms(estimator: Estimator) -> list[EnergyKernel]:
    return [term for term in dynamics_terms(estimator) if isinstance(term, EnergyKernel)]


def _check(model: TorqueModel, motion: Motion, names: Sequence[str], tau: Array | None) -> list[ComponentName]:
    offered = offered_components(model.estimator.name)
    for name in names:
        if name not in offered:
            raise UnavailableComponentError(
                f"component is {name!r}, expected one that estimator {model.estimator.name!r} offers: "
                f"{', '.join(offered)}"
            )
    if motion.n_joints != model.n_joints:
        raise ValueError(f"motion has {motion.n_joints} joints, expected {model.n_joints}")
    if ("forward_dynamics" in names) != (tau is not None):
        expected = "a torque for forward_dynamics" if tau is None else "None without forward_dynamics"
        raise ValueError(f"tau is {'None' if tau is None else 'given'}, expected {expected}")
    if tau is not None and tau.shape != motion.q.shape:
        raise ValueError(f"tau has shape {tau.shape}, expected {motion.q.shape}, the shape of q")
    return [name for name in COMPONENTS if name in names]
