"""Writing bags with independent programs: the `rosbags` package, and the `mcap` packages of Foxglove."""

import contextlib
import shutil
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.datasets.formats.bags.reading import BagKind, open_bag
from service.datasets.options import ReadOptions
from service.foundation.settings import Settings
from tests.service.datasets.reading import Read, read_blocks

typesys = pytest.importorskip("rosbags.typesys", reason="bags are written by `rosbags`, of the extra `dev`")
rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="bags are written by `rosbags`, of the extra `dev`")
rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="bags are written by `rosbags`, of the extra `dev`")

ROS1 = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
ROS2 = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
JOINT_STATE = "sensor_msgs/msg/JointState"
START = 1_700_000_000_123_456_789
SETTINGS = Settings()


@dataclass
class State:
    """A joint state to record. stamp, received: ns; if `received` is None, it equals the stamp."""

    stamp: int
    names: Sequence[str]
    position: Sequence[float]
    velocity: Sequence[float] = ()
    effort: Sequence[float] = ()
    received: int | None = None
    topic: str = "/joint_states"
    frame: str = ""

    @property
    def time(self) -> int:
        """Reception time, ns."""
        return self.stamp if self.received is None else self.received


def states(count: int, names: Sequence[str] = ("a", "b", "c"), seed: int = 0, step: int = 10_000_000) -> list[State]:
    """Return states of random numbers, 100 Hz by default."""
    numbers = np.random.default_rng(seed).normal(size=(count, 3, len(names)))
    return [State(START + k * step, names, *row.tolist()) for k, row in enumerate(numbers)]


def table_of(written: Iterable[State]) -> np.ndarray:
    """Return the expected table: s since the first stamp, positions, velocities, efforts."""
    written = list(written)
    times = [(each.stamp - written[0].stamp) / 1e9 for each in written]
    return np.column_stack([times, *([getattr(s, key) for s in written] for key in ("position", "velocity", "effort"))])


def message(store: Any, state: State) -> Any:
    """Return the message as an object of `rosbags`."""
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=state.stamp // 10**9, nanosec=state.stamp % 10**9)
    extra = {"seq": 7} if store is ROS1 else {}
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id=state.frame, **extra)
    numbers = {key: np.array(getattr(state, key), float) for key in ("position", "velocity", "effort")}
    return types[JOINT_STATE](header=header, name=list(state.names), **numbers)


def write_rosbag1(path: Path, written: Iterable[State], compression: str | None = None) -> Path:
    """Write a ROS 1 bag with `rosbags`."""
    writer = rosbag1.Writer(path)
    if compression:
        writer.set_compression(getattr(rosbag1.Writer.CompressionFormat, compression.upper()))
    with writer:
        connections: dict[str, Any] = {}
        for each in written:
            if each.topic not in connections:
                connections[each.topic] = writer.add_connection(each.topic, JOINT_STATE, typestore=ROS1)
            data = ROS1.serialize_ros1(message(ROS1, each), JOINT_STATE)
            writer.write(connections[each.topic], each.time, data)
    return path


def write_rosbag2(
    folder: Path,
    written: Iterable[State],
    storage: str = "SQLITE3",
    compression: str = "NONE",
    big_endian: bool = False,
) -> Path:
    """Write the folder of a ROS 2 bag with `rosbags`."""
    writer = rosbag2.Writer(folder, version=9, storage_plugin=getattr(rosbag2.StoragePlugin, storage))
    writer.set_compression(getattr(rosbag2.CompressionMode, compression), rosbag2.CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for each in written:
            if each.topic not in connections:
                connections[each.topic] = writer.add_connection(each.topic, JOINT_STATE, typestore=ROS2)
            data = ROS2.serialize_cdr(message(ROS2, each), JOINT_STATE, little_endian=not big_endian)
            writer.write(connections[each.topic], each.time, data)
    return folder


def write_mcap(path: Path, written: Iterable[State], compression: str = "ZSTD", chunk_size: int = 4096) -> Path:
    """Write an MCAP file with Foxglove's writers; message times are reception times."""
    mcap = pytest.importorskip("mcap.writer", reason="MCAP files are written by `mcap`, of the extra `dev`")
    ros2 = pytest.importorskip("mcap_ros2.writer", reason="written by `mcap-ros2-support`, of the extra `dev`")
    with path.open("wb") as file:
        writer = ros2.Writer(file, chunk_size=chunk_size, compression=getattr(mcap.CompressionType, compression))
        text, _ = ROS2.generate_msgdef(JOINT_STATE, ros_version=2)
        schema = writer.register_msgdef(JOINT_STATE, text)
        for each in written:
            stamp = {"sec": each.stamp // 10**9, "nanosec": each.stamp % 10**9}
            body = {
                "header": {"stamp": stamp, "frame_id": each.frame},
                "name": list(each.names),
                "position": list(each.position),
                "velocity": list(each.velocity),
                "effort": list(each.effort),
            }
            writer.write_message(each.topic, schema, body, log_time=each.time, publish_time=each.time)
        writer.finish()
    return path


def zipped(folder: Path, file: Path, inside: str = "recording") -> Path:
    """Zip a folder."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for each in sorted(folder.iterdir()):
            archive.write(each, f"{inside}/{each.name}")
    return file


def bare(folder: Path, file: Path) -> Path:
    """Move the only data file out of the folder of a ROS 2 bag."""
    (result,) = [each for each in folder.iterdir() if each.suffix in (".db3", ".mcap")]
    shutil.copyfile(result, file)
    return file


def read(path: Path, kind: BagKind, options: ReadOptions | None = None, settings: Settings = SETTINGS) -> Read:
    """Read the whole table of a bag."""
    with open_bag(path, kind, options or ReadOptions(), settings) as table:
        return read_blocks(table)


@contextlib.contextmanager
def changed(path: Path) -> Iterator[bytearray]:
    """Yield the bytes of a file to change, and write them back."""
    data = bytearray(path.read_bytes())
    yield data
    path.write_bytes(bytes(data))
