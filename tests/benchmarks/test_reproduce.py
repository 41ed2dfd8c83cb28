"""`python -m benchmarks.reproduce` on a small experiment, from options to tables and figures."""

import csv
import json
import shutil
from itertools import product

import numpy as np
import pinocchio
import pytest

import lipcore
from benchmarks import run
from benchmarks.reproduce.command import ERRORS, app
from benchmarks.reproduce.experiment import Cell, Experiment
from benchmarks.reproduce.results import Results, ResultsError
from lipcore.estimators.options import FitOptions
from lipcore.robots.library import ROBOTS, load_robot
from lipcore.robots.simulation import Simulation, simulate

ESTIMATORS = ("se", "rigid-body", "lip-chain")
JOINTS = ("joint1", "joint2")
FILES = {"cells.jsonl", "results.csv", "results.md", "summary.csv", "figure1.png", "reliability.png", "samples.png"}
TINY = ("--robot", "double-pendulum", "--training-sets", "1", "--test-sets", "2", "--samples", "40", "--workers", "1")


def reproduce(*arguments):
    """Run the experiment in this process; return its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["reproduce", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            run(app, ERRORS, "python -m benchmarks.reproduce")
    return ended.value.code or 0


def tiny(out, *options):
    estimators = [part for name in ESTIMATORS for part in ("--estimator", name)]
    return reproduce(*TINY, *estimators, "--size", 20, "--test-stride", 2, "--out", out, *options)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Return the folder of a finished run."""
    out = tmp_path_factory.mktemp("reproduction")
    assert tiny(out) == 0
    return out


def lines(folder):
    return [json.loads(line) for line in (folder / "cells.jsonl").read_text().splitlines()]


def cells(folder):
    return [tuple(line["result"]["cell"].values()) for line in lines(folder)[1:]]


def rows(folder):
    with (folder / "results.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_all_files_are_written_and_cells_computed_once(finished):
    assert {path.name for path in finished.iterdir()} == FILES
    for name in FILES:
        assert (finished / name).stat().st_size > 500
        if name.endswith(".png"):
            assert (finished / name).read_bytes().startswith(b"\x89PNG")
    assert sorted(cells(finished)) == sorted(product(ESTIMATORS, [1.0], [20, 40], [1]))
    assert {line["settings"] for line in lines(finished)} == {lines(finished)[0]["settings"]}
    found = {(row["estimator"], row["samples"], row["test_seed"], row["joint"]) for row in rows(finished)}
    assert found == set(product(ESTIMATORS, ["20", "40"], ["1001", "1002"], JOINTS))
    assert len(rows(finished)) == len(found)


@pytest.mark.slow
def test_results_equal_those_computed_here(finished):
    """Errors are against Pinocchio's torque, coverage and width are of the measured torque."""
    robot = load_robot("double-pendulum")
    training = simulate(robot, Simulation(40), 1).rows(np.round(np.linspace(0, 39, 20)).astype(int))
    model = lipcore.train(training, robot.joint_types, "lip-chain", FitOptions(device="cpu", prior="zero"))
    test = simulate(robot, Simulation(40, n_sinusoids=100), 1002).rows(slice(None, None, 2))
    answer = model.predict(test.q, test.dq, test.ddq)
    data, states = robot.model.createData(), zip(test.q, test.dq, test.ddq, strict=True)
    true = np.array([pinocchio.rnea(robot.model, data, *state) for state in states])
    total = np.hypot(answer.tau_std, answer.noise_std)
    expected = {
        "nmse": ((answer.tau - true) ** 2).mean(0) / true.var(0),
        "nmse_noisy": ((answer.tau - test.tau) ** 2).mean(0) / test.tau.var(0),
        "coverage_95": (np.abs(answer.tau - test.tau) <= 1.959963984540054 * total).mean(0),
        "width_95": 2 * 1.959963984540054 * total.mean(0),
        "torque_std": true.std(0),
    }
    tolerances = {"coverage_95": {"abs": 1e-5}, "torque_std": {"rel": 1e-5}}
    found = {(row["estimator"], row["samples"], row["test_seed"], row["joint"]): row for row in rows(finished)}
    for j, joint in enumerate(JOINTS):
        row = found["lip-chain", "20", "1002", joint]
        for name, values in expected.items():
            assert float(row[name]) == pytest.approx(values[j], **tolerances.get(name, {"rel": 1e-3})), name


@pytest.mark.slow
def test_killed_run_is_resumed(finished, tmp_path, capsys):
    """The run was killed while it wrote the third result, whose line is incomplete."""
    out = tmp_path / "killed"
    shutil.copytree(finished, out)
    whole = (finished / "cells.jsonl").read_bytes().splitlines(keepends=True)
    kept, torn = b"".join(whole[:3]), whole[3][: len(whole[3]) // 2]
    (out / "cells.jsonl").write_bytes(kept + torn)
    assert tiny(out) == 0
    assert "6 trainings, 2 of them in" in capsys.readouterr().out
    assert (out / "cells.jsonl").read_bytes().startswith(kept)
    assert sorted(cells(out)) == sorted(cells(finished))
    assert "trainings in this run" in (out / "results.md").read_text()
    assert sorted(map(str, rows(finished))) == sorted(map(str, rows(out)))
    assert tiny(out) == 0  # a finished run is only reported again
    assert "6 trainings, 6 of them in" in capsys.readouterr().out


@pytest.mark.slow
def test_results_of_other_settings_are_not_mixed(finished, capsys):
    before = (finished / "cells.jsonl").read_bytes()
    assert tiny(finished, "--samples", 50, "--seed", 5) == 1
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    for text in ("samples was 40, now 50", "first_seed was 1, now 5", "Choose another folder with --out"):
        assert text in err
    assert (finished / "cells.jsonl").read_bytes() == before


def test_two_runs_do_not_share_a_folder(tmp_path):
    with Results(tmp_path, Experiment()), pytest.raises(ResultsError, match="in use by another run"):
        Results(tmp_path, Experiment())
    with pytest.raises(ResultsError, match="now after"):
        Results(tmp_path, Experiment(code="after"))
    Results(tmp_path, Experiment()).__exit__()


def test_training_and_test_sets_differ_in_seeds_and_frequencies():
    experiment = Experiment(robot="double-pendulum", samples=40, test_sets=4, test_stride=1)
    whole, fewer = (experiment.training_set(Cell(estimator="se", speed=2.0, samples=size, seed=3)) for size in (40, 10))
    assert (len(fewer), fewer.t[0], fewer.t[-1]) == (10, whole.t[0], whole.t[-1])
    assert set(fewer.t) <= set(whole.t)
    assert not set(experiment.training_seeds(10)) & set(experiment.test_seeds())
    found, torque = experiment.test_set(1.0, 1001)
    expected = simulate(load_robot("double-pendulum"), Simulation(40, n_sinusoids=100), 1001)
    np.testing.assert_array_equal(found.tau, expected.tau)
    assert np.std(found.tau - torque) == pytest.approx(0.01, rel=0.3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--robot", "r2d2"), f"robot is 'r2d2', expected one of {', '.join(ROBOTS)}"),
        (("--estimator", "magic"), "estimator is 'magic', expected one of auto, lip, lip-chain"),
        (("--speed", "nan"), "--speed is nan, expected a positive number"),
        (("--size", 3), "--size is 3, expected from 10"),
        (("--test-stride", 200), "--test-stride is 200, expected at most 50"),
    ],
)
def test_bad_options_are_refused_before_any_work(tmp_path, capsys, options, message):
    out = tmp_path / "out"
    assert reproduce(*options, "--out", out) == 1
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert message in err
    assert not out.exists()
