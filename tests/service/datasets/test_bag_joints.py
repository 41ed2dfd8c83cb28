"""Joints are matched by name in every message, in any order and with any other joints."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.datasets.formats.bags.joints import MessageKind, choose_joints, has_joints
from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError
from service.foundation.settings import Settings
from tests.service.datasets import bag_writers as bags
from tests.service.datasets.bag_writers import QUANTITIES, State, altered, read, states, table_of, write_mcap


def shuffled(state: State, order: list[int]) -> State:
    """Return the same state in another order of joints."""
    parts = {key: [getattr(state, key)[k] for k in order] for key in QUANTITIES}
    return State(state.stamp, [state.names[k] for k in order], **parts)


@pytest.mark.parametrize("write", [write_mcap, bags.write_rosbag1])
def test_joint_order_may_change_between_messages(tmp_path, write):
    recorded = states(200, ("a", "b", "c", "d"))
    generator = np.random.default_rng(1)
    mixed = [recorded[0], *(shuffled(each, generator.permutation(4).tolist()) for each in recorded[1:])]
    result = read(write(tmp_path / "bag", mixed))
    assert sorted(result.joint_names) == ["a", "b", "c", "d"]
    ordered = [shuffled(each, ["abcd".index(name) for name in result.joint_names]) for each in recorded]
    np.testing.assert_array_equal(result.rows, table_of(ordered))
    assert any("matched by name in every message" in fact for fact in result.facts)


def test_arm_is_read_beside_a_gripper_on_the_same_topic(tmp_path):
    arm = states(100)
    gripper = [State(each.stamp + k * 1000 + 1, ("finger",), [1.0], [0.0]) for each in arm for k in range(3)]
    path = write_mcap(tmp_path / "a.mcap", sorted(arm + gripper, key=lambda each: each.stamp))
    result = read(path)
    np.testing.assert_array_equal(result.rows, table_of(arm))
    others = "300 of 400 messages do not have all joints and were not read; other joints of the topic: finger"
    assert others in result.facts
    with pytest.raises(InvalidDataError, match="no effort: it is empty in all messages"):
        read(path, ReadOptions(joint_names=("finger",)))


def test_joint_names_choose_joints_and_their_order(tmp_path):
    recorded = states(50)
    result = read(write_mcap(tmp_path / "a.mcap", recorded), ReadOptions(joint_names=("c", "a")))
    assert result.joint_names == ("c", "a")
    np.testing.assert_array_equal(result["c/effort"], [each.effort[2] for each in recorded])
    assert "joints not read: b" in result.facts


def test_joints_without_names_are_numbered_or_given_names(tmp_path):
    recorded = altered(states(50), names=())
    path = write_mcap(tmp_path / "a.mcap", recorded)
    assert read(path).joint_names == ("joint1", "joint2", "joint3")
    result = read(path, ReadOptions(joint_names=("x", "y", "z")))
    assert result.names[1:4] == ("x/position", "y/position", "z/position")
    np.testing.assert_array_equal(result.rows, table_of(recorded))


ALL, SIXTH = slice(None), slice(5, 6)
OUT_OF = "joint_names is a, x, expected joints out of a, b, c that are in the same message"


@pytest.mark.parametrize(
    ("rows", "values", "names", "limits", "message"),
    [
        (
            SIXTH,
            {"names": ("a", "b", "b")},
            None,
            {},
            "message 6 is a state of joints a, b, b, expected each joint only",
        ),
        (SIXTH, {"names": ("a", "b")}, None, {}, "message 6 is a state with 3 values of position, expected 2, one per"),
        (SIXTH, {"velocity": [1.0]}, None, {}, "message 6 is a state with 1 values of velocity, expected 3, one per"),
        (ALL, {"position": (), "velocity": ()}, None, {}, "no positions"),
        (ALL, {"names": ()}, ("x", "y"), {}, "joint_names is x, y, expected 3 names"),
        (ALL, {}, ("a", "x"), {}, OUT_OF),
        (ALL, {}, None, {"max_joints": 2}, "3 joints, expected at most 2"),
        (ALL, {}, None, {"max_samples": 49}, "more than 49 messages"),
    ],
)
def test_unusable_messages_and_names_are_rejected(tmp_path, rows, values, names, limits, message):
    path = write_mcap(tmp_path / "a.mcap", altered(states(50), rows, **values))
    with pytest.raises(InvalidDataError, match=message):
        read(path, ReadOptions(joint_names=names), Settings(**limits))


kinds = st.builds(
    MessageKind,
    st.sets(st.sampled_from("abcdef")).map(lambda joints: tuple(sorted(joints))),
    st.sampled_from([QUANTITIES, ()]),
)


@given(st.lists(st.tuples(kinds, st.integers(1, 100)), min_size=1, max_size=6), st.randoms())
def test_joint_choice_does_not_depend_on_message_order(record, random):
    merged: dict[MessageKind, int] = {}
    for kind, count in record:
        merged[kind] = merged.get(kind, 0) + count
    if not any(kind.quantities for kind in merged):
        return
    chosen = choose_joints(list(merged), list(merged.values()), None, "/t")
    assert any(has_joints(kind, chosen) for kind in merged)
    items = list(merged.items())
    random.shuffle(items)
    again = choose_joints([kind for kind, _ in items], [count for _, count in items], None, "/t")

    def weight(joints: tuple[str, ...]) -> int:
        return len(joints) ** 2 * sum(count for kind, count in items if has_joints(kind, joints))

    assert weight(again) == weight(chosen) == max(weight(kind.joints) for kind, _ in items if kind.quantities)
