"""The recordings of a folder, prepared by the service."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.real.product import Bed
from benchmarks.workload import BenchError
from lipcore.data.samples import Samples
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import JointType
from lipserve.asking import Reading
from service.cli.simulate import write_recording

ARMS_FILE = "real_arms.npz"
"""File of several arms; its arrays are named `arm|part|field`."""
TRAIN = "train"
"""Name of the part for training; other parts are other motions."""
FIELDS = ("t", "episode", "q", "dq", "ddq", "tau")
_UR10 = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")


@dataclass(frozen=True)
class Recording:
    """A recording of one arm.

    Attributes:
        name: name of the recording.
        file: name of its file.
        arm: name of the arm in ARMS_FILE; None if the file has one arm.
        parts: names of the parts, TRAIN first.
        robot: profile with the arm's URDF, if there is one.
        sliding: indices of prismatic joints.
        reading: options of the upload.
    """

    name: str
    file: str = ARMS_FILE
    arm: str | None = None
    parts: tuple[str, ...] = (TRAIN,)
    robot: str | None = None
    sliding: tuple[int, ...] = ()
    reading: Reading | None = None

    def joint_types(self, n_joints: int) -> tuple[JointType, ...]:
        """Return the type of each joint."""
        return tuple("prismatic" if j in self.sliding else "revolute" for j in range(n_joints))

    def body(self, samples: Samples) -> RigidBody:
        """Return the URDF's arm, its joints in the order of the samples; raise BenchError if there is none."""
        if self.robot is None:
            raise BenchError(f"There is no robot model for {self.name}.")
        return RigidBody.from_profile(self.robot, samples.joint_names, self.joint_types(samples.n_joints))


RECORDINGS = (
    Recording("panda-24s", "panda_exciting_trajectory.db3", robot="panda"),
    Recording("ur10", "ur10_exciting_trajectory.db3", robot="ur10", reading=Reading(joints=_UR10)),
    Recording("schunk", "schunk_liu_althoff.npz"),
    Recording("panda-9s", arm="panda", parts=(TRAIN, "other"), robot="panda"),
    Recording("kuka", arm="kuka", parts=(TRAIN, "other")),
    Recording("tiago", arm="tiago", parts=(TRAIN, "other"), robot="tiago", sliding=(0,)),
    Recording("kr300", arm="kr300", parts=(TRAIN, "other", "other2")),
    Recording("double-pendulum", arm="double_pendulum", parts=(TRAIN, "other"), robot="double-pendulum"),
)
"""Eight arms. `sarcos_test.npz` is omitted, because its rows have no times to split by."""

Parts = Mapping[str, Samples]
"""The prepared samples of a recording's parts by name."""


def prepare(recording: Recording, folder: Path, cache: Path, bed: Callable[[], Bed]) -> Parts:
    """Return the prepared parts of a recording, from `cache` if they exist; raise BenchError without the file."""
    return {part: _prepared(recording, part, folder, cache, bed) for part in recording.parts}


def _prepared(recording: Recording, part: str, folder: Path, cache: Path, bed: Callable[[], Bed]) -> Samples:
    path = cache / f"{recording.name}-{part}.npz"
    if not path.is_file():
        source = folder / recording.file
        if not source.is_file():
            raise BenchError(f"{source} does not exist. Give the folder of the recordings.")
        cache.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory() as scratch:
            if recording.arm is not None:
                source = _extract(source, f"{recording.arm}|{part}|", Path(scratch) / path.name)
            draft = Path(scratch) / "prepared.npz"
            write_recording(draft, bed().prepare(source, recording.reading or Reading()))
            path.write_bytes(draft.read_bytes())
    with np.load(path) as arrays:
        return Samples(tuple(map(str, arrays["joint_names"])), *(arrays[name] for name in FIELDS))


def _extract(source: Path, prefix: str, target: Path) -> Path:
    """Write one part of one arm of ARMS_FILE as a separate recording."""
    with np.load(source) as arrays:
        found = {name: arrays[prefix + name] for name in FIELDS if prefix + name in arrays}
    np.savez(target, **found)
    return target
