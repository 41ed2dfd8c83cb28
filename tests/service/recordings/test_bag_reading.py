"""Bags of every kind, written by two independent programs, come back number by number."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from service.datasets.formats.bags import reading
from service.datasets.formats.bags.reading import open_bag
from service.datasets.options import ReadOptions
from service.foundation.settings import Settings
from tests.service.recordings.bag_writers import (
    JOINT_STATE,
    ROS1,
    START,
    State,
    bare,
    message,
    read,
    states,
    table_of,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
    zipped,
)

NAMES = ("t", *(f"{joint}/{quantity}" for quantity in ("position", "velocity", "effort") for joint in "abc"))
PANDA = Path(__file__).parents[4] / "shared/data/panda_exciting_trajectory.db3"


@pytest.mark.parametrize("compression", [None, "bz2", "lz4"])
def test_rosbag1(tmp_path, compression):
    said = states(300)
    found = read(write_rosbag1(tmp_path / "a.bag", said, compression), "rosbag1")
    assert found.names == NAMES
    assert found.joint_names == ("a", "b", "c")
    np.testing.assert_array_equal(found.rows, table_of(said))


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("compression", ["NONE", "FILE", "MESSAGE", "STORAGE"])
def test_zipped_rosbag2(tmp_path, storage, compression):
    if (storage, compression) == ("SQLITE3", "STORAGE"):
        pytest.skip("sqlite3 has no compression of its own")
    said = states(300)
    folder = write_rosbag2(tmp_path / "bag", said, storage, compression)
    found = read(zipped(folder, tmp_path / "a.zip"), "rosbag2")
    assert found.names == NAMES
    np.testing.assert_array_equal(found.rows, table_of(said))
    assert {each.name for each in tmp_path.iterdir()} == {"bag", "a.zip"}  # nothing is left behind


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(("storage", "kind"), [("SQLITE3", "rosbag2"), ("MCAP", "mcap")])
def test_bare_file_of_a_rosbag2(tmp_path, storage, kind, big_endian):
    said = states(300)
    folder = write_rosbag2(tmp_path / "bag", said, storage, big_endian=big_endian)
    found = read(bare(folder, tmp_path / "upload"), kind)
    np.testing.assert_array_equal(found.rows, table_of(said))


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
@pytest.mark.parametrize("frame", ["", "b", "base"])
def test_mcap_of_another_writer(tmp_path, compression, frame):
    said = states(300, ("joint_1", "joint_22"))  # texts whose padding differs
    for each in said:
        each.frame = frame
    found = read(write_mcap(tmp_path / "a.mcap", said, compression), "mcap")
    np.testing.assert_array_equal(found.rows, table_of(said))


def test_files_of_a_split_recording_are_joined_in_their_order(tmp_path):
    said = states(30)
    (tmp_path / "whole").mkdir()
    for part, number in enumerate((1, 2, 10)):
        folder = write_rosbag2(tmp_path / f"part{number}", said[part * 10 : part * 10 + 10])
        bare(folder, tmp_path / "whole" / f"run_{number}.db3")
    found = read(zipped(tmp_path / "whole", tmp_path / "a.zip"), "rosbag2")
    np.testing.assert_array_equal(found.rows, table_of(said))


def test_blocks_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "BLOCK_ROWS", 64)
    said = states(300)
    path = write_mcap(tmp_path / "a.mcap", said)
    with open_bag(path, "mcap", ReadOptions(), Settings()) as table:
        blocks = list(table.blocks)
    assert [len(block) for block in blocks] == [64] * 4 + [44]
    np.testing.assert_array_equal(np.concatenate(blocks), table_of(said))


def test_mcap_of_ros1(tmp_path):
    writing = pytest.importorskip("mcap.writer", reason="MCAP files are written by `mcap`, of the extra `dev`")
    said = states(60)
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = writing.Writer(file)
        writer.start("ros1")
        text, _ = ROS1.generate_msgdef(JOINT_STATE)
        schema = writer.register_schema("sensor_msgs/JointState", "ros1msg", text.encode())
        channel = writer.register_channel("/joint_states", "ros1", schema)
        for each in said:
            data = bytes(ROS1.serialize_ros1(message(ROS1, each), JOINT_STATE))
            writer.add_message(channel, each.time, data, each.time)
        writer.finish()
    np.testing.assert_array_equal(read(tmp_path / "a.mcap", "mcap").rows, table_of(said))


def test_messages_of_changing_shape(tmp_path):
    """Texts of every length, which a reader that remembers layouts might mix up."""
    said = states(200)
    for number, each in enumerate(said):
        each.frame = "x" * (number * 7 % 91)
    found = read(write_mcap(tmp_path / "a.mcap", said), "mcap")
    np.testing.assert_array_equal(found.rows, table_of(said))


def test_times_are_the_stamps_or_else_those_of_reception(tmp_path):
    said = states(20)
    for number, each in enumerate(said):
        each.received = START + number * 11_000_000
    found = read(write_mcap(tmp_path / "a.mcap", said), "mcap")
    np.testing.assert_array_equal(found.column("t"), np.arange(20) / 100)
    assert "times are those of the headers, counted from 1700000000.123456789 s" in found.facts

    said[7].stamp = said[3].stamp
    back = read(write_mcap(tmp_path / "b.mcap", said), "mcap")
    np.testing.assert_array_equal(back.column("t"), np.arange(20) * 11_000_000 / 1e9)
    assert any("header stamps go back 1 times, first in row 8" in fact for fact in back.facts)

    for each in said:
        each.stamp = 0
    unset = read(write_mcap(tmp_path / "c.mcap", said), "mcap")
    np.testing.assert_array_equal(unset.column("t"), back.column("t"))
    assert any("20 of 20 header stamps are not set" in fact for fact in unset.facts)

    for each in said:
        each.stamp = START
    same = read(write_mcap(tmp_path / "d.mcap", said), "mcap")
    np.testing.assert_array_equal(same.column("t"), back.column("t"))


def test_a_simulation_begins_at_zero(tmp_path):
    said = [State(k * 10_000_000, ("a",), [k], [0.0], [0.0], received=START + k * 9_000_000) for k in range(20)]
    found = read(write_mcap(tmp_path / "a.mcap", said), "mcap")
    np.testing.assert_array_equal(found.column("t"), np.arange(20) / 100)


def test_columns_that_are_empty(tmp_path):
    said = states(20)
    for each in said:
        each.velocity = ()
    said[4].effort = ()
    found = read(write_mcap(tmp_path / "a.mcap", said), "mcap")
    assert found.names == tuple(name for name in NAMES if "velocity" not in name)
    assert np.isnan(found.rows[4, 4:]).all()
    assert not np.isnan(np.delete(found.rows, 4, 0)).any()
    assert "1 of 20 messages have no effort" in found.facts


def test_memory_does_not_grow_with_the_recording(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "BATCH_BYTES", 100_000)
    path = write_mcap(tmp_path / "a.mcap", states(6000), "NONE", chunk_size=100_000)
    whole, peaks = path.read_bytes(), {}
    for share in (0.2, 1.0):
        path.write_bytes(whole[: int(len(whole) * share)])
        tracemalloc.start()
        try:
            with open_bag(path, "mcap", ReadOptions(), Settings()) as table:
                rows = sum(len(block) for block in table.blocks)
            peaks[rows] = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    (few, less), (many, more) = sorted(peaks.items())
    assert 800 < few < 1300
    assert many == 6000
    # stamp, time of reception and kind are 20 bytes a message, twice where they are joined; a row of the table takes 80
    assert more - less < 70 * (many - few)


@pytest.mark.skipif(not PANDA.exists(), reason=f"no recording at {PANDA}")
def test_the_real_recording_as_rosbags_reads_it():
    from rosbags.rosbag2 import Reader

    from tests.service.recordings.bag_writers import ROS2

    found = read(PANDA, "rosbag2")
    assert found.joint_names == tuple(f"fer_joint{joint}" for joint in range(1, 8))
    expected = []
    with Reader(PANDA) as reader:
        for connection, _, data in reader.messages():
            if connection.topic == "/joint_states":
                state = ROS2.deserialize_cdr(data, connection.msgtype)
                stamp = state.header.stamp
                time = (stamp.sec * 10**9 + stamp.nanosec) / 1e9
                expected.append([time, *state.position, *state.velocity, *state.effort])
    assert len(expected) == 727
    np.testing.assert_array_equal(found.rows, expected)
