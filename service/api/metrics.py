"""The route `/metrics` for Prometheus, and the metrics of the system and of requests. Computed on request."""

from __future__ import annotations

import multiprocessing
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping

from fastapi import APIRouter, Request, Response
from fastapi.responses import PlainTextResponse
from prometheus_client import CollectorRegistry
from prometheus_client.core import Metric
from prometheus_client.exposition import choose_encoder
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector

from service import __version__
from service.api.access.scopes import READ, needs
from service.api.route import Route
from service.runtime import nursery
from service.storage.disk import measure
from service.storage.storage import Storage
from service.telemetry.counters import Counters
from service.telemetry.meters import Durations, Kind, Meters, MetricKind, merge_durations
from service.telemetry.readiness import Readiness


class System(Collector):
    """Metrics of one service and its processes. Blocking: use it in a thread.

    The service's own process has the usual `process_…` metrics of Prometheus.
    """

    build = MetricKind("gauge", "lipserve_build_info", "Always 1; the label is the version of LIPServe", ("version",))
    parts = MetricKind(
        "gauge", "lipserve_ready", "1 if a part of the service works, 0 if /health/ready reports a fault", ("part",)
    )
    used = MetricKind("gauge", "lipserve_disk_used_bytes", "Size of the files in the home folder, by kind", ("what",))
    free = MetricKind("gauge", "lipserve_disk_free_bytes", "Free bytes on the disk of the home folder")
    memory = MetricKind(
        "gauge", "lipserve_process_memory_bytes", "Resident memory of other processes of the service", ("process",)
    )
    cpu = MetricKind(
        "counter",
        "lipserve_process_cpu_seconds_total",
        "CPU time of the running other processes of the service, s",
        ("process",),
    )

    def __init__(self, storage: Storage, readiness: Readiness, counters: Counters) -> None:
        self._storage, self._readiness, self._counters = storage, readiness, counters
        self._own = ProcessCollector(registry=None)

    def describe(self) -> list[Metric]:
        """Return nothing: the metrics depend on the platform."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield every metric."""
        yield self.build.of([([__version__], 1)])
        parts = self._readiness.report()
        yield self.parts.of(([part.name], float(part.state != "failed")) for part in parts)
        files, usage = self._storage.files, self._storage.disk.usage()
        used = {what: measure(folder) for what, folder in files.folders.items()}
        used["other"] = max(usage.used - sum(used.values()), 0)  # mainly the database; measured slightly earlier
        yield self.used.of(([what], size) for what, size in used.items())
        yield self.free.of([((), usage.free)])
        yield from self._own.collect()
        yield from _processes(self._counters)


def _processes(counters: Counters) -> Iterator[Metric]:
    """Yield memory and CPU time of the other processes of a service, by kind, if the platform reports them."""
    kinds = {"process_resident_memory_bytes": System.memory, "process_cpu_seconds": System.cpu}
    forks = nursery.current()
    named = [*multiprocessing.active_children(), *(() if forks is None else forks.running())]
    running = [(_kind_of(process.name), process.pid) for process in named]
    running += [("data plane", pid) for pid in counters.others()]
    figures: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    for name, pid in running:
        for family in ProcessCollector(pid=lambda pid=pid: pid, registry=None).collect():  # type: ignore[misc]
            if family.name in kinds:
                figures[family.name][name] += family.samples[0].value
    for metric, kind in kinds.items():
        yield kind.of(([name], value) for name, value in figures[metric].items())


def _kind_of(process: str) -> str:
    """Return the label of a process by its name."""
    name = process.removeprefix("lipserve-")
    return name if name in ("learner", "weigher", "worker") else "training"


class Traffic(Collector):
    """Metrics of requests and streams since the service started."""

    duration = MetricKind(
        "histogram",
        "lipserve_request_duration_seconds",
        "Time from the arrival of a request to the start of its answer, s; for a stream, to its acceptance",
        ("method", "route", "model"),
    )
    requests = MetricKind(
        "counter",
        "lipserve_requests_total",
        "Requests that were answered; 101: a stream, 499: client disconnected",
        ("method", "route", "status"),
    )
    errors = MetricKind(
        "counter", "lipserve_errors_total", "Requests answered with an error, by error code", ("route", "code")
    )
    in_flight = MetricKind("gauge", "lipserve_requests_in_flight", "Requests that are being answered")
    streams = MetricKind("gauge", "lipserve_streams_open", "Open WebSocket connections")
    frames = MetricKind(
        "histogram",
        "lipserve_stream_frame_duration_seconds",
        "Time from the arrival of a stream's frame until its answer is ready, s; failed frames do not count",
        ("model",),
    )
    late = MetricKind(
        "counter",
        "lipserve_stream_late_total",
        "Stream answers after their deadline: the frame's budget or else LIPSERVE_STREAM_DEADLINE_S",
        ("model",),
    )
    frame_errors = MetricKind(
        "counter",
        "lipserve_stream_errors_total",
        "Frames answered with an error, by error code",
        ("model", "code"),
    )

    def __init__(self, meters: Meters) -> None:
        self._meters = meters

    def describe(self) -> list[Metric]:
        """Return nothing: the metrics depend on the requests."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield every metric."""
        requests, streams = self._meters.requests, self._meters.streams()
        seen = requests.totals()
        yield self.duration.spread(_grouped(seen, lambda kind: (kind.method, kind.route, kind.model)))
        answers = _grouped(seen, lambda kind: (kind.method, kind.route, str(kind.status)))
        yield self.requests.of((labels, sum(each.counts)) for labels, each in answers)
        refused = {kind: durations for kind, durations in seen.items() if kind.code}
        errors = _grouped(refused, lambda kind: (kind.route, kind.code))
        yield self.errors.of((labels, sum(each.counts)) for labels, each in errors)
        yield self.in_flight.of([((), requests.in_flight.total)])
        yield self.streams.of([((), requests.streams.total)])
        yield self.frames.spread(([model], meter.durations) for model, meter in streams.items())
        yield self.late.of(([model], meter.late) for model, meter in streams.items())
        yield self.frame_errors.of(
            ([model, code], count) for model, meter in streams.items() for code, count in meter.refused.items()
        )


def _grouped(
    seen: Mapping[Kind, Durations], labels: Callable[[Kind], tuple[str, ...]]
) -> list[tuple[tuple[str, ...], Durations]]:
    groups: dict[tuple[str, ...], list[Durations]] = defaultdict(list)
    for kind, durations in seen.items():
        groups[labels(kind)].append(durations)
    return [(group, merge_durations(groups[group])) for group in sorted(groups)]


EXAMPLE = """# HELP lipserve_requests_total Requests that were answered; 101: a stream, 499: client disconnected
# TYPE lipserve_requests_total counter
lipserve_requests_total{method="POST",route="/v1/models/{model}/predict",status="200"} 86400.0
# HELP lipserve_quality_coverage Share of measurements inside the 95 % interval, noise included
# TYPE lipserve_quality_coverage gauge
lipserve_quality_coverage{joint="panda_joint1",model="panda-sim",window="60"} 0.953
"""

router = APIRouter(tags=["health"], route_class=Route)


@router.get(
    "/metrics",
    summary="Retrieve metrics for Prometheus",
    response_class=PlainTextResponse,
    responses={
        200: {
            "description": "Metrics in Prometheus text format, or OpenMetrics if the request accepts it",
            "content": {"text/plain": {"example": EXAMPLE}},
        }
    },
)
@needs(READ)
def metrics(request: Request) -> Response:
    """Return metrics of requests, streams, training jobs, learning models, disk, memory and readiness.

    docs/reference/metrics.md lists all metrics.
    """
    registry = CollectorRegistry()
    for collector in request.app.state.collectors:
        registry.register(collector)
    encode, media_type = choose_encoder(request.headers.get("accept", ""))
    return Response(encode(registry), media_type=media_type)
