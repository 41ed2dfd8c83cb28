"""Tests of the drive: which kinds of friction a recording supports, and what a report states of them."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from lipcore import FitOptions, Samples, TorqueModel, load, save
from lipcore.arm import drive
from lipcore.arm.drive import choose_drive, held_out_errors
from lipcore.arm.posing import make_problem, with_kind
from lipcore.arm.problem import Point, Problem
from lipcore.data.motion import Motion
from lipcore.kernels.drive.kernel import Drive
from lipcore.kernels.drive.terms import drive_features, drive_terms, summary_rows
from lipcore.model.dynamics import forward_dynamics
from lipcore.model.parameters import friction_coefficients
from lipcore.robots.simulation import Simulation, inverse_dynamics, simulate
from lipcore.vocabulary import DRIVE_KINDS, DriveKind
from tests.choosing import slow
from tests.lipcore.arm_oracles import arm, nmse_per_joint, train_from_geometry

GEOMETRY, BODIES, ROBOT = arm("RRR", 31)
SHARE = 0.08
"""Friction per torque that the bodies need."""


def simulate_friction(seed: int, kind: str = "none") -> Samples:
    """Simulate an arm with Coulomb friction of 0.4 N·m and one kind of friction beyond it; the noise is 0.02 N·m."""
    samples = simulate(ROBOT, Simulation(400, n_sinusoids=30, speed=6.0, noise=0.02, viscous=0.3), seed)
    sign, speed = np.tanh(samples.dq / 0.02), np.abs(samples.dq)
    load = np.abs(inverse_dynamics(ROBOT, samples.q, samples.dq, samples.ddq))
    more = {
        "none": 0.0,
        "load": SHARE * load * sign,
        "falling load": -SHARE * load * sign,
        "speed": 0.4 * np.tanh(samples.dq / 0.4) - 0.2 * samples.dq * speed,
        "sides": 0.3 * np.abs(sign) - 0.1 * speed,
    }[kind]
    return replace(samples, tau=samples.tau + 0.4 * sign + more)


@cache
def train_friction(kind: str) -> TorqueModel:
    return train_from_geometry(GEOMETRY, ROBOT, simulate_friction(1, kind), FitOptions(device="cpu"))


def pose(samples: Samples) -> tuple[Problem, Point]:
    """Return the problem of the samples and the point of the true geometry."""
    problem = make_problem(samples, ROBOT.joint_types, np.arange(3), gravity=True)
    return problem, problem.with_noise(problem.at(GEOMETRY.canonical(), 0.05 * samples.tau.std(axis=0)))


@pytest.mark.parametrize("kind", ["load", slow("speed"), slow("sides")])
def test_supported_kind_is_chosen_and_predicts_better(kind: DriveKind, monkeypatch: pytest.MonkeyPatch) -> None:
    model, unseen = train_friction(kind), simulate_friction(2, kind)
    assert kind in str(model.fit["drive"])
    assert float(model.fit["drive_nats"]) > drive.OPTIONS.min_nats
    monkeypatch.setattr(drive, "OPTIONS", replace(drive.OPTIONS, kinds=()))
    without = train_from_geometry(GEOMETRY, ROBOT, simulate_friction(1, kind), FitOptions(device="cpu"))
    assert not without.fit["drive"]
    assert (nmse_per_joint(model, unseen) < nmse_per_joint(without, unseen)).all()
    assert nmse_per_joint(model, unseen).mean() < 0.8 * nmse_per_joint(without, unseen).mean()


def test_share_of_the_load_is_recovered() -> None:
    model = train_friction("load")
    assert model.fit["drive"] == "load"
    friction = friction_coefficients(model.posterior, model.estimator)
    assert friction.load is not None
    assert friction.load_std is not None
    assert (np.abs(friction.load - SHARE) < 3 * friction.load_std).all()
    assert (friction.load_std < 0.3 * SHARE).any()
    assert (np.abs(friction.coulomb - 0.4) < 3 * friction.coulomb_std).all()


@pytest.mark.parametrize("kind", ["none", "falling load"])
def test_unsupported_kinds_are_left_out(kind: str) -> None:
    problem, point = pose(simulate_friction(1, kind))
    chosen = choose_drive(problem, point, np.arange(len(problem.tau)), lambda: False)
    assert "load" not in chosen.problem.drive.kinds
    if kind == "none":
        assert chosen.problem.drive.kinds == ()
        assert chosen.nats == 0.0


def test_held_out_blocks_reject_what_the_evidence_accepts(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, point = pose(simulate_friction(1, "load"))
    rows = np.arange(len(problem.tau))
    assert choose_drive(problem, point, rows, lambda: False).problem.drive.kinds
    monkeypatch.setattr(drive, "held_out_errors", lambda problem, *_: np.full((8, 3), 1.0 + len(problem.drive.kinds)))
    assert choose_drive(problem, point, rows, lambda: False).problem.drive.kinds == ()


def test_held_out_errors_are_those_of_separate_fits() -> None:
    problem, point = pose(simulate_friction(1, "load"))
    problem = with_kind(problem, point, "load")
    point = problem.at(point.geometry, point.sigma)
    blocks = np.arange(len(problem.tau)) // 100
    both = problem.all_features(point)
    assert problem.expected is not None
    width = np.concatenate([np.ones(len(problem.scale)), problem.expected.widths])
    mean = np.concatenate([np.zeros(len(problem.scale)), problem.expected.step(point.geometry)])
    squares = np.empty((4, 3))
    for block in range(4):
        kept = blocks != block
        rows = (both[kept] / point.sigma[:, None]).reshape(-1, both.shape[2])
        rows = np.concatenate([rows, np.diag(1 / width)])
        target = np.concatenate([(problem.tau[kept] / point.sigma).reshape(-1), mean / width])
        weights = np.linalg.lstsq(rows, target)[0]
        squares[block] = ((problem.tau[~kept] - both[~kept] @ weights) ** 2).mean(axis=0)
    np.testing.assert_allclose(held_out_errors(problem, point, blocks), squares, rtol=1e-5)


@pytest.mark.parametrize("kinds", [(), ("stribeck",), ("stribeck", "load"), ("speed",), DRIVE_KINDS])
def test_report_of_viscous_and_coulomb_friction_is_exact(kinds: Sequence[DriveKind]) -> None:
    """With coefficients of other terms zero, a report states those of the first three."""
    rows, terms = summary_rows(kinds), drive_terms(kinds)
    weights = np.zeros(len(terms))
    weights[:3] = 0.7, 0.4, -0.1
    for name, value in zip(("viscous", "coulomb", "offset"), weights[:3], strict=True):
        assert rows[name] @ weights == pytest.approx(value, rel=1e-3)
    assert {"stribeck", "load"} & rows.keys() == {"stribeck", "load"} & set(kinds)


def test_report_of_curved_friction_is_a_line_through_its_curve() -> None:
    kinds: tuple[DriveKind, ...] = ("speed", "sides")
    weights = np.random.default_rng(0).normal(size=len(drive_terms(kinds)))
    rows = summary_rows(kinds)
    curve = {each: float(weights @ drive_features(np.array([[each]]), kinds)[:, 0, 0]) for each in (-1, -0.1, 0.1, 1)}
    for speed in (0.1, 1.0):
        odd = 0.5 * (curve[speed] - curve[-speed])
        assert rows["coulomb"] @ weights + speed * (rows["viscous"] @ weights) == pytest.approx(odd)
    assert rows["offset"] @ weights == pytest.approx(0.5 * (curve[0.1] + curve[-0.1]))


def test_unknown_kinds_and_a_load_without_arm_are_rejected() -> None:
    with pytest.raises(ValueError, match="drive kind is 'cogging', expected one of stribeck, speed, sides, load, play"):
        Drive(3, ("cogging",))
    with pytest.raises(ValueError, match="'load' needs bodies"):
        Drive(3, ("load",))


def test_model_with_load_is_stored_and_restored(tmp_path) -> None:
    model, unseen = train_friction("load"), simulate_friction(2, "load")
    save(model, tmp_path / "model")
    again = load(tmp_path / "model")
    assert again.arm is not None
    assert again.arm.drive == ("load",)
    before, after = (each.predict(unseen.q, unseen.dq, unseen.ddq) for each in (model, again))
    np.testing.assert_allclose(after.tau, before.tau, rtol=1e-9)
    np.testing.assert_allclose(after.tau_std, before.tau_std, rtol=1e-6)


def test_forward_dynamics_inverts_torque_with_load() -> None:
    model, unseen = train_friction("load"), simulate_friction(2, "load")
    motion = Motion.from_arrays(unseen.q[:20], unseen.dq[:20], unseen.ddq[:20])
    tau = model.posterior.mean(motion)
    found = forward_dynamics(model, motion, tau).mean
    np.testing.assert_allclose(found, motion.ddq, atol=1e-3 * np.abs(motion.ddq).max())
