"""What monitoring reads at /metrics, in the format of Prometheus: computed when it is asked for, and kept nowhere."""

from __future__ import annotations

import time
from collections.abc import Iterator

from fastapi import APIRouter, Request, Response
from fastapi.responses import PlainTextResponse
from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector
from sqlalchemy import select

from lipcore.online.batch import CODES
from service.context import Service, ServiceDep
from service.database import StreamRow
from service.inference.loaded import Served
from service.updates.control import revisions
from service.updates.control.status import novel_share
from service.updates.quality import summary
from service.updates.quality.monitor import Monitor

FIGURES = {
    "nmse": "Mean squared error / variance of the measured torque; every row is predicted before it is learnt",
    "coverage": "Share of measurements inside the 95 % interval, noise included",
    "nlpd": "Mean negative log predictive density, nats",
}
EXAMPLE = """# HELP lipserve_quality_coverage Share of measurements inside the 95 % interval, noise included
# TYPE lipserve_quality_coverage gauge
lipserve_quality_coverage{joint="panda_joint1",model="panda-sim",window="60"} 0.953
# HELP lipserve_observations_total Rows of observations since the service has started, by what became of them
# TYPE lipserve_observations_total counter
lipserve_observations_total{model="panda-sim",outcome="learnt"} 12000.0
lipserve_observations_total{model="panda-sim",outcome="contact"} 34.0
"""

router = APIRouter(tags=["health"])


@router.get(
    "/metrics",
    summary="Metrics for Prometheus",
    response_class=PlainTextResponse,
    responses={
        200: {
            "description": "Text of Prometheus, or OpenMetrics where that is accepted",
            "content": {"text/plain": {"example": EXAMPLE}},
        }
    },
)
def metrics(request: Request, service: ServiceDep) -> Response:
    """Quality, revision, lag and counts of every model that has got observations."""
    registry = CollectorRegistry()
    registry.register(Learning(service))
    encode, media_type = choose_encoder(request.headers.get("accept", ""))
    return Response(encode(registry), media_type=media_type)


class Learning(Collector):
    """The figures of all models of one service that learn. Not for the event loop."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def describe(self) -> list[Metric]:
        """Nothing: what there is depends on the models."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield every metric with a sample for each model."""
        gauges = {
            name: GaugeMetricFamily(f"lipserve_quality_{name}", said, labels=["model", "joint", "window"])
            for name, said in FIGURES.items()
        }
        revision = GaugeMetricFamily("lipserve_revision", "Revision that answers contain", labels=["model", "version"])
        novel = GaugeMetricFamily(
            "lipserve_novel_share", "Share of the latest samples that lie beyond the basis", labels=["model"]
        )
        lag = GaugeMetricFamily(
            "lipserve_learning_lag_events", "Events of the log that answers do not contain yet", labels=["model"]
        )
        rows = CounterMetricFamily(
            "lipserve_observations",
            "Rows of observations since the service has started, by what became of them",
            labels=["model", "outcome"],
        )
        for model, monitor in self._monitors().items():
            _add_quality(gauges, model, monitor)
            for outcome in CODES:
                rows.add_metric([model, outcome], monitor.counts[outcome])
            if (served := self._service.loaded.hot(model, None)) is None:
                continue
            revision.add_metric([model, str(served.version)], served.revision)
            lag.add_metric([model], self._lag(served))
            share = novel_share(self._service.updates.status(model, served.version))
            if share is not None:
                novel.add_metric([model], share)
        yield from (*gauges.values(), revision, novel, lag, rows)

    def _monitors(self) -> dict[str, Monitor]:
        """Monitors by model: those there are, and of models in memory that have got observations before the start.

        No model is loaded for it, which would drop another one.
        """
        updates, loaded = self._service.updates, self._service.loaded
        with self._service.database.session() as session:
            learning = list(session.scalars(select(StreamRow.model).distinct()))
        fresh = {model: updates.monitor(model) for model in learning if loaded.hot(model, None) is not None}
        return dict(sorted((updates.monitors() | fresh).items()))

    def _lag(self, served: Served) -> int:
        with self._service.database.session() as session:
            return max(revisions.current(session, served.name, served.version) - served.revision, 0)


def _add_quality(gauges: dict[str, GaugeMetricFamily], model: str, monitor: Monitor) -> None:
    now = time.time()
    for window in monitor.windows:
        seen = summary.window(window, now)
        for name, gauge in gauges.items():
            for joint, value in zip(monitor.joint_names, getattr(seen, name), strict=True):
                if value is not None:
                    gauge.add_metric([model, joint, f"{seen.seconds:g}"], value)
