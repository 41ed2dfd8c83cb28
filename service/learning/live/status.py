"""The status in the live feed of a model, once a second."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from lipcore.vocabulary import CODES
from service.contract.live import LiveAnswers, LiveNovelty, LiveStatus
from service.journal import log
from service.learning import owner
from service.learning.control import decisions, payload, status
from service.learning.learners import Learners
from service.models import registry
from service.models.served import ServedModel
from service.storage.rows import Page
from service.telemetry.meters import OTHER, Durations, Meters, StreamTotals

MAX_ALARMS = 5
"""Newest alarms in a status."""
COUNTS = (*CODES, "batches", "duplicates")
"""Names of the monitor's counts in a status."""


class StatusReader:
    """Reads the status of one model. Blocking: use it in a thread."""

    def __init__(self, learners: Learners, meters: Meters, model: str) -> None:
        self.learners, self.model = learners, model
        self._answers = AnswerCounter(meters, model)
        self._manifest: tuple[int, Mapping[str, Any]] | None = None

    def __call__(self, novel: list[LiveNovelty], passed: float | None) -> LiveStatus:
        """Return the status; raise NotFoundError if the model was deleted. passed: seconds since the last status."""
        learners, model = self.learners, self.model
        served, now = learners.loaded.get(model, None), time.time()
        monitor, latest = learners.monitor(model), learners.status(model, served.version)
        lag = learners.lag(served)
        with learners.database.session() as session:
            events = log.newest(session, model) - log.start_of(session, model, served.version)
            options, held = owner.read_options(session, model), owner.read_pause(session, model)
        return LiveStatus(
            model=model,
            at=now,
            version=served.version,
            revision=served.revision,
            lag_events=max(events - served.revision, 0),
            lag_rows=lag.rows,
            lag_s=lag.seconds,
            joint_names=list(served.model.joint_names),
            joint_types=list(served.model.joint_types),
            torque_convention=served.model.torque_convention,
            learns=options.enabled,
            on_change=options.on_change,
            contact_threshold=options.contact_threshold,
            held=held,
            failure=latest.failure,
            novel_share=latest.novel_share,
            novel=novel,
            counts={name: monitor.counts[name] for name in COUNTS},
            windows=[status.summarise_window(each, now) for each in monitor.windows],
            scale=served.scales.default_factors,
            verdict=status.judge_lately(learners, served, self._read_manifest(served), now),
            payloads=payload.summarise_payloads(monitor, served),
            answers=self._answers.since(passed),
            alarms=decisions.alarms(learners, model, Page(after=None, limit=MAX_ALARMS)).items,
        )

    def _read_manifest(self, served: ServedModel) -> Mapping[str, Any]:
        """Return the manifest of the serving version, which is read once."""
        if self._manifest is None or self._manifest[0] != served.version:
            row = registry.find(self.learners.database, served.name, served.version)
            self._manifest = served.version, row.manifest
        return self._manifest[1]


class AnswerCounter:
    """Counts the answers of a model's streams between two statuses."""

    def __init__(self, meters: Meters, model: str) -> None:
        self._meters, self._model = meters, model
        self._before: tuple[list[int], int, int] | None = None

    def since(self, passed: float | None) -> LiveAnswers | None:
        """Return the answers since the last call, `passed` seconds ago; None at the first call."""
        # only read, because meters belong to the event loop
        meter = self._meters.streams().get(self._model)
        if meter is None and OTHER in self._meters.streams():
            return None
        meter = meter or StreamTotals(Durations(), 0, {})
        bounds, now = meter.durations.bounds, (list(meter.durations.counts), sum(meter.refused.values()), meter.late)
        before, self._before = self._before, now
        if before is None or passed is None:
            return None
        counts = [late - early for late, early in zip(now[0], before[0], strict=True)]
        return LiveAnswers(
            seconds=round(passed, 3),
            count=sum(counts),
            refused=now[1] - before[1],
            late=now[2] - before[2],
            p50_at_most_s=find_quantile_bound(counts, bounds, 0.5),
            p99_at_most_s=find_quantile_bound(counts, bounds, 0.99),
        )


def find_quantile_bound(counts: list[int], bounds: tuple[float, ...], share: float) -> float | None:
    """Return the smallest bound with this share of the counts below it; None if there is none.

    counts: one number for each bucket.
    """
    total, below = sum(counts), 0
    if not total:
        return None
    for count, bound in zip(counts, bounds, strict=False):  # the last bucket has no bound
        below += count
        if below >= share * total:
            return bound
    return None
