"""Counters of requests and streams, and the declaration of metrics.

The counters are plain numbers, changed only by the event loop of their process. The labels and locks of
prometheus-client's own counters cost over 3 µs a request; these cost a few tenths. A metric's declaration makes its
families and its line in the documentation.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from service.telemetry.counters import Counters, Counts, Name, Reals, Tally, new_tally

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
    """A histogram of durations. bounds: upper bounds of its buckets, s; tally: where it counts."""

    __slots__ = ("_sum", "bounds", "counts")

    def __init__(self, bounds: tuple[float, ...] = BUCKET_BOUNDS_S, tally: Tally | None = None) -> None:
        self.bounds = bounds
        self.counts: Counts = [0] * (len(bounds) + 1) if tally is None else tally.counts
        self._sum: Reals = [0.0] if tally is None else tally.reals

    @property
    def total(self) -> float:
        """The sum of all durations, s."""
        return self._sum[0]

    def add(self, seconds: float) -> None:
        """Count one duration."""
        self.counts[bisect_left(self.bounds, seconds)] += 1
        self._sum[0] += seconds

    def merge(self, other: Durations) -> None:
        """Add those of another histogram with the same bounds."""
        for bucket in range(len(self.bounds) + 1):
            self.counts[bucket] += other.counts[bucket]
        self._sum[0] += other.total


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
    """Answered requests by kind, and the number of requests and streams in progress.

    `known` maps the plain tuple of a kind's fields to its durations in this process. `find` is the slow way, for a new
    kind.
    """

    def __init__(self, most_models: int, counters: Counters | None = None) -> None:
        self.known: dict[tuple[str, str, str, int, str], Durations] = {}
        self._counters = Counters() if counters is None else counters
        self.in_flight, self.streams = self._counters.gauge("requests"), self._counters.gauge("streams")
        self._models = {labels[2] for labels in self._counters.tallies(_REQUEST)}
        self._models |= {labels[0] for labels in self._counters.tallies(_STREAM)}
        self._models -= {"", OTHER}
        self._most_models = most_models

    def find(self, kind: Kind, exists: bool) -> Durations:
        """Return the durations of a kind; labels that clients can invent are replaced.

        exists: whether the model exists.
        """
        method = kind.method if kind.method in METHODS else OTHER
        kind = kind._replace(method=method, model=self.label(kind.model) if exists else "")
        durations = self.known.get(kind)
        if durations is None:
            durations = self.known[kind] = Durations(tally=self._counters.tally(_REQUEST, *map(str, kind)))
        return durations

    def label(self, model: str) -> str:
        """Return the label of an existing model: its name, or OTHER if there are too many models."""
        if not model or model in self._models:
            return model
        if len(self._models) >= self._most_models:
            self._models -= {model for (model,) in self._counters.tallies(_DELETED)}
        if len(self._models) >= self._most_models:
            return OTHER
        self._models.add(model)
        return model

    def totals(self) -> Mapping[Kind, Durations]:
        """Return the durations of all kinds, of all processes of the service."""
        found: dict[Kind, Durations] = {}
        for (method, route, model, status, code), tally in _totals(self._counters, _REQUEST).items():
            found[Kind(method, route, model, int(status), code)] = Durations(tally=tally)
        return found


class StreamMeter:
    """Frames of the streams of one model.

    durations: from a frame's arrival until its answer is ready, s. refused: number of frames by error code. late:
    number of answers after their deadline.
    """

    __slots__ = ("_counters", "_late", "_model", "_refused", "durations")

    def __init__(self, counters: Counters | None = None, model: str = "") -> None:
        self._counters, self._model = Counters() if counters is None else counters, model
        self.durations = Durations(tally=self._counters.tally(_STREAM, model))
        self._late = self._counters.tally(_LATE, model).counts
        self._refused: dict[str, Tally] = {}

    @property
    def late(self) -> int:
        """Number of answers after their deadline, in this process."""
        return self._late[0]

    def count_late(self) -> None:
        """Count an answer after its deadline."""
        self._late[0] += 1

    @property
    def refused(self) -> Mapping[str, int]:
        """Number of frames by error code, in this process."""
        return {code: tally.counts[0] for code, tally in self._refused.items()}

    def refuse(self, code: str) -> None:
        """Count a frame that was answered with an error."""
        if (tally := self._refused.get(code)) is None:
            tally = self._refused[code] = self._counters.tally(_REFUSED, self._model, code)
        tally.counts[0] += 1


@dataclass(frozen=True)
class StreamTotals:
    """Frames of the streams of one model in all processes; see `StreamMeter`."""

    durations: Durations
    late: int
    refused: Mapping[str, int]


class Meters:
    """All counters of one process. most_models: max models with labels of their own; counters: where it counts."""

    def __init__(self, most_models: int = MAX_MODELS, counters: Counters | None = None) -> None:
        self.counters = Counters() if counters is None else counters
        self.requests = RequestMeter(most_models, self.counters)
        self._streams: dict[str, StreamMeter] = {}

    def stream(self, model: str) -> StreamMeter:
        """Return the meter of an existing model's streams."""
        label = self.requests.label(model)
        if (meter := self._streams.get(label)) is None:
            meter = self._streams[label] = StreamMeter(self.counters, label)
        return meter

    def forget(self, model: str) -> None:
        """Count what was counted for a deleted model with OTHER, so that no sum falls. Only one process may call it."""
        self.counters.tally(_DELETED, model)
        for kind, place in _MODEL_PLACES.items():
            for name, tallies in self.counters.tallies(kind).items():
                if name[place] == model:
                    total, moved = _add(*tallies), self.counters.tally(_MOVED + kind, *name)
                    moved.counts[:] = array("q", total.counts)
                    moved.reals[:] = array("d", total.reals)

    def streams(self) -> Mapping[str, StreamTotals]:
        """Return the totals of streams by model, of all processes of the service."""
        late, refused = _totals(self.counters, _LATE), defaultdict[str, dict[str, int]](dict)
        for (model, code), tally in _totals(self.counters, _REFUSED).items():
            refused[model][code] = tally.counts[0]
        return {
            model: StreamTotals(Durations(tally=tally), late.get((model,), new_tally()).counts[0], refused[model])
            for (model,), tally in _totals(self.counters, _STREAM).items()
        }


_REQUEST, _STREAM, _LATE, _REFUSED, _DELETED = "request", "stream", "late", "refused", "deleted model"
_MODEL_PLACES = {_REQUEST: 2, _STREAM: 0, _LATE: 0, _REFUSED: 0}
"""Kinds of tallies, and the place of the model in their names."""
_MOVED = "moved "
"""Prefix of the kind of a tally that was moved to OTHER: it has the numbers at the time of the deletion."""


def _totals(counters: Counters, kind: str) -> dict[Name, Tally]:
    """Return the sums over all processes. Those of deleted models are OTHER's; see `Meters.forget`."""
    place = _MODEL_PLACES[kind]
    found = {name: _add(*tallies) for name, tallies in counters.tallies(kind).items()}
    for name, (moved,) in counters.tallies(_MOVED + kind).items():
        found[name] = _add(found[name], moved, sign=-1)
        if not any(found[name].counts):
            del found[name]
        rest = (*name[:place], OTHER, *name[place + 1 :])
        found[rest] = _add(found.get(rest, new_tally()), moved)
    return found


def _add(first: Tally, *others: Tally, sign: int = 1) -> Tally:
    """Return a tally plus others, or minus others."""
    total = Tally([*first.counts], [*first.reals])
    for other in others:
        total.counts = [ours + sign * theirs for ours, theirs in zip(total.counts, other.counts, strict=True)]
        total.reals = [ours + sign * theirs for ours, theirs in zip(total.reals, other.reals, strict=True)]
    return total


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
    for bound, count in zip((*map(str, durations.bounds), "+Inf"), durations.counts, strict=False):
        below += count
        yield bound, below
