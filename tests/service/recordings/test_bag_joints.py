"""Joints are matched by name in every message, whatever order and company they come in."""

from __future__ import annotations

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
    said = states(200, ("a", "b", "c", "d"))
    generator = np.random.default_rng(1)
    mixed = [said[0], *(shuffled(each, generator.permutation(4).tolist()) for each in said[1:])]
    found = read(write(tmp_path / "bag", mixed), "mcap" if write is write_mcap else "rosbag1")
    assert sorted(found.joint_names) == ["a", "b", "c", "d"]
    ordered = [shuffled(each, ["abcd".index(name) for name in found.joint_names]) for each in said]
    np.testing.assert_array_equal(found.rows, table_of(ordered))
    assert any("matched by name in every message" in fact for fact in found.facts)


def test_a_gripper_on_the_same_topic(tmp_path):
    arm = states(100)
    gripper = [State(each.stamp + k * 1000 + 1, ("finger",), [1.0], [0.0]) for each in arm for k in range(3)]
    said = sorted(arm + gripper, key=lambda each: each.stamp)
    path = write_mcap(tmp_path / "a.mcap", said)
    found = read(path, "mcap")
    np.testing.assert_array_equal(found.rows, table_of(arm))
    assert "300 of 400 messages do not tell of all joints and were left out (others tell of finger)" in found.facts
    fingers = read(path, "mcap", ReadOptions(joint_names=("finger",)))
    assert fingers.names == ("t", "finger/position", "finger/velocity")
    assert len(fingers.rows) == 300


def test_joints_that_are_asked_for_come_in_that_order(tmp_path):
    said = states(50)
    found = read(write_mcap(tmp_path / "a.mcap", said), "mcap", ReadOptions(joint_names=("c", "a")))
    assert found.joint_names == ("c", "a")
    np.testing.assert_array_equal(found.column("c/effort"), [each.effort[2] for each in said])
    assert "joints b were left out" in found.facts
    with pytest.raises(InvalidDataError, match=r"joint_names is a, x, expected joints out of a, b, c"):
        read(tmp_path / "a.mcap", "mcap", ReadOptions(joint_names=("a", "x")))


def test_joints_without_names_are_numbered_or_given_names(tmp_path):
    said = states(50)
    for each in said:
        each.names = ()
    path = write_mcap(tmp_path / "a.mcap", said)
    assert read(path, "mcap").joint_names == ("joint1", "joint2", "joint3")
    found = read(path, "mcap", ReadOptions(joint_names=("x", "y", "z")))
    assert found.names[1:4] == ("x/position", "y/position", "z/position")
    np.testing.assert_array_equal(found.rows, table_of(said))
    with pytest.raises(InvalidDataError, match="joint_names is x, y, expected 3 names"):
        read(path, "mcap", ReadOptions(joint_names=("x", "y")))


def test_joints_whose_names_are_numbers_are_still_matched(tmp_path):
    said = states(50, ("joint1", "joint2", "joint3"))
    found = read(write_mcap(tmp_path / "a.mcap", said), "mcap", ReadOptions(joint_names=("joint3", "joint1", "joint2")))
    np.testing.assert_array_equal(found.column("joint3/effort"), [each.effort[2] for each in said])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"names": ("a", "b", "b")}, r"message 6 is with joints a, b, b, expected every joint once"),
        ({"names": ("a", "b")}, r"message 6 is with 3 values of position, expected 2, one a joint"),
        ({"velocity": [1.0]}, r"message 6 is with 1 values of velocity, expected 3, one a joint"),
    ],
)
def test_messages_that_contradict_themselves(tmp_path, change, said):
    written = states(20)
    for key, value in change.items():
        setattr(written[5], key, value)
    with pytest.raises(InvalidDataError, match=said):
        read(write_mcap(tmp_path / "a.mcap", written), "mcap")


def test_no_positions_at_all(tmp_path):
    said = [State(START + k, ("a",), (), (), [1.0]) for k in range(5)]
    with pytest.raises(InvalidDataError, match="without positions"):
        read(write_mcap(tmp_path / "a.mcap", said), "mcap")


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
def test_the_choice_does_not_depend_on_the_order_of_the_kinds(told, random):
    merged: dict[Kind, int] = {}
    for kind, count in told:
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
