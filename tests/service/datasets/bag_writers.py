"""Writing bags with independent programs: the `rosbags` package, and the `mcap` packages of Foxglove."""

import contextlib
import shutil
import sqlite3
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.datasets.formats.bags.reading import open_bag
from service.datasets.options import ReadOptions
from service.foundation.settings import Settings
from tests.service.datasets.reading import Read, read_blocks

typesys = pytest.importorskip("rosbags.typesys", reason="bags are written by `rosbags`, of the extra `dev`")
rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="bags are written by `rosbags`, of the extra `dev`")
rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="bags are written by `rosbags`, of the extra `dev`")

ROS1 = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
ROS2 = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
JOINT_STATE = "sensor_msgs/msg/JointState"
QUANTITIES = ("position", "velocity", "effort")
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


def altered(written: list[State], rows: slice = slice(None), **values: Any) -> list[State]:
    """Set fields of states in place; return all states."""
    for each in written[rows]:
        for name, value in values.items():
            setattr(each, name, value)
    return written


def table_of(written: Iterable[State]) -> np.ndarray:
    """Return the expected table: s since the first stamp, positions, velocities, efforts."""
    written = list(written)
    times = [(each.stamp - written[0].stamp) / 1e9 for each in written]
    return np.column_stack([times, *([getattr(s, key) for s in written] for key in QUANTITIES)])


def message(store: Any, state: State) -> Any:
    """Return the message as an object of `rosbags`."""
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=state.stamp // 10**9, nanosec=state.stamp % 10**9)
    extra = {"seq": 7} if store is ROS1 else {}
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id=state.frame, **extra)
    numbers = {key: np.array(getattr(state, key), float) for key in QUANTITIES}
    return types[JOINT_STATE](header=header, name=list(state.names), **numbers)


def write_messages(writer: Any, store: Any, name: str, messages: Iterable[tuple[str, int, Any]]) -> None:
    """Write messages of one type with a writer of `rosbags`: their topic, time of reception and object."""
    serialize = store.serialize_ros1 if isinstance(writer, rosbag1.Writer) else store.serialize_cdr
    with writer:
        connections: dict[str, Any] = {}
        for topic, time, each in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(connections[topic], time, serialize(each, name))


def write_states(writer: Any, store: Any, written: Iterable[State]) -> None:
    """Write joint states with a writer of `rosbags`."""
    write_messages(writer, store, JOINT_STATE, ((each.topic, each.time, message(store, each)) for each in written))


def write_rosbag1(
    path: Path, written: Iterable[State], compression: str | None = None, chunk_size: int = 1 << 20
) -> Path:
    """Write a ROS 1 bag with `rosbags`."""
    writer = rosbag1.Writer(path)
    writer.chunk_threshold = chunk_size
    if compression:
        writer.set_compression(getattr(rosbag1.Writer.CompressionFormat, compression.upper()))
    write_states(writer, ROS1, written)
    return path


def write_rosbag2(folder: Path, written: Iterable[State], storage: str = "SQLITE3", compression: str = "NONE") -> Path:
    """Write the folder of a ROS 2 bag with `rosbags`."""
    writer = rosbag2.Writer(folder, version=9, storage_plugin=getattr(rosbag2.StoragePlugin, storage))
    writer.set_compression(getattr(rosbag2.CompressionMode, compression), rosbag2.CompressionFormat.ZSTD)
    write_states(writer, ROS2, written)
    return folder


def write_db3(path: Path, written: Iterable[State]) -> Path:
    """Write a ROS 2 bag with `rosbags`, and copy its only data file to the path."""
    return bare(write_rosbag2(path.with_suffix(""), written), path)


def write_zip(path: Path, written: Iterable[State], *options: str) -> Path:
    """Write a ROS 2 bag with `rosbags`, and zip its folder."""
    return zipped(write_rosbag2(path.with_suffix(""), written, *options), path)


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
            body = {"header": {"stamp": stamp, "frame_id": each.frame}, "name": list(each.names)}
            body |= {key: list(getattr(each, key)) for key in QUANTITIES}
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


def read(path: Path, options: ReadOptions | None = None, settings: Settings = SETTINGS) -> Read:
    """Read the whole table of a bag."""
    with open_bag(path, options or ReadOptions(), settings) as table:
        return read_blocks(table)


def run_script(path: Path, script: str) -> None:
    """Change the database of a ROS 2 bag."""
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.executescript(script)


@contextlib.contextmanager
def changed(path: Path) -> Iterator[bytearray]:
    """Yield the bytes of a file to change, and write them back."""
    data = bytearray(path.read_bytes())
    yield data
    path.write_bytes(bytes(data))
