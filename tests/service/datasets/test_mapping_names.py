"""Columns are recognised by the names that robots, drivers and other programs use."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lipcore.profiles import profile
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


def test_desired_torque_alone_gives_a_warning():
    result = mapped(numbered("q#", "tau_des#"))
    (warned,) = [note for note in result.notes if note.startswith("warning: ")]
    assert "tau_des{joint} holds commanded torque, and no columns of measured torque were found" in warned
    assert result.torque.effort == "commanded"
    meant = mapped(numbered("q#", "tau_des#"), options(effort="commanded"))
    assert not any(note.startswith("warning: ") for note in meant.notes)


@pytest.mark.parametrize("pattern", ["{}/position", "position_{}", "position[{}]", "observation.state.{}.pos"])
@pytest.mark.parametrize("joints", [("shoulder_pan", "elbow", "wrist"), ("panda_joint1", "panda_joint2")])
def test_named_joints_keep_their_names_and_the_order_of_the_file(pattern, joints):
    names = [pattern.format(each) for each in joints]
    tau = ["effort_" + each for each in reversed(joints)]
    result = mapped([*names, *tau, "timestamp"])
    assert result.joints == joints
    assert read_as(result) == {"q": names, "tau": tau[::-1]}


UR_QUANTITIES = ("target_q", "target_qd", "target_qdd", "target_moment", "actual_q", "actual_qd", "actual_current")
RTDE = [
    *("timestamp", "actual_momentum", "actual_main_voltage", "actual_robot_current", "speed_scaling", "robot_mode"),
    *(f"{quantity}_{joint}" for quantity in UR_QUANTITIES for joint in range(6)),
    *(f"actual_TCP_pose_{axis}" for axis in range(6)),
    *(f"{quantity}_{axis}" for quantity in ("elbow_position", "elbow_velocity") for axis in range(3)),
]
LIBFRANKA = ("q", "q_d", "dq", "dq_d", "ddq_d", "tau_J", "tau_J_d", "dtau_J", "tau_ext_hat_filtered", "theta", "dtheta")
FRANKA = [f"{quantity}[{joint}]" for quantity in LIBFRANKA for joint in range(7)]
PLAIN = numbered("q#", "tau#")
TORQUES = numbered("q#", "i#", "tau_des#")
SIDES = numbered("left_q#", "right_q#", "left_tau#", "right_tau#")
WORDY_JOINTS = ("shoulder", "elbow")
WORDY = ["t", "arm shoulder p", "arm elbow p", "arm elbow f", "arm shoulder f"]
ARM = Arm(("base", "shoulder", "elbow"), "current", (1.0, 2.0, 3.0))
COMMANDED_ARM = Arm(("joint1",), "commanded")


def named(*joints):
    """Return names of positions and efforts."""
    return [f"{joint}/{what}" for joint in joints for what in ("position", "effort")]


def case(names, given=None, note="", robot=None, names_in_file=None, of=(1, 2, 3), columns=None, **expected):
    """Return a case of names: the patterns of the columns that are read, and other properties of the mapping."""
    if columns is not None:
        patterns = zip(("q", "tau", "dq"), columns, strict=False)
        expected["columns"] = {name: [pattern.replace("#", str(joint)) for joint in of] for name, pattern in patterns}
    return names, given or {}, note, robot, names_in_file, expected


CHOSEN_SIDE = {"columns": {"q": "right_q{joint}", "tau": "right_tau{joint}"}}
SPACED = {"columns": {"q": "arm {joint} p", "tau": "arm {joint} f"}}
ZEIT = ["zeit", "x1", "x2", "y2", "y1"]
LISTED = {"columns": {"t": "zeit", "q": ("x1", "x2"), "tau": ("y1", "y2")}}
RTDE_COLUMNS = ("actual_q_#", "actual_current_#", "actual_qd_#")
RTDE_UNUSED = tuple(each for each in RTDE if not each.startswith(("timestamp", "actual_q", "actual_current_")))
FER = named(*(f"fer_joint{joint}" for joint in (3, 1, 2, 4, 5, 6, 7)))
FER_COLUMNS = ("fer_joint#/position", "fer_joint#/effort")
PANDA = profile("panda")
ONE = ["q1", "tau1"]
MEASURED, CURRENT = ({"effort": effort, "convention": "gravity_included"} for effort in ("measured", "current"))
COMMANDED = {"effort": "commanded", "convention": "gravity_compensated"}
ORDERED = ("fr3_joint1", "fr3_joint2", "fr3_joint10")
OTHER_TORQUES = "tau could also be read from tau_des{joint}, i{joint}"
BESIDE_GRIPPER = named("elbow", "base", "gripper", "shoulder")


@pytest.mark.parametrize(
    ("names", "given", "note", "robot", "names_in_file", "expected"),
    [
        # measured torque first, unless options choose
        case(FRANKA, of=range(7), columns=("q[#]", "tau_J[#]", "dq[#]")),
        case(numbered("q#", "actual_q#", "tau#", "measured_tau#", "effort#"), columns=("q#", "tau#")),
        case(["time", "position", "velocity", "effort"], of="1", columns=("position", "effort", "velocity")),
        case(numbered("q#", "tau_des#", "tau_meas#", "i#"), note=OTHER_TORQUES, columns=("q#", "tau_meas#")),
        case(TORQUES, {"torque_constants": (0.1, 0.2, 0.3)}, columns=("q#", "i#")),
        case(TORQUES, {"columns": {"tau": "tau_des{joint}"}}, columns=("q#", "tau_des#")),
        case(RTDE, {"torque_constants": (0.1,) * 6}, "target_q_{joint}", of=range(6), columns=RTDE_COLUMNS, **CURRENT),
        case(RTDE, {"torque_constants": (0.1,) * 6}, t="timestamp", unused=RTDE_UNUSED),
        case(RTDE, {"effort": "commanded"}, of=range(6), columns=("actual_q_#", "target_moment_#", "actual_qd_#")),
        case(RTDE, {"effort": "commanded"}, convention="gravity_compensated"),
        # effort and convention
        case(ONE, **MEASURED),
        case(ONE, {"effort": "commanded"}, **COMMANDED),
        case(ONE, {"torque_convention": "gravity_compensated"}, **COMMANDED),
        case(ONE, robot=COMMANDED_ARM, **COMMANDED),
        case(ONE, {"effort": "measured"}, robot=COMMANDED_ARM, **MEASURED),
        case(
            ONE,
            {"torque_convention": "gravity_included"},
            robot=COMMANDED_ARM,
            effort="commanded",
            convention="gravity_included",
        ),
        case(ONE, {"units": {"tau": "A"}, "torque_constants": (2.0,)}, **CURRENT),
        # columns by option
        case(SIDES, CHOSEN_SIDE, columns=("right_q#", "right_tau#")),
        case(ZEIT, LISTED, of=(1, 2), columns=("x#", "y#"), t="zeit", joints=("joint1", "joint2")),
        case(WORDY, SPACED, of=WORDY_JOINTS, columns=("arm # p", "arm # f"), joints=WORDY_JOINTS),
        # joints
        case(named(*ORDERED[::-1]), note="in the order fr3_joint1, fr3_joint2, fr3_joint10", joints=ORDERED),
        case(named("elbow", "shoulder_lift", "shoulder_pan"), note="alphabetical order"),
        case(PLAIN, {"joints": ("joint3", "joint1")}, of=(3, 1), columns=("q#", "tau#"), dropped=["joint2"]),
        case(PLAIN, {"joints": ("joint3", "joint1")}, joints=("joint3", "joint1")),
        case(PLAIN, names_in_file=("a", "b", "c"), joints=("a", "b", "c")),
        case(PLAIN, {"joint_names": ("x", "y", "z")}, names_in_file=("a", "b", "c"), joints=("x", "y", "z")),
        case(PLAIN, {"joint_names": ("x", "y"), "drop_joints": ("joint2",)}, joints=("x", "y")),
        # a robot orders its joints, excludes others, and knows the effort; a column named torque is not a current
        case(BESIDE_GRIPPER, note="gripper", robot=ARM, joints=ARM.joint_names, dropped=["gripper"], effort="current"),
        case(BESIDE_GRIPPER, robot=ARM, scales=[1.0, 2.0, 3.0]),
        case(FER, robot=PANDA, of=range(1, 8), columns=FER_COLUMNS, joints=PANDA.joint_names),
        case(PLAIN, robot=ARM, joints=ARM.joint_names, effort="measured"),
        case(named(*ARM.joint_names), {"drop_joints": ("shoulder",)}, robot=ARM, joints=("base", "elbow")),
        case(named(*ARM.joint_names), {"drop_joints": ("shoulder",)}, robot=ARM, constants=(1.0, 3.0)),
        case(named("a", "b", "c"), {"joint_names": ARM.joint_names}, robot=ARM, joints=ARM.joint_names),
    ],
)
def test_columns_are_mapped(names, given, note, robot, names_in_file, expected):
    result = mapped(names, options(**given), robot, joint_names=names_in_file)
    found = {
        "columns": read_as(result),
        "joints": result.joints,
        "dropped": list(result.dropped),
        "scales": [each.factor for each in result.quantities["tau"]],
        "t": result.t[0].name if result.t else None,
        "unused": result.unused,
        **vars(result.torque),
    }
    assert {name: found[name] for name in expected} == expected
    assert any(note in each for each in ["", *result.notes])


UNUSABLE = [
    (["t", "a", "b"], {}, "positions q1..qn"),
    (numbered("q#"), {}, "column tau1 is missing"),
    (["t", "q1", "q2", "tau1"], {}, "column tau2 is missing, expected tau1..tau2 because"),
    (["q1", "q2", "dq1", "tau1", "tau2"], {}, "column dq2 is missing"),
    (["q2", "tau1", "tau2"], {}, "column q1 is missing"),
    (["q0", "q2", "tau0", "tau1", "tau2"], {}, "column q1 is missing"),
    (["q9999", "tau1"], {}, "column tau9999 is missing, expected the torque of q9999"),
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
    (PLAIN, {"joint_names": ("a", "b", "a")}, "expected a different name for each joint"),
    (["q1", "tau1"], {"drop_joints": ("joint1",)}, "joints is 0, expected 1 to 32"),
    (numbered("q#", "tau#", of=range(1, 34)), {}, "joints is 33, expected 1 to 32"),
    (numbered("q#", "current_#"), {}, "torque_constants is missing, expected 3 numbers"),
    (["q1", "effort1 [A]"], {"effort": "measured"}, "expected the effort that the name or unit of effort"),
    # neither currents nor desired torque are measured torque, so neither may be used without an option
    (TORQUES, {}, "torque_constants is missing, expected 3 numbers in N·m/A"),
    (TORQUES, {}, 'or columns={"tau": "tau_des{joint}"} to learn commanded torque'),
    (SIDES, {}, "left_q{joint}, right_q{joint}"),
    (SIDES, {}, 'columns={"q": "left_q{joint}"}'),
]
WRONG_OPTIONS = [
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
]


@pytest.mark.parametrize(
    ("names", "given", "message", "error"),
    [
        *((*each, InvalidDataError) for each in UNUSABLE),
        *((PLAIN, *each, InvalidRequestError) for each in WRONG_OPTIONS),
    ],
)
def test_unusable_columns_and_wrong_options_are_rejected_by_name(names, given, message, error):
    with pytest.raises(error) as caught:
        mapped(names, options(**given))
    assert message in caught.value.message


def test_joints_of_another_robot_are_rejected():
    with pytest.raises(InvalidDataError, match="the joints of arm: base, shoulder, elbow"):
        mapped(named("a", "b", "c"), robot=ARM)


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


ARMS = {"left_#": "right_#", "#_left": "#_right", "bi_left_#": "bi_right_#"}


@pytest.mark.parametrize(("left", "right"), ARMS.items())
def test_two_arms_are_told_apart_and_learnt_alone(left, right):
    joints = profile("ur5e").joint_names
    first, second = ([pattern.replace("#", joint) for joint in joints] for pattern in (left, right))
    names = [f"{joint}/{kind}" for joint in (*first, *second) for kind in ("position", "velocity", "effort")]
    warned = [note for note in mapped(["t", *names]).notes if "2 arms" in note]
    assert warned[0].endswith(f"joints={','.join(first)}.")
    if left.endswith("#"):
        with pytest.raises(InvalidDataError, match="several arms") as caught:
            mapped(["t", *names], options(effort="measured"), profile("ur5e"))
        chosen = caught.value.detail[0].expected.partition("joints=")[2].split(",")
        assert mapped(["t", *names], options(joints=chosen, effort="measured"), profile("ur5e")).joints == joints


@pytest.mark.parametrize("names", [("a", "b", "c"), ("joint1", "joint2", "joint3"), ("left_a", "right_b", "left_c")])
def test_one_arm_is_no_two(names):
    columns = [f"{joint}/{kind}" for joint in names for kind in ("position", "effort")]
    assert not any("arms" in note for note in mapped(["t", *columns]).notes)
