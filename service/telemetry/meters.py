"""Counters of requests and streams, and the declaration of metrics.

The counters are plain numbers, changed only by the event loop. The labels and locks of prometheus-client's own counters
cost over 3 µs a request; these cost a few tenths. A metric's declaration makes its families and its line in the
documentation.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

BUCKET_BOUNDS_S = (
    *(0.000_05, 0.000_1, 0.000_25, 0.000_5, 0.001, 0.002, 0.005, 0.01, 0.025),
    *(0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0),
)
"""Upper bounds of durations, s: from a frame of a stream to a large upload."""
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "DELETE", "PATCH", "OPTIONS", "WEBSOCKET"})
OTHER = "other"
"""Label of unknown methods, of deleted models, and of models beyond `MAX_MODELS`."""
MAX_MODELS = 200
"""Max models with labels of their own in metrics of requests and streams; the others are counted together."""


class Durations:
    """A histogram of durations. bounds: upper bounds of its buckets, s."""

    __slots__ = ("bounds", "counts", "total")

    def __init__(self, bounds: tuple[float, ...] = BUCKET_BOUNDS_S) -> None:
        self.bounds, self.counts = bounds, [0] * (len(bounds) + 1)
        self.total = 0.0

    def add(self, seconds: float) -> None:
        """Count one duration."""
        self.counts[bisect_left(self.bounds, seconds)] += 1
        self.total += seconds

    def merge(self, other: Durations) -> None:
        """Add the durations of a histogram with the same bounds."""
        self.counts = [ours + theirs for ours, theirs in zip(self.counts, other.counts, strict=True)]
        self.total += other.total


class Kind(NamedTuple):
    """The labels of a request's metrics."""

    method: str
    route: str
    model: str
    """Name of the model; empty if there is none."""
    status: int
    """Status of the response; 499 if the client disconnected before the response started."""
    code: str
    """Code of the error; empty if there is none."""


class RequestMeter:
    """Answered requests by kind, and the number of requests in progress.

    `known` maps the plain tuple of a kind's fields to its durations. `find` is the slow way, for a new kind.
    """

    def __init__(self, most_models: int) -> None:
        self.known: dict[tuple[str, str, str, int, str], Durations] = {}
        self.in_flight = 0
        self.streams = 0
        self._models: set[str] = set()
        self._most_models = most_models

    def find(self, kind: Kind, exists: bool) -> Durations:
        """Return the durations of a kind; labels that clients can invent are replaced.

        exists: whether the model exists.
        """
        method = kind.method if kind.method in METHODS else OTHER
        kind = kind._replace(method=method, model=self.label(kind.model) if exists else "")
        return self.known.setdefault(kind, Durations())

    def label(self, model: str) -> str:
        """Return the label of an existing model: its name, or OTHER if there are too many models."""
        if not model or model in self._models:
            return model
        if len(self._models) >= self._most_models:
            return OTHER
        self._models.add(model)
        return model

    def forget(self, model: str) -> None:
        """Count the requests of a deleted model with those of OTHER, so that their number does not fall."""
        self._models.discard(model)
        for key in [key for key in self.known if key[2] == model]:
            durations = self.known.pop(key)
            self.known.setdefault(Kind(*key)._replace(model=OTHER), Durations()).merge(durations)


class StreamMeter:
    """Frames of the streams of one model.

    durations: from a frame's arrival until its answer is ready, s. refused: number of frames by error code. late:
    number of answers after their deadline.
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
    """All counters of one service since its start. most_models: max models with labels of their own."""

    def __init__(self, most_models: int = MAX_MODELS) -> None:
        self.requests = RequestMeter(most_models)
        self._streams: dict[str, StreamMeter] = {}

    def stream(self, model: str) -> StreamMeter:
        """Return the meter of an existing model's streams."""
        return self._streams.setdefault(self.requests.label(model), StreamMeter())

    def forget(self, model: str) -> None:
        """Count requests and frames of a deleted model with those of OTHER. Call it in the event loop."""
        self.requests.forget(model)
        if (meter := self._streams.pop(model, None)) is not None:
            rest = self._streams.setdefault(OTHER, StreamMeter())
            rest.durations.merge(meter.durations)
            rest.late += meter.late
            for code, count in meter.refused.items():
                rest.refused[code] = rest.refused.get(code, 0) + count

    def streams(self) -> Mapping[str, StreamMeter]:
        """Return a copy of the meters of streams by model."""
        return dict(self._streams)


_FAMILIES: dict[str, Any] = {
    "counter": CounterMetricFamily,
    "gauge": GaugeMetricFamily,
    "histogram": HistogramMetricFamily,
}


@dataclass(frozen=True)
class MetricKind:
    """A metric of /metrics."""

    kind: Literal["counter", "gauge", "histogram"]
    name: str
    """Name of the metric in Prometheus queries; the name of a counter ends with `_total`."""
    meaning: str
    """Meaning in words, with the unit."""
    labels: tuple[str, ...] = ()

    def family(self) -> Any:
        """Return an empty family, to which samples are added."""
        return _FAMILIES[self.kind](self.name, self.meaning, labels=self.labels)

    def of(self, samples: Iterable[tuple[Sequence[str], float]]) -> Metric:
        """Return the family of these samples; each has the values of its labels and a number."""
        family: Metric = self.family()
        for labels, value in samples:
            family.add_metric(labels, value)  # type: ignore[attr-defined]  # all families of `family` have it
        return family

    def spread(self, samples: Iterable[tuple[Sequence[str], Durations]]) -> Metric:
        """Return the family of these histograms; each has the values of its labels and its durations."""
        family: Metric = self.family()
        for labels, durations in samples:
            buckets = list(_buckets(durations))
            family.add_metric(labels, buckets, durations.total)  # type: ignore[attr-defined]
        return family


def list_metrics(collector: type[Collector]) -> list[MetricKind]:
    """Return the metrics that a collector declares."""
    return [each for each in vars(collector).values() if isinstance(each, MetricKind)]


def merge_durations(parts: Iterable[Durations]) -> Durations:
    """Return the sum of the durations of several meters."""
    total = Durations()
    for part in parts:
        total.merge(part)
    return total


def _buckets(durations: Durations) -> Iterator[tuple[str, float]]:
    """Yield upper bounds and cumulative counts, as Prometheus defines histograms."""
    below = 0
    for bound, count in zip((*map(str, durations.bounds), "+Inf"), durations.counts, strict=True):
        below += count
        yield bound, below
