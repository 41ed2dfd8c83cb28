"""A client that streams observation batches and collects their acknowledgements."""

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
_LEAD_NS = 50_000_000
"""Time before a paced stream begins."""


@dataclass(frozen=True)
class Ack:
    """An acknowledged batch; sent, acked: `time.monotonic_ns`; revision: the first that contains it."""

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
        """Time from the request to the acknowledgement."""
        return (self.acked - self.sent) / 1e9


class _Answer(msgspec.Struct):
    """Fields of an acknowledgement."""

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
    """Return one batch as an HTTP request; `time_scale` multiplies its times."""
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
    """Return requests of `rows` samples each (None: BATCH_ROWS), with sequences from 0."""
    rows = rows or BATCH_ROWS
    parts = (samples.rows(slice(start, start + rows)) for start in range(0, len(samples), rows))
    return [batch_request(model, stream_id, number, part, time_scale) for number, part in enumerate(parts)]


def send(client: HttpClient, request: bytes) -> Ack:
    """Send a batch and wait for its acknowledgement; raise BadAnswerError if it is refused."""
    sent = time.monotonic_ns()
    answer = client.ask(request)
    acked = time.monotonic_ns()
    ack = _decoder.decode(answer)
    return Ack(ack.sequence, sent, acked, ack.rows, ack.accepted, ack.revision, ack.duplicate, ack.rejected)


def send_all(client: HttpClient, requests: Sequence[bytes]) -> list[Ack]:
    """Send batches one after the other, without pauses."""
    return [send(client, request) for request in requests]


def stream(
    client: HttpClient, requests: Sequence[bytes], period: float, after: Mapping[int, Callable[[], None]] | None = None
) -> list[Ack]:
    """Send a batch every `period` seconds; a late batch does not delay the following ticks.

    `after` holds functions to call after this number of acknowledgements.
    """
    acks, first = [], time.monotonic_ns() + _LEAD_NS
    for number, request in enumerate(requests, start=1):
        _sleep_until(first + number * round(1e9 * period))
        acks.append(send(client, request))
        if after and number in after:
            after[number]()
    return acks


def stream_frames(client: StreamClient, samples: Samples) -> list[Ack]:
    """Send every row as a frame at the time of its measurement, with a query; collect acknowledgements.

    An acknowledgement covers all frames since the previous one; its `sent` is that of the newest frame.
    """
    acks: list[Ack] = []
    sent: list[int] = []
    before, first = client.learnt, time.monotonic_ns() + _LEAD_NS
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
        raise BadAnswerError(f"The service refused frames: {client.refusals[0].message}")
    return acks


def _frames_ack(before: StreamLearnt, now: StreamLearnt, sent: Sequence[int]) -> Ack:
    rejected = {code: count - before.rejected.get(code, 0) for code, count in now.rejected.items()}
    rows, accepted = now.through - before.through, now.accepted - before.accepted
    duplicate = now.duplicates > before.duplicates
    at = time.monotonic_ns()
    return Ack(now.through, sent[now.through - 1], at, rows, accepted, now.revision, duplicate, rejected)


def _sleep_until(at: int) -> None:
    """Sleep until a time of `time.monotonic_ns`."""
    left = at - time.monotonic_ns()
    if left > 0:
        time.sleep(left / 1e9)
