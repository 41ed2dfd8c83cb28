"""Playing a motion to a model in real time: what is played, the loop that plays it, and figures of its answers."""

from __future__ import annotations

import signal
import tempfile
import threading
import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from lipcore.data.samples import Array
from lipcore.online.changes.opening import OPENING, Opening
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.vocabulary import TorqueConvention
from lipserve import StreamClient, StreamError
from lipserve.exchange import StreamAnswer, StreamLearnt, StreamRefusal
from service.cli.consoles import CommandError
from service.cli.wording import in_shell
from service.datasets.formats.opening import open_table
from service.datasets.mapping.reading import read
from service.datasets.options import UploadOptions
from service.datasets.staging import Staged, prepare
from service.foundation.errors import ServiceError
from service.foundation.settings import Settings
from service.storage.disk import Disk


class Tally:
    """What answers were like, as sums: a stream may last for hours. noise_std: (n) N·m, of a measurement."""

    def __init__(self, noise_std: Array) -> None:
        self._noise = noise_std
        self.rows, self.late, self.received_late, self.behind_s = 0, 0, 0, 0.0
        self.refused = Counter[str]()
        self._trips = array("d")
        # answers inside the band, squared errors, torques, squared torques, inside the band as the model itself has it
        self._sums = np.zeros((5, len(noise_std)))

    def add(self, answer: StreamAnswer, tau: Array, seconds: float, behind_s: float, deadline: float = np.inf) -> None:
        """Count an answer with its std.

        tau: (n) measured there; seconds: of the round trip; behind_s: how long after it was due the row was sent;
        deadline: s, after which the answer is late, by the service's clock or by this one.
        """
        error = tau - answer.tau
        self.rows += 1
        self.late += answer.seconds > deadline
        self.received_late += seconds > deadline
        self.behind_s = max(self.behind_s, behind_s)
        self._trips.append(seconds)
        inside = own = np.zeros(tau.shape, np.bool_)
        if answer.tau_std is not None:
            scale, half = (
                1.0 if answer.scale is None else answer.scale,
                OPENING.band * np.hypot(answer.tau_std, self._noise),
            )
            inside, own = np.abs(error) <= scale * half, np.abs(error) <= half
        self._sums += np.array((inside, error**2, tau, tau**2, own))

    def merge(self, other: Tally) -> None:
        """Add the figures of another stretch of the same stream."""
        self.rows += other.rows
        self.late += other.late
        self.received_late += other.received_late
        self.behind_s = max(self.behind_s, other.behind_s)
        self.refused.update(other.refused)
        self._trips.extend(other._trips)
        self._sums += other._sums

    def figures(self) -> dict[str, Any]:
        """The figures for JSON: rmse in N·m over all joints, coverage of the 95 % band; None without answers; late by
        the service's clock, and received late by this one, which has the network in it.

        All compare answers with torque that the model had not learnt yet when it answered.
        """
        p50, p99 = (np.percentile(self._trips, (50, 99)) * 1e3).tolist() if self.rows else (None, None)
        return {
            "rows": self.rows,
            "refused": dict(self.refused),
            "round_trip_ms": {"p50": p50, "p99": p99},
            "late": self.late,
            "received_late": self.received_late,
            "behind_s": self.behind_s,
            "rmse": float(np.sqrt(self._sums[1].mean() / self.rows)) if self.rows else None,
            "coverage": float(self._sums[0].mean() / self.rows) if self.rows else None,
        }

    def opening(self, seconds: float) -> Opening:
        """What the model's own band, which no stream has widened, held of the first seconds of a stream."""
        rows = min(OPENING.rows * seconds, float(self.rows))
        return Opening(rows, rows * self._sums[4] / max(self.rows, 1))

    def joints(self, joint_names: Sequence[str]) -> list[dict[str, Any]]:
        """Figures of each joint: rmse N·m, nmse (None where the torque does not vary), coverage of the 95 % band."""
        if not self.rows:
            return []
        coverage, squared, mean, mean_square = self._sums[:4] / self.rows
        variance = mean_square - mean**2
        return [
            {
                "joint": name,
                "rmse": float(np.sqrt(squared[at])),
                "nmse": float(squared[at] / variance[at]) if variance[at] > 1e-12 else None,
                "coverage": float(coverage[at]),
            }
            for at, name in enumerate(joint_names)
        ]


def learnt_figures(learnt: StreamLearnt) -> dict[str, Any]:
    """What has become of the torques that were sent, for JSON."""
    return {
        "accepted": learnt.accepted,
        "duplicates": learnt.duplicates,
        "kept_out": dict(learnt.rejected),
        "revision": learnt.revision,
    }


def refused_figures(refusals: Sequence[StreamRefusal]) -> list[dict[str, Any]]:
    """Torques that were not logged, for JSON: those that follow each other for the same reason together."""
    told: list[dict[str, Any]] = []
    for each in refusals:
        if told and (told[-1]["through"] + 1, told[-1]["message"]) == (each.first, each.message):
            told[-1]["through"] = each.through
        else:
            told.append({"first": each.first, "through": each.through, "code": each.code, "message": each.message})
    return told


FEWEST = 10
"""Rows of a recording."""


@dataclass(frozen=True)
class Motion:
    """Rows to play. t: (N,) s; q, dq, ddq, tau: (N, n) in SI units, tau as measured."""

    t: Array
    q: Array
    dq: Array
    ddq: Array
    tau: Array
    joint_names: tuple[str, ...]
    torque_convention: TorqueConvention

    def __len__(self) -> int:
        return len(self.t)

    @property
    def step(self) -> float:
        """Usual time between two rows, s."""
        return float(np.median(np.diff(self.t)))

    def ordered(self, joint_names: Sequence[str]) -> tuple[Motion, bool]:
        """The motion in the order of a model's joints, and whether its names were these; raise CommandError.

        Joints of other names are taken in their order, where there are as many.
        """
        if len(joint_names) != len(self.joint_names):
            raise CommandError(
                f"the motion has {len(self.joint_names)} joints ({', '.join(self.joint_names)}), expected the model's "
                f"{len(joint_names)}: {', '.join(joint_names)}"
            )
        if set(joint_names) != set(self.joint_names):
            return self, False
        order = [self.joint_names.index(name) for name in joint_names]
        columns = {name: getattr(self, name)[:, order] for name in ("q", "dq", "ddq", "tau")}
        return replace(self, **columns, joint_names=tuple(joint_names)), True


def simulated(robot: str, stream: Simulation, seed: int = 0) -> Motion:
    """A simulated robot's stream.

    Raise MissingExtraError where what simulates is not installed, ValueError for other robots.
    """
    made = simulate(load_robot(robot), stream, seed)
    return Motion(made.t, made.q, made.dq, made.ddq, made.tau, tuple(made.joint_names), "gravity_included")


def recorded(path: Path, seconds: float | None = None) -> Motion:
    """A recording, prepared as the service prepares an upload; its first seconds where these are given.

    Raise CommandError where it cannot be read or has no times.
    """
    with tempfile.TemporaryDirectory() as folder:
        try:
            staged, convention = _staged(path, Path(folder))
        except ServiceError as error:
            raise CommandError(f"{path.name}: {in_shell(str(error))}") from error
        t = staged.read("t")
        rows = slice(None) if seconds is None else t - t[0] <= seconds
        parts = {name: staged.table(name, rows) for name in ("q", "dq", "ddq", "tau")}
        names = staged.joint_names
    t = t[rows]
    if len(t) < 2 or not np.all(np.diff(t) > 0):
        raise CommandError(f"{path.name} has no times that rise from row to row, expected a column t in seconds")
    return Motion(t=t, **parts, joint_names=names, torque_convention=convention)


def _staged(path: Path, folder: Path) -> tuple[Staged, TorqueConvention]:
    """Columns of a recording in a folder, and what its torque is."""
    settings, options = Settings(home=folder, max_home_bytes=None), UploadOptions()
    disk = Disk(settings)
    with open_table(path, None, options.read, settings) as table:
        recording = read(table, folder, options, None, settings, disk, FEWEST)
    return prepare(recording.staged, folder, options.recipe, FEWEST, disk).staged, recording.torque_convention


class Stop:
    """Whether Ctrl-C was pressed. The first lets the row that is under way be answered; the second ends it at once."""

    def __init__(self) -> None:
        self.asked = False

    @contextmanager
    def listening(self) -> Iterator[Stop]:
        """Listen for Ctrl-C, in the main thread, which alone hears it."""
        if threading.current_thread() is not threading.main_thread():
            yield self
            return
        before = signal.signal(signal.SIGINT, self._ask)
        try:
            yield self
        finally:
            signal.signal(signal.SIGINT, before)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True


def play(
    stream: StreamClient,
    motion: Motion,
    learn: bool,
    deadline: float,
    stop: Stop,
    each_second: Callable[[int, Tally], None],
    total: Tally,
) -> None:
    """Ask for the torque at each row when it is due, and send what was measured there where it is to be learnt.

    A row that is refused is counted and the next one is sent; rows that are due already follow without a pause. Raise
    StreamError where the stream is lost. each_second: is told which second of the playing has ended, and its figures.
    total: gets the figures of all rows, also where the stream is lost.
    """
    part = Tally(stream.hello.noise_std)
    due = motion.t - motion.t[0]
    begin, second = time.perf_counter(), 1
    for row in range(len(motion)):
        while (wait := begin + due[row] - time.perf_counter()) > 0 and not stop.asked:
            time.sleep(min(wait, 0.05))  # a Ctrl-C is handled after this time at the latest
        if stop.asked:
            break
        sent = time.perf_counter()
        if sent - begin >= second:
            each_second(second, part)
            total.merge(part)
            part, second = Tally(stream.hello.noise_std), int(sent - begin) + 1
            sent = time.perf_counter()
        tau = motion.tau[row] if learn else None
        try:
            stream.send(motion.q[row], motion.dq[row], motion.ddq[row], deadline=deadline, tau=tau)
            answer = stream.receive()  # its own, however late
        except StreamError as error:
            if error.sequence is None:
                total.merge(part)
                raise
            part.refused[error.code] += 1
            continue
        part.add(answer, motion.tau[row], time.perf_counter() - sent, max(0.0, -wait), deadline)
    if part.rows or part.refused:
        each_second(second, part)
        total.merge(part)
