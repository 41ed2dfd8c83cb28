"""How well data determine friction and rigid bodies: against least squares done with NumPy and Pinocchio alone."""

from pathlib import Path

import numpy as np
import pinocchio
import pytest

from lipcore.preparation.recipe import Recipe
from lipcore.robots.library import load_robot
from service.datasets.report.excitation import collinearity, count_reversals
from tests.service.datasets.report_data import profile_of, report_on, swing

AS_IT_IS = Recipe(filtering="never")
NOISE = np.array([0.05, 0.2])


def exact(name: str, seconds: float, seed: int, rate: float = 50.0, **options: float) -> dict[str, np.ndarray]:
    """Motion without noise, and torque of the URDF's rigid bodies."""
    move = swing(name, seed, **options)
    t = np.arange(int(seconds * rate)) / rate
    q, dq, ddq = move.at(t)
    model, data = move.robot.model, move.robot.model.createData()
    tau = np.array([pinocchio.rnea(model, data, *row) for row in zip(q, dq, ddq, strict=True)])
    return {"t": t, "q": q, "dq": dq, "ddq": ddq, "tau": tau}


def regressor(name: str, columns: dict[str, np.ndarray]) -> np.ndarray:
    """(N, n, 10 n) by Pinocchio."""
    model = load_robot(name).model
    data = model.createData()
    rows = zip(columns["q"], columns["dq"], columns["ddq"], strict=True)
    return np.array([pinocchio.computeJointTorqueRegressor(model, data, *row).copy() for row in rows])


def test_friction_beside_rigid_bodies_is_that_of_least_squares(tmp_path: Path) -> None:
    columns = exact("double-pendulum", 30.0, 1)
    columns["tau"] = columns["tau"] + NOISE * np.random.default_rng(3).standard_normal((1500, 2))
    profile = profile_of("double-pendulum")
    report = report_on(tmp_path, profile.joint_names, columns, profile, AS_IT_IS)
    dq = columns["dq"]
    friction = np.zeros((len(dq), 2, 6))
    for joint in (0, 1):
        terms = [dq[:, joint], np.tanh(dq[:, joint] / 0.02), np.ones(len(dq))]
        friction[:, joint, 3 * joint : 3 * joint + 3] = np.column_stack(terms)
    both = np.concatenate([regressor("double-pendulum", columns), friction], axis=2) / NOISE[:, None]
    solved = np.linalg.pinv(both.reshape(2 * len(dq), -1), rcond=1e-10)
    stds = np.sqrt(np.square(solved).sum(axis=1))[-6:].reshape(2, 3)
    assert report.excitation.friction_beside == "rigid bodies"
    for each, expected in zip(report.excitation.joints, stds, strict=True):
        result = [each.viscous.std, each.coulomb.std, each.offset.std]
        assert result == pytest.approx(expected.tolist(), rel=0.15)
    entire = report.excitation.whole  # base parameters are those of the regressor
    stacked = regressor("double-pendulum", columns).reshape(-1, 20)
    assert entire.parameters == entire.rank == np.linalg.matrix_rank(stacked, tol=1e-8 * np.linalg.norm(stacked, 2))
    assert entire.condition > 1


def test_joints_that_stand_still_leave_parameters_unexcited(tmp_path: Path) -> None:
    columns = exact("ur5", 20.0, 2)
    for quantity, value in (("q", 0.3), ("dq", 0.0), ("ddq", 0.0)):
        columns[quantity] = columns[quantity].copy()
        columns[quantity][:, 1:] = value
    profile = profile_of("ur5")
    report = report_on(tmp_path, profile.joint_names, columns, profile, AS_IT_IS)
    entire = report.excitation.whole
    assert entire.rank < entire.parameters == 36
    assert entire.weakest == pytest.approx(0, abs=1e-6)
    reply = " ".join(report.advice)
    assert "wrist_2_joint and wrist_3_joint: moved less than 0.02" in reply
    assert "shoulder_pan_joint" not in reply.split(": moved less than")[0]
    assert f"{entire.parameters - entire.rank} of 36 base parameters" in reply


def test_motion_in_one_direction_does_not_identify_coulomb_friction(tmp_path: Path) -> None:
    t = np.arange(2000) / 100
    q = np.column_stack([0.5 * t + 0.05 * np.sin(2 * t), np.sin(1.3 * t) + 0.3 * np.sin(3.1 * t)])
    tau = np.cos(q) + 0.01 * np.random.default_rng(1).standard_normal(q.shape)
    report = report_on(tmp_path, ("a", "b"), {"t": t, "q": q, "tau": tau})
    a, b = report.excitation.joints
    assert (a.backwards, a.reversals) == (0, 0)
    assert a.coulomb.verdict == "not determined"
    assert b.backwards > 0.3
    assert any(each.startswith("a: moved in one direction only") for each in report.advice)


def test_reversals_ignore_noise_and_breaks() -> None:
    dq = np.array([0.5, 0.01, -0.01, 0.5, -0.5, 0.0, -0.3, 0.4, 0.4, -0.4])
    part = np.array([0, 0, 0, 0, 0, 0, 0, 0, 1, 2])
    assert count_reversals(dq, part) == 2


def test_collinearity_is_the_inverse_of_variance_inflation() -> None:
    rng = np.random.default_rng(1)
    q, dq, ddq = rng.uniform(-2, 2, 500), rng.standard_normal(500), rng.standard_normal(500)
    ddq += 3 * dq
    raw = np.column_stack([dq, np.tanh(dq / 0.02), ddq, np.cos(q), np.sin(q)])
    shares = []
    for column in range(5):
        others = np.column_stack([np.delete(raw, column, axis=1), np.ones(500)])
        left = raw[:, column] - others @ np.linalg.lstsq(others, raw[:, column], rcond=None)[0]
        shares.append(1 - left.var() / raw[:, column].var())
    share, term = collinearity(q, dq, ddq)
    assert share == pytest.approx(max(shares), rel=1e-9)
    assert term == ("dq", "sign dq", "ddq", "cos q", "sin q")[int(np.argmax(shares))]
    assert collinearity(q, dq, 2 * dq)[0] == 1.0
    assert collinearity(np.ones(500), dq, ddq) == (1.0, "cos q")
