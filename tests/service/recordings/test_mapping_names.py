"""Columns are recognised by the names that robots, drivers and other programs give them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.datasets.mapping.mapping import resolve
from service.datasets.mapping.recognition import clocks, sightings
from service.foundation.errors import InvalidDataError, InvalidRequestError
from tests.service.recordings.mapping_tables import Arm, options

QUANTITIES = ("q", "dq", "ddq", "tau")


def mapped(names, said=None, robot=None, units=None, joint_names=None, most=32):
    return resolve(tuple(names), units or {}, joint_names, said or options(), robot, most)


def read_as(found):
    """Names of the columns by quantity."""
    return {quantity: [each.name for each in row] for quantity, row in found.quantities.items()}


def numbered(*patterns, of=range(1, 4)):
    """Names t and pattern by pattern, joint by joint."""
    return ["t", *(pattern.replace("#", str(joint)) for pattern in patterns for joint in of)]


@pytest.mark.parametrize(
    ("patterns", "of"),
    [
        pytest.param(("q#", "dq#", "tau#"), range(1, 8), id="documented"),
        pytest.param(("Q#", "DQ#", "TAU#"), range(1, 4), id="capitals"),
        pytest.param(("q_#", "qd_#", "tau_#"), range(1, 7), id="underscores"),
        pytest.param(("q[#]", "dq[#]", "tau_J[#]"), range(7), id="libfranka"),
        pytest.param(("q0#", "dq0#", "tau0#"), range(1, 4), id="leading zero"),
        pytest.param(("position_#", "velocity_#", "effort_#"), range(1, 7), id="ROS fields"),
        pytest.param(("field.position#", "field.velocity#", "field.effort#"), range(7), id="rostopic"),
        pytest.param(("actual_q_#", "actual_qd_#", "torque_#"), range(6), id="UR RTDE, torques"),
        pytest.param(("/js/position[#]", "/js/velocity[#]", "/js/effort[#]"), range(7), id="PlotJuggler arrays"),
        pytest.param(("joint#_pos", "joint#_vel", "joint#_torque"), range(1, 4), id="joint first"),
        pytest.param(("joint#.position", "joint#.velocity", "joint#.effort"), range(3), id="dots"),
        pytest.param(("jointPosition#", "jointVelocity#", "jointTorque#"), range(1, 4), id="camel case"),
        pytest.param(
            ("Joint # Position (rad)", "Joint # Velocity (rad/s)", "Joint # Torque (Nm)"), range(1, 4), id="text"
        ),
        pytest.param(("joint_angle_#", "joint_speed_#", "joint_moment_#"), range(1, 4), id="other words"),
        pytest.param(("q#_rad", "q_dot#_rad_s", "tau#_nm"), range(1, 4), id="units behind"),
        pytest.param(("pos_rad_#", "vel_rad_s_#", "torque_nm_#"), range(1, 4), id="units within"),
        pytest.param(("position_joint#", "velocity_joint#", "torque_joint#"), range(1, 4), id="quantity first"),
        pytest.param(("q#", "joint_velocity[#]", "joint#/torque"), range(1, 4), id="mixed"),
    ],
)
def test_numbered_joints_are_found_in_order_whatever_their_base(patterns, of):
    names = numbered(*patterns, of=of)
    found = mapped(reversed(names))
    for quantity, pattern in zip(("q", "dq", "tau"), patterns, strict=True):
        assert read_as(found)[quantity] == [pattern.replace("#", str(joint)) for joint in of]
    assert len(found.joints) == len(of)
    assert [each.name for each in found.t] == ["t"]
    assert all(each.factor == 1.0 for row in found.quantities.values() for each in row)


@pytest.mark.parametrize(
    "pattern",
    ["{}/position", "{}.pos", "position_{}", "position[{}]", "/joint_states/{}/position", "observation.state.{}.pos"],
)
@pytest.mark.parametrize("joints", [("shoulder_pan", "elbow", "wrist"), ("panda_joint1", "panda_joint2")])
def test_named_joints_keep_their_names_and_the_order_of_the_file(pattern, joints):
    names = [pattern.format(each) for each in joints]
    tau = ["effort_" + each for each in reversed(joints)]
    found = mapped([*names, *tau, "timestamp"])
    assert found.joints == joints
    assert read_as(found) == {"q": names, "tau": tau[::-1]}


def test_joints_whose_names_differ_in_a_number_are_ordered_by_it():
    order = ("fr3_joint10", "fr3_joint2", "fr3_joint1")
    found = mapped([f"{joint}/{what}" for joint in order for what in ("position", "effort")])
    assert found.joints == order[::-1]
    assert any("in the order fr3_joint1, fr3_joint2, fr3_joint10" in note for note in found.notes)


def test_joints_in_the_order_of_the_alphabet_are_told():
    joints = ("elbow", "shoulder_lift", "shoulder_pan")
    found = mapped([f"{joint}/{what}" for joint in joints for what in ("position", "effort")])
    assert any("order of the alphabet" in note for note in found.notes)


RTDE = [
    "timestamp",
    *(
        f"{what}_{joint}"
        for what in ("target_q", "target_qd", "target_qdd", "target_moment", "actual_q", "actual_qd", "actual_current")
        for joint in range(6)
    ),
    *(f"actual_TCP_pose_{axis}" for axis in range(6)),
    *(f"{what}_{axis}" for what in ("elbow_position", "elbow_velocity") for axis in range(3)),
    *("actual_momentum", "actual_main_voltage", "actual_robot_current", "speed_scaling", "robot_mode"),
]


def test_a_universal_robot_writes_many_columns():
    found = mapped(RTDE, options(torque_constants=(0.1,) * 6))
    assert read_as(found) == {
        "q": [f"actual_q_{joint}" for joint in range(6)],
        "dq": [f"actual_qd_{joint}" for joint in range(6)],
        "tau": [f"actual_current_{joint}" for joint in range(6)],
    }
    assert (found.torque.effort, found.torque.convention) == ("current", "gravity_included")
    assert found.t[0].name == "timestamp"
    assert "speed_scaling" in found.unused
    assert any("target_q_{joint}" in note for note in found.notes)


def test_effort_chooses_among_several_torques():
    found = mapped(RTDE, options(effort="commanded"))
    assert read_as(found)["tau"] == [f"target_moment_{joint}" for joint in range(6)]
    assert found.torque.convention == "gravity_compensated"


def test_a_franka_state_holds_desired_and_external_values_too():
    blocks = (
        "q",
        "q_d",
        "dq",
        "dq_d",
        "ddq_d",
        "tau_J",
        "tau_J_d",
        "dtau_J",
        "tau_ext_hat_filtered",
        "theta",
        "dtheta",
    )
    names = [f"{each}[{joint}]" for each in blocks for joint in range(7)] + ["time"]
    wanted = {"q": "q", "dq": "dq", "tau": "tau_J"}
    expected = {key: [f"{each}[{joint}]" for joint in range(7)] for key, each in wanted.items()}
    assert read_as(mapped(names)) == expected


def test_one_joint_needs_no_number():
    found = mapped(["time", "position", "velocity", "effort"])
    assert found.joints == ("joint1",)
    assert read_as(found) == {"q": ["position"], "dq": ["velocity"], "tau": ["effort"]}


def test_documented_names_win_over_others():
    names = numbered("q#", "actual_q#", "tau#", "measured_tau#", "effort#")
    assert read_as(mapped(names)) == {"q": ["q1", "q2", "q3"], "tau": ["tau1", "tau2", "tau3"]}


def test_what_is_unclear_lists_the_candidates_and_the_option():
    names = numbered("left_q#", "right_q#", "left_tau#", "right_tau#")
    with pytest.raises(InvalidDataError) as caught:
        mapped(names)
    assert "left_q{joint}, right_q{joint}" in caught.value.message
    assert 'columns={"q": "left_q{joint}"}' in caught.value.message
    found = mapped(names, options(columns={"q": "right_q{joint}", "tau": "right_tau{joint}"}))
    assert read_as(found) == {
        "q": ["right_q1", "right_q2", "right_q3"],
        "tau": ["right_tau1", "right_tau2", "right_tau3"],
    }


def test_columns_may_be_named_one_by_one():
    names = ["zeit", "a", "b", "c", "d"]
    found = mapped(names, options(columns={"t": "zeit", "q": ("a", "b"), "tau": ("d", "c")}))
    assert read_as(found) == {"q": ["a", "b"], "tau": ["d", "c"]}
    assert (found.t[0].name, found.joints) == ("zeit", ("joint1", "joint2"))


def test_a_pattern_names_the_joints():
    names = ["t", "arm shoulder p", "arm elbow p", "arm elbow f", "arm shoulder f"]
    found = mapped(names, options(columns={"q": "arm {joint} p", "tau": "arm {joint} f"}))
    assert found.joints == ("shoulder", "elbow")
    assert read_as(found)["tau"] == ["arm shoulder f", "arm elbow f"]


@pytest.mark.parametrize(
    ("names", "said", "message"),
    [
        pytest.param(["t", "a", "b"], {}, "positions q1..qn", id="no positions"),
        pytest.param(numbered("q#"), {}, "column tau1 is missing", id="no torques"),
        pytest.param(
            ["t", "q1", "q2", "tau1"], {}, "column tau2 is missing, expected tau1..tau2", id="a torque missing"
        ),
        pytest.param(["q1", "q2", "dq1", "tau1", "tau2"], {}, "column dq2 is missing", id="a velocity missing"),
        pytest.param(["q2", "tau1", "tau2"], {}, "column q1 is missing", id="first missing"),
        pytest.param(["q0", "q2", "tau0", "tau1", "tau2"], {}, "column q1 is missing", id="from 0, one missing"),
        pytest.param(["q9999", "tau1"], {}, "column q1 is missing", id="huge number"),
        pytest.param(["q1", "dq1", "dq2", "tau1"], {}, "at most dq1, as there are q1..q1", id="too many"),
        pytest.param(["q1", "q1", "tau1"], {}, "column 2 is q1, expected every column once", id="doubled"),
        pytest.param(["q1", "tau1", "tau1"], {}, "column 3 is tau1, expected every column once", id="tau doubled"),
        pytest.param(["a/position", "b/position", "a/effort"], {}, "drop_joints=b", id="a named joint without torque"),
        pytest.param(["q1 [furlong]", "tau1"], {}, "unit of q1 [furlong] is furlong", id="unknown unit"),
        pytest.param(["q1", "tau1", "time", "timestamp"], {}, "time, timestamp", id="two times"),
        pytest.param(["q1", "tau1"], {"columns": {"q": "x{joint}"}}, "columns.q is x{joint}", id="pattern of nothing"),
        pytest.param(["q1", "tau1"], {"columns": {"q": ("x",)}}, "columns.q[0] is x", id="no such column"),
        pytest.param(["q1", "tau1"], {"columns": {"t": "x"}}, "columns.t is x", id="no such time"),
        pytest.param(["q1", "tau1"], {"columns": {"q": "q1", "tau": "q1"}}, "for several quantities", id="used twice"),
        pytest.param(
            ["q1", "tau1"],
            {"drop_joints": ("b",)},
            "drop_joints is b, expected joints of the file: joint1",
            id="no such joint",
        ),
        pytest.param(["q1", "tau1"], {"joint_names": ("a", "b")}, "2 names, expected 1 names", id="too many names"),
        pytest.param(numbered("q#", "tau#"), {"joint_names": ("a", "b", "a")}, "names that differ", id="equal names"),
        pytest.param(["q1", "tau1"], {"drop_joints": ("joint1",)}, "joints is 0, expected 1 to 32", id="all dropped"),
    ],
)
def test_what_cannot_be_read_is_refused_by_name(names, said, message):
    with pytest.raises(InvalidDataError) as caught:
        mapped(names, options(**said))
    assert message in caught.value.message


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"units": {"q": "furlong"}}, "units.q is furlong, expected rad, mrad, deg"),
        ({"units": {"speed": "rad"}}, "units.speed"),
        ({"columns": {"x": "q1"}}, "columns.x"),
        ({"columns": {"q": "{joint}{joint}"}}, "{joint} once"),
        ({"joints": ("joint1", "joint1")}, "every joint once"),
        ({"effort": "current", "torque_constants": (1.0,)}, "torque_constants is 1 values, expected 3"),
        ({"effort": "current", "torque_constants": (1.0, 0.0, 1.0)}, "none of them 0"),
    ],
)
def test_options_that_are_wrong_are_refused(said, message):
    with pytest.raises(InvalidRequestError) as caught:
        mapped(numbered("q#", "tau#"), options(**said))
    assert message in caught.value.message


def test_too_many_joints_are_refused():
    with pytest.raises(InvalidDataError, match="joints is 3, expected 1 to 2"):
        mapped(numbered("q#", "tau#"), most=2)


def test_joints_are_kept_in_the_order_asked_for():
    found = mapped(numbered("q#", "tau#"), options(joints=("joint3", "joint1")))
    assert found.joints == ("joint3", "joint1")
    assert read_as(found) == {"q": ["q3", "q1"], "tau": ["tau3", "tau1"]}
    assert list(found.dropped) == ["joint2"]


def test_a_joint_without_torque_may_be_left_out():
    found = mapped(["a/position", "b/position", "a/effort"], options(drop_joints=("b",)))
    assert (found.joints, found.dropped["b"].name) == (("a",), "b/position")


def test_names_are_given_by_the_file_or_by_the_upload():
    names = numbered("q#", "tau#")
    assert mapped(names, joint_names=("a", "b", "c")).joints == ("a", "b", "c")
    assert mapped(names, options(joint_names=("x", "y", "z")), joint_names=("a", "b", "c")).joints == ("x", "y", "z")
    dropped = options(joint_names=("x", "y"), drop_joints=("joint2",))
    assert mapped(names, dropped).joints == ("x", "y")


ARM = Arm(("base", "shoulder", "elbow"), "current", (1.0, 2.0, 3.0))


def test_a_robot_orders_its_joints_and_leaves_out_others():
    joints = ("elbow", "base", "gripper", "shoulder")
    names = [f"{joint}/{what}" for joint in joints for what in ("position", "effort")]
    found = mapped(names, robot=ARM)
    assert found.joints == ARM.joint_names
    assert list(found.dropped) == ["gripper"]
    assert [each.factor for each in found.quantities["tau"]] == [1.0, 2.0, 3.0]
    assert found.torque.effort == "current"
    assert any("gripper" in note for note in found.notes)


def test_a_robot_names_joints_that_only_have_numbers():
    found = mapped(numbered("q#", "tau#"), robot=ARM)
    assert found.joints == ARM.joint_names
    assert found.torque.effort == "measured"  # what is called a torque is no current


def test_a_joint_of_a_robot_may_be_left_out_with_its_constant():
    names = [f"{joint}/{what}" for joint in ARM.joint_names for what in ("position", "effort")]
    found = mapped(names, options(drop_joints=("shoulder",)), ARM)
    assert found.joints == ("base", "elbow")
    assert found.torque.constants == (1.0, 3.0)


def test_joints_that_are_not_the_robots_are_refused():
    names = [f"{joint}/{what}" for joint in ("a", "b", "c") for what in ("position", "effort")]
    with pytest.raises(InvalidDataError, match="those of arm, base, shoulder, elbow"):
        mapped(names, robot=ARM)
    assert mapped(names, options(joint_names=ARM.joint_names), ARM).joints == ARM.joint_names


def test_currents_without_constants_ask_for_them():
    with pytest.raises(InvalidDataError, match="torque_constants is missing, expected 3 numbers"):
        mapped(numbered("q#", "current_#"))


@pytest.mark.parametrize(
    ("said", "robot", "effort", "convention"),
    [
        ({}, None, "measured", "gravity_included"),
        ({"effort": "commanded"}, None, "commanded", "gravity_compensated"),
        ({"torque_convention": "gravity_compensated"}, None, "commanded", "gravity_compensated"),
        ({}, Arm(("joint1",), "commanded"), "commanded", "gravity_compensated"),
        ({"effort": "measured"}, Arm(("joint1",), "commanded"), "measured", "gravity_included"),
        ({"torque_convention": "gravity_included"}, Arm(("joint1",), "commanded"), "commanded", "gravity_included"),
        ({}, Arm(("joint1",), "unknown"), "measured", "gravity_included"),
        ({"units": {"tau": "A"}, "torque_constants": (2.0,)}, None, "current", "gravity_included"),
    ],
)
def test_effort_and_convention(said, robot, effort, convention):
    torque = mapped(["q1", "tau1"], options(**said), robot).torque
    assert (torque.effort, torque.convention) == (effort, convention)


def test_an_effort_that_its_unit_contradicts_is_refused():
    with pytest.raises(InvalidDataError, match="effort is measured, expected what effort"):
        mapped(["q1", "effort1 [A]"], options(effort="measured"))


@pytest.mark.parametrize(
    ("names", "best"),
    [
        (["timestamp", "t"], "t"),
        (["__time", "/joint_states/header/stamp"], "/joint_states/header/stamp"),
        (["%time", "field.header.stamp"], "field.header.stamp"),
        (["Time (s)"], "Time (s)"),
        (["t_ms"], "t_ms"),
        (["secs", "nsecs"], "secs"),
        (["header.stamp.sec", "header.stamp.nanosec"], "header.stamp.sec"),
    ],
)
def test_times_are_recognised(names, best):
    assert clocks(names)[0].name == best


@pytest.mark.parametrize("name", ["duration", "t_c", "temperature", "timeout_s", "status", "x" * 100_000, "(" * 50_000])
def test_other_names_are_no_times_and_no_joints(name):
    assert clocks([name]) == []
    assert sightings(name) == []


WORDS = ("q", "Pos", "velocity", "joint", "tau", "J", "d", "target", "actual", "deg", "rad", "s", "1", "07", "pan", "A")


@given(st.text(max_size=60) | st.lists(st.sampled_from([*WORDS, *"_/.[]() -"]), max_size=12).map("".join))
def test_any_name_can_be_looked_at(name):
    for sighting in sightings(name):
        assert sighting.quantity in QUANTITIES
        assert sighting.pattern.replace("{joint}", sighting.joint) == name
    clocks([name])


@given(st.permutations([*numbered("actual_q_#", "qd_#", "joint#/effort", "target_q_#"), "note", "x1", "x2"]))
def test_the_order_of_columns_does_not_matter(names):
    found = mapped(names)
    expected = {"q": "actual_q_#", "dq": "qd_#", "tau": "joint#/effort"}
    assert read_as(found) == {key: [p.replace("#", str(j)) for j in (1, 2, 3)] for key, p in expected.items()}
    assert all(names[each.index] == each.name for row in found.quantities.values() for each in row)
    assert set(found.unused) == {"note", "x1", "x2", *numbered("target_q_#")[1:]}


BASES = (
    numbered("q#", "tau#", "dq_#"),
    numbered("actual_q_#", "joint#/effort", "target_q_#", of=range(3)),
    numbered("a#/position", "a#/effort", "current[#]"),
    ["elbow.pos", "elbow.torque", "wrist.pos", "wrist.torque", "gripper.pos"],
)
MORE = (
    "t",
    "time",
    "episode",
    "gripper/position",
    "note",
    "q1 [deg]",
    "q1",
    "effort",
    "a1/position",
    "q²",
    "tau_²",
    "",
)


@st.composite
def almost_recordings(draw):
    """Columns of a recording, some of them gone, others added, in any order."""
    base = draw(st.sampled_from(BASES))
    gone = draw(st.sets(st.sampled_from(base), max_size=2))
    more = draw(st.lists(st.sampled_from(MORE), max_size=2))
    return draw(st.permutations([each for each in base if each not in gone] + more))


@given(
    almost_recordings(),
    st.dictionaries(
        st.sampled_from(["t", "episode", *QUANTITIES]),
        st.sampled_from(["{joint}", "q{joint}", "t", "a{joint}/position", "x"]) | st.just(("q1", "q2")),
        max_size=1,
    ),
    st.sampled_from([None, "measured", "commanded", "current"]),
    st.sampled_from([(), ("joint1",), ("a1",), ("gripper",)]),
    st.sampled_from([None, ("joint2", "joint1"), ("a2",)]),
    st.sampled_from([None, Arm(("joint1", "joint2")), Arm(("a1", "a2", "a3"), "current", (1.0, 2.0, 3.0))]),
)
def test_anything_is_mapped_or_refused(names, columns, effort, dropped, joints, robot):
    said = options(columns=columns, effort=effort, drop_joints=dropped, joints=joints, torque_constants=None)
    try:
        found = mapped(names, said, robot)
    except (InvalidDataError, InvalidRequestError):
        return
    sources = [each for row in found.quantities.values() for each in row]
    assert {"q", "tau"} <= found.quantities.keys()
    assert all(len(row) == len(found.joints) > 0 for row in found.quantities.values())
    assert len({each.index for each in sources}) == len(sources)
    assert all(names[each.index] == each.name for each in [*sources, *found.t])
    assert len(set(found.joints)) == len(found.joints)
