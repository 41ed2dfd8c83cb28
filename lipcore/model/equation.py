"""Terms of the equation of motion: gravity g(q), Coriolis torque c(q, dq) and mass matrix M(q).

The torque is M(q) ddq + c(q, dq) + g(q), plus friction and a correction. The first three follow from f, the torque
without friction and correction (docs/method.md, section 5), since f is affine in ddq:

    g(q) = f(q, 0, 0),     c(q, dq) = f(q, dq, 0) − g(q),     M(q) e_j = f(q, 0, e_j) − g(q).

M is the symmetric part: errors of the torque constants make the two sides differ.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from lipcore.data.motion import Array, Motion
from lipcore.estimators.catalogue import Estimator
from lipcore.kernels.base import TorqueKernel
from lipcore.kernels.combined import SumKernel
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.kernels.drive.play import deflections_of
from lipcore.kernels.residual import ResidualKernel
from lipcore.model.functionals import Estimate, combine_torques
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.gravity import Gravity
from lipcore.vocabulary import ENERGY_ESTIMATORS

if TYPE_CHECKING:
    from lipcore.model.torque_model import TorqueModel

AFFINE_ESTIMATORS = (*ENERGY_ESTIMATORS, "gip")
"""Estimators whose torque is affine in ddq."""


VELOCITY, ACCELERATION = 1, 2
"""Rows of `Motion.arrays`."""


class UnavailableComponentError(ValueError):
    """The component does not exist, or the model does not have it. expected: models that have it."""

    def __init__(self, message: str, expected: str = "") -> None:
        super().__init__(message)
        self.expected = expected


def gravity(model: TorqueModel, q: Array) -> Estimate:
    """Return gravity and its standard deviation at N positions; see `TorqueModel.gravity`."""
    if model.torque_convention == "gravity_compensated":
        raise UnavailableComponentError(
            "This model has no gravity: it was trained on torque without gravity (`gravity_compensated`).",
            "a model of torque with gravity",
        )
    _check_energies(model, "gravity")
    rest = np.zeros_like(q)
    motion = with_fixed_deflections(model.estimator, Motion(q, rest, rest))
    if model.linear_bodies is not None:
        return model.linear_bodies.estimate(motion.arrays())
    return combine_torques(model.posterior, _bodies(model.estimator), [motion], np.eye(model.n_joints))


def coriolis(model: TorqueModel, q: Array, dq: Array) -> Array:
    """Return the Coriolis torque at N states, (N, n); see `TorqueModel.coriolis`."""
    _check_energies(model, "the Coriolis torque")
    moving = with_fixed_deflections(model.estimator, Motion(q, dq, np.zeros_like(q))).arrays()
    motions = np.stack([moving, moving])
    motions[1, :, VELOCITY] = 0.0
    torques = _torques(model, motions)
    return np.asarray(torques[0] - torques[1])


def mass_matrix(model: TorqueModel, q: Array) -> Array:
    """Return the mass matrix at N positions, (N, n, n); see `TorqueModel.mass_matrix`."""
    if model.estimator.name not in AFFINE_ESTIMATORS:
        raise UnavailableComponentError(
            f"This model has no mass matrix: its estimator is {model.estimator.name}, whose torque is not affine in "
            "the acceleration.",
            f"a model of estimator {', '.join(AFFINE_ESTIMATORS)}",
        )
    rest, joints = np.zeros_like(q), np.arange(model.n_joints)
    still = with_fixed_deflections(model.estimator, Motion(q, rest, rest)).arrays()
    motions = np.stack([still] * (model.n_joints + 1))
    motions[joints + 1, :, ACCELERATION, joints] = 1.0
    torques = _torques(model, motions)
    columns = torques[1:] - torques[0]  # (n, N, n)
    return np.asarray(0.5 * (columns.transpose(1, 2, 0) + columns.transpose(1, 0, 2)))


class LinearBodies:
    """Torque without friction and correction, Φ w, of a posterior that is linear in its weights.

    It is thread-safe. The numbers are those of `lipcore.model.dynamics`, in a small part of the time.
    """

    def __init__(self, posterior: CompactPosterior) -> None:
        terms = [term for term in posterior.basis.linear if not isinstance(term, ResidualKernel)]
        # a correction is before the other terms
        columns = slice(posterior.basis.rows(terms[0]).start, len(posterior.basis))
        self._bodies = Gravity(terms, [term.regressor() for term in terms])
        mask, self._std_factor = self._bodies.mask, posterior.std_factor
        self._slopes = posterior.slopes[columns] * mask
        # the root is lower triangular: above these rows, these columns are zero
        self._root = posterior.feature_root[columns, columns] * mask

    def torques(self, motions: Array) -> Array:
        """Return the mean torques at N instants, (N, n). motions: as of `Motion.arrays`."""
        return self._mean(self._bodies.features(motions))

    def estimate(self, motions: Array) -> Estimate:
        """Return the torques at N instants and their standard deviations, (N, n) each."""
        features = self._bodies.features(motions)
        std = self._std_factor * np.sqrt(np.square(self._root @ features).sum(axis=1))
        return Estimate(self._mean(features), std)

    def _mean(self, features: Array) -> Array:
        rows = features.swapaxes(0, 1).reshape(len(self._slopes), -1)
        return np.asarray((self._slopes @ rows).reshape(len(features), -1))


def dynamics_terms(estimator: Estimator) -> list[TorqueKernel]:
    """Return the terms of an estimator without friction, correction and alternative arms."""
    return [term for name, term in estimator.terms.items() if name not in ("friction", "local", "others")]


def gains(estimator: Estimator) -> list[TorqueKernel]:
    """Return the errors of torque constants, which scale gravity and inertia as the recording reads them."""
    drive = estimator.terms.get("friction")
    return [drive.gain()] if isinstance(drive, DriveKernel) and "gain" in drive.drive.kinds else []


def with_fixed_deflections(estimator: Estimator, motion: Motion) -> Motion:
    """Return the motion with deflections that do not depend on ddq. Alternative arms differ in friction."""
    friction = estimator.terms.get("friction")
    if not isinstance(friction, DriveKernel) or (elements := friction.drive.elements) is None:
        return motion
    known = deflections_of(replace(motion, ddq=np.zeros_like(motion.q)), elements.widths, elements.acceleration)
    known[:, len(elements.widths) :] = 0.0
    return replace(motion, deflections=known)


def _torques(model: TorqueModel, motions: Array) -> Array:
    """Return the mean torques without friction and correction, (S, N, n). motions: (S, N, …) as `Motion.arrays`."""
    flat, bodies = motions.reshape(-1, *motions.shape[2:]), model.linear_bodies
    if bodies is not None:
        found = bodies.torques(flat)
    else:
        found = model.posterior.mean(Motion.of(flat), _bodies(model.estimator))
    return found.reshape(len(motions), -1, model.n_joints)


def _bodies(estimator: Estimator) -> TorqueKernel:
    """Return the terms of f."""
    return SumKernel(*dynamics_terms(estimator), *gains(estimator))


def _check_energies(model: TorqueModel, what: str) -> None:
    if model.estimator.name not in ENERGY_ESTIMATORS:
        raise UnavailableComponentError(
            f"This model cannot separate {what} from other torque: its estimator is {model.estimator.name}.",
            f"a model of estimator {', '.join(ENERGY_ESTIMATORS)}",
        )
