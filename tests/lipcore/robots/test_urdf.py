"""Tests of rigid bodies from a URDF, rejections by name, and learnt arms as URDFs."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

from lipcore import FitOptions
from lipcore.estimators.catalogue import MissingRobotError, UnknownEstimatorError, check_estimator, make_estimator
from lipcore.export.simulated_arm import ArmJoints, SimulatedArm
from lipcore.export.urdf_writer import rpy, urdf_text
from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.kernels.fast.arm import arm_torques
from lipcore.kernels.geometry import rotation_of
from lipcore.robots.library import ROBOTS, UnknownRobotError, load_robot, profile_urdf
from lipcore.robots.urdf import JointMismatchError, RigidBody, describe
from lipcore.robots.urdf_text import MAX_LINKS, UrdfError
from tests.lipcore.arms import parameters, random_bodies, random_geometry

TWO_REVOLUTE = ("revolute", "revolute")


def link(name: str, mass: float = 1.0) -> str:
    inertia = '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>'
    return (
        f'<link name="{name}"><inertial><origin xyz="0.1 0 0.2"/><mass value="{mass}"/>{inertia}</inertial>'
        '<visual><geometry><mesh filename="package://nowhere/mesh.stl"/></geometry></visual></link>'
    )


def joint(name: str, parent: str, child: str, kind: str = "revolute", extra: str = "") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="0 0 0.3"/><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/>{extra}</joint>'
    )


def robot(*parts: str) -> str:
    return f'<?xml version="1.0"?><robot name="arm">{"".join(parts)}</robot>'


AB = link("a"), link("b")
ARM = robot(link("base"), link("upper"), link("lower"), joint("j1", "base", "upper"), joint("j2", "upper", "lower"))


def test_joints_are_matched_in_any_order() -> None:
    straight = RigidBody.from_urdf(ARM, ("j1", "j2"), TWO_REVOLUTE)
    crossed = RigidBody.from_urdf(ARM, ("j2", "j1"), TWO_REVOLUTE)
    assert (straight.order, straight.matched, crossed.order) == ((0, 1), "name", (1, 0))
    assert np.array_equal(crossed.parameters(), straight.parameters()[::-1])
    assert straight.sha256 == crossed.sha256
    with pytest.raises(JointMismatchError, match=r"joint 'j2' is prismatic in the data, but 'j2' .* is revolute"):
        RigidBody.from_urdf(ARM, ("j1", "j2"), ("revolute", "prismatic"))
    text = robot(*AB, joint("j", "a", "b", "continuous"))
    assert RigidBody.from_urdf(text, ("j",), ("revolute",)).model.nq == 2
    body = RigidBody.from_urdf(ARM, ("shoulder", "elbow"), TWO_REVOLUTE, joints=("j1", "j2"))
    assert (body.joint_names, body.urdf_joints, body.matched) == (("shoulder", "elbow"), ("j1", "j2"), "list")
    # other joints are locked and their bodies merged
    body = RigidBody.from_urdf(ARM, ("j1",), ("revolute",))
    assert body.n_joints == 1
    assert body.parameters()[0, 0] == pytest.approx(2.0)


@pytest.mark.parametrize("name", ROBOTS)
def test_profile_matches_the_simulated_robot(name: str) -> None:
    simulated = load_robot(name)
    body = RigidBody.from_profile(name, simulated.joint_names, simulated.joint_types)
    expected = [inertia.toDynamicParameters() for inertia in list(simulated.model.inertias)[1:]]
    assert np.array_equal(body.parameters(), expected)
    assert body.order == tuple(range(simulated.n_joints))
    assert (body.urdf, body.matched) == (profile_urdf(name), "name")


def test_profile_matches_other_names_by_order() -> None:
    names = tuple(f"joint{i}" for i in range(1, 8))
    body = RigidBody.from_profile("panda", names, ("revolute",) * 7)
    assert (body.joint_names, body.urdf_joints, body.matched) == (names, ROBOTS["panda"].free, "order")


@pytest.mark.parametrize(
    "names",
    [("joint1", "joint2"), ("panda_joint2", *(f"joint{i}" for i in range(2, 8)))],
    ids=["number", "misplaced name"],
)
def test_mismatched_profile_names_both_lists(names: tuple[str, ...]) -> None:
    with pytest.raises(JointMismatchError) as caught:
        RigidBody.from_profile("panda", names, ("revolute",) * len(names))
    assert all(name in str(caught.value) for name in (*names, *ROBOTS["panda"].free))
    for take in (load_robot, lambda name: RigidBody.from_profile(name, ("a",), ("revolute",))):
        with pytest.raises(UnknownRobotError, match=r"robot is 'r2d2', expected one of panda, ur3.*finger-edu"):
            take("r2d2")


@pytest.mark.parametrize("names", [("a", "b"), ("j1", "b"), ("j1", "j2", "j3")])
def test_mismatched_joints_are_named_from_both_sides(names: tuple[str, ...]) -> None:
    with pytest.raises(JointMismatchError) as caught:
        RigidBody.from_urdf(ARM, names, ("revolute",) * len(names))
    assert "movable joints j1, j2; the data have " + ", ".join(names) in str(caught.value)


@pytest.mark.parametrize("listed", [("j1",), ("j1", "j1"), ("j1", "j9")])
def test_mismatched_joint_list_is_shown(listed: tuple[str, ...]) -> None:
    with pytest.raises(JointMismatchError, match=f"`joints` lists {', '.join(listed)}"):
        RigidBody.from_urdf(ARM, ("a", "b"), TWO_REVOLUTE, joints=listed)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not well-formed XML"),
        ("<sdf/>", "root element is <sdf>, expected <robot>"),
        (robot(), "no joint that moves"),
        (robot(link("a"), joint("j", "a", "b")), "joint 'j' has the child 'b', expected a link"),
        (robot(*AB, joint("j", "a", "b").replace("<limit", "<no")), "Pinocchio cannot read"),
        (robot(link("a"), link("b"), link("c"), joint("j", "a", "b")), "no joint leads to the links 'a' and 'c'"),
        (robot(link("a"), link("a")), "two links are called 'a'"),
        (robot(*AB, joint("j", "b", "b")), "lead to link 'b' form a closed loop"),
        (robot(*AB, joint("j", "b", "b"), joint("k", "a", "a")), "closed loop"),
        (ARM.replace('axis xyz="0 1 0"', 'axis xyz="0 0 0"'), "axis xyz> of joint 'j1' is '0 0 0', of length 0"),
        (ARM.replace('axis xyz="0 1 0"', 'axis xyz="1e300 0 0"'), "expected 3 numbers of at most 10000"),
        (ARM.replace('ixx="0.1"', 'ixx="inf"'), "<inertia ixx> of link 'base' is 'inf', expected a number"),
        (ARM.replace('ixx="0.1"', 'ixx="nan"'), "is 'nan', expected a number of at most"),
        (ARM.replace('ixx="0.1"', 'ixx="1_0"'), "is '1_0'"),
        (ARM.replace("0 0 0.3", "0 0.3"), "<origin xyz> of joint 'j1' is '0 0.3', expected 3 numbers"),
        (
            ARM.replace('"upper"', '"up&#10;2026 ERROR forged"'),
            "is called 'up.n2026 ERROR forged', expected a printable name",
        ),
        (robot(*AB, joint("j", "a", "b", "floating")), "'j' is of type 'floating': expected a fixed base"),
        (robot(*AB, joint("j", "a", "b", "spherical")), "'j' is of type 'spherical'"),
        (robot(link("a"), link("b", -1), joint("j", "a", "b")), "'j' moves has mass -1 kg"),
        (
            ARM.replace('"0.1"', '"1e5"'),
            "'j1' moves has a radius of gyration of 316 m for a robot of 1 m, expected kg·m²",
        ),
        (ARM.replace('izz="0.1"', 'izz="0.3"'), "has principal moments of inertia 0.1, 0.1, 0.3, expected none above"),
        (robot(link("a"), link("b", 5e4), joint("j", "a", "b")), "has 5e\\+04 kg within 2.2 mm, denser than any metal"),
        (
            robot(link("r"), link("a"), link("b"), *(joint(f"j{p}{c}", p, c) for p, c in ("ra", "ab", "ba"))),
            "link 'a' is the child of two joints, 'jra' and 'jba': a closed loop",
        ),
        (robot(*(link(f"l{i}") for i in range(MAX_LINKS + 1))), f"expected at most {MAX_LINKS}"),
        (robot("<a>" * 40 + "</a>" * 40), "nests elements more than"),
        ('<!DOCTYPE robot SYSTEM "http://nowhere/x.dtd">' + ARM[21:], "document type or an entity"),
        ('<!DOCTYPE r [<!ENTITY a "aaaaaaaa"><!ENTITY b "&a;&a;">]><robot name="&b;"/>', "document type or an entity"),
    ],
)
def test_invalid_urdf_is_rejected_with_the_reason(text: str, message: str) -> None:
    with pytest.raises(UrdfError, match=message):
        describe(text)


def test_missing_or_fixed_inertia_is_accepted() -> None:
    describe(ARM.replace('"0.1"', '"0"'))
    describe(robot(link("base").replace('"0.1"', '"1e5"'), link("a"), joint("j", "base", "a")))


def test_uploaded_text_is_never_written_to_stderr(capfd: pytest.CaptureFixture[str]) -> None:
    forged = "2026-01-01 ERROR forged"
    material = f'<visual><geometry><forged/></geometry><material name="{forged}&#10;{forged}"/></visual>'
    describe(ARM.replace("<visual>", material + "<visual>"))
    for text in (ARM.replace('"1"', f'"{forged}"'), ARM.replace('type="revolute"', f'type="{forged}"'), ARM[:-9]):
        with pytest.raises(UrdfError):
            describe(text)
    assert "forged" not in "".join(capfd.readouterr())


def test_only_the_fixed_base_may_branch() -> None:
    text = robot(*AB, link("c"), joint("left", "a", "b"), joint("right", "a", "c"))
    both = RigidBody.from_urdf(text, ("left", "right"), TWO_REVOLUTE)
    assert (both.roots, both.fixed_joints) == ((0, 1), ())
    one = RigidBody.from_urdf(text, ("left",), ("revolute",))
    assert (one.roots, one.fixed_joints) == ((0,), ("right",))
    torso = robot(*map(link, "abcd"), joint("lift", "a", "b"), joint("left", "b", "c"), joint("right", "b", "d"))
    with pytest.raises(UrdfError, match=r"'right' follows 'lift', not 'left'; expected serial arms that share only"):
        RigidBody.from_urdf(torso, ("lift", "left", "right"), ("revolute",) * 3)
    assert RigidBody.from_urdf(torso, ("left", "right"), TWO_REVOLUTE).roots == (0, 1)  # the lift stands still


def test_two_arms_in_any_order_have_the_torques_of_pinocchio() -> None:
    urdf, free = profile_urdf("baxter-left"), [ROBOTS[f"baxter-{side}"].free for side in ("left", "right")]
    names = tuple(name for pair in zip(*free, strict=True) for name in pair)  # left, right, left, right, …
    body = RigidBody.from_urdf(urdf, names, ("revolute",) * 14)
    assert body.roots == (0, 7)
    arm = arm_of_robot(body)
    assert arm.arm_of.tolist() == [0, 1] * 7
    full, rng = pin.buildModelFromXML(urdf), np.random.default_rng(0)
    places = [full.joints[full.getJointId(name)] for name in names]
    q, (dq, ddq) = pin.neutral(full), np.zeros((2, full.nv))
    motion = rng.normal(size=(1, 3, 14))
    at = [place.idx_v for place in places]
    q[[place.idx_q for place in places]], dq[at], ddq[at] = motion[0]
    expected, found = pin.rnea(full, full.createData(), q, dq, ddq)[at], np.empty((1, 14))
    arm_torques(arm.geometry.constants, arm.geometry.gravity, arm.parameters, arm.order, motion, found)
    np.testing.assert_allclose(found[0], expected, rtol=0, atol=1e-9)


def test_joints_without_data_are_fixed_and_named() -> None:
    panda = RigidBody.from_profile("panda", ROBOTS["panda"].free, ("revolute",) * 7)
    assert panda.fixed_joints == ("panda_finger_joint1", "panda_finger_joint2")
    assert RigidBody.from_urdf(ARM, ("j1", "j2"), TWO_REVOLUTE).fixed_joints == ()


def test_only_rigid_body_estimators_take_a_robot() -> None:
    body = RigidBody.from_urdf(ARM, ("j1", "j2"), TWO_REVOLUTE)
    arm = arm_of_robot(body)
    for name, terms in (("rigid-body", ()), ("rigid-body+local", ()), ("rigid-body+lip-chain", ("energy",))):
        assert list(make_estimator(name, TWO_REVOLUTE, arm=arm).terms) == ["rigid_body", *terms, "friction"]
    for name, given in (("rigid-body", None), ("lip-chain", arm)):
        with pytest.raises(ValueError, match=r"only rigid-body, .* need an arm"):
            make_estimator(name, TWO_REVOLUTE, arm=given)
    with pytest.raises(JointMismatchError, match="the arm has joints"):
        make_estimator("rigid-body", ("revolute", "prismatic"), arm=arm)
    for name in ("rigid-body", "rigid-body+lip-chain"):
        check_estimator(name, TWO_REVOLUTE, body)
    with pytest.raises(MissingRobotError, match="'lip-chain' does not use a robot, only rigid-body"):
        check_estimator("lip-chain", TWO_REVOLUTE, body)
    for known in (make_estimator, check_estimator):
        with pytest.raises(UnknownEstimatorError, match=r"lip-chain.*rigid-body, .*rigid-body\+lip-chain"):
            known("newton", TWO_REVOLUTE)


@pytest.mark.parametrize("geometry", ["fixed", "calibrate"])
def test_fixed_geometry_needs_a_robot(geometry: str) -> None:
    with pytest.raises(MissingRobotError, match=f"geometry is '{geometry}', which needs a robot: a profile"):
        check_estimator("rigid-body", TWO_REVOLUTE, None, FitOptions(geometry=geometry))
    for name, known in (("rigid-body", "learn"), ("rigid-body", "auto"), ("lip-chain", geometry)):
        check_estimator(name, TWO_REVOLUTE, None, FitOptions(geometry=known))


def test_energies_need_joints_from_base_to_tip() -> None:
    crossed = RigidBody.from_urdf(ARM, ("j2", "j1"), TWO_REVOLUTE)
    with pytest.raises(JointMismatchError, match="from base to tip, j1, j2; the data have j2, j1"):
        check_estimator("rigid-body+lip-chain", TWO_REVOLUTE, crossed)
    check_estimator("rigid-body", TWO_REVOLUTE, crossed)
    assert make_estimator("rigid-body", TWO_REVOLUTE, arm=arm_of_robot(crossed)).kernel.n_joints == 2
    two = RigidBody.from_urdf(
        robot(*AB, link("c"), joint("left", "a", "b"), joint("right", "a", "c")), ("left", "right"), TWO_REVOLUTE
    )
    with pytest.raises(JointMismatchError, match="needs one serial chain, but the robot has 2 arms: use rigid-body"):
        check_estimator("rigid-body+lip-chain", TWO_REVOLUTE, two)


@pytest.mark.parametrize(
    ("arms", "estimator", "message"),
    [("2,2", "auto", "arms is '2,2', expected numbers whose sum is 2"), ("1,1", "lip-chain", "and one of auto, rigid")],
)
def test_arms_without_a_robot_have_the_joints_of_the_data(arms: str, estimator: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_estimator(estimator, TWO_REVOLUTE, None, FitOptions(arms=arms))
    check_estimator("auto", TWO_REVOLUTE, None, FitOptions(arms="1,1"))
    with pytest.raises(ValueError, match="arms is '7;7', expected the number of joints of each"):
        FitOptions(arms="7;7")


def training_range(n: int) -> dict[str, dict[str, list[float]]]:
    low = [-1.0 - 0.1 * joint for joint in range(n)]
    return {name: {"min": low, "max": [2.0] * n} for name in ("q", "dq", "ddq")}


def joints(names: list[str], **changed: object) -> ArmJoints:
    n = len(names)
    zero = np.zeros(n)
    given = {"lower": zero - 1, "upper": zero + 1, "velocity": zero + 2, "viscous": zero, "coulomb": zero}
    return ArmJoints(tuple(names), **{**given, "offset": zero, "rotor": zero, **changed})


def read_drives(urdf: str, names: list[str]) -> dict[str, np.ndarray]:
    """Return friction and rotors of the URDF, in the order of the names."""
    root = ElementTree.fromstring(urdf)
    dynamics = [root.find(f"joint[@name='{name}']/dynamics").attrib for name in names]
    rotor = {
        each.find("joint").get("name"): float(each.find("actuator/{http://drake.mit.edu}rotor_inertia").get("value"))
        for each in root.findall("transmission")
    }
    terms = {key: np.array([float(each[key]) for each in dynamics]) for key in ("damping", "friction")}
    return {**terms, "rotor": np.array([rotor[name] for name in names])}


def torque_of_urdf(urdf: str, names: list[str], motions: np.ndarray, gravity: bool) -> np.ndarray:
    """Return Pinocchio's torque with the URDF's rotors and friction, in the order of the data."""
    model = pin.buildModelFromXML(urdf)
    if not gravity:
        model.gravity.setZero()
    data, place = model.createData(), [model.names[1:].tolist().index(name) for name in names]
    out, drive = np.empty((len(motions), len(names))), read_drives(urdf, names)
    for row, (q, dq, ddq) in enumerate(motions):
        chain = np.empty((3, len(names)))
        chain[:, place] = q, dq, ddq
        out[row] = pin.rnea(model, data, *chain)[place] + drive["rotor"] * ddq
        out[row] += drive["damping"] * dq + drive["friction"] * np.sign(dq)
    return out


@pytest.mark.parametrize("kinds", ["R", "PR", "RRP", "RPPR", "RRRRRR", "RPRRRRR"])
@pytest.mark.parametrize("gravity", [True, False])
def test_urdf_torque_matches_the_arm(kinds: str, gravity: bool) -> None:
    n, seed = len(kinds), len(kinds) + gravity
    rng = np.random.default_rng(seed)
    geometry, bodies = random_geometry(kinds, seed, gravity), random_bodies(n, seed)
    order, names = rng.permutation(n), [f"joint {letter}" for letter in "edcbagf"[:n]]
    report = parameters(geometry, bodies, names, order.tolist())
    urdf = urdf_text(SimulatedArm.of_parameters(report, names, training_range(n)))
    assert (pin.buildModelFromXML(urdf).effortLimit > 0).all()
    motions = rng.normal(0, 1.5, (20, 3, n))
    expected = np.empty((20, n))
    arm_torques(geometry.constants, geometry.gravity, bodies, order, motions, expected)
    expected += np.array(report["rotor"]["mean"]) * motions[:, 2]
    for term, feature in (("viscous", motions[:, 1]), ("coulomb", np.sign(motions[:, 1]))):
        expected += np.array(report["friction"][term]["mean"]) * feature
    np.testing.assert_allclose(torque_of_urdf(urdf, names, motions, gravity), expected, rtol=1e-9, atol=1e-9)


def test_names_and_numbers_are_kept() -> None:
    names = ['a<b>&"c"', "base", "base_link", "world_to_base", "größe -- 1"]
    geometry = random_geometry("RPRRR", 3)
    words = tuple(("mass", "shift 1") if k == 2 else () for k in range(5))
    numbers = np.arange(5.0)
    given = joints(names, lower=-numbers, upper=numbers, offset=numbers, undetermined=words)
    urdf = urdf_text(SimulatedArm(geometry, random_bodies(5, 3), given, np.arange(5)), 'my "arm"')
    model = pin.buildModelFromXML(urdf)
    assert model.names[1:].tolist() == names
    assert model.name == 'my "arm"'
    np.testing.assert_array_equal(model.lowerPositionLimit, -numbers)
    np.testing.assert_array_equal(model.upperPositionLimit, numbers)
    np.testing.assert_array_equal(model.velocityLimit, 2.0)
    assert describe(urdf).joint_names == tuple(names)
    assert "not identifiable from torque: mass, shift 1" in urdf
    assert "offset torque 4.0" in urdf


def test_negative_friction_is_written_as_zero() -> None:
    given = joints(["a"], viscous=np.array([-0.5]))
    arm = SimulatedArm(random_geometry("R", 1), random_bodies(1, 1), given, np.arange(1))
    urdf = urdf_text(arm)
    weak = replace(arm.geometry, gravity=arm.geometry.gravity / 6)
    assert "set it in the simulator" in urdf_text(replace(arm, geometry=weak))
    assert 'damping="0.0"' in urdf
    assert "learnt damping is -0.5" in urdf


@pytest.mark.parametrize("pitch", [0.0, 0.3, np.pi / 2, -np.pi / 2])
def test_angles_match_the_rotation(pitch: float) -> None:
    roll, yaw = 0.7, -2.1
    turns = [rotation_of(angle * axis) for angle, axis in zip((yaw, pitch, roll), np.eye(3)[::-1], strict=True)]
    rotation = turns[0] @ turns[1] @ turns[2]
    np.testing.assert_allclose(pin.rpy.rpyToMatrix(rpy(rotation)), rotation, atol=1e-15)


def test_impossible_urdf_is_rejected() -> None:
    report, names = parameters(random_geometry("RR", 1), random_bodies(2, 1), ["a", "b"], [0, 1]), ["a", "b"]
    with pytest.raises(ValueError, match="no rigid bodies"):
        SimulatedArm.of_parameters({"friction": report["friction"]}, names, training_range(2))
    report["inertia"]["bodies"][1]["plausible"]["mass"] = -1.0
    with pytest.raises(ValueError, match="joint 'b' moves is -1 kg"):
        SimulatedArm.of_parameters(report, names, training_range(2))
    with pytest.raises(ValueError, match=r"names\[1\] is 'a'"):
        joints(["a", "a"])
    with pytest.raises(ValueError, match="lower is"):
        joints(["a"], lower=np.array([3.0]))
    with pytest.raises(ValueError, match="rotor is"):
        joints(["a"], rotor=np.array([np.nan]))
    with pytest.raises(ValueError, match="bodies has shape"):
        SimulatedArm(random_geometry("RR", 1), random_bodies(3, 1), joints(["a", "b"]), np.arange(2))
