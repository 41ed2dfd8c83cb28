"""Motions that are played to a model in real time, the loop that plays them, and figures of the answers."""

from __future__ import annotations

import re
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
from lipserve.answers import StreamAnswer, StreamLearnt, StreamRefusal
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
    """Error figures of answers, kept as sums because a stream may last for hours.

    noise_std: (n,) standard deviation of a measurement, N·m.
    """

    def __init__(self, noise_std: Array) -> None:
        self._noise = noise_std
        self.rows, self.late, self.received_late, self.behind_s = 0, 0, 0, 0.0
        self.refused = Counter[str]()
        self._trips = array("d")
        # inside the scaled interval, squared errors, torques, squared torques, inside the model's own interval
        self._sums = np.zeros((5, len(noise_std)))

    def add(self, answer: StreamAnswer, tau: Array, seconds: float, behind_s: float, deadline: float = np.inf) -> None:
        """Add an answer.

        Args:
            answer: The answer, with its standard deviation.
            tau: (n,) measured torque, N·m.
            seconds: Round-trip time.
            behind_s: Delay of the row when it was sent, s.
            deadline: Time after which the answer is late, s, for the service's clock and for this one.
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
        """Add the figures of another part of the same stream."""
        self.rows += other.rows
        self.late += other.late
        self.received_late += other.received_late
        self.behind_s = max(self.behind_s, other.behind_s)
        self.refused.update(other.refused)
        self._trips.extend(other._trips)
        self._sums += other._sums

    def figures(self) -> dict[str, Any]:
        """Return the figures for JSON; errors and coverage are None without answers.

        rmse is in N·m, over all joints. coverage is that of the 95 % interval. Answers are computed before the model
        learns from their rows. `late` is measured by the service's clock, `received_late` by this machine's,
        so it includes the network.
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
        """Return the coverage of the model's own interval, not widened by streams, in the first seconds."""
        rows = min(OPENING.rows * seconds, float(self.rows))
        return Opening(rows, rows * self._sums[4] / max(self.rows, 1))

    def joints(self, joint_names: Sequence[str]) -> list[dict[str, Any]]:
        """Return rmse (N·m), nmse (None for constant torque) and coverage of the 95 % interval of each joint."""
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
    """Return what happened to the torques that were sent, for JSON."""
    return {
        "accepted": learnt.accepted,
        "duplicates": learnt.duplicates,
        "kept_out": dict(learnt.rejected),
        "revision": learnt.revision,
    }


def refused_figures(refusals: Sequence[StreamRefusal]) -> list[dict[str, Any]]:
    """Return torques that were not logged, for JSON.

    Consecutive ones are merged if their messages differ at most in numbers; the first message is kept.
    """
    merged: list[dict[str, Any]] = []
    for each in refusals:
        kind = (each.first - 1, each.code, NUMBER.sub("", each.message))
        if merged and (merged[-1]["through"], merged[-1]["code"], NUMBER.sub("", merged[-1]["message"])) == kind:
            merged[-1]["through"] = each.through
        else:
            merged.append({"first": each.first, "through": each.through, "code": each.code, "message": each.message})
    return merged


NUMBER = re.compile(r"\d+")
MIN_ROWS = 10
"""Min rows of a recording."""


@dataclass(frozen=True)
class Motion:
    """Rows to play: times (N,), s; q, dq, ddq and measured tau (N, n), SI units."""

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
        """Median time between two rows, s."""
        return float(np.median(np.diff(self.t)))

    def ordered(self, joint_names: Sequence[str]) -> tuple[Motion, bool]:
        """Return the motion in a model's joint order, and whether the names match.

        If the names differ, the joints keep their order. Raise CommandError if their number differs.
        """
        if len(joint_names) != len(self.joint_names):
            raise CommandError(
                f"the motion has {len(self.joint_names)} joints ({', '.join(self.joint_names)}), but the model has "
                f"{len(joint_names)}: {', '.join(joint_names)}"
            )
        if set(joint_names) != set(self.joint_names):
            return self, False
        order = [self.joint_names.index(name) for name in joint_names]
        columns = {name: getattr(self, name)[:, order] for name in ("q", "dq", "ddq", "tau")}
        return replace(self, **columns, joint_names=tuple(joint_names)), True


def simulated(robot: str, stream: Simulation, seed: int = 0) -> Motion:
    """Return the motion of a simulated robot.

    Raise MissingExtraError if the simulator is not installed, ValueError for unknown robots.
    """
    made = simulate(load_robot(robot), stream, seed)
    return Motion(made.t, made.q, made.dq, made.ddq, made.tau, tuple(made.joint_names), "gravity_included")


def recorded(path: Path, seconds: float | None = None) -> Motion:
    """Return (the first seconds of) a recording, prepared like an upload.

    Raise CommandError if it cannot be read or has no times.
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
        raise CommandError(f"{path.name} has no increasing times: a column `t` in seconds is required")
    return Motion(t=t, **parts, joint_names=names, torque_convention=convention)


def _staged(path: Path, folder: Path) -> tuple[Staged, TorqueConvention]:
    """Return the columns of a recording, staged in a folder, and its torque convention."""
    settings, options = Settings(home=folder, max_home_bytes=None), UploadOptions()
    disk = Disk(settings)
    with open_table(path, None, options.read, settings) as table:
        recording = read(table, folder, options, None, settings, disk, MIN_ROWS)
    return prepare(recording.staged, folder, options.recipe, MIN_ROWS, disk).staged, recording.torque_convention


class Stop:
    """Flag set by Ctrl-C. The first press lets the current row be answered; the second stops at once."""

    def __init__(self) -> None:
        self.asked = False

    @contextmanager
    def listening(self) -> Iterator[Stop]:
        """Handle Ctrl-C in the block; does nothing outside the main thread, which alone gets signals."""
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
    """Query the torque at each row when it is due, and send the measured torque if the model is to learn from it.

    Rejected rows are counted. Rows that are overdue follow without a pause.

    Args:
        stream: The open stream.
        motion: The rows to play.
        learn: Whether to send the measured torque.
        deadline: Time after which an answer is late, s.
        stop: Ends the loop when Ctrl-C was pressed.
        each_second: Called at the end of each second with its number and figures.
        total: Receives the figures of all rows, also if the stream is lost.

    Raises:
        StreamError: The stream is lost.
    """
    part = Tally(stream.hello.noise_std)
    due = motion.t - motion.t[0]
    begin, second = time.perf_counter(), 1
    for row in range(len(motion)):
        while (wait := begin + due[row] - time.perf_counter()) > 0 and not stop.asked:
            time.sleep(min(wait, 0.05))  # short, so that Ctrl-C is handled soon
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
            answer = stream.receive()  # the answer to this row, even if late
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
