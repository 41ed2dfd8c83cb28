"""The whole report: its figures against the samples, its shape, its memory, and the real recordings."""

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from lipcore.data.signals import low_pass, noise_level
from lipcore.preparation.recipe import Recipe
from service.datasets.report.making import make_report
from service.datasets.schema import DatasetReport
from service.datasets.staging import prepare
from service.foundation.settings import Settings
from tests.lipcore.test_real_data import SCHUNK
from tests.service.recordings.report_data import profile_of, recording, report_on, staged

OLD = {
    "rows_uploaded": 80,
    "rows": 80,
    "episodes": 1,
    "rate_hz": 10.0,
    "gaps": 0,
    "derived": [],
    "preparation": [],
    "ranges": {"q": {"min": [0.0], "max": [1.0]}},
    "torque_noise_estimate": [0.1],
    "warnings": [],
}


def test_reports_of_older_releases_are_still_shown() -> None:
    report = DatasetReport.model_validate(OLD)
    assert (report.timing, report.excitation, report.advice, report.steps) == (None, None, [], [])


def test_a_report_tells_of_the_samples(tmp_path: Path) -> None:
    columns = recording("double-pendulum", 20.0, 128.0, 6)
    profile = profile_of("double-pendulum", 50.0)
    raw = staged(tmp_path, profile.joint_names, columns)
    prepared = prepare(raw, tmp_path, Recipe(), 30, raw.disk)
    made = make_report(raw, prepared, profile, ["a fact"], Settings(home=tmp_path))
    report = DatasetReport.model_validate(made)
    assert json.loads(json.dumps(made, allow_nan=False)) == made
    tau = low_pass(columns["tau"], 128.0)[32:-32]
    assert (report.rows_uploaded, report.rows, report.episodes, report.gaps) == (2560, 2496, 1, 0)
    assert report.derived == ["ddq"]
    assert report.rate_hz == 128
    assert report.ranges["tau"]["max"] == pytest.approx(tau.max(0).tolist(), rel=1e-9)
    assert report.ranges["q"]["min"] == pytest.approx(low_pass(columns["q"], 128.0)[32:-32].min(0).tolist(), rel=1e-9)
    assert report.torque_noise_estimate == pytest.approx(noise_level([tau]).tolist(), rel=1e-6)
    assert report.preparation == [step["text"] for step in prepared.steps]
    assert report.steps == prepared.steps
    assert report.recipe == Recipe().to_json()
    assert report.reading == ["a fact"]
    assert report.noise is not None
    assert [each.torque for each in report.noise] == pytest.approx([0.01, 0.01], rel=0.15)
    assert report.limits is not None
    assert report.limits[0].torque_used == pytest.approx(np.abs(columns["tau"][:, 0]).max() / 50)
    assert "20 s in all: record some minutes" in report.advice[-1]


def test_a_constant_torque_and_a_strange_robot(tmp_path: Path) -> None:
    columns = dict(recording("double-pendulum", 20.0, 100.0, 6))
    columns["tau"] = columns["tau"].copy()
    columns["tau"][:, 1] = 2.0
    report = report_on(tmp_path, ("a", "b"), columns, profile_of("finger-edu"), Recipe(filtering="never"))
    assert "tau2 is constant: nothing can be learnt about this joint's torque" in report.warnings
    assert any("robot finger-edu are not those of the data" in each for each in report.reading)
    assert report.robot is None
    assert report.lag is not None
    assert report.lag[2].reason == "the torque is constant"
    assert report.excitation is not None
    assert report.excitation.joints[1].viscous.verdict == "not determined"


@pytest.mark.parametrize("rows", [30, 31, 45])
def test_the_shortest_recordings_get_a_report(tmp_path: Path, rows: int) -> None:
    rng = np.random.default_rng(rows)
    columns = {name: rng.standard_normal((rows, 3)) for name in ("q", "dq", "ddq", "tau")}
    columns |= {"t": np.arange(rows) / 10, "episode": np.repeat(np.arange(3.0), rows // 3 + 1)[:rows]}
    report = report_on(tmp_path, ("a", "b", "c"), columns)
    assert report.rows == rows
    assert report.lag is not None
    assert all(each.seconds is None for each in report.lag)


def test_one_joint_that_never_moves(tmp_path: Path) -> None:
    columns = {name: np.zeros((50, 1)) for name in ("q", "dq", "ddq", "tau")}
    report = report_on(tmp_path, ("a",), columns, None, Recipe(filtering="never"))
    assert report.warnings == ["tau1 is constant: nothing can be learnt about this joint's torque"]
    assert report.advice[0].startswith("a: moved less than")


def test_memory_is_that_of_a_few_columns(tmp_path: Path) -> None:
    rows, joints = 100_000, 10
    t = np.arange(rows) / 1000
    angle = t[:, None] * np.random.default_rng(1).uniform(0.5, 3, joints)
    columns = {"t": t, "q": np.sin(angle), "dq": np.cos(angle), "ddq": -np.sin(angle), "tau": np.cos(2 * angle)}
    raw = staged(tmp_path, tuple(f"j{k}" for k in range(joints)), columns)
    prepared = prepare(raw, tmp_path, Recipe(filtering="never"), 30, raw.disk)
    settings = Settings(home=tmp_path, max_report_rows=300)
    tracemalloc.start()
    make_report(raw, prepared, None, [], settings)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 14 * 8 * rows  # of 41 columns


@pytest.mark.skipif(not SCHUNK.exists(), reason=f"no recording at {SCHUNK}")
def test_the_schunk_recording(tmp_path: Path) -> None:
    with np.load(SCHUNK) as file:
        columns = {name: file[name] for name in ("q", "dq", "tau")}
        episode, dt = file["episode"].astype(float), float(file["dt"])
    columns |= {"episode": episode, "t": np.arange(len(episode)) * dt}
    report = report_on(tmp_path, tuple(f"joint{k}" for k in range(1, 7)), columns)
    assert (report.rows_uploaded, report.episodes, report.derived) == (67450, 100, ["ddq"])
    one_way = next(each for each in report.advice if "moved in one direction only" in each)
    low, high = columns["dq"].min(0), columns["dq"].max(0)
    assert [f"joint{k + 1}" in one_way for k in range(6)] == [
        bool(min(-a, b) < 0.05) for a, b in zip(low, high, strict=True)
    ]
