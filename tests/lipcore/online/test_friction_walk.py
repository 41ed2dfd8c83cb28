"""Tests of drifting friction against one dense Gaussian process with friction per epoch."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore import FitOptions, TorqueModel
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.online import regime, transfer
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.online.transfer import consolidate
from tests.lipcore.arm_oracles import as_rows, assert_same_predictions
from tests.lipcore.estimators.test_estimators import train_estimator
from tests.lipcore.online.test_learner import assert_solution, learn_parts, simulate_pendulum

START_S = 1000.0
OPTIONS = FitOptions(hyperparameter_samples=60, max_iterations=60, starts=1, device="cpu", compact_tolerance=0.1)


@pytest.fixture(scope="module", params=["lip-chain", "rigid-body"])
def base(request: pytest.FixtureRequest) -> TorqueModel:
    return train_estimator(request.param, simulate_pendulum(1, coulomb=0.2), OPTIONS)


@pytest.fixture(scope="module")
def rows() -> Rows:
    """Return twelve seconds of the same robot, whose friction grows by half."""
    samples = simulate_pendulum(2, viscous=0.0)
    factor = (1 + 0.5 * samples.t / samples.t[-1])[:, None]
    friction = factor * (0.1 * samples.dq + 0.2 * np.sign(samples.dq))
    return as_rows(replace(samples, tau=samples.tau + friction), START_S)


def with_friction_walk(base: TorqueModel, time_s: float) -> OnlineModel:
    return OnlineModel.start(base, since=START_S).with_walk(time_s)


def friction_places(base: TorqueModel) -> np.ndarray:
    """Return the places of the friction weights."""
    basis = base.posterior.basis
    term = next(each for each in basis.linear if isinstance(each, DriveKernel))
    return np.arange(len(basis))[basis.rows(term)]


def dense_process(base: TorqueModel, rows: Rows, time_s: float, epoch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of the whitened variables in the newest epoch, conditioned on all torques.

    The covariance of a friction weight's deviation from the trained one is ρ^|k − l| between epochs k and l, and 1 for
    other variables. The trained samples lie ten epochs before epoch 0, as torques with the trained mean.
    """
    posterior, friction = base.posterior, friction_places(base)
    centre = posterior.basis.root.T @ posterior.weights
    kept = np.ones(len(centre))
    kept[friction] = np.sqrt(1 - (0.3 * np.maximum(np.abs(centre[friction]), 0.03)) ** 2 / 10)
    values, vectors = np.linalg.eigh(posterior.statistics.a)
    old = vectors * np.sqrt(np.maximum(values, 0.0))  # torques of unit noise with the sums of the version
    motion = rows.motion()
    features = posterior.basis.features(motion)
    open_ = posterior.basis.uncovered(motion, posterior.basis.features(motion))
    noise = (posterior.misfit.of_row(posterior.noise_variance, motion) + open_).reshape(-1)
    prior_mean = posterior.kernel.mean(motion)
    design = np.concatenate([old, features], axis=1)
    when = np.concatenate([np.full(old.shape[1], -10), np.repeat(epoch, rows.q.shape[1])])
    residual = np.concatenate([np.zeros(old.shape[1]), (rows.tau - prior_mean).reshape(-1) - features.T @ centre])
    apart = np.abs(when[:, None] - when[None])
    others = np.setdiff1d(np.arange(len(centre)), friction)
    gram = design[others].T @ design[others]
    for place in friction:
        gram += np.outer(design[place], design[place]) * kept[place] ** apart
    gram += np.diag(np.concatenate([np.ones(old.shape[1]), noise]))
    cross = design * kept[:, None] ** (when.max() - when)[None]
    gain = np.linalg.solve(gram, cross.T).T
    return centre + gain @ residual, np.eye(len(centre)) - gain @ cross.T


def spread_of(online: OnlineModel) -> np.ndarray:
    """Return the standard deviation of each whitened variable."""
    return np.sqrt(online.now.solve(online.walk).covariance.diagonal())


def numbers_of_epochs(online: OnlineModel) -> list[int]:
    return [each.number for each in online.now.epochs]


@pytest.mark.parametrize(("time_s", "epochs"), [(5.0, 4), (60.0, 2)], ids=["folded", "kept"])
def test_model_is_one_process_with_walking_friction(base: TorqueModel, rows: Rows, time_s: float, epochs: int) -> None:
    """Test 24 epochs, most of them folded, and 2 epochs."""
    online = learn_parts(with_friction_walk(base, time_s), rows, np.array_split(np.arange(len(rows)), 9))
    assert len(online.now.epochs) == epochs
    epoch = ((rows.time - START_S) // (time_s / 10)).astype(int)
    assert_solution(online, *dense_process(base, rows, time_s, epoch))


def test_model_follows_friction_and_keeps_the_arm(base: TorqueModel, rows: Rows) -> None:
    friction, late = friction_places(base), rows.take(slice(-20, None))
    plain, walked = (each.learn(rows) for each in (OnlineModel.start(base), with_friction_walk(base, 5.0)))
    before, after = (
        np.mean((each.model().predict(late.q, late.dq, late.ddq).tau - late.tau) ** 2) for each in (plain, walked)
    )
    assert after < 0.9 * before
    ratio = spread_of(walked) / spread_of(plain)
    assert ratio[friction].max() > 2
    assert np.median(np.delete(ratio, friction)) < 1.05


def test_order_does_not_matter_while_epochs_are_kept(base: TorqueModel, rows: Rows) -> None:
    start = with_friction_walk(base, 40.0)  # epochs of 4 s
    at_once = start.learn(rows)
    assert numbers_of_epochs(at_once) == [0, 1, 2]
    shuffled = learn_parts(start, rows, np.array_split(np.random.default_rng(0).permutation(len(rows)), 7))
    assert_same_predictions(shuffled.model(), at_once.model(), rows)


def test_folded_epochs_are_closed(base: TorqueModel, rows: Rows) -> None:
    online = with_friction_walk(base, 10.0).learn(rows)  # epochs of 1 s: 8 to 11 are kept
    assert numbers_of_epochs(online) == [8, 9, 10, 11]
    early = rows.take(slice(70, 80))
    moved = replace(early, time=early.time + 1.0)
    assert transfer.dump(online.learn(early)) == transfer.dump(online.learn(moved))


def test_long_pause_opens_only_the_friction(base: TorqueModel, rows: Rows) -> None:
    friction, centre = friction_places(base), base.posterior.basis.root.T @ base.posterior.weights
    later = replace(rows.take(slice(60, 61)), time=rows.time[60:61] + 1e9, weight=np.full(1, 1e-12))
    before = with_friction_walk(base, 5.0).learn(rows.take(slice(0, 60)))
    after = before.learn(later)
    one, other = spread_of(before), spread_of(after)
    np.testing.assert_allclose(other[friction], 1.0, atol=1e-6)
    np.testing.assert_allclose(after.now.solve(after.walk).mean[friction], centre[friction], atol=1e-6)
    assert (other >= one - 1e-9).all()
    assert np.median(np.delete(other / one, friction)) < 2


def test_without_a_walk_nothing_changes(base: TorqueModel, rows: Rows, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = OnlineModel.start(base)
    unset = plain.with_walk(300.0).with_walk(None)
    assert transfer.dump(unset.learn(rows)) != transfer.dump(plain.with_walk(300.0).learn(rows))
    assert_same_predictions(unset.learn(rows).model(), plain.learn(rows).model(), rows, 0.0)
    assert plain.learn(rows).now.epochs == ()
    monkeypatch.setattr(regime, "WALK", replace(regime.WALK, share=1e-6))
    assert_same_predictions(plain.with_walk(5.0).learn(rows).model(), plain.learn(rows).model(), rows, 1e-5)


def test_ended_walk_keeps_its_friction(base: TorqueModel, rows: Rows) -> None:
    start = with_friction_walk(base, 10.0)
    known, walked = transfer.dump(start), start.learn(rows)
    ended = walked.with_walk(None)
    assert_same_predictions(ended.model(), walked.model(), rows)
    start.detached().with_walk(None).learn(rows, own=True)
    assert transfer.dump(start) == known, "sums of others are overwritten"
    assert_same_predictions(ended.with_walk(10.0).model(), walked.model(), rows)
    assert walked.with_walk(10.0) is walked


def test_stored_state_and_in_place_learning_are_exact(base: TorqueModel, rows: Rows) -> None:
    start, parts = OnlineModel.start(base, 50.0, START_S).with_walk(10.0), np.array_split(np.arange(len(rows)), 8)
    usual = learn_parts(start, rows, parts)
    state = transfer.dump(usual)
    assert transfer.dump(learn_parts(start.detached(), rows, parts, own=True).symmetrised()) == state
    read = transfer.load(base, state)
    assert transfer.dump(read) == state
    more = replace(rows, time=rows.time + 12.0)
    assert transfer.dump(read.learn(more)) == transfer.dump(usual.learn(more))
    assert_same_predictions(consolidate(usual), usual.model(), rows, 0.0)


def test_change_keeps_the_friction_of_its_time(base: TorqueModel, rows: Rows) -> None:
    early, late, new = rows.take(slice(0, 50)), rows.take(slice(50, 80)), rows.take(slice(80, None))
    start = with_friction_walk(base, 40.0)
    in_time = start.learn(early).learn(late).change(float(new.time[0])).learn(new)
    assert in_time.before is not None
    too_late = start.learn(early).change(float(new.time[0])).learn(new).learn(late)
    assert_same_predictions(too_late.model(), in_time.model(), new, 1e-6)


def test_invalid_walk_time_is_rejected(base: TorqueModel) -> None:
    for time_s in (0.0, float("inf"), float("nan")):
        with pytest.raises(ValueError, match="friction_walk_s is"):
            with_friction_walk(base, time_s)
