"""Comparison of acknowledged writes with those that the service has stored."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np

from benchmarks.clients import HttpClient
from benchmarks.online.bed import Bed
from benchmarks.online.scene import rows_of
from benchmarks.online.sending import batch_request, send
from benchmarks.soak.connections import BATCH_ROWS, TAUGHT, Log, stream_of
from lipcore.data.samples import Array, Samples
from lipcore.model.torque_model import TorqueModel
from lipcore.online.learner import OnlineModel
from lipserve import Client

_PAGE = 100


@dataclass
class Account:
    """Counts of writes.

    Attributes:
        batches: acknowledged observation batches.
        rows: accepted rows in them.
        datasets: acknowledged uploads.
        deleted: acknowledged deletions.
        unsure: writes without an answer, which may be stored.
        lost: acknowledged, but not stored.
        changed: stored with other content than acknowledged.
        surplus: stored, but neither acknowledged nor unsure.
        twice: batches that were learnt again when sent again.
        difference: relative difference of served torques from a model that learnt the same rows at once.
    """

    batches: int = 0
    rows: int = 0
    datasets: int = 0
    deleted: int = 0
    unsure: int = 0
    lost: int = 0
    changed: int = 0
    surplus: int = 0
    twice: int = 0
    difference: float = 0.0

    @classmethod
    def of(cls, logs: Sequence[Log]) -> Account:
        """Count the acknowledgements that the clients received."""
        acks = [ack for log in logs for ack in log.acks.values()]
        return cls(
            batches=len(acks),
            rows=sum(ack.accepted for ack in acks),
            datasets=sum(len(log.stored) for log in logs),
            deleted=sum(len(log.deleted) for log in logs),
            unsure=sum(log.unsure for log in logs) + sum(sum(log.errors.values()) for log in logs if log.acks),
        )


def check(account: Account, logs: Sequence[Log], client: Client) -> None:
    """Compare the acknowledgements with the service's lists; add the differences to the account."""
    _check_datasets(account, logs, client)
    _check_batches(account, logs, client)


def send_again(account: Account, logs: Sequence[Log], observed: dict[int, Samples], bed: Bed, every: int = 10) -> None:
    """Send every tenth acknowledged batch again; the service must answer that it is a duplicate."""
    with HttpClient(bed.tcp) as client:
        for number, log in _observing(logs).items():
            for sequence in sorted(log.acks)[::every]:
                rows = slice(sequence * BATCH_ROWS, (sequence + 1) * BATCH_ROWS)
                request = batch_request(TAUGHT, stream_of(number), sequence, observed[number].rows(rows))
                account.twice += not send(client, request).duplicate


def compare(
    account: Account, logs: Sequence[Log], observed: dict[int, Samples], base: TorqueModel, queries: Samples, bed: Bed
) -> None:
    """Wait until all rows are learnt; compare torques with those of a model that learnt them at once."""
    online, revision = OnlineModel.start(base), 0
    for number, log in _observing(logs).items():
        if log.acks:
            revision = max(revision, *(ack.revision for ack in log.acks.values()))
            sent = observed[number].rows(slice(0, BATCH_ROWS * (max(log.acks) + 1)))
            online = online.learn(rows_of(sent))
    motion = np.stack([queries.q[0], queries.dq[0], queries.ddq[0]])
    bed.wait_learnt(TAUGHT, motion, revision)
    served: Array = bed.predict(TAUGHT, queries)[0]
    expected = online.model().predict(queries.q, queries.dq, queries.ddq).tau
    account.difference = float(np.abs(served - expected).max() / np.abs(expected).max())


def _check_datasets(account: Account, logs: Sequence[Log], client: Client) -> None:
    with httpx.Client(base_url=client.url, timeout=60.0) as http:
        listed = {item["id"]: item for item in _pages(http, "/v1/datasets")}
    known: dict[str, dict[str, Any]] = {}
    gone: set[str] = set()
    for log in logs:
        known |= log.stored
        gone |= log.deleted
    for name, acknowledged in known.items():
        if name in gone:
            account.surplus += name in listed
        elif name not in listed:
            account.lost += 1
        else:
            found = {"sha256": listed[name]["sha256"], "rows": listed[name]["report"]["rows"]}
            account.changed += found != acknowledged
    unknown = len(listed.keys() - known.keys())
    account.surplus += max(0, unknown - sum(log.unsure for log in logs))


def _check_batches(account: Account, logs: Sequence[Log], client: Client) -> None:
    listed: Counter[tuple[str, int]] = Counter()
    accepted: dict[tuple[str, int], int] = {}
    with httpx.Client(base_url=client.url, timeout=60.0) as http:
        for item in _pages(http, f"/v1/models/{TAUGHT}/observations"):
            key = (item["stream_id"], item["sequence"])
            listed[key] += 1
            accepted[key] = item["accepted"]
    known = {
        (stream_of(number), sequence): ack
        for number, log in _observing(logs).items()
        for sequence, ack in log.acks.items()
    }
    account.lost += len(known.keys() - listed.keys())
    account.surplus += sum(count - 1 for count in listed.values())
    account.changed += sum(accepted[key] != ack.accepted for key, ack in known.items() if key in accepted)


def _pages(http: httpx.Client, path: str) -> list[dict[str, Any]]:
    """Return all items of a paginated list."""
    items: list[dict[str, Any]] = []
    params: dict[str, Any] = {"limit": _PAGE}
    while True:
        answer = http.get(path, params=params)
        answer.raise_for_status()
        body = answer.json()
        items += body["items"]
        if body["next_cursor"] is None:
            return items
        params["cursor"] = body["next_cursor"]


def _observing(logs: Sequence[Log]) -> dict[int, Log]:
    """Return the logs of the connections that send observations, by their number."""
    return dict(enumerate(log for log in logs if log.kind == "observe"))
