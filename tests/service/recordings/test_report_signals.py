"""Clock, limits and saturation: against what plain counting says of recordings made to have them."""

from pathlib import Path

import numpy as np
import pytest

from lipcore.preparation.recipe import Recipe
from service.datasets.report.signals import against_limits, limits_of, look_at_clock, saturation
from service.datasets.schema import DatasetReport
from tests.service.recordings.report_data import FakeProfile, recording, report_on, staged

PENDULUM = ("joint1", "joint2")
AS_IT_IS = Recipe(filtering="never")


def robot(**changed: np.ndarray) -> FakeProfile:
    limits = {
        "lower": np.array([-1.0, -1.0]),
        "upper": np.array([1.0, 1.0]),
        "speed": np.array([2.0, np.inf]),
        "torque": np.array([np.nan, 5.0]),
    }
    return FakeProfile("arm", PENDULUM, ("revolute", "revolute"), **limits | changed)


def test_jitter_is_a_share_of_the_usual_step(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    steps = 0.01 * (1 + np.where(rng.random(4000) < 0.02, 0.2, 0.0))
    t = np.concatenate([[5.0], 5.0 + np.cumsum(steps)])
    timing = look_at_clock(staged(tmp_path, ("a",), {"t": t, "q": t[:, None]}), 1.5, 3).timing
    assert timing.rate_hz == pytest.approx(100)
    assert timing.jitter_p50 == pytest.approx(0, abs=1e-9)
    assert timing.jitter_p99 == pytest.approx(0.2)
    assert timing.jitter_max == pytest.approx(0.2)
    assert timing.duration_s == pytest.approx(t[-1] - t[0])
    assert (timing.gaps, timing.repeated_stamps, timing.missing_rows) == ([], 3, 0)


def test_gaps_are_listed_with_their_times(tmp_path: Path) -> None:
    t = np.arange(1000) / 100
    t[300:] += 2.0
    t[700:] += 0.5
    episode = np.repeat([1.0, 2.0], 500)
    q = np.sin(t)[:, None]
    q[[10, 11]] = np.nan
    clock = look_at_clock(staged(tmp_path, ("a",), {"t": t, "episode": episode, "q": q}), 1.5, 0)
    assert [(gap.t, gap.seconds) for gap in clock.timing.gaps] == [
        (pytest.approx(2.99), pytest.approx(2.01)),
        (pytest.approx(8.99), pytest.approx(0.51)),
    ]
    assert clock.timing.missing_rows == 2
    # to 10, two missing rows alone, to 300, to 500 (another episode), to 700, to the end
    assert np.unique(clock.part, return_counts=True)[1].tolist() == [10, 1, 1, 288, 200, 200, 300]


def test_a_recording_without_times_has_no_rate(tmp_path: Path) -> None:
    timing = look_at_clock(staged(tmp_path, ("a",), {"q": np.zeros((50, 1))}), 1.5, 0).timing
    assert (timing.rate_hz, timing.jitter_max, timing.duration_s) == (None, None, None)


def test_limits_are_compared_joint_by_joint() -> None:
    limits = limits_of(robot(), PENDULUM)
    q = np.linspace(-0.5, 1.5, 201)
    columns = {"q": q, "dq": 3 * q, "tau": 4 * q}
    first, second = (against_limits(joint, PENDULUM[joint], columns, limits) for joint in (0, 1))
    assert first.range_used == pytest.approx(1.0)
    assert first.beyond_range == pytest.approx(50 / 201)
    assert first.speed_used == pytest.approx(4.5 / 2)
    assert first.beyond_speed == pytest.approx(np.mean(np.abs(3 * q) > 2))
    assert (first.torque_used, first.beyond_torque) == (None, None)
    assert (second.speed_used, second.beyond_speed) == (None, None)
    assert second.torque_used == pytest.approx(6 / 5)
    unknown = against_limits(0, "joint1", columns, None)
    assert set(unknown.model_dump(exclude={"joint"}).values()) == {None}


def test_limits_follow_the_names() -> None:
    profile = robot(upper=np.array([1.0, 2.0]))
    swapped, one = limits_of(profile, PENDULUM[::-1]), limits_of(profile, ("joint2", "gripper"))
    assert swapped is not None
    assert swapped.upper.tolist() == [2.0, 1.0]
    assert swapped.urdf_joints == PENDULUM[::-1]
    assert one is not None
    assert one.upper[0] == 2.0
    assert np.isnan(one.upper[1])
    assert one.urdf_joints is None
    by_order = limits_of(profile, ("x", "y"))
    assert by_order is not None
    assert by_order.by_order
    assert by_order.urdf_joints == PENDULUM
    assert limits_of(profile, ("x", "y", "z")) is None
    assert limits_of(None, PENDULUM) is None


def test_a_torque_that_is_cut_off_is_seen() -> None:
    t = np.arange(2000) / 100
    full = 8 * np.sin(2 * t) + 2 * np.sin(7 * t)
    tau = np.clip(full, -6, 5)
    limits = limits_of(robot(), PENDULUM)
    found = saturation(1, "joint2", np.cos(t), tau, limits)
    assert found.at_largest == pytest.approx(np.mean((full >= 5) | (full <= -6)))
    assert found.flat == pytest.approx(found.at_largest, rel=0.05)
    assert found.at_limit == pytest.approx(np.mean(np.abs(tau) >= 0.99 * 5))
    assert saturation(0, "joint1", np.cos(t), full, limits).flat == 0
    assert saturation(0, "joint1", np.cos(t), full, limits).at_limit is None


def test_a_robot_that_holds_still_is_not_cut_off() -> None:
    q = np.concatenate([np.linspace(0, 1, 500), np.ones(500)])
    found = saturation(0, "a", q, 9.81 * q, None)
    assert found.flat == 0
    assert found.at_largest == pytest.approx(0.5, abs=0.01)
    assert saturation(0, "a", q, np.ones(1000), None).at_largest == 0


@pytest.fixture
def troubled(tmp_path: Path) -> DatasetReport:
    columns = dict(recording("double-pendulum", 30.0, 100.0, 5))
    columns["ddq"] = np.gradient(columns["dq"], 0.01, axis=0)
    most = np.abs(columns["tau"]).max(axis=0) / 2
    columns["tau"] = np.clip(columns["tau"], -most, most)
    columns["q"] = columns["q"].copy()
    columns["q"][200:300, 0] = np.nan
    return report_on(tmp_path, PENDULUM, columns, robot(upper=np.array([0.1, 1.0])), AS_IT_IS)


def test_what_is_wrong_is_said(troubled: DatasetReport) -> None:
    said = " ".join(troubled.warnings)
    assert "100 of 3000 rows lack a value" in said
    assert "positions of joint1" in said
    assert "are beyond the robot's limits" in said
    assert "it was cut off there" in said
    assert troubled.robot == "arm"
    assert troubled.noise is not None
    assert troubled.noise[0].velocity == pytest.approx(0, abs=1e-3)
