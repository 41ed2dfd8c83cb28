"""Throughput of acknowledgements and learning, and latency of answers meanwhile."""

from __future__ import annotations

import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks import processor
from benchmarks.clients import HttpClient
from benchmarks.online.asking import LoopFigures, LoopProcess
from benchmarks.online.bed import Bed
from benchmarks.online.sending import BATCH_ROWS, Ack, batch_requests, send_all, stream, stream_frames
from lipcore.data.samples import Array, Samples
from lipserve import StreamClient

STREAM = "bench"
PUSHED_ROWS = 500
"""Rows of a batch that is sent as fast as possible."""
_TIME_SCALE = 0.1
"""Factor on the times of such a stream; otherwise its rows would lie in the future."""


@dataclass(frozen=True)
class Flow:
    """Figures of a stream.

    Attributes:
        rows: rows sent.
        accepted: rows accepted for learning.
        rejected: rejected rows by code.
        acknowledged: `rows` per second until the last acknowledgement.
        learnt: `accepted` per second until answers contain all of them.
        ack: p50, p99 and maximum of the time of a request, ms.
        lag: the same of the time from an acknowledgement to the first answer with its batch, s; None without answers.
        learner: share of one core that the service's children used.
    """

    rows: int
    accepted: int
    rejected: dict[str, int]
    acknowledged: float
    learnt: float
    ack: tuple[float, float, float]
    lag: tuple[float, float, float] | None
    learner: float


def idle(bed: Bed, model: str, motions: Array, seconds: float) -> LoopFigures:
    """Run the loop without learning."""
    with LoopProcess(bed.tcp, model, motions) as loop:
        time.sleep(seconds)
        return loop.finish()


def live(bed: Bed, model: str, samples: Samples, motions: Array, websocket: bool = False) -> tuple[LoopFigures, Flow]:
    """Run the loop while a stream is learnt in real time; websocket: the stream is sent in frames, one a row."""
    period = BATCH_ROWS * float(samples.t[1] - samples.t[0])
    requests = [] if websocket else batch_requests(model, STREAM, samples)
    with LoopProcess(bed.tcp, model, motions) as loop:
        began, used = time.monotonic(), processor.seconds_below(bed.pid)
        if websocket:
            with StreamClient(model, bed.client.url, stream_id=STREAM) as frames:
                acks = stream_frames(frames, samples)
        else:
            with HttpClient(bed.tcp) as client:
                acks = stream(client, requests, period)
        share = (processor.seconds_below(bed.pid) - used) / (time.monotonic() - began)
        learnt = bed.wait_learnt(model, motions[0], max(ack.revision for ack in acks))
        figures = loop.finish()
    # the rows of the first batch were measured in the period before it was sent
    start = acks[0].sent - round(1e9 * period)
    return figures, _flow(acks, start, learnt, share, lags(acks, figures.revisions))


def burst(bed: Bed, model: str, samples: Samples, motions: Array) -> tuple[LoopFigures, Flow]:
    """Run the loop while a stream is sent as fast as the service acknowledges it."""
    requests = batch_requests(model, STREAM, samples, _TIME_SCALE, PUSHED_ROWS)
    with LoopProcess(bed.tcp, model, motions) as loop, HttpClient(bed.tcp) as client:
        began, used = time.monotonic(), processor.seconds_below(bed.pid)
        acks = send_all(client, requests)
        learnt = bed.wait_learnt(model, motions[0], max(ack.revision for ack in acks))
        share = (processor.seconds_below(bed.pid) - used) / (time.monotonic() - began)
        figures = loop.finish()
    return figures, _flow(acks, acks[0].sent, learnt, share, lags(acks, figures.revisions))


def lags(acks: Sequence[Ack], revisions: Sequence[tuple[int, int]]) -> list[float]:
    """Return seconds from each acknowledgement to the first answer with the batch.

    `revisions` holds time (ns) and number of each revision's first answer, in order. Batches without accepted rows, and
    batches in no answer, are omitted.
    """
    numbers, found = [revision for _, revision in revisions], []
    for ack in acks:
        place = bisect_left(numbers, ack.revision)
        if ack.accepted and place < len(revisions):
            found.append(max(0, revisions[place][0] - ack.acked) / 1e9)
    return found


def _flow(acks: Sequence[Ack], start: int, learnt: int, share: float, waited: Sequence[float]) -> Flow:
    rejected = sum((Counter(ack.rejected) for ack in acks), Counter[str]())
    rows, accepted = sum(ack.rows for ack in acks), sum(ack.accepted for ack in acks)
    return Flow(
        rows,
        accepted,
        dict(rejected),
        rows / ((acks[-1].acked - start) / 1e9),
        accepted / ((learnt - start) / 1e9),
        _summary([1e3 * ack.seconds for ack in acks]),
        _summary(waited) if waited else None,
        share,
    )


def _summary(values: Sequence[float]) -> tuple[float, float, float]:
    p50, p99 = (float(value) for value in np.percentile(values, (50, 99)))
    return p50, p99, float(max(values))
