"""Columns are recognised by the names that robots, drivers and other programs use."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.datasets.mapping.mapping import map_columns
from service.datasets.mapping.recognition import find_times, interpret_name
from service.foundation.errors import InvalidDataError, InvalidRequestError
from tests.service.datasets.mapping_tables import Arm, options

QUANTITIES = ("q", "dq", "ddq", "tau")


def mapped(names, given=None, robot=None, units=None, joint_names=None, most=32):
    return map_columns(tuple(names), units or {}, joint_names, given or options(), robot, most)


def read_as(result):
    """Return the names of the columns by quantity."""
    return {quantity: [each.name for each in row] for quantity, row in result.quantities.items()}


def numbered(*patterns, of=range(1, 4)):
    """Return the names t and each pattern for each joint."""
    return ["t", *(pattern.replace("#", str(joint)) for pattern in patterns for joint in of)]


@pytest.mark.parametrize(
    ("patterns", "of"),
    [
        pytest.param(("q#", "dq#", "tau#"), range(1, 8), id="documented"),
        pytest.param(("q[#]", "dq[#]", "tau_J[#]"), range(7), id="libfranka"),
        pytest.param(("field.position#", "field.velocity#", "field.effort#"), range(7), id="rostopic"),
        pytest.param(("jointPosition#", "jointVelocity#", "jointTorque#"), range(1, 4), id="camel case"),
        pytest.param(("Joint # Position (rad)", "Joint # Velocity (rad/s)", "Joint # Torque (Nm)"), (1, 2), id="text"),
        pytest.param(("Q0#", "q_dot0#_rad_s", "TAU0#"), (1, 2), id="capitals, zeros, units behind"),
        pytest.param(("joint#.pos", "velocity_joint#", "torque_nm_#"), (0, 1), id="joint first, last, units within"),
        pytest.param(("joint_angle_#", "joint_speed_#", "joint_moment_#"), range(1, 4), id="other words"),
        pytest.param(("q#", "joint_velocity[#]", "joint#/torque"), range(1, 4), id="mixed"),
    ],
)
def test_numbered_joints_are_found_in_order(patterns, of):
    names = numbered(*patterns, of=of)
    result = mapped(reversed(names))
    for quantity, pattern in zip(("q", "dq", "tau"), patterns, strict=True):
        assert read_as(result)[quantity] == [pattern.replace("#", str(joint)) for joint in of]
    assert len(result.joints) == len(of)
    assert [each.name for each in result.t] == ["t"]
    assert all(each.factor == 1.0 for row in result.quantities.values() for each in row)


def test_currents_beside_desired_torque_need_a_choice():
    """Neither is measured torque, so neither may be used without an option."""
    names = numbered("q#", "i#", "tau_des#")
    with pytest.raises(InvalidDataError) as caught:
        mapped(names)
    assert "torque_constants is missing, expected 3 numbers in N·m/A" in str(caught.value)
    assert 'or columns={"tau": "tau_des{joint}"} to learn commanded torque' in str(caught.value)
    result = mapped(names, options(torque_constants=(0.1, 0.2, 0.3)))
    assert read_as(result)["tau"] == ["i1", "i2", "i3"]
    chosen = mapped(names, options(columns={"tau": "tau_des{joint}"}))
    assert read_as(chosen)["tau"] == ["tau_des1", "tau_des2", "tau_des3"]


def test_desired_torque_alone_gives_a_warning():
    result = mapped(numbered("q#", "tau_des#"))
    (warned,) = [note for note in result.notes if note.startswith("warning: ")]
    assert "tau_des{joint} holds commanded torque, and no columns of measured torque were found" in warned
    assert result.torque.effort == "commanded"
    meant = mapped(numbered("q#", "tau_des#"), options(effort="commanded"))
    assert not any(note.startswith("warning: ") for note in meant.notes)


def test_measured_torque_is_preferred_and_others_are_reported():
    result = mapped(numbered("q#", "tau_des#", "tau_meas#", "i#"))
    assert read_as(result)["tau"] == ["tau_meas1", "tau_meas2", "tau_meas3"]
    assert any("tau could also be read from tau_des{joint}, i{joint}" in note for note in result.notes)


@pytest.mark.parametrize(
    "pattern",
    ["{}/position", "position_{}", "position[{}]", "observation.state.{}.pos"],
)
@pytest.mark.parametrize("joints", [("shoulder_pan", "elbow", "wrist"), ("panda_joint1", "panda_joint2")])
def test_named_joints_keep_their_names_and_the_order_of_the_file(pattern, joints):
    names = [pattern.format(each) for each in joints]
    tau = ["effort_" + each for each in reversed(joints)]
    result = mapped([*names, *tau, "timestamp"])
    assert result.joints == joints
    assert read_as(result) == {"q": names, "tau": tau[::-1]}


def test_joints_are_ordered_by_the_number_in_their_names():
    order = ("fr3_joint10", "fr3_joint2", "fr3_joint1")
    result = mapped([f"{joint}/{what}" for joint in order for what in ("position", "effort")])
    assert result.joints == order[::-1]
    joints = ("elbow", "shoulder_lift", "shoulder_pan")
    alphabet = mapped([f"{joint}/{what}" for joint in joints for what in ("position", "effort")])
    assert any("alphabetical order" in note for note in alphabet.notes)
    assert any("in the order fr3_joint1, fr3_joint2, fr3_joint10" in note for note in result.notes)


UR_QUANTITIES = ("target_q", "target_qd", "target_qdd", "target_moment", "actual_q", "actual_qd", "actual_current")
RTDE = [
    *("timestamp", "actual_momentum", "actual_main_voltage", "actual_robot_current", "speed_scaling", "robot_mode"),
    *(f"{quantity}_{joint}" for quantity in UR_QUANTITIES for joint in range(6)),
    *(f"actual_TCP_pose_{axis}" for axis in range(6)),
    *(f"{quantity}_{axis}" for quantity in ("elbow_position", "elbow_velocity") for axis in range(3)),
]
FRANKA = ("q", "q_d", "dq", "dq_d", "ddq_d", "tau_J", "tau_J_d", "dtau_J", "tau_ext_hat_filtered", "theta", "dtheta")


@pytest.mark.parametrize(
    ("names", "firsts"),
    [
        ([f"{each}[{j}]" for each in FRANKA for j in range(7)], {"q": "q[0]", "dq": "dq[0]", "tau": "tau_J[0]"}),
        (numbered("q#", "actual_q#", "tau#", "measured_tau#", "effort#"), {"q": "q1", "tau": "tau1"}),
        (["time", "position", "velocity", "effort"], {"q": "position", "dq": "velocity", "tau": "effort"}),
    ],
    ids=["libfranka", "documented names win", "one joint"],
)
def test_measured_columns_are_preferred(names, firsts):
    assert {quantity: row[0] for quantity, row in read_as(mapped(names)).items()} == firsts


def test_columns_of_a_universal_robot_are_mapped():
    result = mapped(RTDE, options(torque_constants=(0.1,) * 6))
    assert read_as(result) == {
        "q": [f"actual_q_{joint}" for joint in range(6)],
        "dq": [f"actual_qd_{joint}" for joint in range(6)],
        "tau": [f"actual_current_{joint}" for joint in range(6)],
    }
    assert (result.torque.effort, result.torque.convention) == ("current", "gravity_included")
    assert result.t[0].name == "timestamp"
    assert "speed_scaling" in result.unused
    assert any("target_q_{joint}" in note for note in result.notes)


def test_effort_chooses_among_several_torques():
    result = mapped(RTDE, options(effort="commanded"))
    assert read_as(result)["tau"] == [f"target_moment_{joint}" for joint in range(6)]
    assert result.torque.convention == "gravity_compensated"


def test_ambiguous_columns_are_listed_with_the_option():
    names = numbered("left_q#", "right_q#", "left_tau#", "right_tau#")
    with pytest.raises(InvalidDataError) as caught:
        mapped(names)
    assert "left_q{joint}, right_q{joint}" in caught.value.message
    assert 'columns={"q": "left_q{joint}"}' in caught.value.message
    result = mapped(names, options(columns={"q": "right_q{joint}", "tau": "right_tau{joint}"}))
    assert read_as(result) == {
        "q": ["right_q1", "right_q2", "right_q3"],
        "tau": ["right_tau1", "right_tau2", "right_tau3"],
    }


def test_columns_can_be_given_by_list_or_pattern():
    result = mapped(["zeit", "a", "b", "c", "d"], options(columns={"t": "zeit", "q": ("a", "b"), "tau": ("d", "c")}))
    assert read_as(result) == {"q": ["a", "b"], "tau": ["d", "c"]}
    assert (result.t[0].name, result.joints) == ("zeit", ("joint1", "joint2"))
    names = ["t", "arm shoulder p", "arm elbow p", "arm elbow f", "arm shoulder f"]
    result = mapped(names, options(columns={"q": "arm {joint} p", "tau": "arm {joint} f"}))
    assert result.joints == ("shoulder", "elbow")
    assert read_as(result)["tau"] == ["arm shoulder f", "arm elbow f"]


NAMED = [f"{joint}/{quantity}" for joint in ("a", "b", "c") for quantity in ("position", "effort")]
REFUSED = [
    (["t", "a", "b"], {}, "positions q1..qn"),
    (numbered("q#"), {}, "column tau1 is missing"),
    (["t", "q1", "q2", "tau1"], {}, "column tau2 is missing, expected tau1..tau2 because"),
    (["q1", "q2", "dq1", "tau1", "tau2"], {}, "column dq2 is missing"),
    (["q2", "tau1", "tau2"], {}, "column q1 is missing"),
    (["q0", "q2", "tau0", "tau1", "tau2"], {}, "column q1 is missing"),
    (["q9999", "tau1"], {}, "column q1 is missing"),
    (["q1", "dq1", "dq2", "tau1"], {}, "at most dq1 because there are q1..q1"),
    (["q1", "tau1", "tau1"], {}, "column 3 is tau1, expected each column only once"),
    (["a/position", "b/position", "a/effort"], {}, "drop_joints=b"),
    (["q1 [furlong]", "tau1"], {}, "unit of q1 [furlong] is furlong"),
    (["q1", "tau1", "time", "timestamp"], {}, "time, timestamp"),
    (["q1", "tau1"], {"columns": {"q": "x{joint}"}}, "columns.q is x{joint}"),
    (["q1", "tau1"], {"columns": {"q": ("x",)}}, "columns.q[0] is x"),
    (["q1", "tau1"], {"columns": {"t": "x"}}, "columns.t is x"),
    (["q1", "tau1"], {"columns": {"q": "q1", "tau": "q1"}}, "for several quantities"),
    (["q1", "tau1"], {"drop_joints": ("b",)}, "drop_joints is b, expected one of the joints of the file: joint1"),
    (["q1", "tau1"], {"joint_names": ("a", "b")}, "2 names, expected 1 names, one per joint"),
    (numbered("q#", "tau#"), {"joint_names": ("a", "b", "a")}, "expected a different name for each joint"),
    (["q1", "tau1"], {"drop_joints": ("joint1",)}, "joints is 0, expected 1 to 32"),
    (numbered("q#", "tau#", of=range(1, 34)), {}, "joints is 33, expected 1 to 32"),
    (numbered("q#", "current_#"), {}, "torque_constants is missing, expected 3 numbers"),
    (["q1", "effort1 [A]"], {"effort": "measured"}, "expected the effort that the name or unit of effort"),
]


@pytest.mark.parametrize(("names", "given", "message"), REFUSED)
def test_unusable_columns_are_rejected_by_name(names, given, message):
    with pytest.raises(InvalidDataError) as caught:
        mapped(names, options(**given))
    assert message in caught.value.message


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"units": {"q": "furlong"}}, "units.q is furlong, expected rad, mrad, deg"),
        ({"units": {"speed": "rad"}}, "units.speed is not one of t, q"),
        ({"columns": {"x": "q1"}}, "columns.x is not a quantity"),
        ({"columns": {"q": "{joint}{joint}"}}, "{joint} only once"),
        ({"joints": ("joint1", "joint1")}, "each joint only once"),
        ({"effort": "current", "torque_constants": (1.0,)}, "Expected 3 torque constants, one per kept joint, got 1."),
        ({"effort": "current", "torque_constants": (1.0, 0.0, 1.0)}, "none of them 0"),
        (
            {"torque_constants": (1.0, 2.5, 3.0)},
            "expected no `torque_constants` because tau{joint} is assumed to be measured torque, gravity included",
        ),
        ({"effort": "commanded", "torque_constants": (1.0,) * 3}, "Set effort=current if it is motor current"),
        ({"torque_factors": (1.0,)}, "Expected 3 torque factors, one per kept joint, got 1."),
    ],
)
def test_wrong_options_are_rejected(given, message):
    with pytest.raises(InvalidRequestError) as caught:
        mapped(numbered("q#", "tau#"), options(**given))
    assert message in caught.value.message


def test_joints_are_kept_in_the_given_order():
    result = mapped(numbered("q#", "tau#"), options(joints=("joint3", "joint1")))
    assert result.joints == ("joint3", "joint1")
    assert read_as(result) == {"q": ["q3", "q1"], "tau": ["tau3", "tau1"]}
    assert list(result.dropped) == ["joint2"]


def test_joint_names_come_from_the_file_or_the_upload():
    names = numbered("q#", "tau#")
    assert mapped(names, joint_names=("a", "b", "c")).joints == ("a", "b", "c")
    assert mapped(names, options(joint_names=("x", "y", "z")), joint_names=("a", "b", "c")).joints == ("x", "y", "z")
    dropped = options(joint_names=("x", "y"), drop_joints=("joint2",))
    assert mapped(names, dropped).joints == ("x", "y")


ARM = Arm(("base", "shoulder", "elbow"), "current", (1.0, 2.0, 3.0))


def test_robot_orders_its_joints_and_excludes_others():
    joints = ("elbow", "base", "gripper", "shoulder")
    names = [f"{joint}/{what}" for joint in joints for what in ("position", "effort")]
    result = mapped(names, robot=ARM)
    assert result.joints == ARM.joint_names
    assert list(result.dropped) == ["gripper"]
    assert [each.factor for each in result.quantities["tau"]] == [1.0, 2.0, 3.0]
    assert result.torque.effort == "current"
    assert any("gripper" in note for note in result.notes)


def test_robot_names_numbered_joints():
    result = mapped(numbered("q#", "tau#"), robot=ARM)
    assert result.joints == ARM.joint_names
    assert result.torque.effort == "measured"  # a column named torque is not a current


def test_joint_of_a_robot_can_be_excluded_with_its_constant():
    names = [f"{joint}/{what}" for joint in ARM.joint_names for what in ("position", "effort")]
    result = mapped(names, options(drop_joints=("shoulder",)), ARM)
    assert result.joints == ("base", "elbow")
    assert result.torque.constants == (1.0, 3.0)


def test_joints_of_another_robot_are_rejected():
    with pytest.raises(InvalidDataError, match="the joints of arm: base, shoulder, elbow"):
        mapped(NAMED, robot=ARM)
    assert mapped(NAMED, options(joint_names=ARM.joint_names), ARM).joints == ARM.joint_names


@pytest.mark.parametrize(
    ("given", "robot", "effort", "convention"),
    [
        ({}, None, "measured", "gravity_included"),
        ({"effort": "commanded"}, None, "commanded", "gravity_compensated"),
        ({"torque_convention": "gravity_compensated"}, None, "commanded", "gravity_compensated"),
        ({}, Arm(("joint1",), "commanded"), "commanded", "gravity_compensated"),
        ({"effort": "measured"}, Arm(("joint1",), "commanded"), "measured", "gravity_included"),
        ({"torque_convention": "gravity_included"}, Arm(("joint1",), "commanded"), "commanded", "gravity_included"),
        ({"units": {"tau": "A"}, "torque_constants": (2.0,)}, None, "current", "gravity_included"),
    ],
)
def test_effort_and_convention(given, robot, effort, convention):
    torque = mapped(["q1", "tau1"], options(**given), robot).torque
    assert (torque.effort, torque.convention) == (effort, convention)


@pytest.mark.parametrize(
    ("names", "best"),
    [
        (["timestamp", "t"], "t"),
        (["__time", "/joint_states/header/stamp"], "/joint_states/header/stamp"),
        (["%time", "field.header.stamp"], "field.header.stamp"),
        (["secs", "nsecs"], "secs"),
        (["header.stamp.sec", "header.stamp.nanosec"], "header.stamp.sec"),
    ],
)
def test_times_are_recognised(names, best):
    assert find_times(names)[0].name == best


@pytest.mark.parametrize("name", ["duration", "t_c", "temperature", "timeout_s", "status", "x" * 100_000, "(" * 50_000])
def test_other_names_are_neither_times_nor_joints(name):
    assert find_times([name]) == []
    assert interpret_name(name) == []


WORDS = ("q", "Pos", "velocity", "joint", "tau", "J", "d", "target", "actual", "deg", "rad", "s", "1", "07", "pan", "A")


@given(st.text(max_size=60) | st.lists(st.sampled_from([*WORDS, *"_/.[]() -"]), max_size=12).map("".join))
def test_any_name_can_be_interpreted(name):
    for sighting in interpret_name(name):
        assert sighting.quantity in QUANTITIES
        assert sighting.pattern.replace("{joint}", sighting.joint) == name
    find_times([name])


BASES = (
    numbered("q#", "tau#", "dq_#"),
    numbered("actual_q_#", "joint#/effort", "target_q_#", of=range(3)),
    numbered("a#/position", "a#/effort", "current[#]"),
    ["elbow.pos", "elbow.torque", "wrist.pos", "wrist.torque", "gripper.pos"],
)
MORE = ("t", "time", "episode", "gripper/position", "note", "q1 [deg]", "q1", "effort", "a1/position", "tau_²", "")


@st.composite
def almost_recordings(draw):
    """Draw the columns of a recording, with some removed, others added, in any order."""
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
def test_any_columns_are_mapped_or_rejected(names, columns, effort, dropped, joints, robot):
    reply = options(columns=columns, effort=effort, drop_joints=dropped, joints=joints, torque_constants=None)
    try:
        result = mapped(names, reply, robot)
    except (InvalidDataError, InvalidRequestError):
        return
    sources = [each for row in result.quantities.values() for each in row]
    assert {"q", "tau"} <= result.quantities.keys()
    assert all(len(row) == len(result.joints) > 0 for row in result.quantities.values())
    assert len({each.index for each in sources}) == len(sources)
    assert all(names[each.index] == each.name for each in [*sources, *result.t])
    assert len(set(result.joints)) == len(result.joints)
