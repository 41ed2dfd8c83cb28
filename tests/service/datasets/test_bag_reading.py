"""Bags of every kind, written by two independent programs, are read back exactly."""

import tracemalloc

import numpy as np
import pytest

from service.datasets.formats.bags import reading
from service.datasets.formats.bags.reading import open_bag
from service.datasets.options import ReadOptions
from service.foundation.settings import Settings
from tests.service.datasets.bag_writers import (
    START,
    bare,
    read,
    states,
    table_of,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
    zipped,
)

NAMES = ("t", *(f"{joint}/{quantity}" for quantity in ("position", "velocity", "effort") for joint in "abc"))


@pytest.mark.parametrize("compression", [None, "bz2", "lz4"])
def test_rosbag1_is_read_back(tmp_path, compression):
    written = states(300)
    result = read(write_rosbag1(tmp_path / "a.bag", written, compression), "rosbag1")
    assert result.names == NAMES
    assert result.joint_names == ("a", "b", "c")
    np.testing.assert_array_equal(result.rows, table_of(written))


@pytest.mark.parametrize(
    ("storage", "compression"),
    [("SQLITE3", "NONE"), ("SQLITE3", "FILE"), ("SQLITE3", "MESSAGE"), ("MCAP", "FILE"), ("MCAP", "STORAGE")],
)
def test_zipped_rosbag2_is_read_back(tmp_path, storage, compression):
    written = states(300)
    folder = write_rosbag2(tmp_path / "bag", written, storage, compression)
    result = read(zipped(folder, tmp_path / "a.zip"), "rosbag2")
    assert result.names == NAMES
    np.testing.assert_array_equal(result.rows, table_of(written))
    assert {each.name for each in tmp_path.iterdir()} == {"bag", "a.zip"}  # nothing is left behind


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_mcap_of_another_writer_is_read_back(tmp_path, compression):
    """Texts have every length, which a reader that caches layouts could confuse."""
    written = states(300, ("joint_1", "joint_22"))
    for number, each in enumerate(written):
        each.frame = "x" * (number * 7 % 91)
    result = read(write_mcap(tmp_path / "a.mcap", written, compression), "mcap")
    np.testing.assert_array_equal(result.rows, table_of(written))


def test_files_of_a_split_recording_are_joined_in_their_order(tmp_path):
    written = states(30)
    (tmp_path / "whole").mkdir()
    for part, number in enumerate((1, 2, 10)):
        folder = write_rosbag2(tmp_path / f"part{number}", written[part * 10 : part * 10 + 10])
        bare(folder, tmp_path / "whole" / f"run_{number}.db3")
    result = read(zipped(tmp_path / "whole", tmp_path / "a.zip"), "rosbag2")
    np.testing.assert_array_equal(result.rows, table_of(written))


def test_times_are_header_stamps_or_reception_times(tmp_path):
    written = states(20)
    for number, each in enumerate(written):
        each.received = START + number * 11_000_000
    result = read(write_mcap(tmp_path / "a.mcap", written), "mcap")
    np.testing.assert_array_equal(result["t"], np.arange(20) / 100)
    assert "times are header stamps, counted from 1700000000.123456789 s" in result.facts

    written[7].stamp = written[3].stamp
    back = read(write_mcap(tmp_path / "b.mcap", written), "mcap")
    np.testing.assert_array_equal(back["t"], np.arange(20) * 11_000_000 / 1e9)
    assert any("header stamps go back 1 time, first in row 8" in fact for fact in back.facts)

    for each in written:
        each.stamp = 0
    unset = read(write_mcap(tmp_path / "c.mcap", written), "mcap")
    np.testing.assert_array_equal(unset["t"], back["t"])
    assert any("20 of 20 header stamps are not set" in fact for fact in unset.facts)


def test_missing_quantities_have_no_columns(tmp_path):
    written = states(20)
    for each in written:
        each.velocity = ()
    written[4].effort = ()
    result = read(write_mcap(tmp_path / "a.mcap", written), "mcap")
    assert result.names == tuple(name for name in NAMES if "velocity" not in name)
    assert np.isnan(result.rows[4, 4:]).all()
    assert not np.isnan(np.delete(result.rows, 4, 0)).any()
    assert "1 of 20 messages have no effort" in result.facts


@pytest.mark.slow
def test_memory_does_not_grow_with_the_recording(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "BATCH_BYTES", 100_000)
    path = write_mcap(tmp_path / "a.mcap", states(6000), "NONE", chunk_size=100_000)
    entire, peaks = path.read_bytes(), {}
    for share in (0.2, 1.0):
        path.write_bytes(entire[: int(len(entire) * share)])
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
