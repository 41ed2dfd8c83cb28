"""Bags of every kind, written by two independent programs, are read back exactly."""

import numpy as np
import pytest

from tests.service.datasets import bag_writers as bags
from tests.service.datasets.bag_writers import START, altered, read, states, table_of, write_mcap

NAMES = ("t", *(f"{joint}/{quantity}" for quantity in bags.QUANTITIES for joint in "abc"))


@pytest.mark.parametrize(
    ("write", "options"),
    [
        *((bags.write_rosbag1, [compression]) for compression in (None, "bz2", "lz4")),
        *((bags.write_zip, ["SQLITE3", compression]) for compression in ("NONE", "FILE", "MESSAGE")),
        *((bags.write_zip, ["MCAP", compression]) for compression in ("FILE", "STORAGE")),
        *((write_mcap, [compression]) for compression in ("NONE", "LZ4", "ZSTD")),
    ],
)
def test_bag_is_read_back(tmp_path, write, options):
    """Texts have every length, which a reader that caches layouts could confuse."""
    written = states(300)
    for number, each in enumerate(written):
        each.frame = "x" * (number * 7 % 91)
    path = write(tmp_path / "a.bag", written, *options)
    before = set(tmp_path.iterdir())
    result = read(path)
    assert result.names == NAMES
    assert result.joint_names == ("a", "b", "c")
    np.testing.assert_array_equal(result.rows, table_of(written))
    assert set(tmp_path.iterdir()) == before


def test_files_of_a_split_recording_are_joined_in_their_order(tmp_path):
    written = states(30)
    (tmp_path / "whole").mkdir()
    for part, number in enumerate((1, 2, 10)):
        folder = bags.write_rosbag2(tmp_path / f"part{number}", written[part * 10 : part * 10 + 10])
        bags.bare(folder, tmp_path / "whole" / f"run_{number}.db3")
    result = read(bags.zipped(tmp_path / "whole", tmp_path / "a.zip"))
    np.testing.assert_array_equal(result.rows, table_of(written))


def test_times_are_header_stamps_or_reception_times(tmp_path):
    written = states(20)
    for number, each in enumerate(written):
        each.received = START + number * 11_000_000
    stamped, received = np.arange(20) / 100, np.arange(20) * 11_000_000 / 1e9
    for rows, stamp, times, fact in (
        (slice(0), 0, stamped, "times are header stamps"),
        (slice(7, 8), written[3].stamp, received, "header stamps go back 1 time, first in row 8"),
        (slice(20), 0, received, "20 of 20 header stamps are not set"),
    ):
        result = read(write_mcap(tmp_path / "a.mcap", altered(written, rows, stamp=stamp)))
        np.testing.assert_array_equal(result["t"], times)
        assert any(fact in each for each in result.facts)


def test_missing_quantities_have_no_columns(tmp_path):
    written = altered(states(20), velocity=())
    written[4].effort = ()
    result = read(write_mcap(tmp_path / "a.mcap", written))
    assert result.names == tuple(name for name in NAMES if "velocity" not in name)
    assert np.isnan(result.rows[4, 4:]).all()
    assert not np.isnan(np.delete(result.rows, 4, 0)).any()
    assert "1 of 20 messages have no effort" in result.facts
