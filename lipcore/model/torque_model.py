"""A trained torque model: immutable, asked for torques with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from lipcore.data.metrics import Answer
from lipcore.data.motion import Motion, motion_arrays
from lipcore.data.samples import Array
from lipcore.fitting.estimators import NO_CALIBRATION, Calibration, Estimator
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
class TorquePrediction:
    """Answer for N queries of n joints, N·m.

    tau: (N, n) mean; tau_std: (N, n) standard deviation of the function; noise_std: (n,) of the measurement; scale:
    (n,) factor on the half width of intervals, which for 95 % of measurements are

        tau ± 1.96 · scale · √(tau_std² + noise_std²)

    covariance: (N, n, n) of the function between joints, where asked for.
    """

    tau: Array
    tau_std: Array
    noise_std: Array
    scale: Array
    covariance: Array | None = None

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


@dataclass(frozen=True)
class TorqueModel:
    """Fitted inverse dynamics of one robot: immutable, safe to share between threads.

    joint_names, joint_types: (n,), in the order of the data; torque_convention: what its torques hold; options: those
    of the fit; fit: what the fit reported, compact: how near the compact posterior comes to the exact one, both for the
    manifest; training_range: of the samples behind the posterior; robot: the rigid bodies of an estimator that has
    them; calibration: how the posterior's deviations are corrected; selection: how `auto` has chosen the estimator,
    None where it was named; conformal: what left-out blocks of the training say of the intervals, None where an earlier
    release has trained it.
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

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    @property
    def arm(self) -> Arm | None:
        """What is known of the rigid bodies, of an estimator that has them."""
        term = self.estimator.terms.get("rigid_body")
        return term.arm if isinstance(term, ArmKernel) else None

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
        tau, std, between = self.evaluator.many(*query, covariance)
        return TorquePrediction(tau, std, self.noise_std, self.scale, between)

    def answer(self, motion: Array, std: bool = True) -> tuple[Array, Array | None]:
        """Torque at one instant, and its standard deviation where asked for: both (n,) N·m. For control loops.

        motion: q, dq and ddq as a float64 array (3, n). Neither shape nor finiteness is checked; what is not finite
        ends in what is not finite.
        """
        return self.evaluator.one(motion, std)

    def answer_with_covariance(self, motion: Array) -> tuple[Array, Array, Array]:
        """What `answer` says of one instant, and the covariance of the function between the joints, (n, n) (N·m)²."""
        covariance = np.empty((1, self.n_joints, self.n_joints))
        tau, std = self.evaluator.one(motion, covariance=covariance)
        assert std is not None  # it is asked for
        return tau, std, covariance[0]

    def warm_up(self) -> None:
        """Do all that the first answer would otherwise wait for."""
        self.evaluator.warm_up()
        external.warm_up()

    @cached_property
    def evaluator(self) -> Evaluator:
        """The compiled form of the posterior, which answers queries."""
        posterior, basis = self.posterior, self.posterior.basis
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
        )
