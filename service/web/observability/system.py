"""Metrics of the service itself: its parts, its disk, its processes."""

from __future__ import annotations

import multiprocessing
from collections import defaultdict
from collections.abc import Iterator

from prometheus_client.core import Metric
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector

from service import __version__
from service.storage.disk import measure
from service.storage.storage import Storage
from service.web.observability.metric import MetricKind
from service.web.observability.readiness import Readiness

BUILD = MetricKind("gauge", "lipserve_build_info", "1; the version of LIPServe", ("version",))
PARTS = MetricKind("gauge", "lipserve_ready", "1 where a part is in order, 0 where /health/ready names it", ("part",))
USED = MetricKind("gauge", "lipserve_disk_used_bytes", "Bytes of the home's files, by what they are of", ("what",))
FREE = MetricKind("gauge", "lipserve_disk_free_bytes", "Bytes that the disk of the home has free")
MEMORY = MetricKind(
    "gauge", "lipserve_process_memory_bytes", "Resident memory of the processes that learn and train", ("process",)
)
CPU = MetricKind(
    "counter",
    "lipserve_process_cpu_seconds_total",
    "CPU time of the processes that learn and train which run now, s",
    ("process",),
)
KINDS = (BUILD, PARTS, USED, FREE, MEMORY, CPU)
LEARNER = "lipserve-learner"
_SHOWN = {"process_resident_memory_bytes": MEMORY, "process_cpu_seconds": CPU}


class System(Collector):
    """Of one service. Its own process has Prometheus's usual `process_…` metrics. Not for the event loop."""

    def __init__(self, storage: Storage, readiness: Readiness) -> None:
        self._storage, self._readiness = storage, readiness
        self._own = ProcessCollector(registry=None)

    def describe(self) -> list[Metric]:
        """Nothing: what there is depends on the platform."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield every metric."""
        yield BUILD.of([([__version__], 1)])
        parts = self._readiness.report().checks
        yield PARTS.of(([part.name], float(part.state != "failed")) for part in parts)
        files, usage = self._storage.files, self._storage.disk.usage()
        used = {what: measure(folder) for what, folder in files.folders.items()}
        used["other"] = max(usage.used - sum(used.values()), 0)  # the database above all; measured a moment before
        yield USED.of(([what], size) for what, size in used.items())
        yield FREE.of([((), usage.free)])
        yield from self._own.collect()
        yield from _processes()


def _processes() -> Iterator[Metric]:
    """What the processes take that the service has started, where the platform says."""
    found: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    for process in multiprocessing.active_children():
        name, pid = "learner" if process.name == LEARNER else "training", process.pid
        for family in ProcessCollector(pid=lambda pid=pid: pid, registry=None).collect():  # type: ignore[misc]
            if family.name in _SHOWN:
                found[family.name][name] += family.samples[0].value
    for shown, kind in _SHOWN.items():
        yield kind.of(([name], value) for name, value in found[shown].items())
