"""A trained torque model: immutable, it predicts torques with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lipcore.data.motion import Motion, motion_arrays
from lipcore.data.samples import Array, Samples
from lipcore.estimators.catalogue import NO_CALIBRATION, Calibration, Estimator
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import Arm
from lipcore.kernels.drive.play import ELEMENTS, PlayFollower, PlayState, element_widths, with_deflections
from lipcore.kernels.drive.terms import SIGN_WIDTH
from lipcore.kernels.geometry import Geometry
from lipcore.model import equation, external
from lipcore.model.equation import LinearBodies
from lipcore.model.functionals import Estimate
from lipcore.model.prediction import Fallback, TorqueAnswer, TorquePrediction
from lipcore.model.selection import Selection
from lipcore.posterior.batch_mean import BatchMean
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.conformal import Conformal
from lipcore.posterior.evaluator import Evaluator
from lipcore.posterior.threads import run_parts
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import JointType, TorqueConvention

MIN_BATCH = 16
"""States from which on the mean alone is faster without features, measured on a Panda."""


TrainingRange = dict[str, dict[str, list[float]]]
"""Min (`min`) and max (`max`) of q, dq and ddq of the posterior's samples, per joint."""


def training_range(motion: Motion) -> TrainingRange:
    """Return min and max of q, dq and ddq of N instants, SI units."""
    return {
        name: {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        for name, values in (("q", motion.q), ("dq", motion.dq), ("ddq", motion.ddq))
    }


TrainingTorque = dict[str, list[float]]
"""Mean (`mean`) and standard deviation (`std`) of the recorded torque, N·m, per joint."""


def training_torque(tau: Array) -> TrainingTorque:
    """Return the mean and standard deviation of N torques, (N, n) N·m."""
    return {"mean": tau.mean(0).tolist(), "std": tau.std(0).tolist()}


@dataclass(frozen=True)
class TorqueModel:
    """Learnt inverse dynamics of one robot. It is immutable and may be shared between threads.

    If the posterior variance of a torque (without misfit and floor) exceeds its variance in training, the prediction
    falls back to gravity, offset and friction. If these are not determined either, it falls back to the mean torque in
    training, or to gravity for a joint that stood still there (eq. 26 of docs/method.md). Without `training_torque` no
    prediction falls back.
    """

    estimator: Estimator
    """Estimator of the model."""
    joint_names: tuple[str, ...]
    """Names of the joints, (n,), in the order of the data."""
    joint_types: tuple[JointType, ...]
    """Types of the joints, (n,)."""
    torque_convention: TorqueConvention
    """Meaning of its torques."""
    options: dict[str, int | float | bool | str]
    """Options of the fit."""
    fit: dict[str, float | int | bool | str]
    """Report of the fit, for the manifest."""
    posterior: CompactPosterior
    """Posterior of the torque."""
    training_range: TrainingRange
    """Range of the posterior's samples."""
    compact: dict[str, float | int | bool]
    """Deviation of the compact posterior from the exact one, for the manifest."""
    robot: RigidBody | None = None
    """Rigid bodies, if the estimator has them."""
    calibration: Calibration = NO_CALIBRATION
    """Calibration of the posterior's standard deviations."""
    selection: Selection | None = None
    """How `auto` chose the estimator; None if it was named."""
    conformal: Conformal | None = None
    """Conformal factors of the intervals; None for a model of an earlier release."""
    training_torque: TrainingTorque | None = None
    """Torque of the recording; None for a model of an earlier release."""

    def __getstate__(self) -> dict[str, Any]:
        """Pickle the fields and the evaluator if it is built: all other caches are cheap to compute again."""
        kept = {*(each.name for each in fields(self)), "evaluator"}
        return {name: value for name, value in vars(self).items() if name in kept}

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    @property
    def arm(self) -> Arm | None:
        """The learnt rigid bodies of all arms, if the estimator has them."""
        term = self.estimator.terms.get("rigid_body")
        return term.arm if isinstance(term, ArmKernel) else None

    @property
    def arms(self) -> int:
        """Number of arms on the base, 0 without rigid bodies."""
        return 0 if self.arm is None else len(self.arm.geometry.roots)

    @cached_property
    def geometry(self) -> Geometry | None:
        """The arm's geometry, as learnt if training moved it from that of the URDF; None without rigid bodies."""
        if self.arm is None or self.arm.mode == "fixed":
            return None if self.arm is None else self.arm.geometry
        basis = self.posterior.basis
        term = next(each for each in basis.linear if isinstance(each, ArmKernel))
        return term.geometry(self.posterior.slopes[basis.rows(term)])

    def position_limits(self, largest: float) -> Array:
        """Return the max |q| of each joint for values in SI units, (n,) rad (m).

        It is `largest`, and infinite for joints that turn continuously: revolute joints recorded over more than a turn.
        """
        return np.where(self._turns, np.inf, largest)

    @cached_property
    def _turns(self) -> NDArray[np.bool_]:
        span = np.subtract(self.training_range["q"]["max"], self.training_range["q"]["min"])
        return np.asarray((span > 2 * np.pi) & (np.array(self.joint_types) == "revolute"))

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the measured torque around the function, (n,) N·m, with jitter."""
        return np.asarray(np.sqrt(self.posterior.noise_variance))

    @property
    def scale(self) -> Array:
        """Factor on the half width of intervals, (n,), at least 1, from held-out blocks of the training."""
        return np.ones(self.n_joints) if self.conformal is None else np.array(self.conformal.scale)

    def predict(
        self,
        q: ArrayLike,
        dq: ArrayLike,
        ddq: ArrayLike,
        covariance: bool = False,
        deflections: Array | None = None,
    ) -> TorquePrediction:
        """Return the torque with its uncertainty at N states, or at one.

        Friction may depend on the motion before a state. Without `deflections` that motion is unknown, and the
        uncertainty at low speed is larger.

        Args:
            q: Positions, (n,) or (N, n), rad (m).
            dq: Velocities, same shape, rad/s (m/s).
            ddq: Accelerations, same shape, rad/s² (m/s²).
            covariance: Whether to compute the covariance between the joints.
            deflections: Deflections of the play elements, (N, 2 K, n); see `deflections_along`.

        Returns:
            Torques, standard deviations and, if requested, covariances; see `TorquePrediction`.

        Raises:
            ValueError: The number of joints is wrong, the shapes differ, or a value is not finite.

        """
        motion = self._checked(q, dq, ddq, deflections)
        mean, std, between, share = self.evaluator.many(motion.q, motion.dq, motion.ddq, covariance, deflections)
        tau, fallback = mean, None
        if share is not None:
            rows = share.any(axis=1)
            tau, fallback = mean.copy(), Fallback(share, mean)
            motions = motion[np.flatnonzero(rows)].arrays()
            tau[rows] = self.evaluator.fall_back(motions, mean[rows], share[rows])
        return TorquePrediction(tau, std, self.noise_std, self.scale, between, fallback)

    def torque(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike, deflections: Array | None = None) -> Array:
        """Return the mean torque alone at N states, or at one: for planners and simulators with large batches.

        It is `TorquePrediction.mean`, which never falls back, to rounding. Estimators `rigid-body` and
        `rigid-body+local` take a tenth to a half of the time of `predict`; others as long. Large batches use all
        processors.

        Args:
            q: Positions, (n,) or (N, n), rad (m).
            dq: Velocities, same shape, rad/s (m/s).
            ddq: Accelerations, same shape, rad/s² (m/s²).
            deflections: Deflections of the play elements, (N, 2 K, n); see `deflections_along`.

        Returns:
            Torques, (N, n) N·m (N).

        Raises:
            ValueError: The number of joints is wrong, the shapes differ, or a value is not finite.

        Example: the efforts of N states.

            np.abs(model.torque(q, dq, ddq)).sum(axis=1)

        """
        motion = self._checked(q, dq, ddq, deflections)
        batch = self._batch_mean if len(motion) >= MIN_BATCH else None
        if batch is None:
            return self.evaluator.many(motion.q, motion.dq, motion.ddq, False, deflections)[0]
        out = np.empty(motion.q.shape)

        def run_part(rows: slice) -> None:
            out[rows] = batch(motion[rows])

        run_parts(len(motion), run_part)
        return out

    def gravity(self, q: ArrayLike) -> Estimate:
        """Return the torque that holds the arm against gravity, g(q), and its standard deviation.

        M(q) ddq + c(q, dq) + g(q) is the torque without friction and correction, as the recording would read it. A
        payload of the model is included.

        Args:
            q: Positions, (n,) or (N, n), rad (m).

        Returns:
            Mean and standard deviation, shaped as q, N·m (N).

        Raises:
            UnavailableComponentError: The model was trained on torque without gravity, or cannot separate gravity.
            ValueError: The number of joints is wrong, or a value is not finite.

        Example: the torque of a computed-torque controller.

            tau = model.mass_matrix(q) @ ddq + model.coriolis(q, dq) + model.gravity(q).mean

        """
        query = self._checked(q, q, q, None)
        found, shape = equation.gravity(self, query.q), np.shape(q)
        return Estimate(found.mean.reshape(shape), found.std.reshape(shape))

    def coriolis(self, q: ArrayLike, dq: ArrayLike) -> Array:
        """Return the Coriolis and centrifugal torque c(q, dq); see `gravity`.

        Args:
            q: Positions, (n,) or (N, n), rad (m).
            dq: Velocities, same shape, rad/s (m/s).

        Returns:
            Mean torque, shaped as q, N·m (N).

        Raises:
            UnavailableComponentError: The model cannot separate it from friction.
            ValueError: The number of joints is wrong, the shapes differ, or a value is not finite.

        """
        query = self._checked(q, dq, dq, None)
        return equation.coriolis(self, query.q, query.dq).reshape(np.shape(q))

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Return the mass matrix M(q), with the inertia of the rotors; see `gravity`.

        Args:
            q: Positions, (n,) or (N, n), rad (m).

        Returns:
            Mean, symmetric, (n, n) or (N, n, n): kg·m² if both joints are revolute.

        Raises:
            UnavailableComponentError: The torque of the estimator is not affine in the acceleration.
            ValueError: The number of joints is wrong, or a value is not finite.

        """
        query = self._checked(q, q, q, None)
        return equation.mass_matrix(self, query.q).reshape(*np.shape(q), self.n_joints)

    def predict_along(self, samples: Samples, covariance: bool = False) -> TorquePrediction:
        """Return the torque along recordings: rows are in order of time in each episode, and friction follows them.

        Raise ValueError like `predict`.
        """
        known = samples.deflections
        if known is None and self.remembers and samples.n_joints == self.n_joints:
            known = with_deflections(samples, self.joint_types).deflections
        return self.predict(samples.q, samples.dq, samples.ddq, covariance, known)

    def deflections_along(self, t: Array, q: Array, dq: Array) -> Array | None:
        """Return the deflections along one motion, (N, 2 K, n) as in `Motion`; None if the model does not remember.

        The motion before the first row is unknown. t: (N,) s, in order of time; q, dq: (N, n).
        """
        if not self.remembers:
            return None
        return PlayState.unknown(self.n_joints).follow(t, q, dq, element_widths(self.joint_types))[0]

    @property
    def remembers(self) -> bool:
        """Whether friction depends on the motion before a state."""
        return self.posterior.misfit.elements.size > 0

    @property
    def separates_gravity(self) -> bool:
        """Whether `evaluator` computes its torque without gravity: it has bodies and no nonlinear term."""
        compact = isinstance(self.posterior, CompactPosterior)
        return compact and self.arm is not None and self.evaluator.separates_gravity

    def answer(self, motion: Array, std: bool = True) -> tuple[Array, Array | None]:
        """Return the torque at one instant, and its standard deviation if `std`, both (n,) N·m.

        It is meant for control loops.

        motion: q, dq and ddq, and deflections if known, float64 (3, n) or (3 + 2 K, n). Neither shape nor finiteness is
        checked. Values that are not finite give torques that are not finite.
        """
        tau, deviation, share = self.evaluator.one(motion, std)
        return tau if share is None else self._harmless(motion, tau, share), deviation

    def answer_fully(
        self, motion: Array, std: bool = True, covariance: bool = False, reduced: Array | None = None
    ) -> TorqueAnswer:
        """Return the torque like `answer`, with the fallback and, if requested together with std, the covariance.

        reduced: (2, n), receives the torque to send minus gravity, and the standard deviation of the difference. Only
        for a model that `separates_gravity`.
        """
        between = np.empty((1, self.n_joints, self.n_joints)) if covariance else None
        mean, deviation, share = self.evaluator.one(motion, std, between, reduced)
        tau, fallback = mean, None
        if share is not None:
            tau, fallback = self._harmless(motion, mean, share), Fallback(share, mean)
            if reduced is not None:
                reduced[0] += tau - mean
        return TorqueAnswer(tau, deviation, None if between is None else between[0], fallback)

    def _harmless(self, motion: Array, tau: Array, share: Array) -> Array:
        return np.asarray(self.evaluator.fall_back(motion[None], tau[None], share[None])[0])

    def warm_up(self) -> None:
        """Compile or load everything that the first prediction needs."""
        self.evaluator.warm_up()
        if self.remembers:
            PlayFollower(element_widths(self.joint_types)).step(0.0)
        external.warm_up()

    @cached_property
    def fast(self) -> TorqueModel:
        """The model with less exact answers in less time: a correction has fewer centres."""
        if self.posterior.basis.residual is None:
            return self
        model = replace(self)
        model.__dict__["evaluator"] = self.evaluator.fast()  # fill the cached property
        return model

    @cached_property
    def linear_bodies(self) -> LinearBodies | None:
        """The torque without friction and correction, or None for a model with a nonlinear term."""
        return LinearBodies(self.posterior) if self.separates_gravity else None

    def _checked(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike, deflections: Array | None) -> Motion:
        """Return N states; raise ValueError like `predict`."""
        query = motion_arrays(q, dq, ddq)
        joints = query[0].shape[1]
        if joints != self.n_joints:
            raise ValueError(f"q has {joints} joints, expected {self.n_joints}: {', '.join(self.joint_names)}")
        if deflections is not None:
            expected = (len(query[0]), 2 * len(ELEMENTS), joints)
            if deflections.shape != expected or not np.isfinite(deflections).all():
                raise ValueError(f"deflections has shape {deflections.shape}, expected finite numbers, {expected}")
        return Motion(*query, deflections)

    @cached_property
    def _batch_mean(self) -> BatchMean | None:
        """The mean of rigid bodies, drive and correction, or None if the model has other terms."""
        return BatchMean(self.posterior) if BatchMean.applies_to(self.posterior) else None

    @cached_property
    def evaluator(self) -> Evaluator:
        """The compiled form of the posterior, for predictions."""
        posterior, basis, torque = self.posterior, self.posterior.basis, self.training_torque
        return Evaluator(
            basis.term,
            posterior.params,
            None if basis.term is None else basis.inducing,
            basis.outputs,
            basis.linear,
            posterior.weights,
            posterior.root,
            posterior.std_factor,
            posterior.floor,
            posterior.misfit,
            None if torque is None else (np.array(torque["mean"]), np.square(torque["std"])),
            np.abs([self.training_range["dq"][end] for end in ("min", "max")]).max(0) < SIGN_WIDTH,
        )
