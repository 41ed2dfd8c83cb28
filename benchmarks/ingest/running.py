"""The benchmark of uploads, each to a service that has just started."""

from __future__ import annotations

import json
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks import facts
from benchmarks.ingest import recording
from benchmarks.latency.table import NOTHING, Grid, targets_grid
from benchmarks.latency.targets import Target
from benchmarks.processes import resident_mib
from lipserve import Client
from service.cli.demo import ServiceProcess

MAX_SECONDS, MAX_MIB = 60.0, 500.0
TARGET_ROWS = 1_000_000
"""Rows of the recording that the targets are about."""
MIB = 1 << 20


@dataclass(frozen=True)
class Options:
    """Scope of the benchmark; columns: of the file, the service derives the others."""

    rows: int = TARGET_ROWS
    joints: int = 7
    formats: tuple[str, ...] = recording.FORMATS
    columns: tuple[str, ...] = ("q", "dq", "tau")
    seed: int = 0

    def __post_init__(self) -> None:
        if unknown := [name for name in self.formats if name not in recording.FORMATS]:
            raise ValueError(f"Unknown format {unknown[0]!r} in --formats. Formats: {', '.join(recording.FORMATS)}.")


@dataclass(frozen=True)
class Ingested:
    """Figures of one upload.

    Attributes:
        format: format of the file.
        file_mib: size of the file.
        seconds: time from the first byte sent to the answer with the report.
        before: memory of the service before, MiB; None if the system does not report it.
        peak: peak memory of the service, MiB.
        rows: rows of the data set.
    """

    format: str
    file_mib: float
    seconds: float
    before: float | None
    peak: float | None
    rows: int

    @property
    def taken(self) -> float | None:
        """Additional memory, MiB."""
        return None if self.peak is None or self.before is None else self.peak - self.before


@dataclass
class Results:
    """All figures of the benchmark."""

    options: Options
    machine: dict[str, str]
    found: list[Ingested] = field(default_factory=list)

    def write(self, path: Path, targets: list[dict[str, Any]]) -> None:
        """Write all figures as JSON."""
        path.write_text(json.dumps({**asdict(self), "targets": targets}, indent=2) + "\n")


def run(options: Options, console: Console) -> Results:
    """Upload one recording in each format, each to a service that has just started."""
    results = Results(options, facts.machine())
    for kind in options.formats:
        with tempfile.TemporaryDirectory(prefix="lipserve-bench-") as folder:
            path = Path(folder) / f"recording.{kind}"
            console.print(f"writing {options.rows:,} rows of {options.joints} joints as {kind}", highlight=False)
            recording.write(path, options.rows, options.joints, options.columns, options.seed)
            console.print(f"uploading {path.stat().st_size / MIB:.0f} MiB", highlight=False)
            results.found.append(_upload(path, kind, Path(folder) / "home", options))
    return results


def grids(results: Results) -> list[Grid]:
    """Return all tables."""
    rows = [
        (
            each.format,
            f"{each.rows:,}",
            f"{each.file_mib:.0f}",
            f"{each.seconds:.1f}",
            f"{results.options.rows / each.seconds:,.0f}",
            _text(each.before),
            _text(each.peak),
        )
        for each in results.found
    ]
    header = ("", "samples", "file MiB", "seconds", "rows/s", "memory before MiB", "peak MiB")
    title = f"{results.options.rows:,} rows, {results.options.joints} joints, {', '.join(results.options.columns)}"
    return [
        Grid("machine", ("", ""), list(results.machine.items()), texts=True),
        Grid(f"{title}: from upload to report", header, rows),
        targets_grid(targets(results), ""),
    ]


def targets(results: Results) -> list[Target]:
    """Return the targets for a million rows of Parquet."""
    found = [each for each in results.found if each.format == "parquet" and results.options.rows >= TARGET_ROWS]
    seconds = max((each.seconds for each in found), default=None)
    taken = max((each.taken for each in found if each.taken is not None), default=None)
    return [
        Target("a million rows of Parquet, report included", seconds, "s", "<", MAX_SECONDS),
        Target("additional memory for it", taken, "MiB", "<", MAX_MIB),
    ]


def _upload(path: Path, kind: str, home: Path, options: Options) -> Ingested:
    settings = {"LIPSERVE_HOME": str(home), "LIPSERVE_MAX_UPLOAD_BYTES": str(path.stat().st_size + MIB)}
    service = ServiceProcess(0, {**settings, "LIPSERVE_MAX_SAMPLES": str(max(options.rows, 1))})
    try:
        with Client(service.url) as client:
            service.wait_ready(client)
            before = resident_mib(service.process.pid, "VmRSS")
            began = time.monotonic()
            dataset = client.upload(path)
            seconds = time.monotonic() - began
            peak = resident_mib(service.process.pid, "VmHWM")
    finally:
        service.stop()
    return Ingested(kind, path.stat().st_size / MIB, seconds, before, peak, dataset.report.rows)


def _text(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.0f}"
