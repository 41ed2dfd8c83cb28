"""SDF converted to URDF: the same dynamics as the URDF that it describes, with link frames anywhere."""

from xml.etree import ElementTree

import numpy as np
import pinocchio
import pytest

from lipcore.robots.library import profile_urdf
from lipcore.robots.sdf import convert_sdf, is_sdf
from lipcore.robots.urdf import RigidBody, describe
from lipcore.robots.urdf_text import UrdfError

SO3 = pinocchio.SE3


def se3(element):
    origin = element.find("origin") if element is not None else None
    xyz, rpy = ((0.0, 0.0, 0.0),) * 2
    if origin is not None:
        xyz, rpy = ([float(each) for each in origin.get(key, "0 0 0").split()] for key in ("xyz", "rpy"))
    return SO3(pinocchio.rpy.rpyToMatrix(*rpy), np.array(xyz))


def pose(placed, attributes=""):
    numbers = [*placed.translation, *pinocchio.rpy.matrixToRpy(placed.rotation)]
    return f"<pose{attributes}>{' '.join(f'{each:.15g}' for each in numbers)}</pose>"


def sdf_of(urdf, rng, relative):
    """Write a URDF as SDF, each link with a random frame, poses in the model's frame or relative to the parent's."""
    robot = ElementTree.fromstring(urdf)
    joints, links = robot.findall("joint"), {each.get("name"): each for each in robot.findall("link")}
    above = {joint.find("child").get("link"): joint for joint in joints}

    def place(link):  # of the URDF's frame of a link, in the model
        if link not in above:
            return SO3.Identity()
        return place(above[link].find("parent").get("link")) * se3(above[link])

    frame = {
        name: place(name) * SO3(pinocchio.rpy.rpyToMatrix(*rng.normal(size=3)), rng.normal(size=3)) for name in links
    }
    parts = []
    for name, link in links.items():
        parent = above[name].find("parent").get("link") if name in above else None
        base = pose(frame[name])
        if relative and parent:
            base = pose(frame[parent].inverse() * frame[name], f' relative_to="{parent}"')
        inertial = link.find("inertial")
        body = ""
        if inertial is not None:
            inertia = "".join(f"<{key}>{value}</{key}>" for key, value in inertial.find("inertia").attrib.items())
            body = pose(frame[name].inverse() * place(name) * se3(inertial))
            body += f"<mass>{inertial.find('mass').get('value')}</mass><inertia>{inertia}</inertia>"
            body = f"<inertial>{body}</inertial>"
        parts.append(f'<link name="{name}">{base}{body}<visual name="v"><geometry/></visual></link>')
    for joint in joints:
        child, axis, limit = joint.find("child").get("link"), joint.find("axis"), joint.find("limit")
        xyz = np.array([float(each) for each in ("1 0 0" if axis is None else axis.get("xyz")).split()])
        inside = pose(frame[child].inverse() * place(child))
        expressed = ' expressed_in="__model__"' if relative else ""
        xyz = place(child).rotation @ xyz if relative else xyz
        limits = "" if limit is None else "".join(f"<{key}>{value}</{key}>" for key, value in limit.attrib.items())
        parts.append(
            f'<joint name="{joint.get("name")}" type="{joint.get("type")}">{inside}'
            f"<parent>{joint.find('parent').get('link')}</parent><child>{child}</child>"
            f"<axis><xyz{expressed}>{' '.join(map(repr, map(float, xyz)))}</xyz><limit>{limits}</limit></axis></joint>"
        )
    return f'<?xml version="1.0"?><sdf version="1.9"><model name="arm">{"".join(parts)}</model></sdf>'


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("name", ["kinova", "ur5", "double-pendulum"])
def test_converted_arm_has_the_same_dynamics(name, relative):
    urdf = profile_urdf(name).replace('"world"', '"ground"')
    text = sdf_of(urdf, np.random.default_rng(4), relative)
    assert is_sdf(text)
    converted = convert_sdf(text)
    names = [each.name for each in describe(urdf).joints]
    assert [each.name for each in describe(converted).joints] == names
    bodies = [RigidBody.from_urdf(each, names, ["revolute"] * len(names)) for each in (urdf, converted)]
    rng = np.random.default_rng(5)
    for q, dq, ddq in rng.normal(size=(5, 3, len(names))):
        here, there = (torque(body, q, dq, ddq) for body in bodies)
        np.testing.assert_allclose(there, here, rtol=1e-7, atol=1e-9)


def torque(body, q, dq, ddq):
    """Return the torque by Pinocchio; joints without limits have cos q and sin q there."""
    parts = zip(q, list(body.model.joints)[1:], strict=True)
    turned = np.concatenate([[np.cos(each), np.sin(each)] if joint.nq == 2 else [each] for each, joint in parts])
    return pinocchio.rnea(body.model, body.model.createData(), turned, dq, ddq)


LINK = '<link name="{}"><inertial><mass>1</mass></inertial></link>'
JOINT = '<joint name="j" type="{}"><parent>{}</parent><child>b</child><axis><xyz>{}</xyz></axis></joint>'
MOVED = JOINT.format("revolute", "a", "0 0 1").replace("<parent", "<pose relative_to='f'/><parent")
WRONG = {
    "two models": ("</model><model name='c'>", "has 2 models"),
    "ball": (JOINT.format("ball", "a", "0 0 1"), "is of type 'ball'"),
    "stranger": (JOINT.format("revolute", "x", "0 0 1"), "the parent 'x', expected a link"),
    "text": (JOINT.format("revolute", "a", "0 up 1"), "<xyz> is '0 up 1', expected 3 numbers"),
    "include": ("<include><uri>model://arm</uri></include>", "has <include>"),
    "loop": ("<frame name='f'><pose relative_to='j'/></frame>" + MOVED, "on itself"),
    "frame": (MOVED, "'f', which is no link"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_wrong_sdf_is_refused(kind):
    body, message = WRONG[kind]
    text = f'<sdf version="1.9"><model name="m">{LINK.format("a")}{LINK.format("b")}{body}</model></sdf>'
    with pytest.raises(UrdfError, match=message):
        describe(convert_sdf(text))


def test_entities_in_sdf_are_refused():
    with pytest.raises(UrdfError, match="document type"):
        convert_sdf("<!DOCTYPE sdf [<!ENTITY a 'b'>]><sdf><model name='&a;'/></sdf>")
