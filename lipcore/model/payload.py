"""A payload: a body in addition to those of the learnt arm, and the model that predicts with it.

A payload is fixed to the last link. Torque is linear in its ten parameters, as in those of that link. If the geometry
is learnt too, torque is linearised around the means of both,

    tau = Y(θ + δθ) (π + payload) ≈ Y(θ) (π + payload) + J(θ, π + payload) δθ,

where θ is the geometry of the learnt arm or, far from it, the geometry estimated from rows with the payload. The
variables of the posterior are those of the learnt arm, and the ten of the payload.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from lipcore.data.metrics import quantile
from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.estimators.catalogue import Estimator
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import Alternative
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.kernels.geometry import Geometry
from lipcore.kernels.mixture import MixtureKernel
from lipcore.kernels.payload import PayloadKernel
from lipcore.model.memory import Memory
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.basis import Basis
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.linalg import block_diagonal, eigen
from lipcore.posterior.statistics import make_solution
from lipcore.robots.urdf import PARAMETERS
from lipcore.vocabulary import ROBOT_ESTIMATORS

ONE_ARM = "but payloads are supported for one arm: train a model for each arm"
"""What to do if a model has several arms."""


class NoArmError(ValueError):
    """The model has no rigid bodies that a payload could be added to, or several arms."""


@dataclass(frozen=True)
class PayloadPosterior:
    """Posterior N(mean, covariance) of (w, π): a model's whitened variables w, (M,), and a payload π."""

    mean: Array
    """Mean of (w, π), (M + 10,)."""
    covariance: Array
    """Covariance of (w, π), (M + 10, M + 10)."""
    room: Array
    """Upper bounds of the variances of π for any w and π, (10,)."""
    geometry: Geometry | None = None
    """Geometry with this mean, at which torque is linearised. None: the geometry of the learnt arm."""
    others: tuple[Alternative, ...] = ()
    """Arms with their payloads that are equally probable, this one first; empty if the posterior is practically
    linear."""
    excess: Array | float = 0.0
    """Variance of the errors of rows with the payload, beyond the stated one, (n,) (N·m)². It lasts like an error of
    the arm."""

    @property
    def payload(self) -> Array:
        """Mean of the payload's parameters, (10,)."""
        return self.mean[-PARAMETERS:]


@dataclass(frozen=True)
class Carrier:
    """A model with an arm that can carry a payload. Raise NoArmError if it has no arm, or several."""

    model: TorqueModel

    def __post_init__(self) -> None:
        if self.model.arm is None:
            raise NoArmError(
                f"estimator {self.model.estimator.name!r} has no rigid bodies, expected a model of estimator "
                f"{', '.join(ROBOT_ESTIMATORS)}"
            )
        if self.model.arms > 1:
            raise NoArmError(f"the model has {self.model.arms} arms, {ONE_ARM}")

    def has_same_posterior(self, other: Carrier) -> bool:
        """Return whether another revision has the same posterior.

        Rows that are excluded from learning do not change it.
        """
        one, two = self.model.posterior, other.model.posterior
        return self is other or (
            one.basis is two.basis and np.array_equal(one.weights, two.weights) and np.array_equal(one.root, two.root)
        )

    @property
    def term(self) -> ArmKernel:
        """The arm among the model's terms."""
        kernel = self.model.estimator.terms["rigid_body"]
        assert isinstance(kernel, ArmKernel)
        return kernel

    @cached_property
    def rows(self) -> slice:
        """Places of the arm's weights among the variables."""
        return self.model.posterior.basis.rows(self.term)

    @cached_property
    def mean(self) -> Array:
        """Mean ŵ of the whitened variables, (M,)."""
        posterior = self.model.posterior
        return np.asarray(posterior.basis.root.T @ posterior.weights)

    @cached_property
    def covariance(self) -> Array:
        """Covariance Σ of the whitened variables, (M, M)."""
        covariance = self.model.posterior.covariance
        values, vectors = eigen(covariance)
        if values[0] >= 1e-14:  # relative to the prior variance of one
            return np.asarray(covariance)
        # a variance that the samples determine to rounding may have either sign
        return np.asarray((vectors * np.maximum(values, 1e-14)) @ vectors.T)

    @cached_property
    def covariance_root(self) -> Array:
        """Cholesky root of the covariance, (M, M) lower triangular."""
        return np.asarray(np.linalg.cholesky(self.covariance))

    @property
    def is_nonlinear(self) -> bool:
        """Whether the arm's geometry can be followed beyond the linear range.

        The geometry must be learnt, and all other terms of the torque must be linear, so that the variables are few.
        """
        return self.term.arm.steps > 0 and self.model.posterior.basis.term is None

    @cached_property
    def memory(self) -> Memory:
        """Training memory: with it, the probability of arms with another geometry is computed."""
        n, limits = self.model.n_joints, self.model.training_range
        count = int(np.ceil(1.5 * self.term.size / n))  # one and a half times as many torques as the arm has weights
        draw = np.random.default_rng(0).uniform
        q, dq, ddq = (draw(limits[name]["min"], limits[name]["max"], (count, n)) for name in ("q", "dq", "ddq"))
        motion, posterior = Motion.from_arrays(q, dq, ddq), self.model.posterior
        features, base = LinearisedCarrier(self, self.known(np.zeros(PARAMETERS))).rows(motion)
        variance = posterior.noise_variance + posterior.misfit.variance(motion)
        if posterior.basis.residual is not None:
            variance = variance + posterior.basis.residual.beyond(motion)
        return Memory.of(motion.arrays(), base, features[:-PARAMETERS], self.rows, self.mean, self.covariance, variance)

    @cached_property
    def steps(self) -> slice:
        """Places of the geometry's steps among the variables."""
        first, steps = self.rows.start, self.term.steps
        return slice(first + steps.start, first + steps.stop)

    @property
    def is_tip_unidentified(self) -> bool:
        """Whether the training leaves the direction of the last axis, which bears almost no load, unidentified.

        A right angle may still be expected there, but then any right angle.
        """
        arm = self.term.arm
        taught = (1 / self.covariance.diagonal()[self.steps] - 1) / arm.widths**2
        first = arm.steps - arm.geometry.screws[-1]
        return bool((taught[first : first + 2] < 0.1**-2).any())  # the first two numbers are turns, rad

    @property
    def step(self) -> Array:
        """Mean step of the geometry, (g,) rad and m."""
        return self.weights(self.mean)[self.term.steps]

    def alternative(self, mean: Array, geometry: Geometry, payload: Array, probability: float) -> Alternative:
        """Return the arm of these variables, (M,), and a geometry, with a payload, (10,)."""
        arm, n, friction = self.term.arm, self.model.n_joints, self.model.estimator.terms["friction"]
        assert isinstance(friction, DriveKernel)
        weights, rows = self.weights(mean), self.model.posterior.basis.rows(friction)
        bodies = weights[: PARAMETERS * n].reshape(n, PARAMETERS)[arm.order]
        bodies[-1] += payload
        rotor, rubbing = weights[PARAMETERS * n : (PARAMETERS + 1) * n], self.root[rows] * mean[rows]
        return Alternative(geometry, bodies, rotor, rubbing.reshape(n, -1), probability)

    def weights(self, mean: Array) -> Array:
        """Return the arm's weights, (p,), from the mean of the variables, (M,)."""
        centre = self.term.prior_weights()
        return np.asarray(self.root[self.rows] * mean[self.rows] + (0.0 if centre is None else centre))

    @cached_property
    def root(self) -> Array:
        """Prior standard deviations of the weights, the diagonal of the basis' root, (M,)."""
        return np.asarray(self.model.posterior.basis.root.diagonal())

    def rest(self, motion: Motion) -> tuple[Array, Array]:
        """Return features of w at N instants, (M, N, n), zero for the arm's, and prior means of other terms, (N, n)."""
        posterior, base = self.model.posterior, np.zeros(motion.q.shape)
        out = np.zeros((len(self.mean), *base.shape))
        for kernel in posterior.basis.linear:
            if kernel is self.term:
                continue
            places = posterior.basis.rows(kernel)
            out[places] = kernel.features(motion).transpose(2, 0, 1) * self.root[places][:, None, None]
            base += kernel.mean(motion)
        if posterior.basis.term is not None:
            # features of the nonlinear term: its torques are whitened by a root that is not diagonal
            whitened, _ = posterior.basis.features_and_uncovered(motion)
            count = len(posterior.basis.outputs)
            out[:count] = whitened[:count].reshape(-1, *base.shape)
        return out, base

    def known(self, body: Array, spread: Array | None = None) -> PayloadPosterior:
        """Return the posterior of a known payload of ten parameters.

        spread: covariance, (10, 10); None if it is known exactly.
        """
        size = len(self.mean)
        covariance = np.zeros((size + PARAMETERS, size + PARAMETERS))
        covariance[:size, :size] = self.covariance
        if spread is not None:
            covariance[size:, size:] = spread
        # Σ ≤ k diag Σ for every covariance of k numbers, here a payload's ten: so the posterior is nowhere wider than
        # its prior, which the evaluator assumes
        room = PARAMETERS * np.diagonal(covariance)[size:]
        return PayloadPosterior(np.concatenate([self.mean, body]), covariance, np.maximum(room, 1e-12))

    def warm_up(self) -> None:
        """Predict once with a payload, and once with several arms with a payload, so that all code is compiled."""
        n, geometry = self.model.n_joints, self.term.arm.geometry
        load = self.known(np.zeros(PARAMETERS))
        if self.is_nonlinear:
            other = self.alternative(self.mean, geometry, load.payload, 0.5)
            load = replace(load, geometry=geometry, others=(other, other))
        self.with_payload(load).answer(np.zeros((3, n)))

    def with_payload(self, load: PayloadPosterior) -> TorqueModel:
        """Return the model that predicts with a payload. Its intervals include the uncertainty of the payload."""
        posterior, around = self.model.posterior, LinearisedCarrier(self, load)
        unit = np.concatenate([np.ones(len(self.mean)), np.sqrt(load.room)])
        size, count = len(unit), len(unit) + max(0, len(load.others) - 1)
        mean, covariance = np.zeros(count), np.eye(count)
        mean[:size], covariance[:size, :size] = load.mean / unit, load.covariance / np.outer(unit, unit)
        solved = CompactPosterior.solved(
            around.estimator.kernel,
            around.basis,
            make_solution(mean, covariance, len(around.basis.outputs)),
            posterior.noise_variance,
            posterior.std_factor,
            posterior.floor,
            posterior.misfit,
        )
        return replace(self.model, estimator=around.estimator, posterior=solved)


@dataclass(frozen=True, eq=False)
class LinearisedCarrier:
    """A carrier linearised around a payload posterior: its torque is linear in w and π, see the module."""

    carrier: Carrier
    load: PayloadPosterior

    @cached_property
    def estimator(self) -> Estimator:
        """The model's terms, with the payload in the arm's parameters, plus terms of the payload and of other arms."""
        estimator = self.carrier.model.estimator
        terms = {name: self._loaded(each) for name, each in estimator.terms.items()}
        more = {} if self._others is None else {"others": self._others}
        return replace(estimator, terms={**terms, "payload": self._payload, **more})

    @cached_property
    def basis(self) -> Basis:
        """Basis with the variables w, π / √room, and those of other arms."""
        basis = self.carrier.model.posterior.basis
        own = np.diag(np.sqrt(self._payload.variances(basis.params)))
        linear = [self._loaded(each) for each in basis.linear]
        linear, roots = [*linear, self._payload], [basis.root, own]
        if self._others is not None:
            linear.append(self._others)
            roots.append(np.diag(np.sqrt(self._others.variances(basis.params))))
        return replace(basis, linear=tuple(linear), root=block_diagonal(roots))

    def rows(self, motion: Motion, rest: tuple[Array, Array] | None = None) -> tuple[Array, Array]:
        """Return the features of (w, π) of N instants, (M + 10, N, n), and the torque if both are zero, (N, n) N·m.

        rest: `Carrier.rest` of the same instants, if it was computed before.
        """
        features, base = self.carrier.rest(motion) if rest is None else rest
        places, centre = self.carrier.rows, self._arm.prior_weights()
        of_arm = self._arm.features(motion)
        out = np.empty((len(features) + PARAMETERS, *base.shape))
        out[: places.start], out[places.stop : -PARAMETERS] = features[: places.start], features[places.stop :]
        out[places] = of_arm.transpose(2, 0, 1) * self.carrier.root[places][:, None, None]
        if self._friction is not None:  # friction grows with the payload, too
            rubbing, kernel = self._friction
            where = self.carrier.model.posterior.basis.rows(rubbing)
            out[where] = kernel.features(motion).transpose(2, 0, 1) * self.carrier.root[where][:, None, None]
        out[-PARAMETERS:] = self._payload.features(motion).transpose(2, 0, 1)
        return out, base if centre is None else base + of_arm @ centre

    def _loaded(self, term: Any) -> Any:
        """Return a term of the model with the payload."""
        if term is self.carrier.term:
            return self._arm
        return self._friction[1] if self._friction is not None and term is self._friction[0] else term

    @cached_property
    def _friction(self) -> tuple[DriveKernel, DriveKernel] | None:
        """The drive without and with the payload in its load; None if it does not depend on the load."""
        friction = self.carrier.model.estimator.terms["friction"]
        if not isinstance(friction, DriveKernel) or not friction.drive.needs_bodies:
            return None
        return friction, DriveKernel(self._arm.arm.friction)

    @cached_property
    def _arm(self) -> ArmKernel:
        arm, load = self.carrier.term.arm, self.load
        if load.geometry is None:
            parameters = arm.parameters.copy()
        else:
            size = PARAMETERS * arm.n_joints
            weights = self.carrier.weights(load.mean[:-PARAMETERS])
            parameters = weights[:size].reshape(-1, PARAMETERS)[arm.order]
            # steps start at this geometry, and their mean is zero
            step = weights[self.carrier.term.steps]
            arm = replace(arm, geometry=load.geometry, expected=arm.expected - step)
        parameters[-1] += load.payload
        return ArmKernel(replace(arm, parameters=parameters))

    def all_rows(self, motion: Motion) -> tuple[Array, Array]:
        """Return the features of all variables of N instants, (M + K + 10, N, n), and the mean torque, (N, n) N·m.

        The order of the variables is that of `covariance`.
        """
        features, base = self.rows(motion)
        mean = base + np.tensordot(self.load.mean, features, axes=1)
        if self._others is None:
            return features, mean
        more, centre = self._others.features(motion), self._others.prior_weights()
        known = np.split(features, [len(features) - PARAMETERS])
        return np.concatenate([known[0], more.transpose(2, 0, 1), known[1]]), mean + more @ centre

    @cached_property
    def covariance(self) -> Array:
        """Covariance of w, of the weights of K other arms, and of π, (M + K + 10, M + K + 10)."""
        known = self.load.covariance
        if self._others is None:
            return known
        size, count = len(known) - PARAMETERS, self._others.size
        places = np.concatenate([np.arange(size), size + count + np.arange(PARAMETERS)])
        out = np.zeros((len(known) + count,) * 2)
        out[np.ix_(places, places)] = known
        out[size : size + count, size : size + count] = np.diag(self._others.variances(self.basis.params))
        return out

    @cached_property
    def _others(self) -> MixtureKernel | None:
        arm = self.carrier.term.arm
        others = self.load.others
        return MixtureKernel(arm, others, _variance_factor([each.probability for each in others])) if others else None

    @cached_property
    def _payload(self) -> PayloadKernel:
        return PayloadKernel(self._arm.arm, self.load.room)


def _variance_factor(shares: Sequence[float]) -> float:
    """Return the variance factor for a mixture of few draws, so that 95 % intervals keep their coverage.

    It is that of Student's t, with the effective number of equal draws.
    """
    from scipy.stats import t  # noqa: PLC0415 - serving does without it

    count = max(1.0, 1 / float(np.square(shares).sum()) - 1)
    return float((t.ppf(0.975, count) / quantile(0.95)) ** 2)
