"""`python -m benchmarks latency`: arithmetic on known numbers, and a tiny run."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from benchmarks.clients import BadAnswerError
from benchmarks.latency import table
from benchmarks.latency.baselines import gpytorch_installed
from benchmarks.latency.loop import Loop, excess, summarise
from benchmarks.latency.results import LoopPair, Results, Row
from benchmarks.latency.running import KEYS, LOOP, Options, run
from benchmarks.latency.subjects import Subject
from benchmarks.latency.targets import targets
from benchmarks.latency.websocket import read_answer, request_frame
from benchmarks.timing import Timing, median
from benchmarks.workload import BenchError, Source
from lipcore.robots.simulation import Simulation
from lipserve.frames import ANSWER, ERROR, REQUEST
from tests.service.data import QUICK

pytestmark = pytest.mark.slow

MS = 1_000_000


def timed(p50: float, p99: float = 0.0) -> Timing:
    return Timing(10, p50, p50, p99, p99, p99, 1e6 / p50)


def test_percentiles_of_known_times():
    found = Timing.of(np.arange(1, 1002) * 1000)  # 1 to 1001 µs
    assert (found.count, found.p50, found.p90, found.p99, found.largest) == (1001, 501.0, 901.0, 991.0, 1001.0)
    assert found.p999 == pytest.approx(1000.0)
    assert found.per_second == pytest.approx(1e6 / 501.0)
    batch = Timing.of(np.array([50_000_000, 70_000_000]), queries=1000)
    assert (batch.p50, batch.per_second) == pytest.approx((60.0, 1000 * 2 / 0.12))
    with pytest.raises(ValueError, match="at least one time"):
        Timing.of(np.array([], dtype=np.int64))
    middle = median([timed(1.0, 9.0), timed(3.0, 5.0), timed(2.0, 70.0)])  # figure by figure
    assert (middle.p50, middle.p99, middle.largest, middle.count) == (2.0, 9.0, 70.0, 30)


def test_late_answers_are_counted_with_their_clusters():
    one = np.array([0.2, 3.0, 2.0, 0.3, 1.5, 0.2]) * MS
    two = np.array([1.1, 1.0, 0.2, 0.2]) * MS  # exactly 1 ms is in time
    found = summarise([one, two], shown=2)
    assert (found.ticks, found.misses, found.clusters, found.longest_cluster) == (10, 4, 3, 2)
    assert found.largest == (3.0, 2.0)
    assert found.share == pytest.approx(0.4)
    echo = summarise([np.array([0.2, 0.2, 0.2, 5.0]) * MS])
    assert excess(found, echo) == pytest.approx(0.15)


def known() -> Results:
    results = Results({"processor": "p"}, {"model": "m"}, 0.021, runs=3, queries=10)
    results.rows = {
        "mean": Row("mean", "mean", None, {"idle": [timed(30.0)] * 3}),
        "std": Row("std", "std", None, {"idle": [timed(p, 4 * p) for p in (100.0, 110.0, 150.0)]}),
        "ws": Row("ws", "ws", "echo-ws", {"idle": [timed(p, 3 * p) for p in (300.0, 500.0, 320.0)]}),
        "echo-ws": Row("echo-ws", "echo", None, {"idle": [timed(p, p) for p in (100.0, 290.0, 110.0)]}),
        "exact": Row("exact", "exact", None, {"idle": [timed(9_000.0)] * 3}),
    }
    results.rows["ws"].runs["training"] = [timed(p, 9 * p) for p in (600.0, 600.0, 330.0)]
    loop = Loop(1000, 9, 4, 3, 0.3, 0.9, 1.2, (4.0, 3.0))
    results.loops["idle"] = LoopPair(loop, Loop(1000, 6, 4, 2, 0.2, 0.8, 1.1, (3.5,)), server_late=1)
    return results


def test_targets_are_medians_of_figures_of_the_same_run():
    found = {each.name: each for each in targets(known())}
    for name, value, met in (
        # run by run 200, 210, 210; the noisy second run does not count
        ("WebSocket: p50 above the floor", 210.0, True),
        ("WebSocket: p99 / p50, idle", 3.0, True),
        # 600/300, 600/500, 330/320
        ("WebSocket: p50 while training / idle", 1.2, True),
        ("WebSocket: p99 while training / idle", 3.6, False),
        ("speed-up over the exact GP, with std", 9000 / 110, False),
        ("1 kHz WebSocket loop: late answers minus the floor's", 0.3, False),
    ):
        assert (found[name].value, found[name].met) == (pytest.approx(value), met), name
    assert found["largest deviation from the exact posterior"].met is False


def test_frames_follow_the_protocol():
    motion = np.arange(6.0).reshape(3, 2)
    data = request_frame(motion, std=True, deadline=0.25, sequence=7)
    assert data[:2] == bytes((0x82, 0x80 | 64))  # final and binary; masked, with a mask of zeros
    assert REQUEST.unpack_from(data, 6) == (7, 1, 2, 0.25)
    np.testing.assert_array_equal(np.frombuffer(data, "<f8", offset=6 + 16).reshape(3, 2), motion)
    answer = ANSWER.pack(7, 1, 2, 1, 3, 0, 1e-4) + np.array([1.0, 2.0, 0.1, 0.2]).tobytes()
    tau, std, late = read_answer(answer)
    assert (tau.tolist(), std.tolist(), late) == ([1.0, 2.0], [0.1, 0.2], 3)
    with pytest.raises(BadAnswerError, match="too long"):
        read_answer(ANSWER.pack(7, ERROR, 0, 1, 0, 0, 0.0) + b"too long")


def test_wrong_answer_stops_the_benchmark():
    expected = (np.ones(2), np.ones(2))
    workload = SimpleNamespace(model=SimpleNamespace(answer=lambda motion: expected), queries=np.zeros((9, 3, 2)))
    good = Subject("ws", "WebSocket", lambda number: None, answer=lambda number: expected)
    good.check(workload)
    bad = replace(good, answer=lambda number: (np.ones(2), np.array([1.0, 1.1])))
    with pytest.raises(BenchError, match="tau_std of query 0"):
        bad.check(workload)


def test_run_measures_all_subjects_in_both_states():
    """A double pendulum, too short for meaningful figures."""
    source = Source(
        robot="double-pendulum",
        stream=Simulation(n_samples=80, speed=5.0),
        fit=QUICK,
        load={"hyperparameter_samples": 80, "max_iterations": 10_000, "starts": 20},
    )
    measured = run(Options(source=source, runs=1, queries=20, seconds=0.05), Console(quiet=True))
    assert "nan" not in table.markdown(measured)
    absent = {LOOP} if gpytorch_installed() else {LOOP, "gpytorch", "gpytorch-fast"}
    assert list(measured.rows) == [key for key in KEYS if key not in absent]
    for row in measured.rows.values():
        assert set(row.runs) == {"idle", "training"}
        for runs in row.runs.values():
            assert len(runs) == 1
            assert 0 < runs[0].p50 <= runs[0].p90 <= runs[0].p99 <= runs[0].p999 <= runs[0].largest
    ticks = {state: (pair.asked.ticks, pair.floor.ticks) for state, pair in measured.loops.items()}
    assert ticks == {"idle": (50, 50), "training": (50, 50)}
    assert all(each.value is not None for each in targets(measured) if "GPyTorch" not in each.name)
