"""Metrics of training jobs, computed from their rows on each request, so that they survive restarts."""

from __future__ import annotations

from collections.abc import Iterator

from prometheus_client.core import Metric
from prometheus_client.registry import Collector
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.contract.states import ACTIVE, QUEUED, RUNNING, PartState
from service.foundation.text import counted
from service.storage.database import Database, JobRow
from service.telemetry.meters import MetricKind
from service.telemetry.readiness import FaultAge
from service.training.ended import count_jobs, read_durations
from service.training.queue import JobQueue

START_S = 60.0
"""Maximum time to start a job while a training process is free, s."""
SILENT_S = 10.0
"""Maximum time without a heartbeat from a healthy training process, s; the interval is half a second."""


class JobMetrics(Collector):
    """Metrics of the training jobs in the database. Blocking: use it in a thread."""

    jobs = MetricKind("gauge", "lipserve_jobs", "Training jobs that wait or run", ("state",))
    finished = MetricKind("counter", "lipserve_jobs_finished_total", "Training jobs that have ended", ("outcome",))
    duration = MetricKind(
        "histogram",
        "lipserve_job_duration_seconds",
        "Time from the last start of a training job to its end, s",
        ("outcome",),
    )

    def __init__(self, database: Database) -> None:
        self._database = database

    def describe(self) -> list[Metric]:
        """Return nothing: the metrics depend on the rows."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield every metric."""
        with self._database.moment() as session:  # jobs are deleted and tallied meanwhile
            states, finished, durations = _counts(session), count_jobs(session), read_durations(session)
        yield self.jobs.of(([state], states.get(state, 0)) for state in ACTIVE)
        yield self.finished.of(([outcome], count) for outcome, count in finished.items())
        yield self.duration.spread(([outcome], each) for outcome, each in durations.items())


def check_queue(queue: JobQueue, lasting: FaultAge) -> tuple[PartState, str]:
    """Return whether queued jobs are started, for readiness."""
    with queue.database.session() as session:
        counts = _counts(session)
    waiting, running = counts.get(QUEUED, 0), counts.get(RUNNING, 0)
    words = f"{counted(waiting, 'job')} waiting, {running} running"
    if (cluster := queue.cluster) is not None:  # serving does not need the cluster
        if cluster.problem is not None:
            return "warning", f"{cluster.problem}; {words}"
        none = waiting > 0 and cluster.jobs == 0
        return ("warning" if none else "ok"), f"{words}, the cluster runs up to {cluster.jobs} at a time"
    stuck = lasting(waiting > 0 and running < queue.settings.training_workers)
    if stuck is None or stuck <= START_S:
        silent_s = queue.silent_s
        if silent_s > SILENT_S:
            return "warning", f"{words}; a training process has made no progress for {silent_s:.0f} s"
        return "ok", words
    return "failed", f"{counted(waiting, 'job')} waiting and {running} running for {stuck:.0f} s: no job is started"


def _counts(session: Session) -> dict[str, int]:
    """Return the number of jobs by state."""
    return dict(session.execute(select(JobRow.state, func.count()).group_by(JobRow.state)).all())
