"""Metrics of requests and streams."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator

from prometheus_client.core import Metric
from prometheus_client.registry import Collector

from service.web.observability.meters import Durations, Kind, Meters
from service.web.observability.metric import MetricKind, merged

DURATION = MetricKind(
    "histogram",
    "lipserve_request_duration_seconds",
    "Time from a request's arrival until its answer began, s; of a stream, until it was accepted",
    ("method", "route", "model"),
)
REQUESTS = MetricKind(
    "counter",
    "lipserve_requests_total",
    "Requests that were answered; 101: a stream, 499: the client went away before",
    ("method", "route", "status"),
)
ERRORS = MetricKind(
    "counter", "lipserve_errors_total", "Requests that were answered with an error, by its code", ("route", "code")
)
IN_FLIGHT = MetricKind("gauge", "lipserve_requests_in_flight", "Requests that are being answered now")
STREAMS = MetricKind("gauge", "lipserve_streams_open", "WebSocket connections that are open now")
FRAMES = MetricKind(
    "histogram",
    "lipserve_stream_frame_duration_seconds",
    "Time from the arrival of a stream's frame until its answer was ready, s; frames that were refused left out",
    ("model",),
)
LATE = MetricKind(
    "counter",
    "lipserve_stream_late_total",
    "Answers of streams after their deadline: the frame's budget, else LIPSERVE_STREAM_DEADLINE_S",
    ("model",),
)
FRAME_ERRORS = MetricKind(
    "counter", "lipserve_stream_errors_total", "Frames that were answered with an error, by its code", ("model", "code")
)
KINDS = (DURATION, REQUESTS, ERRORS, IN_FLIGHT, STREAMS, FRAMES, LATE, FRAME_ERRORS)


class Traffic(Collector):
    """What the meters have counted since the service started."""

    def __init__(self, meters: Meters) -> None:
        self._meters = meters

    def describe(self) -> list[Metric]:
        """Nothing: what there is depends on the requests."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield every metric."""
        requests, streams = self._meters.requests, self._meters.streams()
        seen = {Kind(*key): durations for key, durations in list(requests.known.items())}
        yield DURATION.spread(_grouped(seen, lambda kind: (kind.method, kind.route, kind.model)))
        answers = _grouped(seen, lambda kind: (kind.method, kind.route, str(kind.status)))
        yield REQUESTS.of((labels, sum(found.counts)) for labels, found in answers)
        refused = {kind: durations for kind, durations in seen.items() if kind.code}
        errors = _grouped(refused, lambda kind: (kind.route, kind.code))
        yield ERRORS.of((labels, sum(found.counts)) for labels, found in errors)
        yield IN_FLIGHT.of([((), requests.in_flight)])
        yield STREAMS.of([((), requests.streams)])
        yield FRAMES.spread(([model], meter.durations) for model, meter in streams.items())
        yield LATE.of(([model], meter.late) for model, meter in streams.items())
        yield FRAME_ERRORS.of(
            ([model, code], count) for model, meter in streams.items() for code, count in dict(meter.refused).items()
        )


def _grouped(
    seen: dict[Kind, Durations], labels: Callable[[Kind], tuple[str, ...]]
) -> list[tuple[tuple[str, ...], Durations]]:
    groups: dict[tuple[str, ...], list[Durations]] = defaultdict(list)
    for kind, durations in seen.items():
        groups[labels(kind)].append(durations)
    return [(found, merged(groups[found])) for found in sorted(groups)]
