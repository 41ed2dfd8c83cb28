"""Damaged and hostile bags are read as far as possible or rejected, without unexpected errors and within limits."""

import bz2
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
from tests.service.datasets import bag_writers as bags
from tests.service.datasets.bag_writers import read, states, table_of

WRITERS = {
    "rosbag1": ("rosbag1", bags.write_rosbag1, {}),
    "bz2": ("rosbag1", bags.write_rosbag1, {"compression": "bz2"}),
    "db3": ("rosbag2", bags.write_db3, {}),
    "zip": ("rosbag2", bags.write_zip, {}),
    "mcap": ("mcap", bags.write_mcap, {"chunk_size": 512}),
    "plain": ("mcap", bags.write_mcap, {"compression": "NONE", "chunk_size": 512}),
}


@pytest.fixture
def small(monkeypatch) -> Settings:
    """Return settings with small limits for bags."""
    for module in ("container", "files"):
        monkeypatch.setattr(f"service.datasets.formats.bags.{module}.MAX_PART_BYTES", 1 << 20)
    return Settings(max_unpacked_bytes=1 << 22)


@pytest.fixture(scope="module", params=WRITERS)
def bag(request, tmp_path_factory) -> tuple[bytes, str]:
    """Return the bytes of a small bag, and its kind."""
    kind, write, options = WRITERS[request.param]
    return write(tmp_path_factory.mktemp("bags") / "a.bag", states(40), **options).read_bytes(), kind


@pytest.mark.parametrize(
    ("kind", "write", "options", "share"),
    [
        ("mcap", bags.write_mcap, {"chunk_size": 512}, 0.24),
        ("mcap", bags.write_mcap, {"compression": "NONE", "chunk_size": 512}, 0.72),
        ("rosbag1", bags.write_rosbag1, {"chunk_size": 4096}, 0.75),
    ],
)
def test_incomplete_recording_is_read_to_its_end(tmp_path, kind, write, options, share):
    written = states(400)
    path = write(tmp_path / "a.bag", written, **options)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    result = read(path, kind)
    assert 60 * share < len(result.rows) < 400
    np.testing.assert_array_equal(result.rows, table_of(written[: len(result.rows)]))
    assert any("ends within a record" in fact for fact in result.facts)


def test_rosbag1_without_index_is_read(tmp_path):
    written = states(3000)
    path = bags.write_rosbag1(tmp_path / "a.bag", written)
    with bags.changed(path) as raw:
        at = raw.index(b"index_pos=") + len(b"index_pos=")
        raw[at : at + 8] = bytes(8)
    unindexed = read(path, "rosbag1")
    np.testing.assert_array_equal(unindexed.rows, table_of(written))
    assert any("has no index" in fact for fact in unindexed.facts)


def test_bag_cut_off_anywhere_is_read_or_rejected(bag, tmp_path):
    data, kind = bag
    for length in [0, 1, 5, 13, 20, 100, *np.linspace(101, len(data) - 1, 40).astype(int)]:
        cut = tmp_path / "cut"
        cut.write_bytes(data[:length])
        with suppress(InvalidDataError):
            assert 0 < len(read(cut, kind).rows) <= 40


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_bag_with_changed_bytes_is_read_or_rejected(bag, tmp_path, data, small):
    content, kind = bag
    raw = bytearray(content)
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
    data = bytes(bags.ROS2.serialize_cdr(bags.message(bags.ROS2, states(1)[0]), bags.JOINT_STATE))
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
    ],
)
@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_hostile_definitions_are_rejected(definition, encoding):
    with pytest.raises(InvalidDataError):
        Decoder(Channel("/t", "sensor_msgs/JointState", encoding, definition)).find_form(
            b"\x00\x01\x00\x00" + bytes(500), 1
        )


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_built_in_definition_replaces_a_missing_one(encoding):
    decoder = Decoder(Channel("/t", "sensor_msgs/JointState", encoding, ""))
    assert decoder.types["sensor_msgs/JointState"][-1].name == "effort"


def test_mcap_that_declares_2_gb_is_rejected(tmp_path):
    path = bags.write_mcap(tmp_path / "a.mcap", states(40), chunk_size=512)
    with bags.changed(path) as raw:
        at = raw.index(b"\x06", 9)
        while struct.unpack_from("<Q", raw, at + 1)[0] > len(raw):
            at = raw.index(b"\x06", at + 1)
        raw[at + 9 + 16 : at + 9 + 24] = struct.pack("<Q", 2 << 30)  # of the first chunk, once unpacked
    with pytest.raises(TooLargeError, match="a part of 2147483648 bytes, expected at most 67108864"):
        read(path, "mcap")
    with bags.changed(path) as raw:
        raw[at + 1 : at + 9] = struct.pack("<Q", 2 << 30)  # of the record
    with pytest.raises(InvalidDataError, match="The bag has no messages"):
        read(path, "mcap")


@pytest.mark.parametrize(("size", "error"), [(1 << 24, TooLargeError), (1000, InvalidDataError)])
def test_bomb_in_a_chunk_is_rejected(tmp_path, small, size, error):
    """A chunk unpacks to 16 MB, declared or not."""
    chunk = {b"op": b"\x05", b"compression": b"bz2", b"size": struct.pack("<I", size)}
    fields = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k + b"=" + v for k, v in chunk.items())
    parts = [struct.pack("<I", len(part)) + part for part in (fields, bz2.compress(bytes(1 << 24)))]
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + b"".join(parts))
    with pytest.raises(error):
        read(tmp_path / "a.bag", "rosbag1", settings=small)


def zstd(size: int) -> bytes:
    """Return zeros, compressed."""
    return pa.compress(bytes(size), codec="zstd", asbytes=True)


@pytest.mark.parametrize(
    ("script", "error", "message"),
    [
        ("ALTER TABLE messages RENAME TO m; CREATE VIEW messages AS SELECT * FROM m", InvalidDataError, None),
        ("DROP TABLE topics", InvalidDataError, None),
        ("UPDATE messages SET data = 'text' WHERE id = 2", InvalidDataError, None),
        ("UPDATE topics SET serialization_format = 'json'", InvalidDataError, None),
        ("DELETE FROM messages", InvalidDataError, None),
        ("UPDATE messages SET data = zeroblob(20) WHERE id = 2", InvalidDataError, None),
        ("UPDATE message_definitions SET encoded_message_definition = 'float64'", InvalidDataError, None),
        (f"UPDATE messages SET data = x'{zstd(1 << 24).hex()}' WHERE id = 2", TooLargeError, "a part of"),
    ],
)
def test_databases_that_are_not_bags_are_rejected(tmp_path, small, script, error, message):
    path = bags.write_db3(tmp_path / "a.db3", states(3))
    bags.run_script(path, script)
    with pytest.raises(error, match=message):
        read(path, "rosbag2", settings=small)


@pytest.mark.parametrize(
    ("members", "error", "message"),
    [
        ({"a.txt": b"no"}, InvalidDataError, "an archive without .db3, .mcap"),
        ({"../a.db3": b"no"}, InvalidDataError, "a plain path inside the archive"),
        ({"a.db3": b"no bag"}, InvalidDataError, "not a bag .it begins with"),
        ({"a.db3": b""}, InvalidDataError, "file is empty"),
        ({"a.db3.zstd": b"not packed"}, InvalidDataError, "The file could not be read"),
        ({"one/a.db3": b"", "two/b.db3": b""}, InvalidDataError, "bags in several folders: one, two, expected one bag"),
        ({"a.db3": bytes(1 << 23)}, TooLargeError, None),
        ({"a.db3.zstd": zstd(1 << 23)}, TooLargeError, None),
    ],
)
def test_archives_that_are_not_bags_are_rejected(tmp_path: Path, small, members, error, message):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    with pytest.raises(error, match=message):
        read(tmp_path / "a.zip", "rosbag2", settings=small)
    assert [each.name for each in tmp_path.rglob("*")] == ["a.zip"]
