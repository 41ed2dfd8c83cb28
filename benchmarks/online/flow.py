"""How fast rows are acknowledged and learnt, and what that does to who asks meanwhile."""

from __future__ import annotations

import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks import processor
from benchmarks.clients import HttpClient
from benchmarks.online.asking import Asked, Asker
from benchmarks.online.bed import Bed
from benchmarks.online.sending import BATCH_ROWS, Ack, batch_requests, send_all, stream, stream_frames
from lipcore.data.samples import Array, Samples
from lipserve import StreamClient

STREAM = "bench"
PUSHED_ROWS = 500
"""Rows of a batch of a stream that is pushed."""
_COMPRESSED = 0.1
"""Of the time of a stream that is sent faster than it ran: otherwise its rows would come from the future."""


@dataclass(frozen=True)
class Flow:
    """What became of a stream.

    rows, accepted: that came, and that teach; rejected: by code; acknowledged, learnt: rows a second, of `rows` and of
    `accepted`, over the time until the last acknowledgement, and until answers contained them all; ack: p50, p99 and
    largest time of a request, ms; lag: the same from an acknowledgement to the first answer that contains its batch, s,
    None where nobody asked; learner: share of one core that the service's children had.
    """

    rows: int
    accepted: int
    rejected: dict[str, int]
    acknowledged: float
    learnt: float
    ack: tuple[float, float, float]
    lag: tuple[float, float, float] | None
    learner: float


def idle(bed: Bed, model: str, motions: Array, seconds: float) -> Asked:
    """Ask while nobody teaches."""
    with Asker(bed.tcp, model, motions) as asker:
        time.sleep(seconds)
        return asker.finish()


def live(bed: Bed, model: str, samples: Samples, motions: Array, websocket: bool = False) -> tuple[Asked, Flow]:
    """Ask while a stream is learnt in real time. websocket: it comes in frames, one a row, instead of in batches."""
    period = BATCH_ROWS * float(samples.t[1] - samples.t[0])
    requests = [] if websocket else batch_requests(model, STREAM, samples)
    with Asker(bed.tcp, model, motions) as asker:
        began, used = time.monotonic(), processor.seconds_below(bed.pid)
        if websocket:
            with StreamClient(model, bed.client.url, stream_id=STREAM) as frames:
                acks = stream_frames(frames, samples)
        else:
            with HttpClient(bed.tcp) as client:
                acks = stream(client, requests, period)
        share = (processor.seconds_below(bed.pid) - used) / (time.monotonic() - began)
        learnt = bed.wait_learnt(model, motions[0], max(ack.revision for ack in acks))
        asked = asker.finish()
    # the rows of the first batch had been measured in the period before it was sent
    start = acks[0].sent - round(1e9 * period)
    return asked, _flow(acks, start, learnt, share, lags(acks, asked.revisions))


def burst(bed: Bed, model: str, samples: Samples, motions: Array) -> tuple[Asked, Flow]:
    """Ask while a stream is taught as fast as the service acknowledges."""
    requests = batch_requests(model, STREAM, samples, _COMPRESSED, PUSHED_ROWS)
    with Asker(bed.tcp, model, motions) as asker, HttpClient(bed.tcp) as client:
        began, used = time.monotonic(), processor.seconds_below(bed.pid)
        acks = send_all(client, requests)
        learnt = bed.wait_learnt(model, motions[0], max(ack.revision for ack in acks))
        share = (processor.seconds_below(bed.pid) - used) / (time.monotonic() - began)
        asked = asker.finish()
    return asked, _flow(acks, acks[0].sent, learnt, share, lags(acks, asked.revisions))


def lags(acks: Sequence[Ack], revisions: Sequence[tuple[int, int]]) -> list[float]:
    """Seconds from each acknowledgement to the first answer that contains the batch; of batches that teach anything.

    revisions: when (ns) each revision was first seen, in order. Batches that no answer contained are left out.
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
