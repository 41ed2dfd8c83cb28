"""Damaged and hostile bags are read as far as possible or rejected, without unexpected errors and within limits."""

import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from service.datasets.formats.bags.containers import Topic
from service.datasets.formats.bags.decoding import make_decoder
from service.foundation.errors import InvalidDataError, InvalidRequestError, TooLargeError
from service.foundation.settings import Settings
from tests.service.datasets import bag_writers as bags
from tests.service.datasets.bag_writers import read, states, table_of

SMALL = Settings(max_unpacked_bytes=1 << 22)
WRITERS = {
    "rosbag1": (bags.write_rosbag1, {}),
    "bz2": (bags.write_rosbag1, {"compression": "bz2"}),
    "db3": (bags.write_db3, {}),
    "zip": (bags.write_zip, {}),
    "mcap": (bags.write_mcap, {"chunk_size": 512}),
    "plain": (bags.write_mcap, {"compression": "NONE", "chunk_size": 512}),
}


@pytest.fixture(scope="module", params=WRITERS)
def bag(request, tmp_path_factory) -> bytes:
    """Return the bytes of a small bag."""
    write, options = WRITERS[request.param]
    return write(tmp_path_factory.mktemp("bags") / "a.bag", states(40), **options).read_bytes()


@pytest.mark.parametrize(
    ("write", "options", "share"),
    [
        (bags.write_mcap, {"chunk_size": 512}, 0.24),
        (bags.write_mcap, {"compression": "NONE", "chunk_size": 512}, 0.72),
        (bags.write_rosbag1, {"chunk_size": 4096}, 0.75),
    ],
)
def test_incomplete_recording_is_read_to_its_end(tmp_path, write, options, share):
    written = states(400)
    path = write(tmp_path / "a.bag", written, **options)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    result = read(path)
    assert 60 * share < len(result.rows) < 400
    np.testing.assert_array_equal(result.rows, table_of(written[: len(result.rows)]))
    assert any("last record is cut off" in fact for fact in result.facts)


def test_rosbag1_without_index_is_read(tmp_path):
    written = states(3000)
    path = bags.write_rosbag1(tmp_path / "a.bag", written)
    with bags.changed(path) as raw:
        at = raw.index(b"index_pos=") + len(b"index_pos=")
        raw[at : at + 8] = bytes(8)
    unindexed = read(path)
    np.testing.assert_array_equal(unindexed.rows, table_of(written))


def test_bag_cut_off_anywhere_is_read_or_rejected(bag, tmp_path):
    for length in [0, 1, 5, 13, 20, 100, *np.linspace(101, len(bag) - 1, 40).astype(int)]:
        cut = tmp_path / "cut"
        cut.write_bytes(bag[:length])
        with suppress(InvalidDataError):
            assert 0 < len(read(cut).rows) <= 40


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_bag_with_changed_bytes_is_read_or_rejected(bag, tmp_path, data):
    raw = bytearray(bag)
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    broken = tmp_path / "broken"
    broken.write_bytes(bytes(raw))
    with suppress(InvalidDataError, InvalidRequestError, TooLargeError, MemoryError):  # the confined process limits it
        read(broken)
    assert not [each for each in tmp_path.iterdir() if each.is_dir()]


@given(st.text("abc[]<=0123456789 \n#/_MSG:float64stringtimeHeadernamepositionvelocityeffort", max_size=200))
def test_any_definition_is_parsed_or_rejected(text):
    data = bytes(bags.ROS2.serialize_cdr(bags.message(bags.ROS2, states(1)[0]), bags.JOINT_STATE))
    for start in ("", "std_msgs/Header header\nstring[] name\nfloat64[] position\n"):
        definition = (start + text + "\nfloat64[] effort").encode()
        with suppress(InvalidDataError):
            decode = make_decoder(Topic("/t", "sensor_msgs/JointState", "cdr", "ros2msg", definition))
            with suppress(Exception):  # the callers report any error of a message
                decode(data)


@pytest.mark.parametrize(
    "definition",
    [
        "std_msgs/Header header\nsensor_msgs/JointState[] more\nfloat64[] effort",  # within itself
        "std_msgs/Header header\nfloat64[999999999] effort",
        "std_msgs/Header header\nUnknown[] name\nfloat64[] effort",
        "float64 effort; import os",
        "float64[] effort\nfloat64[] effort",
        "float64[]",
    ],
)
@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_hostile_definitions_are_rejected(definition, encoding):
    data = bytes(bags.ROS2.serialize_cdr(bags.message(bags.ROS2, states(1)[0]), bags.JOINT_STATE))
    topic = Topic("/t", "sensor_msgs/JointState", encoding, "ros2msg", definition.encode())
    try:
        decode = make_decoder(topic)
    except InvalidDataError:
        return
    with pytest.raises(Exception, match=r"."):  # the callers report any error of a message
        decode(data)


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
        (f"UPDATE messages SET data = x'{zstd(1 << 24).hex()}' WHERE id = 2", InvalidDataError, "message 2"),
    ],
)
def test_databases_that_are_not_bags_are_rejected(tmp_path, script, error, message):
    path = bags.write_db3(tmp_path / "a.db3", states(3))
    bags.run_script(path, script)
    with pytest.raises(error, match=message):
        read(path, settings=SMALL)


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
def test_archives_that_are_not_bags_are_rejected(tmp_path: Path, members, error, message):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    with pytest.raises(error, match=message):
        read(tmp_path / "a.zip", settings=SMALL)
    assert [each.name for each in tmp_path.rglob("*")] == ["a.zip"]
