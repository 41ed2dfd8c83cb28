"""Tests of the drive: which kinds of friction a recording supports, and what a report states of them."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from lipcore import FitOptions, ModelFormatError, Samples, TorqueModel, load, save
from lipcore.arm import drive
from lipcore.arm.drive import choose_drive, held_out_errors
from lipcore.arm.posing import make_problem, with_kind
from lipcore.arm.problem import Point, Problem
from lipcore.data.metrics import evaluate
from lipcore.data.motion import Array, Motion
from lipcore.kernels.drive.kernel import Drive, DriveKernel
from lipcore.kernels.drive.play import ELEMENTS, with_deflections
from lipcore.kernels.drive.terms import KIND_TERMS, drive_features, drive_terms, summary_rows
from lipcore.model.dynamics import components, forward_dynamics
from lipcore.model.parameters import friction_coefficients, negative_friction, report, weight_posterior
from lipcore.model.warnings import warnings
from lipcore.robots.dirt import MAXWELL_ELEMENTS, Dirt
from lipcore.robots.simulation import Simulation, inverse_dynamics, simulate, usual_torque
from lipcore.vocabulary import DRIVE_KINDS, DriveKind
from tests.choosing import few
from tests.lipcore.arm_oracles import arm, nmse_per_joint, train_from_geometry
from tests.lipcore.files.test_persistence import edit_tensor

GEOMETRY, BODIES, ROBOT = arm("RRR", 31)
SHARE = 0.08
"""Friction per torque that the bodies need."""
GAINS = np.array([0.0, 0.12, -0.08])
"""Errors of the gains."""
MAXWELL = Dirt(load=0.5, position=0.0, warmth=0.0, ripple=0.0, gain=0.0, noise=0.005, seed=3, drive="maxwell")
"""Friction that the terms of the drive can express, with noise of 0.5 % of the usual torque."""


def simulate_friction(seed: int, kind: str = "none") -> Samples:
    """Simulate an arm with Coulomb friction of 0.4 N·m and one kind of friction beyond it; the noise is 0.02 N·m."""
    motion = "full" if kind == "position" else "middle"
    samples = simulate(ROBOT, Simulation(400, n_sinusoids=30, speed=6.0, noise=0.02, viscous=0.3, motion=motion), seed)
    sign, speed = np.tanh(samples.dq / 0.02), np.abs(samples.dq)
    load = np.abs(inverse_dynamics(ROBOT, samples.q, samples.dq, samples.ddq))
    more = {
        "none": 0.0,
        "load": SHARE * load * sign,
        "falling load": -SHARE * load * sign,
        "speed": 0.4 * np.tanh(samples.dq / 0.4) - 0.2 * samples.dq * speed,
        "sides": 0.3 * np.abs(sign) - 0.1 * speed,
        "position": 0.5 * np.sin(2 * samples.q) - 0.3 * np.cos(3 * samples.q),
        "gain": GAINS * inverse_dynamics(ROBOT, samples.q, samples.dq, samples.ddq),
    }[kind]
    return replace(samples, tau=samples.tau + 0.4 * sign + more)


@cache
def train_friction(kind: str) -> TorqueModel:
    return train_from_geometry(GEOMETRY, ROBOT, simulate_friction(1, kind), FitOptions(device="cpu"))


@cache
def simulate_maxwell(seed: int, speed: float = 6.0) -> Samples:
    """Simulate an arm whose friction remembers: 40 s, without the ends, where filters are less accurate."""
    stream = Simulation(1000, 25.0, n_sinusoids=30, speed=speed, noise=0.0, dirt=MAXWELL)
    return with_deflections(simulate(ROBOT, stream, seed).rows(slice(5, -5)), ROBOT.joint_types)


@cache
def train_maxwell() -> TorqueModel:
    return train_from_geometry(GEOMETRY, ROBOT, simulate_maxwell(1), FitOptions(device="cpu"))


def pose(samples: Samples) -> tuple[Problem, Point]:
    """Return the problem of the samples and the point of the true geometry."""
    problem = make_problem(samples, ROBOT.joint_types, np.arange(3), gravity=True)
    return problem, problem.with_noise(problem.at(GEOMETRY.canonical(), 0.05 * samples.tau.std(axis=0)))


@pytest.mark.parametrize("kind", few(["load", "gain", "position", "speed", "sides"], kept=lambda kind: kind == "load"))
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


def test_torque_that_repeats_over_a_turn_is_recovered() -> None:
    model = train_friction("position")
    friction = friction_coefficients(model.posterior, model.estimator)
    assert friction.position is not None
    assert friction.position_std is not None
    truth = np.sqrt(0.5 * (0.5**2 + 0.3**2))
    np.testing.assert_allclose(friction.position, truth, rtol=0.03)
    assert (friction.position_std < 0.03 * truth).all()


def test_joints_that_turn_little_have_no_torque_that_repeats_over_a_turn() -> None:
    samples = simulate_friction(1, "position")
    problem, point = pose(replace(samples, q=np.clip(samples.q, -1.5, 1.5)))
    assert "position" not in choose_drive(problem, point, np.arange(400), lambda: False).problem.drive.kinds


def test_gains_are_recovered_and_belong_to_the_bodies() -> None:
    model, unseen = train_friction("gain"), simulate_friction(2, "gain")
    assert model.fit["drive"] == "gain"
    friction = friction_coefficients(model.posterior, model.estimator)
    assert friction.gain is not None
    assert friction.gain_std is not None
    # without known masses only ratios of gains are identifiable
    ratios, truth = ((1 + gain) / (1 + gain[1]) for gain in (friction.gain, GAINS))
    np.testing.assert_allclose(ratios, truth, atol=0.03)
    motion = Motion.from_arrays(unseen.q[:20], unseen.dq[:20], unseen.ddq[:20])
    parts = components(model, motion, ("gravity", "coriolis", "inertial", "friction"))
    np.testing.assert_allclose(sum(each.mean for each in parts.values()), model.posterior.mean(motion), atol=1e-9)
    [text] = warnings(model, report(model.posterior, model.estimator, model.joint_names))
    assert text.startswith("The torque does not fit the masses: ")
    assert "joint2 reads " in text
    assert text.endswith("% too high. Check the torque constants or sensors.")
    still = np.zeros_like(motion.q)
    gravity = (1 + GAINS) * inverse_dynamics(ROBOT, motion.q, still, still)
    np.testing.assert_allclose(parts["gravity"].mean, gravity, atol=0.05 * np.abs(gravity).max())


def test_play_and_share_of_the_load_are_recovered() -> None:
    model, truth = train_maxwell(), MAXWELL.coefficients(usual_torque(ROBOT))
    assert model.fit["drive"] == "load, play"
    friction = friction_coefficients(model.posterior, model.estimator)
    assert friction.load is not None
    assert friction.load_std is not None
    slipped = truth.coulomb + truth.elements.sum(axis=0)
    for found, std, expected in (
        (friction.load, friction.load_std, truth.load),
        (friction.coulomb, friction.coulomb_std, slipped),
        (friction.viscous, friction.viscous_std, truth.viscous),
    ):
        assert (np.abs(found - expected) < 3 * std).all()
    assert (friction.load_std < 0.1 * truth.load).all()
    assert (friction.coulomb_std < 0.2 * slipped).all()


def test_torque_of_each_element_is_recovered() -> None:
    model, truth = train_maxwell(), MAXWELL.coefficients(usual_torque(ROBOT))
    term = model.estimator.terms["friction"]
    assert isinstance(term, DriveKernel)
    weights, terms = weight_posterior(model.posterior, term), list(term.drive.terms)
    torques = dict(zip((width for width, _ in MAXWELL_ELEMENTS), truth.elements, strict=True))
    expected = np.array([torques.get(width, np.zeros(3)) for width in ELEMENTS])
    places = np.array([terms.index(each) for each in KIND_TERMS["play"]])
    for joint in range(3):
        own = places + joint * len(terms)
        found, covariance = weights.mean[own], weights.covariance[np.ix_(own, own)]
        std = np.sqrt(covariance.diagonal())
        assert (np.abs(found - expected[:, joint]) < 3 * std).all()
        assert (std < 0.15 * expected[:, joint].max()).all()
        assert np.abs(found.sum() - expected[:, joint].sum()) < 3 * np.sqrt(covariance.sum())


def test_prediction_along_a_motion_is_better_than_without_play(monkeypatch: pytest.MonkeyPatch) -> None:
    model, unseen = train_maxwell(), simulate_maxwell(2)
    monkeypatch.setattr(drive, "OPTIONS", replace(drive.OPTIONS, kinds=DRIVE_KINDS[:-1]))
    without = train_from_geometry(GEOMETRY, ROBOT, simulate_maxwell(1), FitOptions(device="cpu"))
    assert not without.remembers
    along = evaluate(unseen.tau, *model.predict_along(unseen).interval)
    assert (np.asarray(along.nmse) < 0.1 * nmse_per_joint(without, unseen)).all()
    assert (np.asarray(along.coverage) > 0.88).all()
    # deflections that are not given are computed
    again = model.predict_along(replace(unseen, deflections=None))
    assert np.array_equal(again.tau, model.predict_along(unseen).tau)


@pytest.mark.parametrize("speed", [6.0, 1.2])
def test_intervals_without_history_are_wider_at_low_speed(speed: float) -> None:
    model, unseen = train_maxwell(), simulate_maxwell(5, speed)
    alone = model.predict(unseen.q, unseen.dq, unseen.ddq)
    coverage = np.asarray(evaluate(unseen.tau, *alone.interval).coverage)
    assert ((coverage >= 0.88) & (coverage <= 1.0)).all(), coverage
    slow = np.abs(unseen.dq) < 0.05
    widths = [np.where(slow, each.tau_std, np.nan) for each in (alone, model.predict_along(unseen))]
    assert (np.nanmean(widths[0], axis=0) > 2 * np.nanmean(widths[1], axis=0)).all()


@pytest.mark.parametrize("kind", ["none", "falling load"])
def test_unsupported_kinds_are_left_out(kind: str) -> None:
    problem, point = pose(with_deflections(simulate_friction(1, kind), ROBOT.joint_types))
    chosen = choose_drive(problem, point, np.arange(len(problem.tau)), lambda: False)
    assert not {"load", "play"} & set(chosen.problem.drive.kinds)
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
    problem = with_kind(problem, point, "load", np.ones(3, np.bool_))
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


def test_negative_friction_is_found() -> None:
    samples = simulate_friction(1)
    wrong = replace(samples, tau=samples.tau - 0.8 * np.tanh(samples.dq / 0.02))
    model = train_from_geometry(GEOMETRY, ROBOT, wrong, FitOptions(device="cpu"))
    found = [each for each in negative_friction(model.posterior, model.estimator) if each.is_implausible(2.0)]
    assert [(each.joint, each.name) for each in found] == [(0, "coulomb"), (1, "coulomb"), (2, "coulomb")]
    assert all(each.mean == pytest.approx(-0.4, abs=0.05) for each in found)
    right = train_friction("load")
    assert not [each for each in negative_friction(right.posterior, right.estimator) if each.is_implausible(2.0)]


def test_unknown_kinds_and_a_load_without_arm_are_rejected() -> None:
    with pytest.raises(
        ValueError, match="drive kind is 'cogging', expected one of stribeck, speed, sides, position, load"
    ):
        Drive(3, ("cogging",))
    with pytest.raises(ValueError, match="'load' needs bodies"):
        Drive(3, ("load",))


@pytest.mark.parametrize("kind", ["load", "gain", "position"])
def test_model_with_a_kind_is_stored_and_restored(kind: DriveKind, tmp_path: Path) -> None:
    model, unseen = train_friction(kind), simulate_friction(2, kind)
    save(model, tmp_path / "model")
    again = load(tmp_path / "model")
    assert again.arm is not None
    assert again.arm.drive == (kind,)
    before, after = (each.predict(unseen.q, unseen.dq, unseen.ddq) for each in (model, again))
    np.testing.assert_allclose(after.tau, before.tau, rtol=1e-9)
    np.testing.assert_allclose(after.tau_std, before.tau_std, rtol=1e-6)


def test_model_with_play_is_stored_and_restored(tmp_path: Path) -> None:
    model, unseen = train_maxwell(), simulate_maxwell(2)
    save(model, tmp_path / "model")
    again = load(tmp_path / "model")
    assert again.arm is not None
    assert again.arm.drive == ("load", "play")
    assert again.remembers
    assert np.array_equal(again.posterior.misfit.packed(), model.posterior.misfit.packed())
    for deflections in (unseen.deflections, None):
        before, after = (
            each.predict(unseen.q, unseen.dq, unseen.ddq, deflections=deflections) for each in (model, again)
        )
        np.testing.assert_allclose(after.tau, before.tau, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(after.tau_std, before.tau_std, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "replacement", "message"),
    [
        ("arm/acceleration", None, "'arm/acceleration' is wrong, expected one positive number a joint"),
        ("arm/acceleration", np.ones(2), "'arm/acceleration' is wrong"),
        ("arm/acceleration", np.array([1.0, 0.0, 1.0]), "'arm/acceleration' is wrong"),
        ("arm/acceleration", np.array([1.0, np.nan, 1.0]), "'arm/acceleration' is not made of finite"),
        ("arm/drive", np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]), "'arm/acceleration' is wrong"),
        ("misfit", np.ones((15, 3)), r"'misfit' has shape \(15, 3\), expected \(16, 3\)"),
        ("misfit", np.ones((16, 2)), r"'misfit' has shape \(16, 2\), expected \(16, 3\)"),
        ("misfit", -np.ones((16, 3)), "'misfit' has a number below zero"),
        ("misfit", np.ones((6, 3)), "tensor 'misfit' needs rows of play elements if friction has play"),
        ("misfit", None, "tensor 'misfit' needs rows of play elements"),
    ],
)
def test_wrong_tensor_of_play_is_named(tmp_path: Path, name: str, replacement: Array | None, message: str) -> None:
    save(train_maxwell(), tmp_path / "model")
    edit_tensor(tmp_path / "model", name, lambda values: replacement)
    with pytest.raises(ModelFormatError, match=message):
        load(tmp_path / "model")


def test_forward_dynamics_inverts_torque_with_load() -> None:
    model, unseen = train_friction("load"), simulate_friction(2, "load")
    motion = Motion.from_arrays(unseen.q[:20], unseen.dq[:20], unseen.ddq[:20])
    tau = model.posterior.mean(motion)
    found = forward_dynamics(model, motion, tau).mean
    np.testing.assert_allclose(found, motion.ddq, atol=1e-3 * np.abs(motion.ddq).max())
