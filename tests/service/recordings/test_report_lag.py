"""Lags between torque and motion that are known, since the simulated torque was shifted by them."""

from pathlib import Path

import numpy as np
import pytest

from service.datasets.report.fit import shifts
from tests.service.recordings.report_data import recording, report_on

NAMES = ("a", "b")


@pytest.mark.parametrize(("rate", "late"), [(50.0, 0.02), (50.0, -0.015), (250.0, 0.0), (250.0, 0.0033)])
def test_a_known_lag_is_found(tmp_path: Path, rate: float, late: float) -> None:
    report = report_on(tmp_path, NAMES, recording("double-pendulum", 30.0, rate, 3, late))
    assert report.lag is not None
    assert [each.joint for each in report.lag] == [None, *NAMES]
    for each in report.lag:
        assert each.seconds == pytest.approx(late, abs=2e-3)
        assert each.std_s is not None
        assert each.std_s < 5e-3
    said = " ".join(report.warnings)
    assert ("not of the same time" in said) == (abs(late) > 0.01)
    if late > 0.01:
        assert "after motion" in said
    if late < -0.01:
        assert "before motion" in said


def test_torque_that_motion_does_not_explain_has_no_lag(tmp_path: Path) -> None:
    columns = dict(recording("double-pendulum", 20.0, 100.0, 4))
    columns["tau"] = np.random.default_rng(1).standard_normal(columns["tau"].shape)
    report = report_on(tmp_path, NAMES, columns)
    assert report.lag is not None
    assert all(each.seconds is None and each.reason for each in report.lag)
    assert "explains only" in (report.lag[1].reason or "")


def test_slow_motion_cannot_tell(tmp_path: Path) -> None:
    t = np.arange(3000) / 100
    q = np.column_stack([0.5 * np.sin(0.3 * t), 0.4 * np.sin(0.2 * t)])
    tau = 3 * q + 0.02 * np.random.default_rng(1).standard_normal(q.shape)
    report = report_on(tmp_path, NAMES, {"t": t, "q": q, "tau": tau})
    assert report.lag is not None
    assert report.lag[0].seconds is None
    assert "record faster motion" in (report.lag[1].reason or "")


def test_without_times_there_is_no_lag(tmp_path: Path) -> None:
    columns = dict(recording("double-pendulum", 20.0, 100.0, 4))
    del columns["t"]
    columns["ddq"] = np.gradient(columns["dq"], 0.01, axis=0)
    report = report_on(tmp_path, NAMES, columns)
    assert report.lag is not None
    assert {each.reason for each in report.lag} == {"no times were given"}


@pytest.mark.parametrize(("rate", "longest"), [(30.0, 10_000), (250.0, 10_000), (1000.0, 400), (5000.0, 10**6)])
def test_shifts_lie_within_a_quarter_of_a_second(rate: float, longest: int) -> None:
    steps = shifts(rate, longest)
    assert steps is not None
    assert (steps == -steps[::-1]).all()
    assert len(steps) <= 130
    assert steps[-1] <= min(rate / 4, longest / 8)
    assert shifts(rate, 15) is None
