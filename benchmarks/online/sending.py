"""A client that streams observation batches, and what the service says to each."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import msgspec

from benchmarks.clients import BadAnswerError, HttpClient, post
from lipcore.data.samples import Samples
from lipserve import StreamClient
from lipserve.stream import StreamLearnt

BATCH_ROWS = 100
_LEAD = 50_000_000
"""Nanoseconds before a paced stream begins."""


@dataclass(frozen=True)
class Ack:
    """An acknowledged batch. sent, acked: nanoseconds of `time.monotonic_ns`; revision: from which on it is learnt."""

    sequence: int
    sent: int
    acked: int
    rows: int
    accepted: int
    revision: int
    duplicate: bool
    rejected: Mapping[str, int]

    @property
    def seconds(self) -> float:
        """From the request to the acknowledgement."""
        return (self.acked - self.sent) / 1e9


class _Answer(msgspec.Struct):
    """What is read of an acknowledgement."""

    sequence: int
    rows: int
    accepted: int
    revision: int
    duplicate: bool
    rejected: dict[str, int]


_decoder = msgspec.json.Decoder(_Answer)


def batch_request(
    model: str,
    stream_id: str,
    sequence: int,
    samples: Samples,
    time_scale: float = 1.0,
    headers: dict[str, str] | None = None,
) -> bytes:
    """One batch as an HTTP request. time_scale: multiplies its times, for a stream that is sent faster than it ran."""
    body = {
        "stream_id": stream_id,
        "sequence": sequence,
        "t": (time_scale * samples.t).tolist(),
        **{name: getattr(samples, name).tolist() for name in ("q", "dq", "ddq", "tau")},
    }
    return post(f"/v1/models/{model}/observations", msgspec.json.encode(body), headers=headers)


def batch_requests(
    model: str, stream_id: str, samples: Samples, time_scale: float = 1.0, rows: int | None = None
) -> list[bytes]:
    """Requests of so many samples each, BATCH_ROWS where None, sequences from 0 on."""
    rows = rows or BATCH_ROWS
    parts = (samples.rows(slice(start, start + rows)) for start in range(0, len(samples), rows))
    return [batch_request(model, stream_id, number, part, time_scale) for number, part in enumerate(parts)]


def send(client: HttpClient, request: bytes) -> Ack:
    """Send a batch and wait until it is acknowledged; raise BadAnswerError where it is refused."""
    sent = time.monotonic_ns()
    answer = client.ask(request)
    acked = time.monotonic_ns()
    said = _decoder.decode(answer)
    return Ack(said.sequence, sent, acked, said.rows, said.accepted, said.revision, said.duplicate, said.rejected)


def send_all(client: HttpClient, requests: Sequence[bytes]) -> list[Ack]:
    """Send batches one after the other, each as soon as the one before is acknowledged."""
    return [send(client, request) for request in requests]


def stream(
    client: HttpClient, requests: Sequence[bytes], period: float, after: Mapping[int, Callable[[], None]] | None = None
) -> list[Ack]:
    """Send a batch every `period` seconds, when its last row has been measured; one that is late delays no tick.

    after: what to do when so many batches are acknowledged.
    """
    acks, first = [], time.monotonic_ns() + _LEAD
    for number, request in enumerate(requests, start=1):
        _sleep_until(first + number * round(1e9 * period))
        acks.append(send(client, request))
        if after and number in after:
            after[number]()
    return acks


def stream_frames(client: StreamClient, samples: Samples) -> list[Ack]:
    """Send every row as a frame at the time it was measured, ask for its torque too, and collect acknowledgements.

    Each acknowledgement stands for all frames since the one before; it was sent when the newest of them was.
    """
    acks: list[Ack] = []
    sent: list[int] = []
    before, first = client.learnt, time.monotonic_ns() + _LEAD
    for row, at in enumerate(samples.t - samples.t[0]):
        _sleep_until(first + round(1e9 * at))
        sent.append(time.monotonic_ns())
        client.predict(samples.q[row], samples.dq[row], samples.ddq[row], std=False, tau=samples.tau[row])
        if client.learnt is not before:
            acks.append(_frames_ack(before, client.learnt, sent))
            before = client.learnt
    if client.flush() is not before:
        acks.append(_frames_ack(before, client.learnt, sent))
    if client.refusals:
        raise BadAnswerError(f"frames were not logged: {client.refusals[0].message}")
    return acks


def _frames_ack(before: StreamLearnt, now: StreamLearnt, sent: Sequence[int]) -> Ack:
    rejected = {code: count - before.rejected.get(code, 0) for code, count in now.rejected.items()}
    rows, accepted = now.through - before.through, now.accepted - before.accepted
    duplicate = now.duplicates > before.duplicates
    at = time.monotonic_ns()
    return Ack(now.through, sent[now.through - 1], at, rows, accepted, now.revision, duplicate, rejected)


def _sleep_until(at: int) -> None:
    """Sleep until a moment of `time.monotonic_ns`."""
    left = at - time.monotonic_ns()
    if left > 0:
        time.sleep(left / 1e9)
