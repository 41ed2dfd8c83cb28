"""Arms of example-robot-data as Pinocchio models, with every other joint locked.

The URDFs are part of the package `example-robot-data` (extra `sim`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lipcore.data.samples import Array
from lipcore.extras import MissingExtraError, find_data_folder, import_extra
from lipcore.vocabulary import JointType


class UnknownRobotError(ValueError):
    """No robot of that name can be simulated."""


@dataclass(frozen=True)
class RobotSource:
    """A URDF below example-robot-data's `robots` folder and the joints that stay free, from base to tip."""

    urdf: str
    free: tuple[str, ...]


def _numbered(pattern: str, *numbers: int) -> tuple[str, ...]:
    return tuple(pattern.format(number) for number in numbers)


_UR = tuple(f"{j}_joint" for j in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))
# the gripper's jaw is the last joint of the chain; Pinocchio cannot lock it, since a link has the same name
_SO = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
_PR2 = ("shoulder_pan", "shoulder_lift", "upper_arm_roll", "elbow_flex", "forearm_roll", "wrist_flex", "wrist_roll")

ROBOTS: dict[str, RobotSource] = {
    "panda": RobotSource("panda_description/urdf/panda.urdf", _numbered("panda_joint{}", *range(1, 8))),
    "ur3": RobotSource("ur_description/urdf/ur3_robot.urdf", _UR),
    "ur5": RobotSource("ur_description/urdf/ur5_robot.urdf", _UR),
    "ur10": RobotSource("ur_description/urdf/ur10_robot.urdf", _UR),
    "xarm7": RobotSource("xarm_description/urdf/xarm7.urdf", _numbered("joint{}", *range(1, 8))),
    "kinova": RobotSource("kinova_description/robots/kinova.urdf", _numbered("j2s6s200_joint_{}", *range(1, 7))),
    "z1": RobotSource("z1_description/urdf/z1.urdf", _numbered("joint{}", *range(1, 7))),
    "so100": RobotSource("so_arm_description/urdf/so100.urdf", _SO),
    "so101": RobotSource("so_arm_description/urdf/so101.urdf", _SO),
    "baxter-left": RobotSource(
        "baxter_description/urdf/baxter.urdf", tuple(f"left_{j}" for j in ("s0", "s1", "e0", "e1", "w0", "w1", "w2"))
    ),
    "baxter-right": RobotSource(
        "baxter_description/urdf/baxter.urdf", tuple(f"right_{j}" for j in ("s0", "s1", "e0", "e1", "w0", "w1", "w2"))
    ),
    "pr2-left": RobotSource("pr2_description/urdf/pr2.urdf", tuple(f"l_{j}_joint" for j in _PR2)),
    "pr2-right": RobotSource("pr2_description/urdf/pr2.urdf", tuple(f"r_{j}_joint" for j in _PR2)),
    "talos-left": RobotSource("talos_data/robots/talos_left_arm.urdf", _numbered("arm_left_{}_joint", *range(2, 8))),
    "tiago": RobotSource(
        "tiago_description/robots/tiago_no_hand.urdf",
        ("torso_lift_joint", *_numbered("arm_{}_joint", *range(1, 8))),
    ),
    "tiago-pro-left": RobotSource(
        "tiago_pro_description/robots/tiago_pro.urdf", _numbered("arm_left_{}_joint", *range(1, 8))
    ),
    "tiago-pro-right": RobotSource(
        "tiago_pro_description/robots/tiago_pro.urdf", _numbered("arm_right_{}_joint", *range(1, 8))
    ),
    "double-pendulum": RobotSource("double_pendulum_description/urdf/double_pendulum.urdf", ("joint1", "joint2")),
    "asr-twodof": RobotSource("asr_twodof_description/urdf/TwoDofs.urdf", ("J1", "J2")),
    "finger-edu": RobotSource(
        "finger_edu_description/robots/finger_edu.urdf",
        ("finger_base_to_upper_joint", "finger_upper_to_middle_joint", "finger_middle_to_lower_joint"),
    ),
}


@dataclass(frozen=True)
class Robot:
    """A serial arm by name: its Pinocchio model, and its joints for the simulator."""

    name: str
    model: Any
    joint_names: tuple[str, ...]
    joint_types: tuple[JointType, ...]
    lower: Array
    """Min positions, (n,) rad (m)."""
    upper: Array
    """Max positions, (n,) rad (m)."""
    speed: Array
    """Max speeds, (n,) rad/s (m/s), infinite if unknown."""

    @property
    def n_joints(self) -> int:
        """Return the number of free joints n."""
        return len(self.joint_names)

    def configuration(self, q: Array) -> Array:
        """Return Pinocchio's configuration of joint positions q (n,), with (cos, sin) of unbounded joints."""
        out = np.empty(self.model.nq)
        for at, size, place in self._places:
            angle = q[place]
            out[at : at + size] = angle if size == 1 else (np.cos(angle), np.sin(angle))
        return out

    @cached_property
    def _places(self) -> list[tuple[int, int, int]]:
        """Return the start and length of each joint's configuration, and the index of its position."""
        model = self.model  # read once: each access takes longer than the dynamics of a sample
        return [(model.idx_qs[joint], model.joints[joint].nq, model.idx_vs[joint]) for joint in range(1, model.njoints)]


def pinocchio() -> Any:
    """Return the pinocchio module; raise MissingExtraError.

    A minimal system may lack its OpenMP runtime, libgomp1.
    """
    return import_extra("pinocchio", "robots")


def load_robot(name: str) -> Robot:
    """Return a robot by name; raise UnknownRobotError or MissingExtraError."""
    if name not in ROBOTS:
        raise UnknownRobotError(f"robot is {name!r}, expected one of {', '.join(ROBOTS)}")
    pin, source = pinocchio(), ROBOTS[name]
    full = pin.buildModelFromUrdf(str(_robots_folder() / source.urdf))
    locked = [full.getJointId(joint) for joint in list(full.names)[1:] if joint not in source.free]
    model = pin.buildReducedModel(full, locked, pin.neutral(full)) if locked else full
    names = tuple(model.names)[1:]
    if names != source.free:
        raise UnknownRobotError(f"robot {name!r} has the joints {names}, expected {source.free}")
    types: list[JointType] = []
    limits = []
    for index in range(1, model.njoints):
        joint = model.joints[index]
        types.append("prismatic" if joint.shortname().startswith("JointModelP") else "revolute")
        at = model.idx_qs[index]
        low, high = model.lowerPositionLimit[at], model.upperPositionLimit[at]
        # unbounded joints have limits of (cos, sin), and some URDFs have none
        limits.append((low, high) if joint.nq == 1 and high > low else (-np.pi, np.pi))
    lower, upper = np.array(limits).T
    speed = np.where(model.velocityLimit > 0, model.velocityLimit, np.inf)
    return Robot(name, model, names, tuple(types), lower, upper, speed)


def list_installed_robots() -> tuple[str, ...]:
    """Return the names of the robots with installed URDFs."""
    try:
        folder = _robots_folder()
    except MissingExtraError:
        return ()
    return tuple(name for name, source in ROBOTS.items() if (folder / source.urdf).is_file())


def profile_urdf(name: str) -> str:
    """Return the URDF of a robot of ROBOTS as text; raise UnknownRobotError or MissingExtraError."""
    if name not in ROBOTS:
        raise UnknownRobotError(f"robot is {name!r}, expected one of {', '.join(ROBOTS)}")
    return (_robots_folder() / ROBOTS[name].urdf).read_text()


def _robots_folder() -> Path:
    return find_data_folder("sim")
