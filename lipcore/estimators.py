"""The estimators a user chooses from: a torque kernel each, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lipcore.kernels.base import SumKernel, TorqueKernel
from lipcore.kernels.friction import FrictionKernel
from lipcore.kernels.lip import LipKernel
from lipcore.motion import check_joint_types

DEFAULT_ESTIMATOR = "lip"


class UnknownEstimatorError(ValueError):
    """No estimator of that name."""


@dataclass(frozen=True)
class Estimator:
    """A torque prior: `dynamics` from energies and friction, independent of each other."""

    name: str
    dynamics: LipKernel
    friction: FrictionKernel

    @property
    def kernel(self) -> TorqueKernel:
        """Sum of both, the prior of the measured torque without noise."""
        return SumKernel(self.dynamics, self.friction)


def _lip(joint_types: Sequence[str], tied: bool) -> Estimator:
    return Estimator("lip", LipKernel(joint_types, tied), FrictionKernel(len(joint_types)))


ESTIMATORS: dict[str, Callable[[Sequence[str], bool], Estimator]] = {"lip": _lip}


def make_estimator(name: str, joint_types: Sequence[str], tied: bool = True) -> Estimator:
    """Build an estimator for a robot; raise UnknownEstimatorError listing the known names."""
    if name not in ESTIMATORS:
        raise UnknownEstimatorError(f"estimator is {name!r}, expected one of {', '.join(ESTIMATORS)}")
    return ESTIMATORS[name](check_joint_types(joint_types), tied)
