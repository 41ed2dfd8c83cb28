"""The estimators a user chooses from: a torque prior each, by name, and the factor that makes its intervals true.

A posterior with fitted hyperparameters knows what the samples leave open, but takes the hyperparameters themselves for
certain: it is too sure of itself. The standard deviation of the function is therefore multiplied by a factor, one for
each estimator, measured on simulated arms with random masses: `lip-chain` on four arms, `lip` on two, the baselines on
one; slow and fast motion, 60 to 500 samples, judged on trajectories of twice the bandwidth
(`benchmarks/studies/calibration.py`). It is stored with the model and touches neither mean nor noise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from lipcore.data.motion import Array, Motion, check_joint_types
from lipcore.estimators.options import FitOptions
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import Arm
from lipcore.kernels.base import SumKernel, TorqueKernel
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.friction import FrictionKernel
from lipcore.kernels.independent import GeometricallyInspiredKernel, SquaredExponentialKernel
from lipcore.kernels.lip import LipKernel
from lipcore.kernels.local import LocalKernel
from lipcore.kernels.lse import LagrangianSEKernel
from lipcore.robots.urdf import JointMismatchError, RigidBody
from lipcore.vocabulary import AUTO, CHOICES, ROBOT_ESTIMATORS, JointType


class UnknownEstimatorError(ValueError):
    """No estimator of that name."""


class MissingRobotError(ValueError):
    """The estimator needs a robot, or it has no use for the one given."""


@dataclass(frozen=True)
class Estimator:
    """A torque prior: a sum of independent terms by name, friction always among them."""

    name: str
    terms: Mapping[str, TorqueKernel]

    @property
    def kernel(self) -> TorqueKernel:
        """Sum of the terms, the prior of the measured torque without noise."""
        return SumKernel(*self.terms.values())


class _ResidualChainKernel(ChainKernel):
    """Energies for what rigid bodies leave over: the fit starts from a share of the torque, not from all of it."""

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Those of the chain kernel for a tenth of the torque."""
        return super().initial(motion, 0.1 * tau)


Maker = Callable[[tuple[JointType, ...], bool], dict[str, TorqueKernel]]

ESTIMATORS: dict[str, Maker] = {
    "lip": lambda types, tied: {"energy": LipKernel(types, tied)},
    "lip-chain": lambda types, tied: {"energy": ChainKernel(types)},
    "se": lambda types, tied: {"torque": SquaredExponentialKernel(len(types))},
    "gip": lambda types, tied: {"torque": GeometricallyInspiredKernel(types)},
    "lse": lambda types, tied: {"torque": LagrangianSEKernel(types)},
    "rigid-body": lambda types, tied: {},
    "rigid-body+local": lambda types, tied: {"local": LocalKernel(len(types))},
    "rigid-body+lip-chain": lambda types, tied: {"energy": _ResidualChainKernel(types)},
}


def make_estimator(
    name: str,
    joint_types: Sequence[str],
    tied: bool = True,
    arm: Arm | None = None,
) -> Estimator:
    """Build an estimator for a robot; raise UnknownEstimatorError listing the known names.

    arm: for ROBOT_ESTIMATORS, what was learnt of the rigid bodies (`lipcore.arm.learning`); raise ValueError where it
    is absent or of no use, JointMismatchError where its joints are not those of the data.
    """
    if name not in ESTIMATORS:
        raise UnknownEstimatorError(f"estimator is {name!r}, expected one of {', '.join(ESTIMATORS)}")
    types = check_joint_types(joint_types)
    friction = FrictionKernel(len(types), arm is not None and arm.stribeck)
    terms = {**ESTIMATORS[name](types, tied), "friction": friction}
    if (name in ROBOT_ESTIMATORS) != (arm is not None):
        raise ValueError(f"estimator {name!r}: expected an arm for {', '.join(ROBOT_ESTIMATORS)}, and for no other")
    if arm is None:
        return Estimator(name, terms)
    of_arm = tuple(arm.geometry.joint_types[place] for place in arm.place)
    if of_arm != types:
        raise JointMismatchError(f"the arm has joints {of_arm}, the data have {types}")
    return Estimator(name, {"rigid_body": ArmKernel(arm), **terms})


def check_estimator(
    name: str, joint_types: Sequence[str], robot: RigidBody | None = None, options: FitOptions | None = None
) -> None:
    """Check that an estimator can be trained so, before anything is spent on it.

    Raise UnknownEstimatorError, MissingRobotError where a robot is given in vain, ValueError where `options.geometry`
    needs one and there is none, JointMismatchError where its joints are not those of the data or in another order.
    """
    if name not in CHOICES:
        raise UnknownEstimatorError(f"estimator is {name!r}, expected one of {', '.join(CHOICES)}")
    types = check_joint_types(joint_types)
    if robot is None:
        if name in (AUTO, *ROBOT_ESTIMATORS) and options is not None and options.geometry in ("calibrate", "fixed"):
            raise MissingRobotError(
                f"geometry is {options.geometry!r}, which needs a robot: a profile such as panda, or a URDF"
            )
        return
    if name not in (AUTO, *ROBOT_ESTIMATORS):
        raise MissingRobotError(f"estimator {name!r} takes no robot, only {', '.join(ROBOT_ESTIMATORS)} and {AUTO} do")
    if robot.joint_types != types:
        raise JointMismatchError(f"robot {robot.name!r} has joints {robot.joint_types}, the data have {types}")
    if name == "rigid-body+lip-chain" and robot.order != tuple(range(robot.n_joints)):
        order = [robot.joint_names[robot.order.index(place)] for place in range(robot.n_joints)]
        raise JointMismatchError(
            f"estimator {name!r} needs joints from base to tip, {', '.join(order)}; the data have "
            f"{', '.join(robot.joint_names)}"
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
"""Where 95 % intervals covered 95 % on average; `rigid-body+lip-chain` takes that of its terms."""


@dataclass(frozen=True)
class Calibration:
    """function_std_factor: what the standard deviation of the function is multiplied by, at least 1."""

    function_std_factor: float

    def __post_init__(self) -> None:
        if not 1.0 <= self.function_std_factor < 100.0:
            raise ValueError(f"function_std_factor is {self.function_std_factor!r}, expected a number from 1 to 100")


NO_CALIBRATION = Calibration(1.0)


def calibrate(estimator: str) -> Calibration:
    """Return the correction measured for an estimator."""
    return Calibration(FUNCTION_STD_FACTOR.get(estimator, 1.0))
