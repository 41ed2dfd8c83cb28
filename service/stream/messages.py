"""What the service says in a stream, as a client reads it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.stream.frames import ANSWER, ERROR, HAS_STD, LATE, LAYOUT, NUMBER, UNREAD


class StreamError(RuntimeError):
    """The service refused a connection or a frame, or is gone.

    code: as the service says, else `unreachable`, `closed`, `timeout` or `layout`; detail: its problems; sequence: of
    the frame that was refused, None where it could not be read.
    """

    def __init__(
        self, message: str, code: str, detail: list[dict[str, Any]] | None = None, sequence: int | None = None
    ) -> None:
        super().__init__(message)
        self.message, self.code, self.detail, self.sequence = message, code, detail or [], sequence


@dataclass(frozen=True)
class StreamHello:
    """What holds for all answers of a version. noise_std: (n,) N·m, of the measurement around the function."""

    model: str
    version: int
    revision: int
    joint_names: tuple[str, ...]
    torque_convention: str
    noise_std: NDArray[np.float64]
    max_position: float


@dataclass(frozen=True, slots=True)
class StreamAnswer:
    """Torque at one motion, N·m.

    tau: (n,) mean; tau_std: (n,) standard deviation of the function, where asked for; late: whether the answer left
    the service after its deadline; late_answers: how many of this connection have; seconds: from the arrival of the
    frame in the service to the departure of the answer.
    """

    sequence: int
    tau: NDArray[np.float64]
    tau_std: NDArray[np.float64] | None
    version: int
    revision: int
    late: bool
    late_answers: int
    seconds: float


@dataclass(frozen=True)
class StreamLearnt:
    """What has become of the torques that a client sent; all of it is durable.

    through: the last sequence that is settled, one less than the client's first where none is; accepted: how many are
    new and learnt from; duplicates: were known before; rejected: kept out of learning, by code; revision: answers of it
    and above contain them.
    """

    through: int
    accepted: int = 0
    duplicates: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    revision: int = 0

    def and_more(self, said: dict[str, Any]) -> StreamLearnt:
        """Return the totals after one more message of the service."""
        rejected = dict(self.rejected)
        for code, count in said["rejected"].items():
            rejected[code] = rejected.get(code, 0) + count
        return StreamLearnt(
            through=said["through"],
            accepted=self.accepted + said["accepted"],
            duplicates=self.duplicates + said["duplicates"],
            rejected=rejected,
            revision=max(self.revision, said["revision"]),
        )


@dataclass(frozen=True)
class StreamRefusal:
    """Torques that the service could not log: those with sequences first to through. code, message, detail: why."""

    first: int
    through: int
    code: str
    message: str
    detail: list[dict[str, Any]]


def read_hello(said: dict[str, Any]) -> StreamHello:
    """Read what holds for all answers; raise StreamError where frames have another layout than this client's."""
    if said["layout"] != LAYOUT:
        raise StreamError(f"the service's frames have layout {said['layout']}, this client knows {LAYOUT}", "layout")
    return StreamHello(
        model=said["model"],
        version=said["version"],
        revision=said["revision"],
        joint_names=tuple(said["joint_names"]),
        torque_convention=said["torque_convention"],
        noise_std=np.array(said["noise_std"]),
        max_position=said["max_position"],
    )


def read_refusal(said: dict[str, Any]) -> StreamRefusal:
    """Read why torques were not logged."""
    error = said["error"]
    return StreamRefusal(said["first"], said["through"], error["code"], error["message"], error["detail"])


def read_answer(data: bytes) -> StreamAnswer | StreamError:
    """Read an answer frame, or the error that is in its place."""
    sequence, flags, n, version, late, revision, seconds = ANSWER.unpack_from(data)
    if flags & ERROR:
        error = json.loads(data[ANSWER.size :])["error"]
        return StreamError(error["message"], error["code"], error["detail"], None if flags & UNREAD else sequence)
    numbers = np.frombuffer(data, NUMBER, offset=ANSWER.size)
    std = numbers[n:] if flags & HAS_STD else None
    return StreamAnswer(sequence, numbers[:n], std, version, revision, bool(flags & LATE), late, seconds)
