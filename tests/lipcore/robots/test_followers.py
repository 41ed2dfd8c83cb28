"""Joints that mimic another one: a gripper's second finger follows the first, others are rejected."""

import numpy as np
import pinocchio as pin
import pytest

from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.kernels.fast.arm import arm_torques
from lipcore.robots.library import ROBOTS, profile_urdf
from lipcore.robots.urdf import RigidBody, describe
from lipcore.robots.urdf_text import UrdfError
from tests.lipcore.robots.test_urdf import joint, link, robot


def test_coupled_joints_are_rejected() -> None:
    text = robot(
        *map(link, "abcd"),
        joint("j1", "a", "b"),
        joint("j2", "b", "c", extra='<mimic joint="j1"/>'),
        joint("j3", "c", "d"),
    )
    with pytest.raises(UrdfError, match="joint 'j2' mimics 'j1'"):
        RigidBody.from_urdf(text, ("j1", "j2", "j3"), ("revolute",) * 3)
    with pytest.raises(
        UrdfError, match=r"mimics 'j1' of the data: only a slider parallel to another one .*Without 'j1'"
    ):
        RigidBody.from_urdf(text, ("j1",), ("revolute",))
    assert RigidBody.from_urdf(text, ("j3",), ("revolute",)).n_joints == 1
    assert describe(text).joint_names == ("j1", "j3")


@pytest.mark.parametrize(("rate", "offset"), [("-0.5", "0.01"), ("1", "0")])
def test_follower_moves_with_its_leader(rate: str, offset: str) -> None:
    """One body behind the leader stands for both sliders, except for their spread of inertia, which grows with q²."""
    names, kinds = (*ROBOTS["panda"].free, "panda_finger_joint1"), ("revolute",) * 7 + ("prismatic",)
    mimic = '<mimic joint="panda_finger_joint1"'
    urdf = profile_urdf("panda").replace(mimic, f'{mimic} multiplier="{rate}" offset="{offset}"')
    body = RigidBody.from_urdf(urdf, names, kinds)
    assert [(each.joint, each.leader) for each in body.followers] == [("panda_finger_joint2", "panda_finger_joint1")]
    assert body.fixed_joints == ()
    arm, full, rng = arm_of_robot(body), pin.buildModelFromXML(urdf), np.random.default_rng(0)
    for _ in range(10):
        motion = rng.normal(size=(3, 8)) * [1, 1, 1, 1, 1, 1, 1, 0.01]
        second = float(rate) * motion[:, 7] + [float(offset), 0, 0]
        tau = pin.rnea(full, full.createData(), *np.column_stack([motion, second]))
        expected, found = np.append(tau[:7], tau[7] + float(rate) * tau[8]), np.empty((1, 8))
        parts = arm.geometry.constants, arm.geometry.gravity, arm.parameters, arm.order
        arm_torques(*parts, np.ascontiguousarray(motion[None]), found)
        np.testing.assert_allclose(found[0] + arm.rotor * motion[2], expected, rtol=0, atol=5e-3)
        fixed = RigidBody.from_urdf(urdf, names[:7], kinds[:7])
        assert fixed.fixed_joints == ("panda_finger_joint1", "panda_finger_joint2")
