"""Checks of the base of a training: the version of another unit of the same robot that it starts from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from lipcore.estimators.options import FitOptions
from lipcore.vocabulary import AUTO, CHAINED_ARM, ROBOT_ESTIMATORS


class BaseMismatchError(ValueError):
    """The training cannot start from the given base.

    field: of the training, as in the API, that does not match; value: its value; expected: its valid values.
    """

    def __init__(self, field: str, value: object, expected: str) -> None:
        super().__init__(f"{field} is {value!r}, expected {expected}")
        self.field, self.value, self.expected = field, value, expected


@dataclass(frozen=True)
class RobotKind:
    """Properties that all units of a robot share: joint names, joint types and torque convention."""

    joint_names: tuple[str, ...]
    joint_types: tuple[str, ...]
    torque_convention: str

    @classmethod
    def of_manifest(cls, manifest: Mapping[str, Any]) -> RobotKind:
        """Return the robot of a saved model."""
        names, types = tuple(manifest["joint_names"]), tuple(manifest["joint_types"])
        return cls(names, types, manifest["torque_convention"])

    def difference(self, other: RobotKind) -> tuple[str, str, str] | None:
        """Return the first field that differs from another robot, with its text in both; None if there is none."""
        for name in (each.name for each in fields(RobotKind)):
            own, others = getattr(self, name), getattr(other, name)
            if own != others:
                own, others = (part if isinstance(part, str) else ", ".join(part) for part in (own, others))
                return name, own, others
        return None


def check_base(
    name: str,
    base: RobotKind,
    order: Sequence[int] | None,
    data: RobotKind,
    estimator: str,
    options: FitOptions,
    robot: str | None,
    arms: int = 1,
) -> None:
    """Raise BaseMismatchError unless a training can start from a base.

    name: of the base; order: the data's joint at each place of its arm's chain, (n,), None if it has no arm; data:
    robot of the training data; estimator, options, robot: of the training; arms: number of the base's arms.
    """
    robots = (AUTO, *ROBOT_ESTIMATORS)
    if order is None:
        raise BaseMismatchError("base", name, f"a version of estimator {' or '.join(ROBOT_ESTIMATORS)}")
    if estimator not in robots:
        raise BaseMismatchError("estimator", estimator, f"one of {', '.join(robots)} if a base is given")
    if (found := data.difference(base)) is not None:
        field, own, others = found
        raise BaseMismatchError("base", name, f"a version with the {field} of the data, {own}; it has {others}")
    if estimator == CHAINED_ARM and arms > 1:
        expected = f"{' or '.join(robots[:3])}, as the base has {arms} arms and {CHAINED_ARM} needs one serial chain"
        raise BaseMismatchError("estimator", estimator, expected)
    if estimator == CHAINED_ARM and list(order) != list(range(len(order))):
        expected = f"{' or '.join(robots[:2])}, as the joints of the base have another order"
        raise BaseMismatchError("estimator", estimator, expected)
    if robot is not None:
        raise BaseMismatchError("robot", robot, "no robot together with a base: the base's arm is used")
    if options.geometry == "learn":
        raise BaseMismatchError("options.geometry", "learn", "auto, calibrate or fixed if a base is given")
    if options.arms:
        raise BaseMismatchError("options.arms", options.arms, "the default if a base is given: its arms are used")
    if options.prior != "urdf":
        raise BaseMismatchError("options.prior", options.prior, "the default if a base is given: its masses are used")
