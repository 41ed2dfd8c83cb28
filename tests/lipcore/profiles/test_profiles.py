"""Tests of robot profiles: limits, joint names of drivers, and uploaded URDFs."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lipcore.profiles import from_urdf, names, profile, profiles, recognise
from lipcore.profiles.catalogue import read_entries
from lipcore.profiles.names import split_words
from lipcore.robots.library import ROBOTS, UnknownRobotError, load_robot, profile_urdf
from lipcore.robots.urdf import RigidBody
from lipcore.robots.urdf_text import UrdfError
from tests.lipcore.robots.test_urdf import joint, link, robot

SHEETS = read_entries()
ALL = tuple(SHEETS)
ARMS = tuple(name for name, sheet in SHEETS.items() if sheet.ranges)
UR = tuple(f"{each}_joint" for each in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))
SO_ARM = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
ROBOTS_WITH_MAKER_LIMITS = {"ur3", "ur5", "ur10"}
"""Robots with the maker's numbers, not those of example-robot-data."""


def numbered(pattern: str, count: int) -> tuple[str, ...]:
    return tuple(pattern.format(i) for i in range(1, count + 1))


def test_catalogue_contains_all_promised_robots() -> None:
    assert set(ROBOTS) <= set(ALL)
    promised = "panda fr3 ur3 ur5 ur10 ur3e ur5e ur10e xarm6 xarm7 kinova z1 so100 so101"
    assert set(promised.split()) <= set(ARMS)
    assert names() == tuple(each.name for each in profiles()) == ALL


@pytest.mark.parametrize("name", ALL)
def test_every_profile_is_complete(name: str) -> None:
    found = profile(name)
    assert found.joint_names == (ROBOTS[name].free if name in ROBOTS else SHEETS[name].joints)
    assert found.title
    assert found.source
    assert len(found.effort_note) > 20
    assert (found.urdf is not None) == (name in ROBOTS)
    assert found.torque_constants is None
    # a range is an interval or unknown, other limits are positive or unknown: never 0, never a guess
    known = ~np.isnan(found.lower)
    assert np.array_equal(known, ~np.isnan(found.upper))
    assert (found.lower[known] < found.upper[known]).all()
    for limit in (found.speed, found.acceleration, found.torque):
        assert (np.isnan(limit) | (np.isfinite(limit) & (limit > 0))).all()
    # spellings must be unique
    spellings = [
        {split_words(each) for each in (a, *b)} for a, b in zip(found.joint_names, found.joint_aliases, strict=True)
    ]
    assert sum(map(len, spellings)) == len(set().union(*spellings))


@pytest.mark.parametrize("name", [name for name in ALL if name in ROBOTS])
def test_limits_match_the_urdf(name: str) -> None:
    found, model = profile(name), load_robot(name).model
    assert found.joint_types == load_robot(name).joint_types
    for joint_index in range(1, model.njoints):
        q, v, at = model.joints[joint_index].idx_q, model.joints[joint_index].idx_v, joint_index - 1
        if model.joints[joint_index].nq == 2:
            assert np.isinf(found.lower[at])
            assert np.isinf(found.upper[at])
        elif name != "ur3" and np.isfinite(found.lower[at]):
            assert found.lower[at] == pytest.approx(model.lowerPositionLimit[q], abs=1e-9)
            assert found.upper[at] == pytest.approx(model.upperPositionLimit[q], abs=1e-9)
        elif np.isnan(found.lower[at]):
            assert not model.lowerPositionLimit[q] < model.upperPositionLimit[q]
        if name not in ROBOTS_WITH_MAKER_LIMITS:
            for ours, theirs in ((found.speed, model.velocityLimit), (found.torque, model.effortLimit)):
                assert np.isnan(ours[at]) or ours[at] == pytest.approx(theirs[v], rel=1e-9)


def test_arms_remain_without_example_robot_data(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lipcore.profiles.catalogue.list_installed_robots", lambda: ())
    assert names() == ARMS
    assert profile("panda").urdf is None
    assert "has no URDF" in profile("panda").explain_missing_urdf()
    assert profile("panda").lower[0] == -2.8973
    with pytest.raises(UnknownRobotError, match="robot is 'tiago', expected one of panda, fr3") as caught:
        profile("tiago")
    assert all(name in str(caught.value) for name in ARMS)
    monkeypatch.undo()
    assert profile("panda").urdf == profile_urdf("panda")


@pytest.mark.parametrize(
    ("name", "joints"),
    [
        ("panda", numbered("fer_joint{}", 7)),
        ("panda", numbered("robot1/panda_joint{}", 7)),
        ("panda", numbered("J{}", 7)),
        ("panda", tuple(f"joint_{i}" for i in range(7))),
        ("panda", numbered("my_arm_joint{}", 7)),
        ("ur5e", tuple(f"ur5e_{each}" for each in UR)),
        ("ur5e", ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")),
        ("iiwa14", numbered("joint_a{}", 7)),
        ("so101", tuple(f"left_{each}" for each in SO_ARM)),
        ("pr2-right", ROBOTS["pr2-right"].free),
    ],
)
@settings(max_examples=10, deadline=None)
@given(data=st.data())
def test_joints_are_found_under_driver_names_in_any_order(
    name: str, joints: tuple[str, ...], data: st.DataObject
) -> None:
    found = profile(name)
    others = () if joints[0][-1].isdigit() and "panda" not in joints[0] else ("head_pan",)
    mixed = data.draw(st.permutations([*joints, *others]))
    order = found.order_of(mixed)
    assert order is not None
    assert [mixed[place] for place in order] == list(joints)
    assert found.match(mixed) == tuple(joints.index(each) if each in joints else None for each in mixed)
    assert found.official_names(joints) == found.joint_names


@pytest.mark.parametrize(
    ("name", "joints"),
    [
        ("panda", numbered("joint{}", 6)),
        ("panda", numbered("fr3_joint{}", 7)),
        ("z1", numbered("xarm6_joint{}", 6)),
        ("ur5", SO_ARM),
        ("panda", ("",) * 7),
        ("panda", (*numbered("left_panda_joint{}", 7), *numbered("right_panda_joint{}", 7))),
        ("panda", ("joint1", "joint1", *numbered("joint{}", 5))),
        ("panda", ("panda_joint3", *numbered("panda_joint{}", 7))),
    ],
)
def test_joints_of_other_robots_have_no_order(name: str, joints: tuple[str, ...]) -> None:
    assert profile(name).order_of(joints) is None


def test_some_joints_match_without_being_a_whole_robot() -> None:
    panda = profile("panda")
    fingers, arm = ("panda_finger_joint1", "panda_finger_joint2"), numbered("panda_joint{}", 7)
    assert panda.order_of((*fingers, *arm)) == list(range(2, 9))
    assert panda.official_names((*fingers, *arm)) is None
    some = ("panda_joint4", "panda_joint2")
    assert panda.match(some) == (3, 1)
    assert panda.order_of(some) is None
    assert panda.official_names(some) == some
    assert panda.official_names(("fer_joint4", "fer_joint2")) == some
    assert panda.match(("joint4", "joint2")) == (3, 1)
    assert panda.official_names(("joint4", "joint2")) is None


def test_known_robots_are_recognised() -> None:
    assert recognise(numbered("fer_joint{}", 7)) == ("panda",)
    assert recognise(numbered("right_fr3_joint{}", 7)) == ("fr3",)
    assert recognise(tuple(f"ur5e_{each}" for each in UR)) == ("ur5e",)
    assert recognise(sorted(UR)) == ("ur3", "ur5", "ur10", "ur3e", "ur5e", "ur10e", "ur16e")
    assert recognise(SO_ARM) == ("so100", "so101")
    assert recognise(numbered("xarm7_joint{}", 7)) == ("xarm7",)
    assert recognise((*numbered("left_panda_joint{}", 7), *numbered("right_panda_joint{}", 7))) == ("panda",)
    assert recognise(ROBOTS["tiago-pro-left"].free) == ("tiago-pro-left", "talos-left")
    columns = tuple(f"n{i}_elbow" for i in range(2000))  # among too many names, only exact matches are found
    assert profile("ur5").match(columns) == (None,) * 2000
    assert recognise((*columns, *UR)) == recognise(UR)
    for nothing in (numbered("joint{}", 7), numbered("q{}", 6), ("shoulder", "elbow"), (), ("",)):
        assert recognise(nothing) == ()


@given(st.lists(st.text(max_size=30), max_size=12))
def test_arbitrary_names_are_accepted(joints: list[str]) -> None:
    recognise(joints)
    for name in ("panda", "ur5", "z1"):
        found = profile(name)
        order = found.order_of(joints)
        assert order is None or len(set(order)) == found.n_joints
        assert len(found.match(joints)) == len(joints)


def test_custom_urdf_is_read() -> None:
    default = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
    unlimited = default, '<limit lower="0" upper="0" effort="0" velocity="0"/>'
    limited = default, '<limit lower="-1" upper="2" effort="3" velocity="4"/>'
    text = robot(
        *map(link, ("base", "upper", "lower", "jaw", "rail")),
        joint("grip", "lower", "jaw", extra='<mimic joint="elbow"/>').replace(*unlimited),
        joint("elbow", "upper", "lower").replace(*limited),
        joint("shoulder", "rail", "upper", "continuous").replace(*unlimited),
        joint("slide", "base", "rail", "prismatic").replace(*limited),
    )
    found = from_urdf(text, "mine")
    assert (found.name, found.urdf, found.effort) == ("mine", text, "unknown")
    # from base to tip in any text order; mimic joints are left out
    assert found.joint_names == ("slide", "shoulder", "elbow")
    assert found.joint_types == ("prismatic", "revolute", "revolute")
    limits = [found.lower, found.upper, found.speed, found.torque, found.acceleration]
    slide = elbow = [-1, 2, 4, 3, np.nan]
    shoulder = [-np.inf, np.inf, np.nan, np.nan, np.nan]
    np.testing.assert_array_equal(limits, np.transpose([slide, shoulder, elbow]))
    # data may lack joints of an uploaded URDF
    assert found.order_of(("elbow", "t", "shoulder")) == [2, 0]
    assert found.order_of(("left_elbow", "left_shoulder", "left_slide")) == [2, 1, 0]
    assert found.order_of(("wrist",)) is None
    for wrong, message in (("", "well-formed"), (robot(link("base")), "no joint that moves")):
        with pytest.raises(UrdfError, match=message):
            from_urdf(wrong, "mine")
    with pytest.raises(ValueError, match=r"torque of 'mine' has shape \(2,\), expected \(3,\)"):
        replace(found, torque=np.ones(2))
    with pytest.raises(ValueError, match="joint_aliases of 'mine' has 1 entries, expected 3"):
        replace(found, joint_aliases=((),))


@pytest.mark.parametrize("name", ["panda", "so101", "tiago", "kinova", "baxter-right"])
def test_uploaded_catalogue_urdf_is_the_same_arm(name: str) -> None:
    known, uploaded = profile(name), from_urdf(profile_urdf(name), "mine")
    places = [uploaded.joint_names.index(each) for each in known.joint_names]
    assert places == sorted(places)
    assert uploaded.order_of(known.joint_names) == list(range(known.n_joints))
    for what in ("lower", "upper"):
        assert getattr(uploaded, what)[places] == pytest.approx(getattr(known, what), nan_ok=True)
    assert known.urdf is not None
    body = RigidBody.from_urdf(known.urdf, known.joint_names, known.joint_types)
    assert body.order == tuple(range(known.n_joints))
