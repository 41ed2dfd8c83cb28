"""Damaged and hostile bags are read as far as possible or rejected, without unexpected errors and within limits."""

import bz2
import sqlite3
import struct
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from service.datasets.formats.bags.container import Channel
from service.datasets.formats.bags.states import Decoder
from service.foundation.errors import InvalidDataError, InvalidRequestError, TooLargeError
from service.foundation.settings import Settings
from tests.service.datasets.bag_writers import (
    JOINT_STATE,
    ROS2,
    bare,
    changed,
    message,
    read,
    states,
    table_of,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
    zipped,
)


@pytest.fixture
def small(monkeypatch) -> Settings:
    """Return settings with small limits for bags."""
    for module in ("container", "files"):
        monkeypatch.setattr(f"service.datasets.formats.bags.{module}.MAX_PART_BYTES", 1 << 20)
    return Settings(max_unpacked_bytes=1 << 22)


@pytest.fixture(scope="module")
def bags(tmp_path_factory) -> dict[str, tuple[Path, str]]:
    """Return one small bag of each kind, and its kind."""
    folder = tmp_path_factory.mktemp("bags")
    written = states(40)
    return {
        "rosbag1": (write_rosbag1(folder / "a.bag", written), "rosbag1"),
        "bz2": (write_rosbag1(folder / "b.bag", written, "bz2"), "rosbag1"),
        "db3": (bare(write_rosbag2(folder / "sqlite", written), folder / "a.db3"), "rosbag2"),
        "zip": (zipped(write_rosbag2(folder / "zipped", written), folder / "a.zip"), "rosbag2"),
        "mcap": (write_mcap(folder / "a.mcap", written, chunk_size=512), "mcap"),
        "plain": (write_mcap(folder / "b.mcap", written, "NONE", chunk_size=512), "mcap"),
    }


@pytest.mark.parametrize(("name", "share"), [("mcap", 0.3), ("plain", 0.9)])
def test_incomplete_recording_is_read_to_its_end(bags, tmp_path, name, share):
    written = states(400)
    path = write_mcap(tmp_path / "a.mcap", written, "ZSTD" if name == "mcap" else "NONE", chunk_size=512)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share * 0.8)])
    result = read(path, "mcap")
    assert 50 * share < len(result.rows) < 400
    np.testing.assert_array_equal(result.rows, table_of(written[: len(result.rows)]))
    assert any("ends within a record" in fact for fact in result.facts)


def test_rosbag1_that_is_incomplete_or_has_no_index_is_read(tmp_path):
    written = states(3000)
    path = write_rosbag1(tmp_path / "a.bag", written)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * 0.75)])
    # rosbags writes chunks of 1 MiB; at least the first must be complete
    result = read(path, "rosbag1") if data.count(b"op=\x05") > 1 else None
    if result is not None:
        np.testing.assert_array_equal(result.rows, table_of(written[: len(result.rows)]))
        assert any("ends within a record" in fact for fact in result.facts)
    path.write_bytes(data)
    with changed(path) as raw:
        at = raw.index(b"index_pos=") + len(b"index_pos=")
        raw[at : at + 8] = bytes(8)
    unindexed = read(path, "rosbag1")
    np.testing.assert_array_equal(unindexed.rows, table_of(written))
    assert any("has no index" in fact for fact in unindexed.facts)


@pytest.mark.parametrize("name", ["rosbag1", "bz2", "db3", "zip", "mcap", "plain"])
def test_bag_cut_off_anywhere_is_read_or_rejected(bags, tmp_path, name):
    path, kind = bags[name]
    data = path.read_bytes()
    for length in [0, 1, 5, 13, 20, 100, *np.linspace(101, len(data) - 1, 40).astype(int)]:
        cut = tmp_path / "cut"
        cut.write_bytes(data[:length])
        with suppress(InvalidDataError):
            assert 0 < len(read(cut, kind).rows) <= 40


@pytest.mark.parametrize("name", ["rosbag1", "bz2", "db3", "zip", "mcap", "plain"])
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_bag_with_changed_bytes_is_read_or_rejected(bags, tmp_path, name, data, small):
    path, kind = bags[name]
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    broken = tmp_path / "broken"
    broken.write_bytes(bytes(raw))
    with suppress(InvalidDataError, InvalidRequestError, TooLargeError):
        read(broken, kind, settings=small)
    assert not [each for each in tmp_path.iterdir() if each.is_dir()]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text("abc[]<=0123456789 \n#/_MSG:float64stringtimeHeadernamepositionvelocityeffort", max_size=200))
def test_any_definition_is_parsed_or_rejected(tmp_path, text):
    data = bytes(ROS2.serialize_cdr(message(ROS2, states(1)[0]), JOINT_STATE))
    for start in ("", "std_msgs/Header header\nstring[] name\nfloat64[] position\n"):
        channel = Channel("/t", "sensor_msgs/JointState", "cdr", start + text + "\nfloat64[] effort")
        with suppress(InvalidDataError):
            Decoder(channel).find_form(data, 1)


@pytest.mark.parametrize(
    "definition",
    [
        "std_msgs/Header header\nsensor_msgs/JointState[] more\nfloat64[] effort",  # within itself
        "std_msgs/Header header\nBig[4000000000] name\nfloat64[] effort\nMSG: sensor_msgs/Big\nuint8 A=1",
        "std_msgs/Header header\nA[300] name\nfloat64[] effort\n"
        + "".join(f"MSG: sensor_msgs/{a}\n{b}[300] x\n" for a, b in zip("ABCDEF", "BCDEFG", strict=True))
        + "MSG: sensor_msgs/G\n",
        "std_msgs/Header header\nfloat64[999999999] effort",
        "Header header\nstring[] name\nduration[] position\nfloat64[] effort\nMSG: std_msgs/Header\nuint8 stamp\n",
        "float64[] effort",
        "",
    ],
)
@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_hostile_definitions_are_rejected(definition, encoding):
    data = b"\x00\x01\x00\x00" + bytes(500)
    channel = Channel("/t", "sensor_msgs/JointState", encoding, definition)
    if definition == "":  # then the built-in definition is used
        assert Decoder(channel).types["sensor_msgs/JointState"][-1].name == "effort"
        return
    with pytest.raises(InvalidDataError):
        Decoder(channel).find_form(data, 1)


def test_mcap_that_declares_2_gb_is_rejected(bags, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(bags["mcap"][0].read_bytes())
    with changed(path) as raw:
        at = raw.index(b"\x06", 9)
        while struct.unpack_from("<Q", raw, at + 1)[0] > len(raw):
            at = raw.index(b"\x06", at + 1)
        raw[at + 9 + 16 : at + 9 + 24] = struct.pack("<Q", 2 << 30)  # of the first chunk, once unpacked
    with pytest.raises(TooLargeError, match="a part of 2147483648 bytes, expected at most 67108864"):
        read(path, "mcap")
    with changed(path) as raw:
        raw[at + 1 : at + 9] = struct.pack("<Q", 2 << 30)  # of the record
    with pytest.raises(InvalidDataError, match="The bag has no messages"):
        read(path, "mcap")


def test_bomb_in_a_chunk_is_rejected(tmp_path, small):
    """A chunk unpacks to 16 MB, declared or not."""

    def record(header: dict[bytes, bytes], data: bytes) -> bytes:
        fields = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k + b"=" + v for k, v in header.items())
        return struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(data)) + data

    packed = bz2.compress(bytes(1 << 24))
    for size, error in ((1 << 24, TooLargeError), (1000, InvalidDataError)):
        chunk = {b"op": b"\x05", b"compression": b"bz2", b"size": struct.pack("<I", size)}
        (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + record(chunk, packed))
        with pytest.raises(error):
            read(tmp_path / "a.bag", "rosbag1", settings=small)


def test_messages_that_unpack_to_too_much_are_rejected(tmp_path, small):
    path = bare(write_rosbag2(tmp_path / "bag", states(3)), tmp_path / "a.db3")
    bomb = pa.compress(bytes(1 << 24), codec="zstd", asbytes=True)
    with sqlite3.connect(path) as database:
        database.execute("UPDATE messages SET data = ? WHERE id = 2", (bomb,))
    database.close()
    with pytest.raises(TooLargeError, match="a part of"):
        read(path, "rosbag2", settings=small)


@pytest.mark.parametrize(
    "script",
    [
        "ALTER TABLE messages RENAME TO m; CREATE VIEW messages AS SELECT * FROM m",
        "DROP TABLE topics",
        "UPDATE messages SET data = 'text' WHERE id = 2",
        "UPDATE topics SET serialization_format = 'json'",
        "DELETE FROM messages",
        "UPDATE messages SET data = zeroblob(20) WHERE id = 2",
        "UPDATE message_definitions SET encoded_message_definition = 'float64'",
    ],
)
def test_databases_that_are_not_bags_are_rejected(tmp_path, script):
    path = bare(write_rosbag2(tmp_path / "bag", states(3)), tmp_path / "a.db3")
    with sqlite3.connect(path) as database:
        database.executescript(script)
    database.close()
    with pytest.raises(InvalidDataError):
        read(path, "rosbag2")


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"a.txt": b"no"}, "an archive without .db3, .mcap"),
        ({"../a.db3": b"no"}, "a plain path inside the archive"),
        ({"a.db3": b"no bag"}, "not a bag .it begins with"),
        ({"a.db3": b""}, "file is empty"),
        ({"a.db3.zstd": b"not packed"}, "The file could not be read"),
        ({"one/a.db3": b"", "two/b.db3": b""}, "bags in several folders: one, two, expected one bag"),
    ],
)
def test_archives_that_are_not_bags_are_rejected(tmp_path, members, message):
    folder = tmp_path / "uploads"
    folder.mkdir()
    with zipfile.ZipFile(folder / "a.zip", "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    with pytest.raises(InvalidDataError, match=message):
        read(folder / "a.zip", "rosbag2")
    assert {each.name for each in tmp_path.rglob("*")} == {"uploads", "a.zip"}


def test_zip_bomb_is_rejected(tmp_path, small):
    bombs = {"a.db3": bytes(1 << 23), "a.db3.zstd": pa.compress(bytes(1 << 23), codec="zstd", asbytes=True)}
    for name, data in bombs.items():
        with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(name, data)
        with pytest.raises(TooLargeError):
            read(tmp_path / "a.zip", "rosbag2", settings=small)
        assert [each.name for each in tmp_path.iterdir()] == ["a.zip"]
