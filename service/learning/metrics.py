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
from service.web.observability.meters import MetricKind

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
PAYLOAD = MetricKind(
    "gauge",
    "lipserve_payload_mass_kg",
    "Mass that a stream's arm carries beyond what the model was trained with, 0 where that is nothing",
    ("model", "stream"),
)
PAYLOAD_STD = MetricKind(
    "gauge", "lipserve_payload_mass_std_kg", "Standard deviation of that mass, 0 for nothing", ("model", "stream")
)
LAG = MetricKind(
    "gauge", "lipserve_learning_lag_events", "Events of the log that answers do not contain yet", ("model",)
)
ROWS = MetricKind(
    "counter",
    "lipserve_observations_total",
    "Rows of observations since the service has started, by what became of them",
    ("model", "outcome"),
)
LOADED = MetricKind("gauge", "lipserve_models_loaded", "Model versions in memory")
KINDS = (*QUALITY.values(), REVISION, NOVEL, SCALE, PAYLOAD, PAYLOAD_STD, LAG, ROWS, LOADED)


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
        revision, novel, scale, lag, rows = (kind.family() for kind in (REVISION, NOVEL, SCALE, LAG, ROWS))
        payload, payload_std = PAYLOAD.family(), PAYLOAD_STD.family()
        for model, monitor in self._learners.watched().items():
            _add_quality(gauges, model, monitor)
            for outcome in CODES:
                rows.add_metric([model, outcome], monitor.counts[outcome])
            if (served := self._learners.loaded.peek(model)) is None:
                continue
            for joint, factor in zip(served.model.joint_names, served.scales.asked, strict=True):
                scale.add_metric([model, joint], factor)
            for stream_id, mass in served.loads.masses().items():
                for family, value in zip((payload, payload_std), mass or (0.0, 0.0), strict=True):
                    family.add_metric([model, stream_id], value)
            revision.add_metric([model, str(served.version)], served.revision)
            with self._learners.database.session() as session:
                behind = status.current(session, model, served.version) - served.revision
            lag.add_metric([model], max(behind, 0))
            if (share := self._learners.status(model, served.version).novel_share) is not None:
                novel.add_metric([model], share)
        yield from (*gauges.values(), revision, novel, scale, payload, payload_std, lag, rows)
        yield LOADED.of([((), len(self._learners.loaded.versions()))])


def _add_quality(gauges: dict[str, GaugeMetricFamily], model: str, monitor: Monitor) -> None:
    now = time.time()
    for window in monitor.windows:
        figures = status.window(window, now)
        for name, gauge in gauges.items():
            for joint, value in zip(monitor.joint_names, getattr(figures, name), strict=True):
                if value is not None:
                    gauge.add_metric([model, joint, f"{figures.seconds:g}"], value)
