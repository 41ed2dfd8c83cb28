"""The estimators a user chooses from: a torque prior each, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from lipcore.kernels.base import SumKernel, TorqueKernel
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.friction import FrictionKernel
from lipcore.kernels.gip import GeometricallyInspiredKernel
from lipcore.kernels.lip import LipKernel
from lipcore.kernels.lse import LagrangianSEKernel
from lipcore.kernels.rigid_body import RigidBodyKernel
from lipcore.kernels.se import SquaredExponentialKernel
from lipcore.motion import Motion, check_joint_types
from lipcore.urdf import JointMismatchError, RigidBody
from lipcore.vocabulary import ROBOT_ESTIMATORS, JointType


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

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """Those of the chain kernel for RESIDUAL_SHARE of the torque."""
        return super().initial(motion, RESIDUAL_SHARE * tau)


RESIDUAL_SHARE = 0.1
Maker = Callable[[tuple[JointType, ...], bool], dict[str, TorqueKernel]]

ESTIMATORS: dict[str, Maker] = {
    "lip": lambda types, tied: {"energy": LipKernel(types, tied)},
    "lip-chain": lambda types, tied: {"energy": ChainKernel(types)},
    "se": lambda types, tied: {"torque": SquaredExponentialKernel(len(types))},
    "gip": lambda types, tied: {"torque": GeometricallyInspiredKernel(types)},
    "lse": lambda types, tied: {"torque": LagrangianSEKernel(types)},
    "rigid-body": lambda types, tied: {},
    "rigid-body+lip-chain": lambda types, tied: {"energy": _ResidualChainKernel(types)},
}


def make_estimator(
    name: str,
    joint_types: Sequence[str],
    tied: bool = True,
    robot: RigidBody | None = None,
    prior: str = "urdf",
    gravity: bool = True,
) -> Estimator:
    """Build an estimator for a robot; raise UnknownEstimatorError listing the known names.

    robot, prior, gravity: for ROBOT_ESTIMATORS, see RigidBodyKernel; raise MissingRobotError where one is needed but
    absent or given but of no use, JointMismatchError where its joints are not those of the data.
    """
    if name not in ESTIMATORS:
        raise UnknownEstimatorError(f"estimator is {name!r}, expected one of {', '.join(ESTIMATORS)}")
    types = check_joint_types(joint_types)
    terms = {**ESTIMATORS[name](types, tied), "friction": FrictionKernel(len(types))}
    if name not in ROBOT_ESTIMATORS:
        if robot is not None:
            raise MissingRobotError(f"estimator {name!r} takes no robot, only {' and '.join(ROBOT_ESTIMATORS)} do")
        return Estimator(name, terms)
    if robot is None:
        raise MissingRobotError(f"estimator {name!r} needs a robot: a profile such as panda, or a URDF")
    if robot.joint_types != types:
        raise JointMismatchError(f"robot {robot.name!r} has joints {robot.joint_types}, the data have {types}")
    if "energy" in terms and robot.order != tuple(range(robot.n_joints)):
        chain = [robot.joint_names[robot.order.index(place)] for place in range(robot.n_joints)]
        raise JointMismatchError(
            f"estimator {name!r} needs joints from base to tip, {', '.join(chain)}; the data have "
            f"{', '.join(robot.joint_names)}"
        )
    return Estimator(name, {"rigid_body": RigidBodyKernel(robot, prior, gravity), **terms})
