"""The table of all metrics that docs/monitoring.md has: `python docs/metrics.py` prints it."""

from __future__ import annotations

import sys
from collections.abc import Iterator

from service.api import metrics
from service.learning import metrics as learning
from service.telemetry.meters import MetricKind, list_metrics
from service.training import metrics as training

KINDS: tuple[MetricKind, ...] = (
    *list_metrics(metrics.Traffic),
    *list_metrics(training.JobMetrics),
    *list_metrics(learning.LearningCollector),
    *list_metrics(metrics.System),
)
"""All metrics that /metrics shows besides Prometheus's usual ones of a process."""


def lines() -> Iterator[str]:
    """Lines of the table, in Markdown."""
    yield "| metric | kind | labels | what it is |"
    yield "| --- | --- | --- | --- |"
    for kind in KINDS:
        labels = ", ".join(f"`{label}`" for label in kind.labels)
        yield f"| `{kind.name}` | {kind.kind} | {labels} | {kind.meaning} |"


if __name__ == "__main__":
    sys.stdout.writelines(f"{line}\n" for line in lines())
