"""What a metric is: one description makes its families for Prometheus and its line in the documentation."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric

from service.web.observability.meters import Durations

_FAMILIES: dict[str, Any] = {
    "counter": CounterMetricFamily,
    "gauge": GaugeMetricFamily,
    "histogram": HistogramMetricFamily,
}


@dataclass(frozen=True)
class MetricKind:
    """A metric that /metrics shows. name: as in queries, a counter's with `_total`; said: what it is, with its unit."""

    kind: Literal["counter", "gauge", "histogram"]
    name: str
    said: str
    labels: tuple[str, ...] = ()

    def family(self) -> Any:
        """An empty family, to which samples are added."""
        return _FAMILIES[self.kind](self.name, self.said, labels=self.labels)

    def of(self, samples: Iterable[tuple[Sequence[str], float]]) -> Metric:
        """The family of these samples, each the values of its labels and a number."""
        family: Metric = self.family()
        for labels, value in samples:
            family.add_metric(labels, value)  # type: ignore[attr-defined]  # of every kind that `family` makes
        return family

    def spread(self, samples: Iterable[tuple[Sequence[str], Durations]]) -> Metric:
        """The family of these histograms, each the values of its labels and durations."""
        family: Metric = self.family()
        for labels, durations in samples:
            buckets = list(_buckets(durations))
            family.add_metric(labels, buckets, durations.total)  # type: ignore[attr-defined]
        return family


def merged(parts: Iterable[Durations]) -> Durations:
    """All durations of several meters together."""
    found = Durations()
    for part in parts:
        found.counts = [ours + theirs for ours, theirs in zip(found.counts, part.counts, strict=True)]
        found.total += part.total
    return found


def _buckets(durations: Durations) -> Iterator[tuple[str, float]]:
    """Upper bounds and how many lie below them, as Prometheus has histograms."""
    below = 0
    for bound, count in zip((*map(str, durations.bounds), "+Inf"), durations.counts, strict=True):
        below += count
        yield bound, below
