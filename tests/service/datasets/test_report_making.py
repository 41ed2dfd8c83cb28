"""The whole report: its figures against the samples, its shape, its memory, and the real recordings."""

import json
from pathlib import Path

import numpy as np
import pytest

from lipcore.data.signals import low_pass, noise_level
from lipcore.preparation.recipe import Recipe
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from service.contract.datasets import DatasetReport
from service.datasets.report.making import make_report
from service.datasets.report.texts import list_names
from service.datasets.staging import prepare
from tests.lipcore.braked import close_brakes
from tests.service.datasets.report_data import profile_of, recording, report_on, staged


def test_report_describes_the_samples(tmp_path: Path) -> None:
    columns = recording("double-pendulum", 20.0, 128.0, 6)
    profile = profile_of("double-pendulum", 50.0)
    raw = staged(tmp_path, profile.joint_names, columns)
    prepared = prepare(raw, tmp_path, Recipe(), 30, raw.disk)
    made = make_report(raw, prepared, profile, ["a fact"])
    report = DatasetReport.model_validate(made)
    assert json.loads(json.dumps(made, allow_nan=False)) == made
    q, tau = (low_pass(columns[name], 128.0)[32:-32] for name in ("q", "tau"))
    assert (report.rows_uploaded, report.rows, report.episodes, report.gaps) == (2560, 2496, 1, 0)
    assert (report.derived, report.rate_hz, report.reading) == (["ddq"], 128, ["a fact"])
    assert report.ranges["tau"]["max"] == pytest.approx(tau.max(0).tolist(), rel=1e-9)
    assert report.ranges["q"]["min"] == pytest.approx(q.min(0).tolist(), rel=1e-9)
    assert report.torque_noise_estimate == pytest.approx(noise_level([tau]).tolist(), rel=1e-6)
    assert (report.steps, report.recipe) == (prepared.steps, Recipe().to_json())
    assert report.preparation == [step["text"] for step in prepared.steps]
    assert [each.torque for each in report.noise] == pytest.approx([0.01, 0.01], rel=0.15)
    assert report.limits[0].torque_used == pytest.approx(np.abs(columns["tau"][:, 0]).max() / 50)
    assert "The recording lasts 20 s. Record several minutes" in report.advice[-1]


def test_constant_torque_and_unknown_robot_get_a_report(tmp_path: Path) -> None:
    columns = recording("double-pendulum", 20.0, 100.0, 6)
    columns = columns | {"tau": np.column_stack([columns["tau"][:, 0], np.full(2000, 2.0)])}
    report = report_on(tmp_path, ("a", "b"), columns, profile_of("finger-edu"), Recipe(filtering="never"))
    assert any("no joint matches robot finger-edu" in each for each in report.reading)
    assert report.robot is None
    assert report.lag[2].reason == "the torque is constant"
    assert report.excitation.joints[1].viscous.verdict == "not determined"


@pytest.mark.parametrize("rows", [30, 31, 45])
def test_shortest_recordings_get_a_report(tmp_path: Path, rows: int) -> None:
    rng = np.random.default_rng(rows)
    columns = {name: rng.standard_normal((rows, 3)) for name in ("q", "dq", "ddq", "tau")}
    columns |= {"t": np.arange(rows) / 10, "episode": np.repeat(np.arange(3.0), rows // 3 + 1)[:rows]}
    report = report_on(tmp_path, ("a", "b", "c"), columns)
    assert report.rows == rows
    assert all(each.seconds is None for each in report.lag)


def test_long_lists_of_names_are_shortened() -> None:
    assert list_names("abcdefghijk") == "a, b, c, d, e, f, g, h and 3 more"


def test_rows_with_closed_brakes_are_left_out_and_reported(tmp_path: Path) -> None:
    robot = load_robot("ur10")
    samples, braked = close_brakes(simulate(robot, Simulation(2500, 50.0, course="rests", motion="full"), 5))
    columns = {name: getattr(samples, name) for name in ("t", "q", "dq", "ddq", "tau")}
    report = report_on(tmp_path, samples.joint_names, columns, recipe=Recipe(filtering="never"))
    assert report.rows == pytest.approx(len(samples) - braked.sum(), abs=0.05 * braked.sum())
    (step,) = (step for step in report.steps if step["step"] == "leave_out")
    assert (step["why"], step["rows"]) == ("braked", len(samples) - report.rows)
    (warning,) = (each for each in report.warnings if "brakes" in each)
    assert warning.startswith(
        f"{samples.joint_names[1]}: no torque at standstill in {step['rows'] / 25:.0f} % of the rows"
    )
    first = int(np.flatnonzero(braked)[5])  # the first stretch has one row
    assert f"({samples.t[first]:.1f} s to " in warning
