"""A trained torque model: immutable, asked for torques with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lipcore.data.metrics import Answer
from lipcore.data.motion import Motion, motion_arrays
from lipcore.data.samples import Array
from lipcore.estimators.catalogue import NO_CALIBRATION, Calibration, Estimator
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import Arm
from lipcore.model import external
from lipcore.model.selection import Selection
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.conformal import Conformal
from lipcore.posterior.evaluator import Evaluator
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import JointType, TorqueConvention


@dataclass(frozen=True)
class Fallback:
    """How torques differ from the posterior mean because the training does not determine them.

    share: of the fallback in each torque, 0 to 1; mean: of the posterior, N·m. Both have the shape of the torques.
    """

    share: Array
    mean: Array


class TorqueAnswer(NamedTuple):
    """Answer for one query of n joints, N·m: see `TorquePrediction`. tau, tau_std: (n,); covariance: (n, n)."""

    tau: Array
    tau_std: Array | None
    covariance: Array | None
    fallback: Fallback | None

    @property
    def mean(self) -> Array:
        """Mean of the posterior, (n,): `tau` unless it falls back."""
        return self.tau if self.fallback is None else self.fallback.mean


@dataclass(frozen=True)
class TorquePrediction:
    """Answer for N queries of n joints, N·m.

    tau: (N, n) mean; tau_std: (N, n) standard deviation of the function; noise_std: (n,) of the measurement; scale:
    (n,) factor on the half width of intervals, which for 95 % of measurements are

        tau ± 1.96 · scale · √(tau_std² + noise_std²)

    covariance: (N, n, n) of the function between joints, where asked for. fallback: None if every torque is the
    posterior mean; standard deviations and covariances are always those of the posterior.
    """

    tau: Array
    tau_std: Array
    noise_std: Array
    scale: Array
    covariance: Array | None = None
    fallback: Fallback | None = None

    @property
    def mean(self) -> Array:
        """Mean of the posterior, (N, n): `tau` unless it falls back."""
        return self.tau if self.fallback is None else self.fallback.mean

    @property
    def interval(self) -> Answer:
        """What its intervals are made of, to be judged: `lipcore.data.metrics.evaluate(tau, *prediction.interval)`."""
        return Answer(self.tau, self.tau_std, self.noise_std, self.scale)


TrainingRange = dict[str, dict[str, list[float]]]
"""Smallest (`min`) and largest (`max`) q, dq and ddq of the samples behind a posterior, per joint."""


def training_range(motion: Motion) -> TrainingRange:
    """Smallest and largest q, dq and ddq of N instants, SI units."""
    return {
        name: {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        for name, values in (("q", motion.q), ("dq", motion.dq), ("ddq", motion.ddq))
    }


TrainingTorque = dict[str, list[float]]
"""Mean (`mean`) and standard deviation (`std`) of the recorded torque, N·m, per joint."""


def training_torque(tau: Array) -> TrainingTorque:
    """Mean and standard deviation of N torques, (N, n) N·m."""
    return {"mean": tau.mean(0).tolist(), "std": tau.std(0).tolist()}


@dataclass(frozen=True)
class TorqueModel:
    """Fitted inverse dynamics of one robot: immutable, safe to share between threads.

    joint_names, joint_types: (n,), in the order of the data; torque_convention: what its torques hold; options: those
    of the fit; fit: what the fit reported, compact: how near the compact posterior comes to the exact one, both for the
    manifest; training_range: of the samples behind the posterior; robot: the rigid bodies of an estimator that has
    them; calibration: how the posterior's deviations are corrected; selection: how `auto` has chosen the estimator,
    None where it was named; conformal: what left-out blocks of the training say of the intervals; training_torque: of
    the recording. Both are None if an earlier release has trained it.

    If the posterior variance of a torque (without misfit and floor) exceeds its variance in training, the answer falls
    back to gravity, offset and friction, or to the training's mean if these are not determined either (eq. 26 of
    docs/method.md). Without `training_torque` no answer does.
    """

    estimator: Estimator
    joint_names: tuple[str, ...]
    joint_types: tuple[JointType, ...]
    torque_convention: TorqueConvention
    options: dict[str, int | float | bool | str]
    fit: dict[str, float | int | bool | str]
    posterior: CompactPosterior
    training_range: TrainingRange
    compact: dict[str, float | int | bool]
    robot: RigidBody | None = None
    calibration: Calibration = NO_CALIBRATION
    selection: Selection | None = None
    conformal: Conformal | None = None
    training_torque: TrainingTorque | None = None

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    @property
    def arm(self) -> Arm | None:
        """What is known of the rigid bodies, of an estimator that has them."""
        term = self.estimator.terms.get("rigid_body")
        return term.arm if isinstance(term, ArmKernel) else None

    def position_limits(self, largest: float) -> Array:
        """Largest |q| of each joint that can be in SI units, (n,) rad (m): `largest`, and any of joints that turn on,
        which are the revolute ones that were recorded over more than a turn."""
        return np.where(self._turns, np.inf, largest)

    @cached_property
    def _turns(self) -> NDArray[np.bool_]:
        span = np.subtract(self.training_range["q"]["max"], self.training_range["q"]["min"])
        return np.asarray((span > 2 * np.pi) & (np.array(self.joint_types) == "revolute"))

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the measured torque around the function, (n,) N·m, jitter included."""
        return np.asarray(np.sqrt(self.posterior.noise_variance))

    @property
    def scale(self) -> Array:
        """Factor on the half width of intervals, (n,): what left-out blocks of the training have proved, at least 1."""
        return np.ones(self.n_joints) if self.conformal is None else np.array(self.conformal.scale)

    def predict(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike, covariance: bool = False) -> TorquePrediction:
        """Torque with uncertainty for arrays of shape (n,) or (N, n), SI units.

        covariance: whether that between the joints is asked for, too.
        Raise ValueError for a wrong number of joints, differing shapes or a value that is not finite.
        """
        query = motion_arrays(q, dq, ddq)
        joints = query[0].shape[1]
        if joints != self.n_joints:
            raise ValueError(f"q has {joints} joints, expected {self.n_joints}: {', '.join(self.joint_names)}")
        mean, std, between, share = self.evaluator.many(*query, covariance)
        tau, fallback = mean, None
        if share is not None:
            rows = share.any(axis=1)
            tau, fallback = mean.copy(), Fallback(share, mean)
            tau[rows] = self.evaluator.fall_back(np.stack(query, axis=1)[rows], mean[rows], share[rows])
        return TorquePrediction(tau, std, self.noise_std, self.scale, between, fallback)

    def answer(self, motion: Array, std: bool = True) -> tuple[Array, Array | None]:
        """Torque at one instant, and its standard deviation where asked for: both (n,) N·m. For control loops.

        motion: q, dq and ddq as a float64 array (3, n). Neither shape nor finiteness is checked; what is not finite
        ends in what is not finite.
        """
        tau, deviation, share = self.evaluator.one(motion, std)
        return tau if share is None else self._harmless(motion, tau, share), deviation

    def answer_fully(self, motion: Array, std: bool = True, covariance: bool = False) -> TorqueAnswer:
        """Return what `answer` does, with the fallback and, if asked for together with std, the covariance."""
        between = np.empty((1, self.n_joints, self.n_joints)) if covariance else None
        mean, deviation, share = self.evaluator.one(motion, std, between)
        tau, fallback = mean, None
        if share is not None:
            tau, fallback = self._harmless(motion, mean, share), Fallback(share, mean)
        return TorqueAnswer(tau, deviation, None if between is None else between[0], fallback)

    def _harmless(self, motion: Array, tau: Array, share: Array) -> Array:
        return np.asarray(self.evaluator.fall_back(motion[None], tau[None], share[None])[0])

    def warm_up(self) -> None:
        """Do all that the first answer would otherwise wait for."""
        self.evaluator.warm_up()
        external.warm_up()

    @cached_property
    def evaluator(self) -> Evaluator:
        """The compiled form of the posterior, which answers queries."""
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
            posterior.misfit.packed(),
            None if torque is None else (np.array(torque["mean"]), np.square(torque["std"])),
        )
