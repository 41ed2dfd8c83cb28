"""LeRobot data sets of versions 2 and 3 in a zip."""

import io
import json
import zipfile

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from service.foundation.errors import InvalidDataError, TooLargeError
from tests.service.datasets.reading import read, read_rejected

JOINTS = ["shoulder_pan", "gripper"]
RNG = np.random.default_rng(4)
STATE, SPEED, EFFORT = (RNG.normal(size=(60, 2)).astype(np.float32) for _ in range(3))
EPISODE = np.repeat([0, 1, 2], 20)
TIME = np.tile(np.arange(20), 3) / np.float32(30)


def feature(names, shape=2):
    return {"dtype": "float32", "shape": [shape], "names": names}


def info(names=None, version="v2.1", **features):
    names = [f"{joint}.pos" for joint in JOINTS] if names is None else names
    reply = {"observation.state": feature(names), "action": feature(names), "observation.velocity": feature(JOINTS)}
    reply |= {"observation.effort": feature([f"{joint}.effort" for joint in JOINTS]), "timestamp": feature(None, 1)}
    return {"codebase_version": version, "robot_type": "so101", "fps": 30, "features": reply | features}


def parquet(rows, without=(), **more):
    lists = {
        "observation.state": STATE,
        "action": STATE + 1,
        "observation.velocity": SPEED,
        "observation.effort": EFFORT,
    }
    table = {name: list(values[rows]) for name, values in lists.items()}
    table |= {"timestamp": TIME[rows], "frame_index": np.tile(np.arange(20), 3)[rows], "episode_index": EPISODE[rows]}
    table |= {"task": ["pick"] * len(EPISODE[rows])}
    out = io.BytesIO()
    pq.write_table(pa.table({name: value for name, value in (table | more).items() if name not in without}), out)
    return out.getvalue()


def zipped(files, compression=zipfile.ZIP_DEFLATED):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", compression) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return out.getvalue()


def dataset(reply=None, root="", **files):
    """Return the files of version 2: one per episode, not in order."""
    reply = info() if reply is None else reply
    out = {"README.md": b"# mine", "meta/info.json": json.dumps(reply).encode(), "videos/a/b.mp4": bytes(1000)}
    for episode in (2, 0, 1):
        out[f"data/chunk-000/episode_{episode:06d}.parquet"] = parquet(slice(20 * episode, 20 * episode + 20))
    return {root + name: content for name, content in (out | files).items() if content is not None}


def check(result):
    assert np.array_equal(result["t"], TIME)
    assert np.array_equal(result["episode"], EPISODE)
    for index, joint in enumerate(JOINTS):
        assert np.array_equal(result[f"{joint}.pos"], STATE[:, index])
        assert np.array_equal(result[f"{joint}.vel"], SPEED[:, index])
        assert np.array_equal(result[f"{joint}.effort"], EFFORT[:, index])
    assert result.units == {"t": "s"}


@pytest.mark.parametrize(
    ("root", "names", "kind"),
    [("", None, "lerobot"), ("mine/", JOINTS, "zip"), ("", {"motors": JOINTS}, None), ("mine/", None, "rosbag2")],
)
def test_version_2(tmp_path, root, names, kind):
    result = read(tmp_path, zipped(dataset(info(names), root)), kind)
    check(result)
    joint = "gripper" if names else "gripper.pos"
    assert np.array_equal(result[f"action.{joint}"], (STATE + 1)[:, 1])
    assert any("so101" in fact for fact in result.facts)
    assert any("degrees" in fact for fact in result.facts)
    assert (kind == "rosbag2") == any("was sent as" in fact for fact in result.facts)


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_version_3(tmp_path, compression):
    files = dataset(info(version="v3.0"))
    files = {name: content for name, content in files.items() if "data/" not in name}
    files["data/chunk-000/file-000.parquet"] = parquet(slice(0, 35))
    files["data/chunk-000/file-001.parquet"] = parquet(slice(35, 60))
    files["meta/episodes/chunk-000/file-000.parquet"] = parquet(slice(0, 1))
    check(read(tmp_path, zipped(files, compression), "lerobot"))


@pytest.mark.parametrize("names", [[], ["gripper", "gripper"], 7])
def test_wrong_joint_names_are_ignored(tmp_path, names):
    reply = info()
    reply["features"]["observation.state"]["names"] = names
    assert np.array_equal(read(tmp_path, zipped(dataset(reply)), "lerobot")["observation.state[1]"], STATE[:, 1])


def test_times_from_frames(tmp_path):
    files = dataset()
    for episode in range(3):
        files[f"data/chunk-000/episode_{episode:06d}.parquet"] = parquet(
            slice(20 * episode, 20 * episode + 20), without=["timestamp"]
        )
    result = read(tmp_path, zipped(files), "lerobot")
    np.testing.assert_allclose(result["t"], np.tile(np.arange(20), 3) / 30, rtol=1e-15)
    assert any("30 Hz" in fact for fact in result.facts)


LAST = "data/chunk-000/episode_000002.parquet"


@pytest.mark.parametrize(
    ("files", "field", "message"),
    [
        (dataset(**{"meta/info.json": b"{"}), "meta/info.json", "LeRobot"),
        (dataset(**{LAST: b"no parquet"}), f"{LAST}: file", "Parquet"),
        (dataset(**{LAST: parquet(slice(0, 5), without=["action"])}), LAST, "the columns of the first file"),
        (dataset(**{LAST: parquet(slice(0, 5))[:-30]}), f"{LAST}: file", "cut off"),
        ({"meta/info.json": json.dumps(info()).encode()}, "member", "parquet"),
    ],
)
def test_damaged_data_set_is_rejected_with_the_member(tmp_path, files, field, message):
    reply = read_rejected(tmp_path, zipped(files), "lerobot", error=InvalidDataError)
    assert reply[0] == field
    assert message in " ".join(reply)


def test_error_names_the_file_and_the_row(tmp_path):
    state = [list(row) for row in STATE[40:60]]
    state[7] = [0.0]
    files = dataset(**{LAST: parquet(slice(40, 60), **{"observation.state": state})})
    assert read_rejected(tmp_path, zipped(files), "lerobot")[:2] == (
        f"{LAST}: observation.state, row 8",
        "a list of 1 values",
    )


def test_zip_bomb_is_rejected_before_unpacking(tmp_path):
    files = dataset(**{LAST: bytes(3_000_000)})
    body = zipped(files)
    assert len(body) < 50_000
    assert "at most 100000" in read_rejected(tmp_path, body, "lerobot", error=TooLargeError, max_unpacked_bytes=100_000)
