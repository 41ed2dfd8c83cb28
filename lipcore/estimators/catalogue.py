"""The estimators by name: a torque prior each, and a factor that calibrates its intervals.

A posterior with fitted hyperparameters does not include the uncertainty of the hyperparameters. It is overconfident.
The standard deviation of the function is therefore multiplied by a factor, one for each estimator. The factors were
measured on simulated arms with random masses: `lip-chain` on four arms, `lip` on two, the baselines on one. Motion was
slow and fast, with 60 to 500 samples, and test trajectories had twice the bandwidth
(`benchmarks/studies/calibration.py`). The factor is stored with the model. It changes neither mean nor noise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from lipcore.data.motion import Array, Motion, check_joint_types
from lipcore.estimators.options import FitOptions
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import Arm
from lipcore.kernels.base import TorqueKernel
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.combined import SumKernel
from lipcore.kernels.drive.kernel import Drive, DriveKernel
from lipcore.kernels.independent import GeometricallyInspiredKernel, SquaredExponentialKernel
from lipcore.kernels.lip import LipKernel
from lipcore.kernels.lse import LagrangianSEKernel
from lipcore.kernels.residual import ResidualKernel
from lipcore.robots.urdf import JointMismatchError, RigidBody
from lipcore.vocabulary import AUTO, CHAINED_ARM, ESTIMATOR_CHOICES, LOCAL, ROBOT_ESTIMATORS, JointType


class UnknownEstimatorError(ValueError):
    """There is no estimator of this name."""


class MissingRobotError(ValueError):
    """The estimator needs a robot, or it cannot use the given one."""


@dataclass(frozen=True)
class Estimator:
    """A torque prior: a sum of independent terms by name, always with friction."""

    name: str
    terms: Mapping[str, TorqueKernel]

    @property
    def kernel(self) -> TorqueKernel:
        """Sum of the terms, the prior of the measured torque without noise."""
        return SumKernel(*self.terms.values())

    def corrected(self, residual: ResidualKernel) -> Estimator:
        """Return the arm of this estimator with a local correction."""
        arm, friction = self.terms["rigid_body"], self.terms["friction"]
        # the residual's features are first, so that a root has the same zeros as the precision
        return Estimator(LOCAL, {"local": residual, "rigid_body": arm, "friction": friction})


class _ResidualChainKernel(ChainKernel):
    """Chain kernel for the residual of rigid bodies: the fit starts from a share of the torque."""

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Start like the chain kernel for a tenth of the torque."""
        return super().initial(motion, 0.1 * tau)


Maker = Callable[[tuple[JointType, ...], bool], dict[str, TorqueKernel]]

ESTIMATORS: dict[str, Maker] = {
    "lip": lambda types, tied: {"energy": LipKernel(types, tied)},
    "lip-chain": lambda types, tied: {"energy": ChainKernel(types)},
    "se": lambda types, tied: {"torque": SquaredExponentialKernel(len(types))},
    "gip": lambda types, tied: {"torque": GeometricallyInspiredKernel(types)},
    "lse": lambda types, tied: {"torque": LagrangianSEKernel(types)},
    "rigid-body": lambda types, tied: {},
    "rigid-body+local": lambda types, tied: {},
    "rigid-body+lip-chain": lambda types, tied: {"energy": _ResidualChainKernel(types)},
}


def make_estimator(
    name: str,
    joint_types: Sequence[str],
    tied: bool = True,
    arm: Arm | None = None,
) -> Estimator:
    """Return an estimator for a robot. Raise UnknownEstimatorError with the valid names.

    arm: for ROBOT_ESTIMATORS, the learnt rigid bodies (`lipcore.arm.learning`). Raise ValueError if it is absent or
    cannot be used, JointMismatchError if its joints are not those of the data.
    """
    if name not in ESTIMATORS:
        raise UnknownEstimatorError(f"estimator is {name!r}, expected one of {', '.join(ESTIMATORS)}")
    types = check_joint_types(joint_types)
    drive = DriveKernel(Drive(len(types)) if arm is None else arm.friction)
    terms = {**ESTIMATORS[name](types, tied), "friction": drive}
    if (name in ROBOT_ESTIMATORS) != (arm is not None):
        raise ValueError(f"estimator {name!r}: only {', '.join(ROBOT_ESTIMATORS)} need an arm, others must have none")
    if arm is None:
        return Estimator(name, terms)
    if arm.joint_types != types:
        raise JointMismatchError(f"the arm has joints {arm.joint_types}, the data have {types}")
    _check_arms(name, len(arm.geometry.roots))
    return Estimator(name, {"rigid_body": ArmKernel(arm), **terms})


def check_estimator(
    name: str, joint_types: Sequence[str], robot: RigidBody | None = None, options: FitOptions | None = None
) -> None:
    """Check that an estimator can be trained with this robot and these options, before any work is done.

    Raise UnknownEstimatorError. Raise MissingRobotError if a robot is given that the estimator cannot use. Raise
    ValueError if `options.geometry` needs a robot and there is none. Raise JointMismatchError if the robot's joints are
    not those of the data, or are in another order.
    """
    if name not in ESTIMATOR_CHOICES:
        raise UnknownEstimatorError(f"estimator is {name!r}, expected one of {', '.join(ESTIMATOR_CHOICES)}")
    types = check_joint_types(joint_types)
    sizes = () if options is None else options.sizes
    if sizes and (robot is not None or sum(sizes) != len(types) or name not in (AUTO, *ROBOT_ESTIMATORS)):
        users = ", ".join((AUTO, *ROBOT_ESTIMATORS))
        expected = f"numbers whose sum is {len(types)}, the joints of the data, no robot, and one of {users}"
        raise ValueError(f"arms is {','.join(map(str, sizes))!r}, expected {expected}")
    if robot is None:
        _check_arms(name, len(sizes))
        if name in (AUTO, *ROBOT_ESTIMATORS) and options is not None and options.geometry in ("calibrate", "fixed"):
            raise MissingRobotError(
                f"geometry is {options.geometry!r}, which needs a robot: a profile such as panda, or a URDF"
            )
        return
    if name not in (AUTO, *ROBOT_ESTIMATORS):
        users = ", ".join(ROBOT_ESTIMATORS)
        raise MissingRobotError(f"estimator {name!r} does not use a robot, only {users} and {AUTO} do")
    if robot.joint_types != types:
        raise JointMismatchError(f"robot {robot.name!r} has joints {robot.joint_types}, the data have {types}")
    _check_arms(name, len(robot.roots))
    if name == CHAINED_ARM and robot.order != tuple(range(robot.n_joints)):
        order = [robot.joint_names[robot.order.index(place)] for place in range(robot.n_joints)]
        raise JointMismatchError(
            f"estimator {name!r} needs joints from base to tip, {', '.join(order)}; the data have "
            f"{', '.join(robot.joint_names)}"
        )


def _check_arms(name: str, arms: int) -> None:
    if name == CHAINED_ARM and arms > 1:
        raise JointMismatchError(
            f"estimator {name!r} needs one serial chain, but the robot has {arms} arms: use rigid-body, "
            "rigid-body+local or auto"
        )


FUNCTION_STD_FACTOR = {
    "lip": 1.4,
    "lip-chain": 1.1,
    "rigid-body": 1.0,
    "rigid-body+lip-chain": 1.1,
    "rigid-body+local": 1.0,
    "se": 1.75,
    "gip": 1.2,
    "lse": 1.8,
}
"""Factors with which 95 % intervals had a coverage of 95 % on average. `rigid-body+lip-chain` uses that of its
terms."""


@dataclass(frozen=True)
class Calibration:
    """Calibration of an estimator.

    function_std_factor: factor on the standard deviation of the function, at least 1.
    """

    function_std_factor: float

    def __post_init__(self) -> None:
        if not 1.0 <= self.function_std_factor < 100.0:
            raise ValueError(f"function_std_factor is {self.function_std_factor!r}, expected a number from 1 to 100")


NO_CALIBRATION = Calibration(1.0)


def calibrate(estimator: str) -> Calibration:
    """Return the calibration of an estimator."""
    return Calibration(FUNCTION_STD_FACTOR.get(estimator, 1.0))
