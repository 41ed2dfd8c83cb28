"""Joints are matched by name in every message, whatever order and company they come in."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.datasets.formats.bags.states import Kind, choose, holds
from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError
from service.foundation.settings import Settings
from tests.service.recordings.bag_writers import START, State, read, states, table_of, write_mcap, write_rosbag1

EVERY = ("position", "velocity", "effort")


def shuffled(state: State, order: list[int]) -> State:
    """The same state told in another order."""
    parts = {key: [getattr(state, key)[k] for k in order] for key in EVERY}
    return State(state.stamp, [state.names[k] for k in order], **parts)


@pytest.mark.parametrize("write", [write_mcap, write_rosbag1])
def test_orders_that_change_from_message_to_message(tmp_path, write):
    recorded = states(200, ("a", "b", "c", "d"))
    generator = np.random.default_rng(1)
    mixed = [recorded[0], *(shuffled(each, generator.permutation(4).tolist()) for each in recorded[1:])]
    result = read(write(tmp_path / "bag", mixed), "mcap" if write is write_mcap else "rosbag1")
    assert sorted(result.joint_names) == ["a", "b", "c", "d"]
    ordered = [shuffled(each, ["abcd".index(name) for name in result.joint_names]) for each in recorded]
    np.testing.assert_array_equal(result.rows, table_of(ordered))
    assert any("matched by name in every message" in fact for fact in result.facts)


def test_a_gripper_on_the_same_topic(tmp_path):
    arm = states(100)
    gripper = [State(each.stamp + k * 1000 + 1, ("finger",), [1.0], [0.0]) for each in arm for k in range(3)]
    recorded = sorted(arm + gripper, key=lambda each: each.stamp)
    path = write_mcap(tmp_path / "a.mcap", recorded)
    result = read(path, "mcap")
    np.testing.assert_array_equal(result.rows, table_of(arm))
    assert "300 of 400 messages do not tell of all joints and were left out (others tell of finger)" in result.facts
    fingers = read(path, "mcap", ReadOptions(joint_names=("finger",)))
    assert fingers.names == ("t", "finger/position", "finger/velocity")
    assert len(fingers.rows) == 300


def test_joints_that_are_asked_for_come_in_that_order(tmp_path):
    recorded = states(50)
    result = read(write_mcap(tmp_path / "a.mcap", recorded), "mcap", ReadOptions(joint_names=("c", "a")))
    assert result.joint_names == ("c", "a")
    np.testing.assert_array_equal(result["c/effort"], [each.effort[2] for each in recorded])
    assert "joints b were left out" in result.facts
    with pytest.raises(InvalidDataError, match=r"joint_names is a, x, expected joints out of a, b, c"):
        read(tmp_path / "a.mcap", "mcap", ReadOptions(joint_names=("a", "x")))


def test_joints_without_names_are_numbered_or_given_names(tmp_path):
    recorded = states(50)
    for each in recorded:
        each.names = ()
    path = write_mcap(tmp_path / "a.mcap", recorded)
    assert read(path, "mcap").joint_names == ("joint1", "joint2", "joint3")
    result = read(path, "mcap", ReadOptions(joint_names=("x", "y", "z")))
    assert result.names[1:4] == ("x/position", "y/position", "z/position")
    np.testing.assert_array_equal(result.rows, table_of(recorded))
    with pytest.raises(InvalidDataError, match="joint_names is x, y, expected 3 names"):
        read(path, "mcap", ReadOptions(joint_names=("x", "y")))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"names": ("a", "b", "b")}, r"message 6 is with joints a, b, b, expected every joint once"),
        ({"names": ("a", "b")}, r"message 6 is with 3 values of position, expected 2, one a joint"),
        ({"velocity": [1.0]}, r"message 6 is with 1 values of velocity, expected 3, one a joint"),
    ],
)
def test_messages_that_contradict_themselves(tmp_path, change, message):
    written = states(20)
    for key, value in change.items():
        setattr(written[5], key, value)
    with pytest.raises(InvalidDataError, match=message):
        read(write_mcap(tmp_path / "a.mcap", written), "mcap")


def test_no_positions_at_all(tmp_path):
    recorded = [State(START + k, ("a",), (), (), [1.0]) for k in range(5)]
    with pytest.raises(InvalidDataError, match="without positions"):
        read(write_mcap(tmp_path / "a.mcap", recorded), "mcap")


def test_too_many_joints_or_messages(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", states(50))
    with pytest.raises(InvalidDataError, match="3 joints, expected at most 2"):
        read(path, "mcap", settings=Settings(max_joints=2))
    with pytest.raises(InvalidDataError, match="more than 49 messages"):
        read(path, "mcap", settings=Settings(max_samples=49))


kinds = st.builds(
    Kind, st.sets(st.sampled_from("abcdef")).map(lambda joints: tuple(sorted(joints))), st.sampled_from([EVERY, ()])
)


@given(st.lists(st.tuples(kinds, st.integers(1, 100)), min_size=1, max_size=6), st.randoms())
def test_the_choice_does_not_depend_on_the_order_of_the_kinds(record, random):
    merged: dict[Kind, int] = {}
    for kind, count in record:
        merged[kind] = merged.get(kind, 0) + count
    if not any(kind.quantities for kind in merged):
        return
    chosen = choose(list(merged), list(merged.values()), None, "/t")
    assert any(holds(kind, chosen) for kind in merged)
    items = list(merged.items())
    random.shuffle(items)
    again = choose([kind for kind, _ in items], [count for _, count in items], None, "/t")

    def weight(joints: tuple[str, ...]) -> int:
        return len(joints) ** 2 * sum(count for kind, count in items if holds(kind, joints))

    assert weight(again) == weight(chosen) == max(weight(kind.joints) for kind, _ in items if kind.quantities)
