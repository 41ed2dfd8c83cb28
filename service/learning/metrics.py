"""Metrics of the models that learn. They are computed at each scrape and not stored."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any

from prometheus_client.core import Metric
from prometheus_client.registry import Collector

from lipcore.vocabulary import CODES
from service.learning.control import status
from service.learning.ingest.monitor import Monitor
from service.learning.learners import Learners
from service.telemetry.meters import MetricKind, list_metrics


def _quality(figure: str, meaning: str) -> MetricKind:
    return MetricKind("gauge", f"lipserve_quality_{figure}", meaning, ("model", "joint", "window"))


class LearningCollector(Collector):
    """The metrics of all models of one service that learn. Blocking: use it in a thread."""

    nmse = _quality(
        "nmse", "Mean squared error / variance of the measured torque; every row is predicted before it is learnt"
    )
    coverage = _quality("coverage", "Share of measurements inside the 95 % interval, noise included")
    nlpd = _quality("nlpd", "Mean negative log predictive density, nats")
    revision = MetricKind("gauge", "lipserve_revision", "Revision that predictions contain", ("model", "version"))
    novel = MetricKind(
        "gauge",
        "lipserve_novel_share",
        "Share of the latest samples that the model's basis does not represent",
        ("model",),
    )
    scale = MetricKind(
        "gauge",
        "lipserve_interval_scale",
        "Factor on the half width of returned intervals; 1: as the model predicts",
        ("model", "joint"),
    )
    streams = MetricKind("gauge", "lipserve_streams", "Streams of the model", ("model",))
    carrying = MetricKind("gauge", "lipserve_streams_with_payload", "Streams that carry a payload", ("model",))
    lag_rows = MetricKind(
        "gauge", "lipserve_learning_lag_rows", "Rows to be learnt that predictions do not contain yet", ("model",)
    )
    lag_s = MetricKind(
        "gauge",
        "lipserve_learning_lag_seconds",
        "Time since the arrival of the first row that predictions do not contain yet, s",
        ("model",),
    )
    rows = MetricKind(
        "counter",
        "lipserve_observations_total",
        "Observation rows since the start of the service, by outcome",
        ("model", "outcome"),
    )
    loaded = MetricKind("gauge", "lipserve_models_loaded", "Model versions in memory")

    def __init__(self, learners: Learners) -> None:
        self._learners = learners

    def describe(self) -> list[Metric]:
        """Return nothing: the metrics depend on the models."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield every metric with a sample for each model."""
        families = {kind: kind.family() for kind in list_metrics(LearningCollector)}
        for model, monitor in self._learners.load_monitors().items():
            self._add_quality(families, model, monitor)
            for outcome in CODES:
                families[self.rows].add_metric([model, outcome], monitor.counts[outcome])
            if (served := self._learners.loaded.peek(model)) is None:
                continue
            for joint, factor in zip(served.model.joint_names, served.scales.default_factors, strict=True):
                families[self.scale].add_metric([model, joint], factor)
            known = served.payloads.masses()
            families[self.streams].add_metric([model], len(monitor.streams.all()))
            families[self.carrying].add_metric([model], sum(mass is not None for mass in known.values()))
            families[self.revision].add_metric([model, str(served.version)], served.revision)
            lag = self._learners.lag(served)
            families[self.lag_rows].add_metric([model], lag.rows)
            families[self.lag_s].add_metric([model], lag.seconds)
            if (share := self._learners.status(model, served.version).novel_share) is not None:
                families[self.novel].add_metric([model], share)
        families[self.loaded].add_metric([], len(self._learners.loaded.versions()))
        yield from families.values()

    def _add_quality(self, families: Mapping[MetricKind, Any], model: str, monitor: Monitor) -> None:
        now = time.time()
        for window in monitor.windows:
            figures = status.summarise_window(window, now)
            by_figure = {self.nmse: figures.nmse, self.coverage: figures.coverage, self.nlpd: figures.nlpd}
            for kind, values in by_figure.items():
                for joint, value in zip(monitor.joint_names, values, strict=True):
                    if value is not None:
                        families[kind].add_metric([model, joint, f"{figures.seconds:g}"], value)
