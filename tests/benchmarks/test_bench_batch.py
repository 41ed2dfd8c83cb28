"""`python -m benchmarks batch`: short runs on the shipped model; code of other libraries where they are installed."""

from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from benchmarks.batch import on_device, running, transports
from benchmarks.batch.peers import open_peers
from benchmarks.batch.running import Options, draw_states
from benchmarks.batch.symbolic import rnea_function
from benchmarks.exported.running import SHIPPED
from benchmarks.workload import BenchError, simulator
from lipcore.files.persistence import load
from lipcore.robots.library import load_robot, pinocchio

ON_DEVICE = [f"{kind}, cpu {dtype}" for dtype in ("float32", "float64") for kind in ("mean", "with std")]


def test_times_of_all_subjects_and_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.batch.peers.compile_pinocchio", _fail)
    monkeypatch.setattr(running, "MIN_STATES", 30)
    results = running.run(Options(SHIPPED, (1, 30), 1, device="cpu"), Console(quiet=True))
    assert {"mean", "with std", "Pinocchio's RNEA, Python loop", *ON_DEVICE} <= results.times.keys()
    assert all(set(sizes) == {1, 30} and min(map(min, sizes.values())) > 0 for sizes in results.times.values())
    assert max(results.deviations.values()) < 1e-12
    _, by_cpu, *_ = running.grids(results)
    assert by_cpu.columns == ("states in a batch", "1", "30")
    assert len(by_cpu.rows) == len(results.times)
    assert any(note.startswith("Pinocchio in C++ is not measured: ") for note in results.notes)


def _fail(*_: object) -> None:
    raise BenchError("no compiler")


@pytest.mark.slow  # traces thousands of operations
def test_compiled_chunks_on_a_device_equal_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(on_device, "CHUNK", 20)
    monkeypatch.setattr(on_device, "DTYPES", {"float64": torch.float64})
    monkeypatch.setattr(torch, "compile", lambda traced, dynamic: traced)
    model = load(SHIPPED)
    states = draw_states(model, 40)
    expected = model.predict(*states)
    found = {name: work() for name, work in on_device.on_device(model, "cpu", states, compiles=True)}
    assert list(found) == [f"{kind}, cpu float64{how}" for kind in ("mean", "with std") for how in ("", ", compiled")]
    for name, chunks in found.items():
        parts = list(zip(*chunks, strict=True)) if name.startswith("with std") else [chunks]
        for part, known in zip(parts, (expected.mean, expected.tau_std), strict=False):
            np.testing.assert_allclose(np.concatenate(part), known, rtol=0, atol=1e-9 * np.abs(known).max())


@pytest.mark.parametrize("name", ["panda", "ur10", "tiago", "double-pendulum"])
def test_symbolic_torques_equal_pinocchio(name: str) -> None:
    casadi, robot = pytest.importorskip("casadi"), load_robot(name)
    states = np.random.default_rng(0).uniform(-1, 1, (10, 3, robot.n_joints))
    ask, data = rnea_function(casadi, robot), robot.model.createData()
    for q, dq, ddq in states:
        expected = pinocchio().rnea(robot.model, data, robot.configuration(q), dq, ddq)
        np.testing.assert_allclose(np.ravel(ask(q, dq, ddq)), expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.slow  # compiles Pinocchio
def test_compiled_libraries_equal_pinocchio() -> None:
    pytest.importorskip("casadi")
    model = load(SHIPPED)
    states = draw_states(model, 50)
    with open_peers(model, {}, simulator(SHIPPED), None) as (peers, _):
        python, *compiled = [peer.prepare(states)() for peer in peers if peer.knows_arm]
        assert len(compiled) == 2
        for torques in compiled:
            np.testing.assert_allclose(torques, python, rtol=0, atol=1e-12 * np.abs(python).max())


@pytest.mark.slow  # starts a service
def test_transports_answer_as_in_process() -> None:
    results = transports.run(Path(SHIPPED), [30, 2000], 1, Console(quiet=True))
    assert {transport for _, _, transport in results.times} == {"in process", "HTTP", "gRPC"}
    assert results.deviation == 0
    assert len(transports.targets(results)) == 8
