"""A trained torque model: train it, ask it, save it, load it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from lipcore.calibration import NO_CALIBRATION, Calibration, calibrate
from lipcore.estimators import DEFAULT_ESTIMATOR, Estimator, make_estimator
from lipcore.fitting import Cancelled, FitOptions, Progress, fit
from lipcore.motion import JointType, Motion, check_finite, check_joint_types
from lipcore.posterior import ExactPosterior
from lipcore.samples import Array, Samples
from lipcore.urdf import JointMismatchError, RigidBody

TorqueConvention = Literal["gravity_included", "gravity_compensated"]
"""What a torque means: all of it (Franka's `tau_J`), or what is added to gravity compensation (its commands)."""
MIN_SAMPLES = 10
TORQUE_CONVENTIONS: tuple[TorqueConvention, ...] = get_args(TorqueConvention)


@dataclass(frozen=True)
class TorquePrediction:
    """Answer for N queries of n joints, N·m.

    tau: (N, n) mean; tau_std: (N, n) standard deviation of the function; noise_std: (n,) of the measurement; an
    interval for measurements needs both. covariance: (N, n, n) of the function between joints, where asked for.
    """

    tau: Array
    tau_std: Array
    noise_std: Array
    covariance: Array | None = None


@dataclass(frozen=True)
class TorqueModel:
    """Fitted inverse dynamics of one robot: immutable, safe to share between threads.

    motion, tau: the samples that the posterior is conditioned on; fit: what the fit reported, for the manifest;
    robot: the rigid bodies of an estimator that has them; calibration: how the posterior's deviations are corrected.
    """

    estimator: Estimator
    joint_names: tuple[str, ...]
    joint_types: tuple[JointType, ...]
    torque_convention: TorqueConvention
    options: dict[str, int | bool | str]
    fit: dict[str, float | int | bool | str]
    tau: Tensor
    posterior: ExactPosterior
    robot: RigidBody | None = None
    calibration: Calibration = NO_CALIBRATION

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the measured torque around the function, (n,) N·m, jitter included."""
        noise = self.posterior.params["noise.log_std"].exp().square() + self.posterior.factor.jitter
        std: Array = noise.sqrt().numpy()
        return std

    def predict(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike, covariance: bool = False) -> TorquePrediction:
        """Torque with uncertainty for arrays of shape (n,) or (N, n).

        Raise ValueError for a wrong number of joints, differing shapes or a value that is not finite.
        """
        query = Motion.from_arrays(q, dq, ddq)
        if query.n_joints != self.n_joints:
            raise ValueError(f"q has {query.n_joints} joints, expected {self.n_joints}: {', '.join(self.joint_names)}")
        answer = self.posterior.predict(query)
        between = answer.covariance.numpy() if covariance else None
        return TorquePrediction(answer.mean.numpy(), answer.std.numpy(), self.noise_std, between)

    def answer(self, motion: Array, std: bool = True) -> tuple[Array, Array | None]:
        """Torque at one instant, and its standard deviation where asked for: both (n,) N·m. For control loops.

        motion: q, dq and ddq as a C-contiguous float64 array (3, n). Neither shape nor finiteness is checked; what is
        not finite ends in what is not finite.
        """
        answer = self.posterior.predict(Motion(*(torch.from_numpy(part[None]) for part in motion)))
        return answer.mean[0].numpy(), answer.std[0].numpy() if std else None

    def warm_up(self) -> None:
        """Do all that the first answer would otherwise wait for."""
        self.answer(np.zeros((3, self.n_joints)))


def train(
    samples: Samples,
    joint_types: Sequence[str],
    estimator: str = DEFAULT_ESTIMATOR,
    options: FitOptions | None = None,
    torque_convention: TorqueConvention = "gravity_included",
    on_progress: Progress | None = None,
    cancelled: Cancelled | None = None,
    robot: RigidBody | None = None,
) -> TorqueModel:
    """Train a model on samples; see `lipcore.fitting.fit` for progress and cancellation.

    robot: for estimators of rigid bodies, built for the joints of the samples.
    Raise ValueError for bad arguments, FitCancelledError, or NotPositiveDefiniteError.
    """
    options = options or FitOptions()
    types = check_joint_types(joint_types)
    if len(types) != samples.n_joints:
        raise ValueError(f"joint_types has {len(types)} entries, expected {samples.n_joints}, one a joint")
    if torque_convention not in TORQUE_CONVENTIONS:
        raise ValueError(f"torque_convention is {torque_convention!r}, expected one of {', '.join(TORQUE_CONVENTIONS)}")
    if len(samples) < MIN_SAMPLES:
        raise ValueError(f"samples has {len(samples)} rows, expected at least {MIN_SAMPLES}")
    check_finite("tau", samples.tau)
    if robot is not None and robot.joint_names != samples.joint_names:
        raise JointMismatchError(
            f"robot {robot.name!r} was built for the joints {', '.join(robot.joint_names)}; the data have "
            f"{', '.join(samples.joint_names)}"
        )
    gravity = torque_convention == "gravity_included"
    chosen = make_estimator(estimator, types, options.tied, robot, options.prior, gravity)
    fitted = fit(chosen.kernel, samples, options, on_progress, cancelled)
    used = samples.rows(fitted.rows)
    motion, tau = used.motion(), used.torque()
    calibration = calibrate(estimator)
    posterior = ExactPosterior.fit(chosen.kernel, fitted.params, motion, tau, calibration.function_std_factor)
    report = {**asdict(fitted.report), "jitter": posterior.factor.jitter}
    return TorqueModel(
        chosen,
        samples.joint_names,
        types,
        torque_convention,
        asdict(options),
        report,
        tau,
        posterior,
        robot,
        calibration,
    )


def training_range(model: TorqueModel) -> dict[str, dict[str, list[float]]]:
    """Smallest and largest q, dq and ddq of the samples behind the posterior, per joint."""
    motion = model.posterior.motion
    return {
        name: {"min": values.min(0).values.tolist(), "max": values.max(0).values.tolist()}
        for name, values in (("q", motion.q), ("dq", motion.dq), ("ddq", motion.ddq))
    }


def restore(
    estimator: str,
    joint_names: Sequence[str],
    joint_types: Sequence[str],
    torque_convention: TorqueConvention,
    options: dict[str, int | bool | str],
    fit_report: dict[str, float | int | bool | str],
    params: dict[str, Tensor],
    motion: Motion,
    tau: Tensor,
    robot: RigidBody | None = None,
    calibration: Calibration = NO_CALIBRATION,
) -> TorqueModel:
    """Rebuild a model from its parts; the posterior is computed anew from hyperparameters and samples.

    Raise ValueError naming the hyperparameter that is missing, unknown or of the wrong shape.
    """
    tied, prior = bool(options.get("tied", True)), str(options.get("prior", "urdf"))
    gravity = torque_convention == "gravity_included"
    chosen = make_estimator(estimator, joint_types, tied, robot, prior, gravity)
    expected = {name: value.shape for name, value in chosen.kernel.initial(motion, tau).items()}
    expected["noise.log_std"] = torch.Size([len(joint_names)])
    for name in expected.keys() | params.keys():
        found = tuple(params[name].shape) if name in params else None
        wanted = tuple(expected[name]) if name in expected else None
        if found != wanted:
            raise ValueError(f"hyperparameter {name!r} has shape {found}, expected {wanted}")
    posterior = ExactPosterior.fit(chosen.kernel, params, motion, tau, calibration.function_std_factor)
    return TorqueModel(
        chosen,
        tuple(joint_names),
        check_joint_types(joint_types),
        torque_convention,
        options,
        fit_report,
        tau,
        posterior,
        robot,
        calibration,
    )
