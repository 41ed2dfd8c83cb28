"""The paper's experiment in small: `python -m benchmarks.reproduce` from options to tables and figures."""

from __future__ import annotations

import csv
import json
import re
import shutil
import sys
from itertools import product

import numpy as np
import pinocchio
import pytest

import lipcore
from benchmarks import run
from benchmarks.reproduce import figures, report, table
from benchmarks.reproduce.command import ERRORS, app
from benchmarks.reproduce.experiment import Cell, Experiment, run_cell
from benchmarks.reproduce.results import Results, ResultsError
from lipcore.fitting.options import FitOptions
from lipcore.robots.library import ROBOTS, load_robot
from lipcore.robots.simulation import Stream, simulate

ESTIMATORS = ("se", "rigid-body", "lip-chain")
JOINTS = ("joint1", "joint2")
FILES = {
    "cells.jsonl",
    "figure1.png",
    "reliability.png",
    "results.csv",
    "results.md",
    "samples.png",
    "summary.csv",
}
TINY = ("--robot", "double-pendulum", "--training-sets", "1", "--test-sets", "2", "--samples", "40", "--workers", "1")


def reproduce(*arguments):
    """Run the experiment with arguments in this process; return its exit code."""
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
    """The folder of a finished run."""
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
def test_every_file_is_written_and_every_cell_computed_once(finished):
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
def test_results_are_those_of_training_and_judging_by_hand(finished):
    """Error against Pinocchio's torque, coverage and width against the measured torque, all computed here."""
    robot = load_robot("double-pendulum")
    training = simulate(robot, Stream(40), 1).rows(np.round(np.linspace(0, 39, 20)).astype(int))
    model = lipcore.train(training, robot.joint_types, "lip-chain", FitOptions(device="cpu", prior="zero"))
    test = simulate(robot, Stream(40, n_sinusoids=100), 1002).rows(slice(None, None, 2))
    answer = model.predict(test.q, test.dq, test.ddq)
    data = robot.model.createData()
    true = np.array(
        [pinocchio.rnea(robot.model, data, *state) for state in zip(test.q, test.dq, test.ddq, strict=True)]
    )
    total = np.hypot(answer.tau_std, answer.noise_std)
    nmse = ((answer.tau - true) ** 2).mean(0) / true.var(0)
    noisy = ((answer.tau - test.tau) ** 2).mean(0) / test.tau.var(0)
    coverage = (np.abs(answer.tau - test.tau) <= 1.959963984540054 * total).mean(0)
    for j, joint in enumerate(JOINTS):
        (row,) = [
            row
            for row in rows(finished)
            if (row["estimator"], row["samples"], row["test_seed"], row["joint"]) == ("lip-chain", "20", "1002", joint)
        ]
        assert float(row["nmse"]) == pytest.approx(nmse[j], rel=1e-3)
        assert float(row["nmse_noisy"]) == pytest.approx(noisy[j], rel=1e-3)
        assert float(row["coverage_95"]) == pytest.approx(coverage[j], abs=1e-5)
        assert float(row["width_95"]) == pytest.approx(2 * 1.959963984540054 * total[:, j].mean(), rel=1e-3)
        assert float(row["torque_std"]) == pytest.approx(true[:, j].std(), rel=1e-5)


def markdown_table(text, heading):
    """Cells of the table after a heading: {estimator: [text a joint]}."""
    part = text.split(heading)[1].strip().split("\n\n")[0]
    found = [[cell.strip(" *`") for cell in line.strip("|").split("|")] for line in part.splitlines()[2:]]
    return {name: rest for name, *rest in found}


@pytest.mark.slow
def test_tables_say_what_the_csv_holds(finished):
    text = (finished / "results.md").read_text()
    errors = markdown_table(text, "the best of each joint in bold:")
    fewer = markdown_table(text, "after training on 20 samples (the first training set):")
    coverages = markdown_table(text, "Mean (lowest) coverage of the 95 % interval, in %:")
    widths = markdown_table(text, "Mean width of the 95 % interval, N·m:")
    levels = markdown_table(text, "Mean coverage over all joints, in %:")
    for name in ESTIMATORS:
        for j, joint in enumerate(JOINTS):
            of = [row for row in rows(finished) if (row["estimator"], row["joint"]) == (name, joint)]
            small, full = ([row for row in of if row["samples"] == size] for size in ("20", "40"))
            column = {key: np.array([float(row[key]) for row in full]) for key in ("nmse", "coverage_95", "width_95")}
            assert float(errors[name][j]) == pytest.approx(np.median(column["nmse"]), rel=0.06)
            assert float(fewer[name][j]) == pytest.approx(np.median([float(row["nmse"]) for row in small]), rel=0.06)
            mean, lowest = 100 * column["coverage_95"].mean(), 100 * column["coverage_95"].min()
            assert coverages[name][j] == f"{mean:.0f} ({lowest:.0f})"
            assert float(widths[name][j]) == pytest.approx(column["width_95"].mean(), rel=0.01)
        everything = [row for row in rows(finished) if (row["estimator"], row["samples"]) == (name, "40")]
        for k, level in enumerate((50, 80, 95, 99)):
            mean = 100 * np.mean([float(row[f"coverage_{level}"]) for row in everything])
            assert float(levels[name][k]) == pytest.approx(mean, abs=0.06)
    # what a reader needs to repeat and to judge it
    for said in (
        "python -m benchmarks.reproduce --robot double-pendulum",
        "from torque alone",
        "every second sample",
        "torch 2.",
    ):
        assert said in text


@pytest.mark.slow
def test_summary_has_the_quartiles(finished):
    with (finished / "summary.csv").open() as file:
        for summary in csv.DictReader(file):
            key = ("estimator", "samples", "joint")
            of = [row for row in rows(finished) if all(row[name] == summary[name] for name in key)]
            quartiles = np.percentile([float(row["nmse"]) for row in of], (25, 50, 75))
            found = [float(summary[name]) for name in ("nmse_q25", "nmse_median", "nmse_q75")]
            np.testing.assert_allclose(found, quartiles, rtol=1e-4)
            assert int(summary["sets"]) == len(of) == 2


@pytest.mark.slow
def test_a_killed_run_goes_on_with_what_is_missing(finished, tmp_path, capsys):
    """Killed while it wrote the third result: two are kept, the torn line is not."""
    out = tmp_path / "killed"
    shutil.copytree(finished, out)
    whole = (finished / "cells.jsonl").read_bytes().splitlines(keepends=True)
    kept, torn = b"".join(whole[:3]), whole[3][: len(whole[3]) // 2]
    (out / "cells.jsonl").write_bytes(kept + torn)
    assert tiny(out) == 0
    said = capsys.readouterr().out
    assert "6 trainings, 2 of them in" in said
    assert (out / "cells.jsonl").read_bytes().startswith(kept)
    assert sorted(cells(out)) == sorted(cells(finished))
    assert "trainings in this run" in (out / "results.md").read_text()
    for before, after in zip(sorted(map(str, rows(finished))), sorted(map(str, rows(out))), strict=True):
        assert before == after


@pytest.mark.slow
def test_a_finished_run_is_only_reported_again(finished, tmp_path, capsys):
    out = tmp_path / "again"
    shutil.copytree(finished, out)
    for name in FILES - {"cells.jsonl"}:
        (out / name).unlink()
    assert tiny(out) == 0
    assert "6 trainings, 6 of them in" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == FILES
    assert (out / "cells.jsonl").read_bytes() == (finished / "cells.jsonl").read_bytes()
    assert (out / "results.csv").read_bytes() == (finished / "results.csv").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--test-sets", 3), "test_sets was 2, now 3"),
        (("--samples", 50), "samples was 40, now 50"),
        (("--robot", "asr-twodof"), "robot was double-pendulum, now asr-twodof"),
        (("--seed", 5), "first_seed was 1, now 5"),
    ],
)
def test_results_of_other_settings_are_not_mixed(finished, capsys, options, said):
    before = (finished / "cells.jsonl").read_bytes()
    assert tiny(finished, *options) == 1
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert said in err
    assert "choose another folder with --out" in err
    assert (finished / "cells.jsonl").read_bytes() == before


@pytest.mark.slow
@pytest.mark.parametrize("damage", [b"not JSON\n", b"{}\n", b"[]\n", b'{"settings": "x", "result": {}}\n'])
def test_a_damaged_file_is_named_with_its_line(finished, tmp_path, capsys, damage):
    content = (finished / "cells.jsonl").read_bytes() + damage
    (tmp_path / "cells.jsonl").write_bytes(content)
    assert tiny(tmp_path) == 1
    assert "cells.jsonl, line 8, " in capsys.readouterr().err
    assert (tmp_path / "cells.jsonl").read_bytes() == content


def test_two_runs_do_not_share_a_folder(tmp_path):
    with Results(tmp_path, Experiment()), pytest.raises(ResultsError, match="another run is at work"):
        Results(tmp_path, Experiment())
    Results(tmp_path, Experiment()).__exit__()


def test_other_code_is_another_setting(tmp_path):
    with Results(tmp_path, Experiment(code="before")):
        pass
    with pytest.raises(ResultsError, match="code was before, now after"):
        Results(tmp_path, Experiment(code="after"))


@pytest.mark.slow
def test_a_failed_training_is_reported_and_tried_again(tmp_path):
    experiment = Experiment(robot="double-pendulum", samples=40, test_sets=1)
    good = Cell(estimator="se", speed=1.0, samples=40, seed=1)
    bad = Cell(estimator="lip", speed=1.0, samples=5, seed=1)
    with Results(tmp_path, experiment) as results:
        for cell in (good, bad):
            results.add(run_cell(experiment, cell))
    with Results(tmp_path, experiment) as results:
        assert results.missing([good, bad]) == [bad]
        assert [result.cell for result in results.of([good, bad])] == [good]
        (failure,) = results.failed([good, bad])
    assert failure.error == "ValueError: samples has 5 rows, expected at least 10"
    found = run_cell(experiment, good)
    run = report.Run(
        experiment,
        command="python -m benchmarks.reproduce",
        joint_names=JOINTS,
        speeds=(1.0,),
        estimators=("se", "lip"),
        sizes=(),
        training_sets=1,
        curve_sets=1,
        results=[found],
        failed=[failure],
        rows=table.rows([found], JOINTS),
        workers=1,
        seconds=1.0,
        computed=1,
    )
    report.write(run, tmp_path)
    figures.draw(run, tmp_path)
    text = (tmp_path / "results.md").read_text()
    assert "- lip, speed 1, 5 samples, seed 1: ValueError" in text
    assert markdown_table(text, "the best of each joint in bold:")["lip"] == ["–", "–"]


def test_fewer_samples_are_spread_over_the_whole_stream():
    experiment = Experiment(robot="double-pendulum", samples=40)
    whole, fewer = (experiment.training_set(Cell(estimator="se", speed=2.0, samples=size, seed=3)) for size in (40, 10))
    assert (len(whole), len(fewer)) == (40, 10)
    assert (fewer.t[0], fewer.t[-1]) == (whole.t[0], whole.t[-1])
    assert set(fewer.t) <= set(whole.t)


def test_training_and_test_sets_have_other_seeds_and_frequencies():
    experiment = Experiment(robot="double-pendulum", samples=40, test_sets=4, test_stride=1)
    assert not set(experiment.training_seeds(10)) & set(experiment.test_seeds())
    found, torque = experiment.test_set(1.0, 1001)
    expected = simulate(load_robot("double-pendulum"), Stream(40, n_sinusoids=100), 1001)
    np.testing.assert_array_equal(found.tau, expected.tau)
    assert np.std(found.tau - torque) == pytest.approx(0.01, rel=0.3)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--robot", "r2d2"), f"robot is 'r2d2', expected one of {', '.join(ROBOTS)}"),
        (("--estimator", "magic"), "estimator is 'magic', expected one of auto, lip, lip-chain"),
        (("--speed", "-1"), "--speed is -1, expected a positive number"),
        (("--speed", "nan"), "--speed is nan, expected a positive number"),
        (("--size", 500), "--size is 500, expected from 10 to less than --samples, 500"),
        (("--size", 3), "--size is 3, expected from 10"),
        (("--test-stride", 200), "--test-stride is 200, expected at most 50"),
    ],
)
def test_bad_options_are_named_before_any_work(tmp_path, capsys, options, said):
    out = tmp_path / "out"
    assert reproduce(*options, "--out", out) == 1
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert said in err
    assert not out.exists()


@pytest.mark.parametrize("option", ["--training-sets", "--test-sets", "--workers", "--test-stride"])
def test_counts_below_one_are_refused(tmp_path, capsys, option):
    assert reproduce(option, 0, "--out", tmp_path / "out") == 2
    assert option in capsys.readouterr().err


@pytest.mark.parametrize(
    ("package", "remedy"),
    [
        ("matplotlib", r"figures need Matplotlib: pip install 'lipserve\[plot\]'"),
        ("pinocchio", r".* needs? Pinocchio: pip install .*"),
    ],
)
def test_a_missing_package_is_said_with_the_remedy_before_any_work(tmp_path, monkeypatch, capsys, package, remedy):
    monkeypatch.setitem(sys.modules, package, None)
    out = tmp_path / "out"
    assert reproduce("--out", out) == 1
    assert re.fullmatch(f"error: {remedy}\n", capsys.readouterr().err)
    assert not out.exists()
