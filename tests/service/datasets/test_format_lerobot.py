"""LeRobot data sets of versions 2 and 3 in a zip."""

import json
import zipfile

import numpy as np
import pytest

from tests.service.datasets.reading import check_rejected, parquet, read, zipped

JOINTS = ["shoulder_pan", "gripper"]
RNG = np.random.default_rng(4)
STATE, SPEED, EFFORT = (RNG.normal(size=(60, 2)).astype(np.float32) for _ in range(3))
EPISODE, FRAME = np.repeat([0, 1, 2], 20), np.tile(np.arange(20), 3)
TIME = FRAME / np.float32(30)


def feature(names, shape=2):
    return {"dtype": "float32", "shape": [shape], "names": names}


def info(names=None, version="v2.1"):
    names = [f"{joint}.pos" for joint in JOINTS] if names is None else names
    features = {"observation.state": feature(names), "action": feature(names), "observation.velocity": feature(JOINTS)}
    features |= {"observation.effort": feature([f"{joint}.effort" for joint in JOINTS]), "timestamp": feature(None, 1)}
    return {"codebase_version": version, "robot_type": "so101", "fps": 30, "features": features}


def frames(first, last, without="", **more):
    """Return a Parquet file of rows of the data set."""
    lists = {"observation.state": STATE, "action": STATE + 1, "observation.velocity": SPEED}
    table = {name: list(values[first:last]) for name, values in (lists | {"observation.effort": EFFORT}).items()}
    table |= {"timestamp": TIME[first:last], "frame_index": FRAME[first:last], "episode_index": EPISODE[first:last]}
    table |= {"task": ["pick"] * (last - first), **more}
    return parquet({name: value for name, value in table.items() if name != without})


def dataset(reply=None, root="", without="", **files):
    """Return the files of version 2: one per episode, not in order."""
    reply = info() if reply is None else reply
    out = {"README.md": b"# mine", "meta/info.json": json.dumps(reply).encode(), "videos/a/b.mp4": bytes(1000)}
    for episode in (2, 0, 1):
        out[f"data/chunk-000/episode_{episode:06d}.parquet"] = frames(20 * episode, 20 * episode + 20, without)
    return {root + name: content for name, content in (out | files).items()}


def check(result):
    assert np.array_equal(result["t"], TIME)
    assert np.array_equal(result["episode"], EPISODE)
    for suffix, values in (("pos", STATE), ("vel", SPEED), ("effort", EFFORT)):
        assert np.array_equal(np.column_stack([result[f"{joint}.{suffix}"] for joint in JOINTS]), values)
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
    files = {name: content for name, content in dataset(info(version="v3.0")).items() if "data/" not in name}
    files["data/chunk-000/file-000.parquet"] = frames(0, 35)
    files["data/chunk-000/file-001.parquet"] = frames(35, 60)
    files["meta/episodes/chunk-000/file-000.parquet"] = frames(0, 1)
    check(read(tmp_path, zipped(files, compression), "lerobot"))


@pytest.mark.parametrize("names", [[], ["gripper", "gripper"], 7])
def test_wrong_joint_names_are_ignored(tmp_path, names):
    reply = info()
    reply["features"]["observation.state"]["names"] = names
    assert np.array_equal(read(tmp_path, zipped(dataset(reply)), "lerobot")["observation.state[1]"], STATE[:, 1])


def test_times_from_frames(tmp_path):
    result = read(tmp_path, zipped(dataset(without="timestamp")), "lerobot")
    np.testing.assert_allclose(result["t"], FRAME / 30, rtol=1e-15)
    assert any("30 Hz" in fact for fact in result.facts)


LAST = "data/chunk-000/episode_000002.parquet"
ODD_LIST = [[0.0] if row == 47 else STATE[row].tolist() for row in range(40, 60)]


@pytest.mark.parametrize(
    ("files", "field", "words"),
    [
        (dataset(**{"meta/info.json": b"{"}), "meta/info.json", "LeRobot"),
        (dataset(**{LAST: b"no parquet"}), f"{LAST}: file", "Parquet"),
        (dataset(**{LAST: frames(0, 5, "action")}), LAST, "the columns of the first file"),
        (dataset(**{LAST: frames(0, 5)[:-30]}), f"{LAST}: file", "cut off"),
        (
            dataset(**{LAST: frames(40, 60, **{"observation.state": ODD_LIST})}),
            f"{LAST}: observation.state, row 8",
            ("a list of 1 values",),
        ),
        ({"meta/info.json": json.dumps(info()).encode()}, "member", "parquet"),
    ],
)
def test_damaged_data_set_is_rejected_with_the_member(tmp_path, files, field, words):
    check_rejected(tmp_path, zipped(files), "lerobot", field, words)
