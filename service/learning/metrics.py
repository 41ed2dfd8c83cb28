"""Metrics of models that learn: computed when they are asked for, and kept nowhere."""

from __future__ import annotations

import time
from collections.abc import Iterator

from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from lipcore.vocabulary import CODES
from service.learning.control import status
from service.learning.ingest.monitor import Monitor
from service.learning.learners import Learners
from service.telemetry.meters import MetricKind

FIGURES = {
    "nmse": "Mean squared error / variance of the measured torque; every row is predicted before it is learnt",
    "coverage": "Share of measurements inside the 95 % interval, noise included",
    "nlpd": "Mean negative log predictive density, nats",
}
QUALITY = {
    name: MetricKind("gauge", f"lipserve_quality_{name}", text, ("model", "joint", "window"))
    for name, text in FIGURES.items()
}
REVISION = MetricKind("gauge", "lipserve_revision", "Revision that answers contain", ("model", "version"))
NOVEL = MetricKind("gauge", "lipserve_novel_share", "Share of the latest samples that lie beyond the basis", ("model",))
SCALE = MetricKind(
    "gauge",
    "lipserve_interval_scale",
    "Factor on the half width of intervals that questions are answered with, 1 as the model itself believes",
    ("model", "joint"),
)
STREAMS = MetricKind("gauge", "lipserve_streams", "Streams that are known", ("model",))
CARRYING = MetricKind("gauge", "lipserve_streams_with_payload", "Streams of them that carry a payload", ("model",))
LAG_ROWS = MetricKind(
    "gauge", "lipserve_learning_lag_rows", "Rows to be learnt that answers do not contain yet", ("model",)
)
LAG_S = MetricKind(
    "gauge",
    "lipserve_learning_lag_seconds",
    "Seconds since the first row arrived that answers do not contain yet",
    ("model",),
)
ROWS = MetricKind(
    "counter",
    "lipserve_observations_total",
    "Rows of observations since the service has started, by what became of them",
    ("model", "outcome"),
)
LOADED = MetricKind("gauge", "lipserve_models_loaded", "Model versions in memory")
KINDS = (*QUALITY.values(), REVISION, NOVEL, SCALE, STREAMS, CARRYING, LAG_ROWS, LAG_S, ROWS, LOADED)


class Learning(Collector):
    """The figures of all models of one service that learn. Not for the event loop."""

    def __init__(self, learners: Learners) -> None:
        self._learners = learners

    def describe(self) -> list[Metric]:
        """Nothing: what there is depends on the models."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield every metric with a sample for each model."""
        gauges = {name: kind.family() for name, kind in QUALITY.items()}
        revision, novel, scale, rows = (kind.family() for kind in (REVISION, NOVEL, SCALE, ROWS))
        streams, carrying, lag_rows, lag_s = (kind.family() for kind in (STREAMS, CARRYING, LAG_ROWS, LAG_S))
        for model, monitor in self._learners.watched().items():
            _add_quality(gauges, model, monitor)
            for outcome in CODES:
                rows.add_metric([model, outcome], monitor.counts[outcome])
            if (served := self._learners.loaded.peek(model)) is None:
                continue
            for joint, factor in zip(served.model.joint_names, served.scales.asked, strict=True):
                scale.add_metric([model, joint], factor)
            known = served.loads.masses()
            streams.add_metric([model], len(monitor.streams.all()))
            carrying.add_metric([model], sum(mass is not None for mass in known.values()))
            revision.add_metric([model, str(served.version)], served.revision)
            lag = self._learners.lag(served)
            lag_rows.add_metric([model], lag.rows)
            lag_s.add_metric([model], lag.seconds)
            if (share := self._learners.status(model, served.version).novel_share) is not None:
                novel.add_metric([model], share)
        yield from (*gauges.values(), revision, novel, scale, streams, carrying, lag_rows, lag_s, rows)
        yield LOADED.of([((), len(self._learners.loaded.versions()))])


def _add_quality(gauges: dict[str, GaugeMetricFamily], model: str, monitor: Monitor) -> None:
    now = time.time()
    for window in monitor.windows:
        figures = status.window(window, now)
        for name, gauge in gauges.items():
            for joint, value in zip(monitor.joint_names, getattr(figures, name), strict=True):
                if value is not None:
                    gauge.add_metric([model, joint, f"{figures.seconds:g}"], value)
