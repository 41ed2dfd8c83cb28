"""Metrics of training jobs: read from their rows when they are asked for, so that they outlive the service."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime

from prometheus_client.core import Metric
from prometheus_client.registry import Collector
from sqlalchemy import func, select

from service.foundation.states import ACTIVE, CANCELLED, FAILED, SUCCEEDED
from service.storage.database import Database, JobRow
from service.web.observability.meters import Durations
from service.web.observability.metric import MetricKind

JOBS = MetricKind("gauge", "lipserve_jobs", "Training jobs that wait or run now", ("state",))
FINISHED = MetricKind("counter", "lipserve_jobs_finished_total", "Training jobs that have ended, ever", ("outcome",))
DURATION = MetricKind(
    "histogram",
    "lipserve_job_duration_seconds",
    "Time from the last start of a training job to its end, s; of all jobs ever",
    ("outcome",),
)
KINDS = (JOBS, FINISHED, DURATION)
BOUNDS = (1.0, 3.0, 10.0, 30.0, 60.0, 180.0, 600.0, 1800.0, 3600.0, 10_800.0, 36_000.0)
OUTCOMES = (SUCCEEDED, FAILED, CANCELLED)


class Work(Collector):
    """Training jobs of one service. Not for the event loop."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def describe(self) -> list[Metric]:
        """Nothing: the rows say what there is."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield every metric."""
        with self._database.session() as session:
            counts = session.execute(select(JobRow.state, func.count()).group_by(JobRow.state))
            states = dict(counts.all())
            ended = select(JobRow.state, JobRow.started_at, JobRow.finished_at).where(JobRow.state.in_(OUTCOMES))
            durations = {outcome: Durations(BOUNDS) for outcome in OUTCOMES}
            for outcome, started, finished in session.execute(ended):
                if started is not None and finished is not None:
                    lasted = datetime.fromisoformat(finished) - datetime.fromisoformat(started)
                    durations[outcome].add(max(lasted.total_seconds(), 0.0))  # clocks are set back at times
        yield JOBS.of(([state], states.get(state, 0)) for state in ACTIVE)
        yield FINISHED.of(([outcome], states.get(outcome, 0)) for outcome in OUTCOMES)
        yield DURATION.spread(([outcome], durations[outcome]) for outcome in OUTCOMES)
