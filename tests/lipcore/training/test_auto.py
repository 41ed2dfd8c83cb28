"""Tests of the estimator `auto`: held-out samples, the choice, and its report."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from lipcore import (
    FitCancelledError,
    FitOptions,
    ModelFormatError,
    NotPositiveDefiniteError,
    Samples,
    load,
    save,
    train,
)
from lipcore.data.splits import SplitError
from lipcore.estimators.catalogue import MissingRobotError, check_estimator
from lipcore.files.manifest import read_manifest_bytes
from lipcore.files.persistence import manifest_bytes
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.robots.urdf import RigidBody
from lipcore.training import auto, held_out
from lipcore.training.held_out import hold_out
from tests import ROOT
from tests.choosing import slow

REAL_ARMS = ROOT.parent / "shared/data/real_arms.npz"
ARM = "finger-edu"
TYPES = ("revolute",) * 3
OPTIONS = FitOptions(
    hyperparameter_samples=30, posterior_samples=100, max_iterations=12, starts=1, device="cpu", search_seconds=0.5
)
NAMES = ["rigid-body", "rigid-body+local", "lip-chain"]


def simulate_arm(rows=200, seed=3, speed=4.0):
    return simulate(load_robot(ARM), Simulation(rows, rate=10.0, speed=speed, noise=0.0005, coulomb=0.005), seed)


def add_disturbance(samples):
    """Add a torque that no state explains."""
    disturbance = 0.003 * np.sin(2 * np.pi * samples.t[:, None] / np.array([5.0, 6.0, 7.0]))
    return replace(samples, tau=samples.tau + disturbance)


def as_one_recording(*parts):
    """Return parts that follow one another at 10 Hz."""
    samples = Samples.concatenate(list(parts))
    return replace(samples, t=np.arange(len(samples)) / 10.0, episode=np.zeros(len(samples), np.int64))


def with_fast_stretch():
    """Return slow motion with three seconds of fast motion in its middle."""
    slow, fast = simulate_arm(170, speed=1.5), simulate_arm(30, seed=4, speed=6.0)
    return as_one_recording(slow.rows(slice(0, 85)), fast, slow.rows(slice(85, None)))


def periodic(rows=400, period=5.03):
    """Return a motion of two harmonics that repeats."""
    rate = 2 * np.pi / period * np.array([1.0, 2.0])[:, None, None]
    phase = rate * np.arange(rows)[:, None] / 10.0 + np.arange(3)
    q, dq, ddq = np.sin(phase).sum(0), (rate * np.cos(phase)).sum(0), (-(rate**2) * np.sin(phase)).sum(0)
    return replace(simulate_arm(rows), q=q, dq=dq, ddq=ddq)


@pytest.fixture(scope="module")
def auto_training():
    seen = []
    model = train(add_disturbance(simulate_arm(seed=0)), TYPES, options=OPTIONS, on_progress=seen.append)
    return model, seen


def test_rigid_arm_gets_the_rigid_body(auto_training):
    model, _ = auto_training
    found = model.selection
    assert (found["asked"], found["chosen"], model.estimator.name) == ("auto", "rigid-body", "rigid-body")
    assert [row["estimator"] for row in found["table"]] == NAMES
    best = max(row["log_density"] for row in found["table"])
    for row in found["table"]:
        assert row["error"] is None
        assert len(row["nmse"]) == len(row["edge_nmse"]) == len(row["coverage"]) == 3
        assert row["difference"] == pytest.approx(row["log_density"] - best)
    held_out = dict(found["held_out"])
    rows, edge_rows = held_out.pop("rows"), held_out.pop("edge_rows")
    assert held_out == {"blocks": 3, "repeats": False, "edge_blocks": 1}
    assert 0.15 * 200 < rows < 0.3 * 200
    assert 0 < edge_rows < 0.5 * rows


@pytest.mark.slow
def test_explained_arm_trains_no_other_estimator():
    model = train(simulate_arm(), TYPES, options=OPTIONS)
    assert model.estimator.name == model.selection["chosen"] == "rigid-body"
    assert [row["estimator"] for row in model.selection["table"]] == ["rigid-body"]
    assert model.selection["reason"].startswith("it explains the held-out torque within the sensor noise")


@pytest.mark.slow
def test_unordered_rows_do_not_determine_the_noise():
    samples = add_disturbance(simulate_arm())
    shuffled = samples.rows(np.random.default_rng(0).permutation(len(samples)))
    model = train(replace(shuffled, t=samples.t), TYPES, options=OPTIONS)
    assert [row["estimator"] for row in model.selection["table"]] == NAMES


@pytest.mark.slow
def test_flexible_estimator_fails_at_the_edge():
    model = train(add_disturbance(with_fast_stretch()), TYPES, options=OPTIONS)
    error = {row["estimator"]: np.mean(row["edge_nmse"]) for row in model.selection["table"]}
    assert error["lip-chain"] > 2 * error["rigid-body"]
    assert model.selection["chosen"] in ("rigid-body", "rigid-body+local")


def test_chosen_estimator_learns_all_samples(auto_training):
    model, _ = auto_training
    assert model.fit["samples_given"] == len(simulate_arm())
    assert "search_hops" in model.fit
    unseen = simulate_arm(seed=8)
    error = model.predict(unseen.q, unseen.dq, unseen.ddq).tau - unseen.tau
    assert (np.mean(error**2, axis=0) < 0.05 * unseen.tau.var(axis=0)).all()


def test_progress_rises_and_names_the_estimator(auto_training):
    _, seen = auto_training
    for values in ([each.fraction for each in seen], [each.elapsed for each in seen]):
        assert values == sorted(values)
    assert 0 <= seen[0].fraction <= seen[-1].fraction <= 1
    assert [*dict.fromkeys(each.estimator for each in seen)] == NAMES


@pytest.fixture
def manifest(auto_training, tmp_path):
    """Return the manifest of a saved choice, to change."""
    return deepcopy(save(auto_training[0], tmp_path / "model"))


def test_choice_is_saved(auto_training, manifest, tmp_path):
    assert manifest["selection"] == load(tmp_path / "model").selection == auto_training[0].selection


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.pop("table"), "selection: Object missing required field `table`"),
        (lambda s: s.update(chosen="lip"), "selection.chosen is 'lip', expected the estimator, 'rigid-body'"),
        (lambda s: s.update(reason="x" * 301), "selection.reason is"),
        (lambda s: s.update(table=[]), "selection.table is"),
        (lambda s: s["held_out"].update(repeats=1), "selection.held_out.repeats is 1, expected `bool`"),
        (lambda s: s["held_out"].update(rows=-1), "selection.held_out.rows is -1"),
        (lambda s: s["held_out"].update(edge_blocks="one"), "selection.held_out.edge_blocks is 'one'"),
        (lambda s: s["held_out"].update(corners=1), "selection.held_out has the entry 'corners'"),
        (lambda s: s["table"][1].update(edge_nmse=[1.0]), r"selection.table\[1\].edge_nmse is .* expected 3"),
        (lambda s: s["table"][1].update(edge_nmse=[-1.0] * 3), r"selection.table\[1\].edge_nmse\[0\] is -1"),
        (lambda s: s["table"][1].update(nmse=[1.0]), r"selection.table\[1\].nmse is .* expected 3"),
        (lambda s: s["table"][0].update(log_density="good"), r"selection.table\[0\].log_density is 'good'"),
        (lambda s: s["table"][0].update(error=""), r"selection.table\[0\].error is"),
    ],
)
def test_malformed_choice_is_rejected(manifest, change, message):
    change(manifest["selection"])
    with pytest.raises(ModelFormatError, match=message):
        read_manifest_bytes(manifest_bytes(manifest))


def test_choice_of_an_earlier_release_is_read(manifest):
    for key in ("edge_rows", "edge_blocks"):
        del manifest["selection"]["held_out"][key]
    for row in manifest["selection"]["table"]:
        del row["edge_nmse"]
    assert read_manifest_bytes(manifest_bytes(manifest))["selection"] == manifest["selection"]


@pytest.mark.slow
def test_arm_with_springs_gets_a_chain():
    samples = simulate_arm(300, speed=8.0)
    # from the energy 0.1 sin²q₂ sin q₃: gravity has no second harmonic
    _, second, third = samples.q.T
    spring = [0 * second, np.sin(2 * second) * np.sin(third), np.sin(second) ** 2 * np.cos(third)]
    options = replace(OPTIONS, hyperparameter_samples=50, max_iterations=40)
    model = train(replace(samples, tau=samples.tau + 0.1 * np.stack(spring, axis=1)), TYPES, options=options)
    assert model.selection["chosen"] == model.estimator.name != "rigid-body", model.selection
    rows = {row["estimator"]: row for row in model.selection["table"]}
    assert rows["rigid-body"]["difference"] < -2 * rows["rigid-body"]["standard_error"] < 0
    assert model.fit["samples_posterior"] == len(samples)


@pytest.mark.slow
@pytest.mark.skipif(not REAL_ARMS.exists(), reason=f"no recordings at {REAL_ARMS}")
def test_real_kuka_gets_the_arm_and_predicts_faster_motion():
    joints, types = tuple(f"joint{number}" for number in range(1, 8)), {"episode": np.int64}
    columns = ("t", "episode", "q", "dq", "ddq", "tau")
    with np.load(REAL_ARMS) as arms:
        training, other = (
            Samples(joints, *(arms[f"kuka|{part}|{name}"].astype(types.get(name, float)) for name in columns))
            for part in ("train", "other")
        )
    model = train(training, ("revolute",) * 7)
    assert model.estimator.name == "rigid-body+local", model.selection  # its motion repeats
    error = model.predict(other.q, other.dq, other.ddq).tau - other.tau
    assert np.mean(np.mean(error**2, axis=0) / other.tau.var(axis=0)) < 0.9


def test_failed_estimator_is_reported_and_others_continue(monkeypatch):
    def fails(self, samples, place, before=None):
        raise NotPositiveDefiniteError("nothing can be\nlearnt")

    monkeypatch.setattr(auto.FitContext, "learn", fails)
    model = train(simulate_arm(), TYPES, options=OPTIONS)
    assert model.selection["chosen"] == model.estimator.name == "lip-chain"
    assert model.selection["reason"] == "no other estimator was trained"
    arm, local, chain = (next(row for row in model.selection["table"] if row["estimator"] == name) for name in NAMES)
    assert arm["error"] == "NotPositiveDefiniteError: nothing can be learnt"
    assert arm["log_density"] is None
    assert local["error"] is not None
    assert chain["error"] is None

    monkeypatch.setattr(auto, "fit_estimator", lambda *given, **named: (_ for _ in ()).throw(ValueError("neither")))
    with pytest.raises(NotPositiveDefiniteError, match="nothing can be"):
        train(simulate_arm(), TYPES, options=OPTIONS)


@pytest.mark.slow
def test_few_rows_are_not_held_out():
    model = train(simulate_arm(held_out.OPTIONS.min_rows - 10), TYPES, options=OPTIONS)
    found = model.selection
    assert found["chosen"] == model.estimator.name == "rigid-body"
    assert found["reason"].startswith(
        "no other estimator was trained, as too few samples can be held out: rows is 50, expected at least 60"
    )
    assert found["held_out"] == {"rows": 0, "blocks": 0, "repeats": False, "edge_rows": 0, "edge_blocks": 0}
    assert [row["estimator"] for row in found["table"]] == ["rigid-body"]


def test_robot_is_used_only_by_rigid_bodies():
    samples = add_disturbance(simulate_arm())
    robot = RigidBody.from_profile(ARM, samples.joint_names, TYPES)
    model = train(samples, TYPES, options=OPTIONS, robot=robot)
    assert all(row["error"] is None for row in model.selection["table"])
    assert model.robot is (None if model.estimator.name == "lip-chain" else robot)
    assert model.arm is None or model.arm.mode == "calibrate"
    with pytest.raises(MissingRobotError, match="geometry is 'fixed', which needs a robot"):
        check_estimator("auto", TYPES, options=FitOptions(geometry="fixed"))


@pytest.mark.parametrize("at_work", [NAMES[0], *map(slow, NAMES[1:])])
def test_auto_can_be_cancelled(at_work):
    seen = []

    def cancelled():
        return any(each.estimator == at_work for each in seen)

    with pytest.raises(FitCancelledError):
        train(add_disturbance(simulate_arm()), TYPES, options=OPTIONS, on_progress=seen.append, cancelled=cancelled)
    assert seen[-1].estimator == at_work


@pytest.mark.slow
def test_leading_chain_restarts_the_search(monkeypatch, tmp_path):
    seeds, learn = [], auto.learn
    monkeypatch.setattr(auto, "learn", lambda *given: (seeds.append(given[-1]), learn(*given))[1])
    monkeypatch.setattr(auto.EstimatorComparison, "_chain_leads", lambda self: True)
    monkeypatch.setattr(auto.EstimatorComparison, "verdict", lambda self: ("rigid-body+local", "it is wanted"))
    model = train(add_disturbance(simulate_arm()), TYPES, options=replace(OPTIONS, posterior_samples=300))
    assert seeds[:2] == [0, 1]
    assert model.selection["chosen"] == model.estimator.name == "rigid-body+local"
    assert model.fit["samples_given"] == len(simulate_arm())
    assert 100 < model.fit["samples_posterior"] <= len(simulate_arm())
    save(model, tmp_path / "model")
    assert load(tmp_path / "model").arm is not None


def test_unrepeated_motion_is_held_out():
    found = hold_out(as_one_recording(periodic(400), simulate_arm(200, seed=5)), TYPES)
    assert not found.repeats
    assert (np.flatnonzero(found.parts.held_out) >= 400 - 30).all()
    assert not (found.parts.held_out & found.parts.train).any()


def test_fastest_block_is_held_out_at_the_edge():
    found = hold_out(with_fast_stretch(), TYPES)
    edge = np.flatnonzero(found.edge)
    assert found.edge_blocks == 1
    assert 85 <= edge.min() <= edge.max() < 115
    assert found.edge[found.parts.held_out].sum() == len(edge) < found.parts.held_out.sum()


def test_repeated_edge_blocks_are_held_out_together():
    found = hold_out(as_one_recording(with_fast_stretch(), with_fast_stretch()), TYPES)
    assert (found.repeats, found.edge_blocks) == (True, 2)
    assert np.unique(np.flatnonzero(found.edge) // 20).tolist() == [4, 14]


def test_edge_rows_do_not_depend_on_order():
    samples = with_fast_stretch()
    order = np.random.default_rng(1).permutation(len(samples))
    assert np.array_equal(hold_out(samples.rows(order), TYPES).edge, hold_out(samples, TYPES).edge[order])


def test_few_blocks_have_no_edge():
    found = hold_out(simulate_arm(60), TYPES)
    assert (found.blocks, found.edge_blocks, int(found.edge.sum())) == (1, 0, 0)


def test_repeating_recording_is_recognised():
    samples = periodic()
    found = hold_out(samples, TYPES)
    held = np.flatnonzero(np.diff(found.parts.held_out.astype(int)) == 1)
    assert (found.repeats, found.edge_blocks, found.blocks, len(held)) == (True, 0, 5, 5)
    assert np.diff(held).min() > 60  # spread over the recording
    noise = 0.1 * samples.ddq.std(0) * np.random.default_rng(0).standard_normal(samples.ddq.shape)
    assert hold_out(replace(samples, ddq=samples.ddq + noise), TYPES).repeats
    assert not hold_out(simulate_arm(), TYPES).repeats


def test_short_recording_cannot_be_divided():
    with pytest.raises(SplitError, match="rows is 59, expected at least 60"):
        hold_out(simulate_arm(59), TYPES)
    fast = simulate_arm(200)
    with pytest.raises(SplitError, match=r"seconds is 0\.199, expected at least 4 to hold some out"):
        hold_out(replace(fast, t=fast.t / 100), TYPES)
