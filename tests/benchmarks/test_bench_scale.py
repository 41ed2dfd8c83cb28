"""`python -m benchmarks scale`: what it makes and concludes. All that it starts takes minutes: a slow test."""

import pytest
from rich.console import Console

from benchmarks.scale import passes, plan, running

COSTS = {
    "service_ms": {"batch": 2.0, "sample": 0.1},
    "learner_ms": {"batch": 5.0, "sample": 0.5},
    "database_ms": {"batch": 1.0, "sample": 0.01},
    "stored_bytes": {"batch": 1000.0, "sample": 200.0},
    "query_stream_us": 100.0,
    "taught_ms_per_s": 50.0,
    "service_mib": 300.0,
    "learner_mib": 200.0,
    "loaded_mib": 10.0,
    "taught_mib": 30.0,
    "version_bytes": 1e6,
    "snapshot_bytes": 2e6,
}


def test_a_ratio_is_that_of_pairs():
    seconds = {passes.POOL: {1: [10.0, 20.0, 10.0], 2: [5.0, 10.0, 8.0]}}
    part = passes._part(1000, seconds, 42.0, 1)
    ratio, linear, sums = part.targets
    assert ratio.value == pytest.approx(2.0)
    assert ratio.met
    assert linear.value == pytest.approx(42.0 / 5 / 8.0)
    assert sums.met
    assert passes._part(1000, seconds, 42.0, 2).targets[-1].met is False


def test_a_plan_is_the_formula():
    fleet = plan.Fleet("", robots=100, models=100, samples=1.0, period=10.0, publish=10.0, queries=4.0)
    found = plan.plan(COSTS, fleet, job_s=6048.0)
    assert (found.batches_per_s, found.samples_per_s) == (5.0, 50.0)
    assert found.service_cpus == pytest.approx(5 * 2e-3 + 50 * 0.1e-3 + 200 * 100e-6)
    # a revision of each of 50 taught models in ten seconds, at both services
    assert found.learner_cpus == pytest.approx(2 * (5 * 50e-3 + 50 * 0.5e-3))
    assert found.services == 2
    assert found.worker_cpus == pytest.approx(1.0)
    assert found.memory_bytes == pytest.approx((300 + 200 + 100 * 40) * plan.MIB)
    assert found.database_bytes == pytest.approx((5 * 1000 + 50 * 200) * 2 / 3 * 30 * 86400)
    assert len(plan.grid(COSTS, 100.0).rows[0]) == 1 + len(plan.FLEETS)


@pytest.mark.slow
def test_a_run_measures_everything():
    results = running.run(running.Options(**running.QUICK), Console(quiet=True))
    assert [part.name for part in results.parts] == list(running.PARTS)
    judged = {each.name: each for each in results.targets()}
    for name in ("different sums", "trials in which their answers differ", "acknowledged and lost", "done twice"):
        assert judged[name].met, name
    assert judged["faults without recovery"].met
