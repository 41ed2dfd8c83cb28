"""Resources of a fleet from the costs of a batch, a sample, a query and a model: the formula of docs/sizing.md."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import ceil
from typing import Any

from benchmarks.latency.table import Grid

REPLICAS = 2
"""Services for each robot, of which one may fail."""
LOAD = 0.6
"""Planned load of a CPU; the rest is for peaks and for robots of a failed service."""
ACTIVE, MOVING = 0.5, 1 / 3
"""Share of the robots that move and learn at the same time; share of the day in which each robot moves."""
DAYS, LOG_BYTES = 30, 1 << 30
"""Retention of observations, and max size of a model's log: the defaults of the settings."""
SNAPSHOTS, VERSIONS = 20, 3
"""Snapshots of a version (the default), and versions of a model."""
WEEK_S = 7 * 86400.0
MIB, GIB = float(1 << 20), float(1 << 30)


@dataclass(frozen=True)
class Fleet:
    """Robots and their load.

    Attributes:
        name: name in the table.
        robots: number of robots.
        models: number of models of all robots.
        samples: samples per second of a moving robot.
        period: time between its batches, s.
        publish: LIPSERVE_PUBLISH_EVERY_S.
        queries: its queries per second, over a stream.
        teachers: max number of robots that send samples at a time; None: all.
    """

    name: str
    robots: int
    models: int
    samples: float
    period: float
    publish: float = 0.5
    queries: float = 10.0
    teachers: int | None = None


FLEETS = (
    Fleet("10 robots, a model each, 100 samples/s", 10, 10, 100.0, 1.0),
    Fleet("1 000 robots, a model each, 10 samples/s", 1000, 1000, 10.0, 10.0, 10.0),
    Fleet("100 000 robots, a model each, 10 samples/s", 100_000, 100_000, 10.0, 10.0, 10.0),
    Fleet("100 000 robots, 100 models, 10 senders each", 100_000, 100, 10.0, 10.0, 10.0, teachers=1000),
)
"""The plans of docs/sizing.md."""


@dataclass(frozen=True)
class Plan:
    """Resources of a fleet; CPUs of the measured kind."""

    batches_per_s: float
    samples_per_s: float
    service_cpus: float
    learner_cpus: float
    database_cpus: float
    worker_cpus: float
    services: int
    memory_bytes: float
    database_bytes: float
    store_bytes: float


def plan(costs: Mapping[str, Any], fleet: Fleet, job_s: float) -> Plan:
    """Return the resources of a fleet, with one training job a week for each model.

    Each service of a pair learns the batches of both; queries and batches are distributed between them.

    Args:
        costs: figures of `benchmarks.scale.costs.run`.
        fleet: the fleet.
        job_s: processor time of a training job.
    """
    teachers = ACTIVE * fleet.robots if fleet.teachers is None else fleet.teachers
    batches, samples = teachers / fleet.period, teachers * fleet.samples
    taught = min(teachers, fleet.models)
    revisions = taught * min(1 / fleet.publish, batches / taught)
    queries = ACTIVE * fleet.robots * fleet.queries
    service = _cost(costs, "service_ms", batches, samples) / 1e3 + queries * costs["query_stream_us"] / 1e6
    learner = (revisions * costs["taught_ms_per_s"] + samples * costs["learner_ms"]["sample"]) / 1e3
    database = _cost(costs, "database_ms", batches, samples) / 1e3
    learners = ceil(learner / LOAD)  # a learner uses one CPU
    services = REPLICAS * max(1, learners, ceil(service / LOAD / REPLICAS))
    models_each = fleet.models * REPLICAS / services
    memory = MIB * (
        costs["service_mib"] + costs["learner_mib"] + models_each * (_mib(costs, "loaded") + _mib(costs, "taught"))
    )
    share = MOVING / ACTIVE  # mean rate of samples over the rate at a busy time
    kept = _cost(costs, "stored_bytes", batches, samples) * share * DAYS * 86400
    of_model = VERSIONS * (costs["version_bytes"] or 0.0) + SNAPSHOTS * (costs["snapshot_bytes"] or 0.0)
    return Plan(
        batches,
        samples,
        service,
        REPLICAS * learner,
        database,
        fleet.models * job_s / WEEK_S,
        services,
        memory,
        min(kept, fleet.models * LOG_BYTES),
        fleet.models * of_model,
    )


def grid(costs: Mapping[str, Any], job_s: float) -> Grid:
    """Return the plans of all fleets, one in each column."""
    plans = [plan(costs, fleet, job_s) for fleet in FLEETS]
    lines: tuple[tuple[str, Callable[[Plan], float]], ...] = (
        ("batches/s and commits/s", lambda each: each.batches_per_s),
        ("samples/s", lambda each: each.samples_per_s),
        ("CPUs used by services", lambda each: each.service_cpus),
        (f"CPUs used by learners, {REPLICAS} for each model", lambda each: each.learner_cpus),
        ("CPUs used by PostgreSQL", lambda each: each.database_cpus),
        ("CPUs used by workers", lambda each: each.worker_cpus),
        (f"services, {LOAD:.0%} of a learner's CPU planned", lambda each: each.services),
        ("GiB of memory of each", lambda each: each.memory_bytes / GIB),
        (f"GiB of database, {DAYS} days or 1 GiB a model", lambda each: each.database_bytes / GIB),
        ("GiB of store", lambda each: each.store_bytes / GIB),
    )
    rows = [(label, *(_text(value(each)) for each in plans)) for label, value in lines]
    return Grid("plans", ("", *(fleet.name for fleet in FLEETS)), rows)


def _cost(costs: Mapping[str, Any], name: str, batches: float, samples: float) -> float:
    """Return the cost of batches with this total of samples; the cost of a batch excludes that of its samples."""
    batch, sample = float(costs[name]["batch"]), float(costs[name]["sample"])
    return max(0.0, batch) * batches + max(0.0, sample) * samples


def _mib(costs: Mapping[str, Any], kind: str) -> float:
    return max(0.0, float(costs[f"{kind}_mib"] or 0.0))


def _text(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}" if value >= 1 else f"{value:.2g}"
