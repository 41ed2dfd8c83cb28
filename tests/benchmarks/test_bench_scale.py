"""`python -m benchmarks scale`: what it makes and concludes. All that it starts takes minutes: a slow test."""

from __future__ import annotations

import os

import numpy as np
import pyarrow.parquet as pq
import pytest
from rich.console import Console

import lipcore
from benchmarks.processes import resident
from benchmarks.scale import engines, passes, plan, replicas, running, streams, training
from benchmarks.scale.part import Results
from benchmarks.scale.peaks import KINDS, Peaks
from benchmarks.workload import BenchError
from lipcore.training.conditioning import SHARD, with_statistics
from service.compute.executors import Inline, summed
from service.foundation.settings import shipped_models

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


def test_what_is_not_installed_is_said(monkeypatch):
    monkeypatch.setattr(engines, "find_spec", lambda name: None if name in ("moto", "s3fs") else object())
    with pytest.raises(BenchError, match=r"s3fs, moto not installed.*pip install"):
        engines.require()


def test_a_part_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="--only has 'pases', expected names out of pass, train"):
        running.Options(only=("pases",))


def test_recordings_come_in_shards(tmp_path):
    paths = list(streams.shards(tmp_path, 70, seed=0, shard_rows=30))
    tables = [pq.read_table(path) for path in paths]
    assert [table.num_rows for table in tables] == [30, 30, 10]
    assert tables[0].column_names[:3] == ["t", "q1", "q2"]
    assert len(tables[0].column_names) == 1 + 4 * 7
    assert not np.array_equal(tables[0]["tau1"].to_numpy(), tables[1]["tau1"].to_numpy())


def test_shards_of_a_pass_tell_what_all_rows_do(tmp_path):
    shards = passes._shards(tmp_path / "recording", SHARD // 16, seed=0)
    assert len(shards) == 1
    half = shards[0].last // 2
    parts = [passes.Shard(shards[0].model, shards[0].recording, *each) for each in ((0, half), (half, 2 * half))]
    told = summed(Inline(), passes.work, parts, lambda: False)
    model = lipcore.load(shipped_models() / passes.MODEL)
    samples = streams.stream(2 * half, 20)
    at_once = passes.work(shards[0])
    one, other = (with_statistics(model, each, 2 * half) for each in (told, at_once))
    query = samples.q[:5], samples.dq[:5], samples.ddq[:5]
    np.testing.assert_allclose(one.predict(*query).tau, other.predict(*query).tau, rtol=1e-8, atol=1e-8)
    assert not np.array_equal(one.predict(*query).tau, model.predict(*query).tau)


def test_a_ratio_is_that_of_pairs():
    seconds = {passes.POOL: {1: [10.0, 20.0, 10.0], 2: [5.0, 10.0, 8.0]}}
    part = passes._part(1000, seconds, 42.0, 1)
    ratio, linear, sums = part.targets
    assert ratio.value == pytest.approx(2.0)
    assert ratio.met
    assert linear.value == pytest.approx(42.0 / 5 / 8.0)
    assert sums.met
    assert passes._part(1000, seconds, 42.0, 2).targets[-1].met is False


def test_promises_of_training_are_judged_by_the_largest_job():
    stages = {"hyperparameters": 60.0, "statistics": 40.0}
    memory = {"service": 300.0, "training": 900.0}
    small = training.Trained(200_000, 2, 5.0, 100.0, stages, memory, inducing=500)
    large = training.Trained(
        1_000_000, 10, 25.0, 300.0, {**stages, "statistics": 880.0}, {"training": 2100.0}, inducing=1000
    )
    seconds, memory, ratio = training._targets([small, large])
    assert seconds.met
    assert memory.value == 2100.0
    assert memory.met is False
    assert ratio.value == pytest.approx(1.1)
    assert [each.value for each in training._targets([small])] == [None, 900.0, None]
    assert len(training._grid([small, large]).rows[0]) == len(training._grid([small, large]).columns)


def test_one_answer_that_differs_is_noticed(tmp_path):
    found = [replicas.Trial(0.1, 0.2, True), replicas.Trial(0.1, 1.2, False)]
    part = replicas._part(found)
    assert [each.met for each in part.targets] == [False, False]
    results = Results({"processor": "one"}, [part])
    assert len(list(results.grids())) == 3
    results.write(tmp_path / "found.json")
    assert '"same": 1' in (tmp_path / "found.json").read_text()


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


def test_a_shared_model_costs_what_its_teachers_do():
    alone, shared = (plan.plan(COSTS, fleet, 100.0) for fleet in plan.FLEETS[2:])
    assert shared.learner_cpus < alone.learner_cpus / 20
    assert shared.database_bytes <= 100 * plan.LOG_BYTES


def test_the_most_memory_of_a_process_is_seen():
    peaks = Peaks(os.getpid())
    peaks.note()
    assert peaks.found[KINDS[0]] == resident(os.getpid(), "VmHWM")
    assert resident(2**22 + 1) is None


@pytest.mark.slow
def test_a_run_measures_everything():
    results = running.run(running.Options(**running.QUICK), Console(quiet=True))
    assert [part.name for part in results.parts] == list(running.PARTS)
    judged = {each.name: each for each in results.targets()}
    for name in ("different sums", "trials in which their answers differ", "acknowledged and lost", "done twice"):
        assert judged[name].met, name
    assert judged["faults without recovery"].met
