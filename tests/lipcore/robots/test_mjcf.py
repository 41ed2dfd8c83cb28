"""MJCF converted to URDF: the same dynamics as Pinocchio's own reading, and no other file is opened."""

import numpy as np
import pinocchio
import pytest

from lipcore.profiles.profile import read_limits
from lipcore.robots.mjcf import convert_mjcf, is_mjcf
from lipcore.robots.urdf import RigidBody, describe
from lipcore.robots.urdf_text import UrdfError

INERTIAL = '<inertial pos="0.02 0 0.1" mass="2" fullinertia="0.03 0.02 0.02 0.001 0.002 0"/>'
ARM = f"""<mujoco model="three"><compiler angle="degree"/>
<default><joint damping="0.3"/><default class="wrist"><joint range="-90 90"/></default></default>
<worldbody><body name="a" pos="0.1 0 0.2" euler="10 20 0">{INERTIAL}
<joint name="lift" type="slide" axis="0 0 1" range="0 0.5"/>
<body name="b" pos="0 0.1 0.3" quat="0.7 0.7 0 0.1">{INERTIAL}
<joint name="turn" axis="0 1 1" actuatorfrcrange="-87 87"/>
<geom type="mesh" mesh="secret"/><body name="c" pos="0 0 0.2"><joint name="wrist" class="wrist" axis="1 0 0"/>
<geom type="capsule" fromto="0 0 0 0 0 0.2" size="0.04" mass="1.2"/>
<body name="tool" pos="0 0 0.1">{INERTIAL}</body></body></body></body></worldbody>
<asset><mesh name="secret" file="/etc/passwd"/></asset><actuator><motor joint="turn"/></actuator></mujoco>"""


def test_converted_arm_has_the_same_dynamics(tmp_path):
    urdf = convert_mjcf(ARM, tmp_path)
    described = describe(urdf)
    assert (described.name, described.joint_names) == ("three", ("lift", "turn", "wrist"))
    limits = read_limits(urdf, described.joint_names)
    np.testing.assert_allclose(limits.upper, [0.5, np.inf, np.pi / 2])
    assert limits.torque[1] == 87
    plain = tmp_path / "plain.xml"
    plain.write_text(
        ARM.replace('<geom type="mesh" mesh="secret"/>', "").replace('<mesh name="secret" file="/etc/passwd"/>', "")
    )
    model = pinocchio.buildModelFromMJCF(str(plain))
    body = RigidBody.from_urdf(urdf, described.joint_names, ("prismatic", "revolute", "revolute"))
    rng = np.random.default_rng(4)
    for q, dq, ddq in rng.normal(size=(5, 3, 3)):
        angle = np.concatenate([q[:1], [np.cos(q[1]), np.sin(q[1])], q[2:]])  # the second joint has no range
        torques = [
            pinocchio.rnea(each, each.createData(), at, dq, ddq)
            for each, at in ((model, angle if model.nq == 4 else q), (body.model, angle if body.model.nq == 4 else q))
        ]
        np.testing.assert_allclose(torques[0], torques[1], rtol=1e-9, atol=1e-9)
    assert is_mjcf(ARM)
    assert not is_mjcf(urdf)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<worldbody>", '<include file="/etc/passwd"/><worldbody>', "<include>, expected one file"),
        ("<worldbody>", "<worldbody><body><freejoint/></body>", "<freejoint>"),
        ('type="slide"', 'type="ball"', "3 degrees of freedom"),
        ('<joint name="turn"', '<joint name="other" axis="1 0 0"/><joint name="turn"', "2 degrees of freedom"),
        (INERTIAL, "", "has no mass"),
        ("<mujoco", '<!DOCTYPE a [<!ENTITY b SYSTEM "/etc/passwd">]><mujoco', "document type"),
        ("</mujoco>", "", "not well-formed"),
        ("<mujoco", "<mujoc><mujoco", "expected <mujoco>"),
        ("<worldbody>", "<worldbody>" + 40 * "<body>", "more than 32 deep"),
        ('axis="0 1 1"', 'axis="0 x 1"', "expected numbers"),
    ],
)
def test_other_robots_are_rejected(tmp_path, old, new, message):
    with pytest.raises(UrdfError, match=message):
        convert_mjcf(ARM.replace(old, new), tmp_path)
