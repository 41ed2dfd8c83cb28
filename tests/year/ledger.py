"""What a service has acknowledged over its whole life, and comparisons with its home and its metrics."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from prometheus_client.parser import text_string_to_metric_families

from service.journal.log import decode
from tests.system.faults.ledger import query_rows

DAY_S = 86400.0
SLACK_S = 2 * DAY_S
"""Tolerance for the age of batches: host clocks are set by up to a day."""
ROWS = "lipserve_observations_total"
_ROUTES = (
    (re.compile(r"(/models)/[^/:]+"), r"\1/{model}"),
    (re.compile(r"(/aliases)/[^/]+"), r"\1/{alias}"),
    (re.compile(r"(/versions)/[^/]+"), r"\1/{version}"),
    (re.compile(r"(/observations)/[^/]+/\d+"), r"\1/{stream_id}/{sequence}"),
    (re.compile(r"(/jobs)/[^/]+"), r"\1/{job}"),
    (re.compile(r"(/datasets)/[^/]+"), r"\1/{dataset}"),
)
BATCHES = "SELECT model, stream_id, sequence, number, rows, void, received FROM events WHERE kind = 'batch'"


@dataclass
class AcknowledgedBatch:
    """A batch as acknowledged. at: its arrival by the right time, Unix s. torque: sum of its torques, N·m, if known."""

    rows: int
    at: float
    torque: float | None
    void: bool = False


Key = tuple[str, str, int]
"""Model, stream and sequence of a batch."""


@dataclass
class Ledger:
    """Acknowledged batches, and the counters that the service must report.

    life: counters since the last start of the service. rows, requests: numbers of acknowledged rows and of answered
    requests.
    """

    batches: dict[Key, AcknowledgedBatch] = field(default_factory=dict)
    life: Counter[tuple[str, ...]] = field(default_factory=Counter)
    rows: int = 0
    requests: int = 0

    def note_answer(self, answer: httpx.Response) -> None:
        """Count an answer to a request of /v1."""
        self.requests += 1
        route = answer.request.url.path
        if not route.startswith("/v1"):
            return
        for pattern, replacement in _ROUTES:
            route = pattern.sub(replacement, route)
        method = answer.request.method
        self.life["lipserve_requests_total", method, route, str(answer.status_code)] += 1
        if answer.status_code >= 400:
            answer.read()
            self.life["lipserve_errors_total", answer.json()["error"]["code"], route] += 1

    def note_batch(self, model: str, body: dict[str, Any], reply: dict[str, Any], now: float) -> None:
        """Record an acknowledged batch."""
        key = model, reply["stream_id"], reply["sequence"]
        assert reply["rows"] == len(body["q"])
        if reply["derived"] is None:  # derived accelerations complete rows of the batch before
            assert reply["rows"] == reply["accepted"] + sum(reply["rejected"].values()), reply
        torque = float(np.array(body["tau"]).sum())
        if key not in self.batches:
            self.batches[key] = AcknowledgedBatch(reply["rows"], now, torque)
            self.rows += reply["rows"]
        if not reply["duplicate"]:
            self._count_rows(model, reply)

    def note_frames(self, model: str, batch: dict[str, Any], now: float) -> None:
        """Record frames of a stream that were logged together."""
        self.batches[model, batch["stream_id"], batch["sequence"]] = AcknowledgedBatch(batch["rows"], now, None)
        self.rows += batch["rows"]
        self._count_rows(model, batch)

    def _count_rows(self, model: str, acknowledged: dict[str, Any]) -> None:
        self.life[ROWS, model, "learnt"] += acknowledged["accepted"]
        for code, count in acknowledged["rejected"].items():
            self.life[ROWS, model, code] += count

    def forget(self, model: str) -> None:
        """Remove the batches of a model that was deleted, and its counters, which /metrics no longer has."""
        self.batches = {key: batch for key, batch in self.batches.items() if key[0] != model}
        for key in [key for key in self.life if key[:2] == (ROWS, model)]:
            del self.life[key]

    def check_counters(self, text: str) -> None:
        """Compare the counters of /metrics with what the service has acknowledged since its start."""
        found: Counter[tuple[str, ...]] = Counter()
        for family in text_string_to_metric_families(text):
            for sample in family.samples:
                if sample.name in ("lipserve_requests_total", "lipserve_errors_total", ROWS):
                    labels = sample.labels
                    names = ("model", "outcome") if sample.name == ROWS else sorted(labels)
                    if labels.get("route", "/v1").startswith("/v1"):
                        found[sample.name, *(labels[name] for name in names)] += int(sample.value)
        assert +found == +self.life, (+(found - self.life), +(self.life - found))

    def check_home(self, home: Path, now: float, retention_s: float, max_bytes: int) -> int:
        """Check that the log has every acknowledged batch within the limits, once and whole; return their number.

        now: the right time, Unix s. The oldest batches of a model may be missing: those older than `retention_s`, or
        before younger ones of about `max_bytes`.
        """
        weighed = {model for (model,) in query_rows(home, "SELECT DISTINCT model FROM events WHERE kind = 'payload'")}
        logged = {(row[0], row[1], row[2]): row[3:] for row in query_rows(home, BATCHES)}
        sizes = dict(query_rows(home, "SELECT model, sum(length(payload)) FROM events GROUP BY model"))
        oldest: dict[str, float] = {}
        for key in self.batches.keys() & logged.keys():
            oldest[key[0]] = min(self.batches[key].at, oldest.get(key[0], math.inf))
        for key, batch in self.batches.items():
            row = logged.get(key)
            if row is None:
                is_full = sizes.get(key[0], 0) > 0.9 * max_bytes
                lost = f"batch {key} of {now - batch.at:.0f} s is lost"
                assert is_full or now - batch.at > retention_s - SLACK_S, lost
                assert batch.at <= oldest.get(key[0], math.inf), lost
            else:
                assert row[1] == batch.rows, f"batch {key} is not whole"
                # rows of a payload that was detected later are unlearnt without being asked
                assert bool(row[2]) == batch.void or (row[2] and key[0] in weighed), f"batch {key} is undone"
        unknown = {key for key in logged.keys() - self.batches.keys() if not key[1].startswith("robot-")}  # of 0.2.0
        assert unknown == set(), "batches were logged unasked"
        for model, first, last, count in query_rows(home, NUMBERS):
            assert count >= last - first + 1, f"the log of {model} has gaps"
        return len(logged.keys() & self.batches.keys())

    def check_rows(self, home: Path, keys: list[Key]) -> None:
        """Compare the logged torques of batches with those that were sent."""
        for key in keys:
            for payload, report in query_rows(home, PAYLOAD, *key):
                own = slice(*json.loads(report).get("own", (None,)))  # without rows of the batch before
                known = self.batches[key].torque
                assert known is None or float(decode(payload).tau[own].sum()) == known, key


PAYLOAD = (
    "SELECT payload, report FROM events WHERE model = ? AND stream_id = ? AND sequence = ? AND payload IS NOT NULL"
)
NUMBERS = """SELECT model, min(number), max(number), count(*) FROM events AS outer
WHERE kind != 'settings' OR number > (SELECT min(number) FROM events WHERE model = outer.model AND kind != 'settings')
GROUP BY model"""
