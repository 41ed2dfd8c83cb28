"""Figures that are counted while requests are answered, and what a metric is.

Plain numbers, changed by the event loop alone, not prometheus-client's own counters: their labels and locks cost 3 µs a
request and more, these a few tenths. A metric's description makes its families and its line in the documentation.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

BOUNDS = (
    *(0.000_05, 0.000_1, 0.000_25, 0.000_5, 0.001, 0.002, 0.005, 0.01, 0.025),
    *(0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0),
)
"""Upper bounds of durations, s: from a frame of a stream to a large upload."""
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "DELETE", "PATCH", "OPTIONS", "WEBSOCKET"})
OTHER = "other"
"""Stands for methods that there are not, and for models beyond those that are told apart."""
MAX_MODELS = 200
"""Models that metrics of requests and streams tell apart; the others are counted together."""


class Durations:
    """How long something took, each time it happened, as a histogram. bounds: upper ones of its buckets, s."""

    __slots__ = ("bounds", "counts", "total")

    def __init__(self, bounds: tuple[float, ...] = BOUNDS) -> None:
        self.bounds, self.counts = bounds, [0] * (len(bounds) + 1)
        self.total = 0.0

    def add(self, seconds: float) -> None:
        """Count one more."""
        self.counts[bisect_left(self.bounds, seconds)] += 1
        self.total += seconds


class Kind(NamedTuple):
    """What requests are told apart by. model: empty where there is none; code: of the error, empty where there is none.

    status: of the answer; 499 where the client went away before there was one.
    """

    method: str
    route: str
    model: str
    status: int
    code: str


class RequestMeter:
    """Requests that were answered, by kind, and how many are being answered.

    A kind is known by the plain tuple of its fields: `find` is the slow way, for one that is not known yet.
    """

    def __init__(self, most_models: int) -> None:
        self.known: dict[tuple[str, str, str, int, str], Durations] = {}
        self.in_flight = 0
        self.streams = 0
        self._models: set[str] = set()
        self._most_models = most_models

    def find(self, kind: Kind, exists: bool) -> Durations:
        """Durations of a kind; what clients can make up at will is not told apart. exists: whether the model does."""
        method = kind.method if kind.method in METHODS else OTHER
        kind = kind._replace(method=method, model=self.label(kind.model) if exists else "")
        return self.known.setdefault(kind, Durations())

    def label(self, model: str) -> str:
        """What stands for an existing model: its name, or OTHER where there are too many."""
        if not model or model in self._models:
            return model
        if len(self._models) >= self._most_models:
            return OTHER
        self._models.add(model)
        return model


class StreamMeter:
    """Frames of the streams of one model.

    durations: from a frame's arrival until its answer was ready, s; refused: by code; late: answers after their
    deadline.
    """

    __slots__ = ("durations", "late", "refused")

    def __init__(self) -> None:
        self.durations = Durations()
        self.refused: dict[str, int] = {}
        self.late = 0

    def refuse(self, code: str) -> None:
        """Count a frame that was answered with an error."""
        self.refused[code] = self.refused.get(code, 0) + 1


class Meters:
    """All that one service counts since it started. most_models: how many models are told apart."""

    def __init__(self, most_models: int = MAX_MODELS) -> None:
        self.requests = RequestMeter(most_models)
        self._streams: dict[str, StreamMeter] = {}

    def stream(self, model: str) -> StreamMeter:
        """The meter of an existing model's streams."""
        return self._streams.setdefault(self.requests.label(model), StreamMeter())

    def streams(self) -> Mapping[str, StreamMeter]:
        """Meters of streams by model, as they are now."""
        return dict(self._streams)


_FAMILIES: dict[str, Any] = {
    "counter": CounterMetricFamily,
    "gauge": GaugeMetricFamily,
    "histogram": HistogramMetricFamily,
}


@dataclass(frozen=True)
class MetricKind:
    """A metric of /metrics. name: as in queries, a counter's with `_total`; meaning: in words, with its unit."""

    kind: Literal["counter", "gauge", "histogram"]
    name: str
    meaning: str
    labels: tuple[str, ...] = ()

    def family(self) -> Any:
        """An empty family, to which samples are added."""
        return _FAMILIES[self.kind](self.name, self.meaning, labels=self.labels)

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


def kinds(collector: type[Collector]) -> list[MetricKind]:
    """The metrics that a collector declares."""
    return [each for each in vars(collector).values() if isinstance(each, MetricKind)]


def merged(parts: Iterable[Durations]) -> Durations:
    """All durations of several meters together."""
    total = Durations()
    for part in parts:
        total.counts = [ours + theirs for ours, theirs in zip(total.counts, part.counts, strict=True)]
        total.total += part.total
    return total


def _buckets(durations: Durations) -> Iterator[tuple[str, float]]:
    """Upper bounds and how many lie below them, as Prometheus has histograms."""
    below = 0
    for bound, count in zip((*map(str, durations.bounds), "+Inf"), durations.counts, strict=True):
        below += count
        yield bound, below
