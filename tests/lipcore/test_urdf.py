"""Rigid bodies from a URDF: matched to the data's joints, and refused by name where they cannot be."""

from __future__ import annotations

import numpy as np
import pytest

from lipcore import FitOptions
from lipcore.fitting.estimators import MissingRobotError, UnknownEstimatorError, check_estimator, make_estimator
from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.robots.library import ROBOTS, UnknownRobotError, load_robot, profile_urdf
from lipcore.robots.urdf import MAX_LINKS, JointMismatchError, RigidBody, UrdfError, describe

TWO = ("revolute", "revolute")


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


ARM = robot(link("base"), link("upper"), link("lower"), joint("j1", "base", "upper"), joint("j2", "upper", "lower"))


def test_what_a_urdf_says_of_itself() -> None:
    said = describe(ARM)
    assert (said.name, said.joint_names) == ("arm", ("j1", "j2"))
    assert [j.kind for j in said.joints] == ["revolute", "revolute"]


def test_joints_are_found_by_name_whatever_their_order() -> None:
    straight = RigidBody.from_urdf(ARM, ("j1", "j2"), TWO)
    crossed = RigidBody.from_urdf(ARM, ("j2", "j1"), TWO)
    assert (straight.order, straight.matched, crossed.order) == ((0, 1), "name", (1, 0))
    assert np.array_equal(crossed.parameters(), straight.parameters()[::-1])
    assert straight.sha256 == crossed.sha256


def test_explicit_list_names_the_joints_of_data_named_otherwise() -> None:
    body = RigidBody.from_urdf(ARM, ("shoulder", "elbow"), TWO, joints=("j1", "j2"))
    assert (body.joint_names, body.urdf_joints, body.matched) == (("shoulder", "elbow"), ("j1", "j2"), "list")


def test_other_joints_are_locked_and_their_bodies_merged() -> None:
    body = RigidBody.from_urdf(ARM, ("j1",), ("revolute",))
    assert body.n_joints == 1
    assert body.parameters()[0, 0] == pytest.approx(2.0)


@pytest.mark.parametrize("name", ROBOTS)
def test_profile_is_the_robot_of_the_simulator(name: str) -> None:
    simulated = load_robot(name)
    body = RigidBody.from_profile(name, simulated.joint_names, simulated.joint_types)
    expected = [inertia.toDynamicParameters() for inertia in list(simulated.model.inertias)[1:]]
    assert np.array_equal(body.parameters(), expected)
    assert body.order == tuple(range(simulated.n_joints))
    assert (body.urdf, body.matched) == (profile_urdf(name), "name")


def test_profile_matches_by_order_where_the_data_have_other_names_and_says_so() -> None:
    names = tuple(f"joint{i}" for i in range(1, 8))
    body = RigidBody.from_profile("panda", names, ("revolute",) * 7)
    assert (body.joint_names, body.urdf_joints, body.matched) == (names, ROBOTS["panda"].free, "order")


@pytest.mark.parametrize(
    "names",
    [("joint1", "joint2"), ("panda_joint2", *(f"joint{i}" for i in range(2, 8)))],
    ids=["number", "misplaced name"],
)
def test_profile_that_does_not_fit_names_both_lists(names: tuple[str, ...]) -> None:
    with pytest.raises(JointMismatchError) as caught:
        RigidBody.from_profile("panda", names, ("revolute",) * len(names))
    assert all(name in str(caught.value) for name in (*names, *ROBOTS["panda"].free))


def test_unknown_profile_lists_the_known() -> None:
    with pytest.raises(UnknownRobotError, match=r"robot is 'r2d2', expected one of panda, ur3.*finger-edu"):
        RigidBody.from_profile("r2d2", ("a",), ("revolute",))


@pytest.mark.parametrize("names", [("a", "b"), ("j1", "b"), ("j1", "j2", "j3")])
def test_joints_that_do_not_match_are_named_from_both_sides(names: tuple[str, ...]) -> None:
    with pytest.raises(JointMismatchError) as caught:
        RigidBody.from_urdf(ARM, names, ("revolute",) * len(names))
    assert "movable joints j1, j2; the data have " + ", ".join(names) in str(caught.value)


@pytest.mark.parametrize("listed", [("j1",), ("j1", "j1"), ("j1", "j9")])
def test_a_list_that_does_not_fit_is_shown(listed: tuple[str, ...]) -> None:
    with pytest.raises(JointMismatchError, match=f"`joints` lists {', '.join(listed)}"):
        RigidBody.from_urdf(ARM, ("a", "b"), TWO, joints=listed)


def test_joint_of_another_type_is_named() -> None:
    with pytest.raises(JointMismatchError, match=r"joint 'j2' is prismatic in the data, but 'j2' .* is revolute"):
        RigidBody.from_urdf(ARM, ("j1", "j2"), ("revolute", "prismatic"))


def test_continuous_joints_are_revolute() -> None:
    text = robot(link("a"), link("b"), joint("j", "a", "b", "continuous"))
    assert RigidBody.from_urdf(text, ("j",), ("revolute",)).model.nq == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not well-formed XML"),
        ("<robot>", "not well-formed XML: no element found"),
        ("q1,q2\n1,2\n", "not well-formed XML"),
        ("<sdf/>", "root element is <sdf>, expected <robot>"),
        (robot(), "no joint that moves"),
        (robot(link("a")), "no joint that moves"),
        (robot(link("a"), joint("j", "a", "b")), "Pinocchio cannot read"),
        (
            robot(link("a"), link("b"), joint("j", "a", "b", "floating")),
            "'j' is of type 'floating': expected a fixed base",
        ),
        (robot(link("a"), link("b"), joint("j", "a", "b", "planar")), "'j' is of type 'planar'"),
        (robot(link("a"), link("b"), joint("j", "a", "b", "spherical")), "'j' is of type 'spherical'"),
        (robot(link("a"), link("b", -1), joint("j", "a", "b")), "'j' moves has mass -1 kg"),
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
def test_text_that_cannot_be_used_is_refused_with_the_reason(text: str, message: str) -> None:
    with pytest.raises(UrdfError, match=message):
        describe(text)


def test_the_longest_chain_admitted_is_read() -> None:
    links = [link(f"l{i}") for i in range(MAX_LINKS)]
    joints = [joint(f"j{i}", f"l{i}", f"l{i + 1}") for i in range(MAX_LINKS - 1)]
    assert len(describe(robot(*links, *joints)).joints) == MAX_LINKS - 1


def test_branching_joints_are_refused() -> None:
    text = robot(link("a"), link("b"), link("c"), joint("left", "a", "b"), joint("right", "a", "c"))
    with pytest.raises(
        UrdfError, match="the joints branch: 'right' follows 'the base', not 'left'; expected one serial"
    ):
        RigidBody.from_urdf(text, ("left", "right"), TWO)
    assert RigidBody.from_urdf(text, ("left",), ("revolute",)).n_joints == 1


def test_coupled_joints_are_refused() -> None:
    text = robot(
        *(link(name) for name in "abcd"),
        joint("j1", "a", "b"),
        joint("j2", "b", "c", extra='<mimic joint="j1"/>'),
        joint("j3", "c", "d"),
    )
    with pytest.raises(UrdfError, match="joint 'j2' mimics 'j1'"):
        RigidBody.from_urdf(text, ("j1", "j2", "j3"), ("revolute",) * 3)
    with pytest.raises(UrdfError, match="mimics 'j1' of the data: a coupled joint cannot be locked"):
        RigidBody.from_urdf(text, ("j1",), ("revolute",))
    assert RigidBody.from_urdf(text, ("j3",), ("revolute",)).n_joints == 1
    assert describe(text).joint_names == ("j1", "j3")


def test_estimator_takes_a_robot_exactly_where_it_has_rigid_bodies() -> None:
    body = RigidBody.from_urdf(ARM, ("j1", "j2"), TWO)
    arm = arm_of_robot(body)
    assert list(make_estimator("rigid-body", TWO, arm=arm).terms) == ["rigid_body", "friction"]
    assert list(make_estimator("rigid-body+lip-chain", TWO, arm=arm).terms) == ["rigid_body", "energy", "friction"]
    for name, given in (("rigid-body", None), ("lip-chain", arm)):
        with pytest.raises(ValueError, match=r"expected an arm for rigid-body and rigid-body\+lip-chain, and for no"):
            make_estimator(name, TWO, arm=given)
    with pytest.raises(JointMismatchError, match="the arm has joints"):
        make_estimator("rigid-body", ("revolute", "prismatic"), arm=arm)
    for name in ("rigid-body", "rigid-body+lip-chain"):
        check_estimator(name, TWO, body)
    with pytest.raises(MissingRobotError, match="'lip-chain' takes no robot, only rigid-body"):
        check_estimator("lip-chain", TWO, body)
    for known in (make_estimator, check_estimator):
        with pytest.raises(UnknownEstimatorError, match=r"lip-chain.*rigid-body, rigid-body\+lip-chain"):
            known("newton", TWO)


@pytest.mark.parametrize("geometry", ["fixed", "calibrate", "learn", "auto"])
def test_a_geometry_that_is_not_learnt_needs_a_robot(geometry: str) -> None:
    options = FitOptions(geometry=geometry)
    if geometry in ("fixed", "calibrate"):
        with pytest.raises(MissingRobotError, match=f"geometry is '{geometry}', which needs a robot: a profile"):
            check_estimator("rigid-body", TWO, None, options)
    else:
        check_estimator("rigid-body", TWO, None, options)
    check_estimator("lip-chain", TWO, None, options)


def test_energies_need_the_joints_from_base_to_tip() -> None:
    crossed = RigidBody.from_urdf(ARM, ("j2", "j1"), TWO)
    with pytest.raises(JointMismatchError, match="from base to tip, j1, j2; the data have j2, j1"):
        check_estimator("rigid-body+lip-chain", TWO, crossed)
    check_estimator("rigid-body", TWO, crossed)
    assert make_estimator("rigid-body", TWO, arm=arm_of_robot(crossed)).kernel.n_joints == 2
