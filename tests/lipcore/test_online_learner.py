"""A model that learns, against dense references: late rows, forgetting, changes, refusals, becoming a version."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from lipcore import FitOptions, ModelFormatError, TorqueModel, load, save, train
from lipcore.data.motion import Motion
from lipcore.data.samples import Samples
from lipcore.files.probing import probe
from lipcore.online import transfer
from lipcore.online.batch import Rows
from lipcore.online.learner import ForgottenError, OnlineModel, uncovered
from lipcore.online.transfer import Revision, consolidate
from lipcore.posterior.compact import CompactPosterior
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Stream, simulate
from tests.lipcore.online_checks import as_rows, same_answers

ROBOT = "double-pendulum"
OPTIONS = FitOptions(hyperparameter_samples=60, max_iterations=60, starts=1, device="cpu")
STREAM = Stream(n_samples=120, speed=10, noise=0.02, viscous=0.1)


def recorded(seed: int, **changes: object) -> Samples:
    return simulate(load_robot(ROBOT), replace(STREAM, **changes), seed=seed)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def base() -> TorqueModel:
    return train(recorded(1), ("revolute",) * 2, "lip-chain", OPTIONS)


@pytest.fixture(scope="module")
def rows() -> Rows:
    return as_rows(recorded(2))


def regression(
    posterior: CompactPosterior, motion: Motion, tau: np.ndarray, weights: np.ndarray, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the whitened variables by conditioning on all torques, in the space of the torques."""
    features = posterior.basis.features(motion).numpy()
    prior = posterior.kernel.variance(posterior.params, motion).diagonal(dim1=1, dim2=2).numpy()
    open_ = np.maximum(prior.reshape(-1) - np.square(features).sum(0), 0.0)
    # the linear terms' features explain their share of the prior exactly
    noise = np.tile(posterior.noise_variance.numpy(), len(motion)) + open_
    gram = features.T @ features + np.diag(noise / np.repeat(weights, motion.n_joints))
    gain = features @ np.linalg.inv(gram)
    mean = centre + gain @ (tau.reshape(-1) - features.T @ centre)
    return mean, np.eye(len(centre)) - gain @ features.T


def assert_solution(online: OnlineModel, mean: np.ndarray, covariance: np.ndarray, tolerance: float = 1e-6) -> None:
    found = online.now.solve()
    np.testing.assert_allclose(found.mean.numpy(), mean, rtol=0, atol=tolerance * np.abs(mean).max())
    spread = np.eye(len(mean)) - (found.learnt.T @ found.learnt).numpy()
    np.testing.assert_allclose(spread, covariance, rtol=0, atol=tolerance)


def test_learning_is_the_posterior_of_all_samples_old_and_new(base: TorqueModel, rows: Rows) -> None:
    old = recorded(1)
    motion = Samples.concatenate([old, recorded(2)]).motion()
    tau = np.concatenate([old.tau, rows.tau])
    zeros = np.zeros(len(base.posterior.basis))
    expected = regression(base.posterior, motion, tau, np.ones(len(motion)), zeros)
    assert_solution(OnlineModel.start(base).learn(rows), *expected)


def test_forgetting_weighs_rows_by_their_age_and_keeps_the_mean_of_the_version(base: TorqueModel, rows: Rows) -> None:
    began, forgetting = float(rows.time.min()), 4.0
    online = OnlineModel.start(base, forgetting, since=began).learn(rows)
    posterior = base.posterior
    age = rows.time.max() - rows.time
    # the version's own samples: pseudo-observations whose sums are those of the version, centred on its mean
    factor = np.exp(-(rows.time.max() - began) / forgetting)
    centre = (posterior.basis.root.T @ posterior.weights).numpy()
    assert posterior.statistics is not None
    old = factor * posterior.statistics.a.numpy()
    values, vectors = np.linalg.eigh(old)
    scale = np.sqrt(np.maximum(values, 0.0))
    features = posterior.basis.features(rows.motion()).numpy()
    prior = posterior.kernel.variance(posterior.params, rows.motion()).diagonal(dim1=1, dim2=2).numpy()
    open_ = np.maximum(prior.reshape(-1) - np.square(features).sum(0), 0.0)
    precision = np.repeat(np.exp(-age / forgetting), 2) / (np.tile(posterior.noise_variance.numpy(), len(rows)) + open_)
    design = np.concatenate([(vectors * scale).T, features.T * np.sqrt(precision)[:, None]])
    target = np.concatenate([(vectors * scale).T @ centre, rows.tau.reshape(-1) * np.sqrt(precision)])
    covariance = np.linalg.inv(np.eye(len(centre)) + design.T @ design)
    mean = covariance @ (centre + design.T @ target)
    assert_solution(online, mean, covariance, 1e-5)


def test_a_changed_robot_is_learnt_anew_around_what_was_known(base: TorqueModel, rows: Rows) -> None:
    heavier = recorded(3, payload=Payload(2.0))
    known = OnlineModel.start(base).learn(rows)
    changed = known.change(5000.0)
    loaded = as_rows(heavier, 5001.0)
    learnt = changed.learn(loaded)
    centre = known.now.solve().mean.numpy()
    expected = regression(base.posterior, heavier.motion(), heavier.tau, np.ones(len(loaded)), centre)
    assert_solution(learnt, *expected)

    unseen = recorded(4, payload=Payload(2.0), noise=0.0)
    errors = {}
    few = loaded.take(slice(0, 15))
    for name, online in (("as before", known), ("anew", changed.learn(few)), ("on top", known.learn(few))):
        errors[name] = np.mean((online.model().predict(unseen.q, unseen.dq, unseen.ddq).tau - unseen.tau) ** 2)
    assert errors["anew"] < 0.2 * errors["as before"]
    assert errors["anew"] < 0.2 * errors["on top"]
    honest = learnt.model().predict(unseen.q, unseen.dq, unseen.ddq)
    assert (np.abs(honest.tau - unseen.tau) < 1.96 * honest.tau_std).mean() > 0.8


def test_rows_that_come_after_a_change_but_are_from_before_it_move_what_it_started_from(
    base: TorqueModel, rows: Rows
) -> None:
    early, late = rows.take(slice(0, 60)), rows.take(slice(60, None))
    new = as_rows(recorded(3, payload=Payload(2.0)), 5001.0)
    in_time = OnlineModel.start(base).learn(rows).change(5000.0).learn(new)
    too_late = OnlineModel.start(base).learn(early).change(5000.0).learn(new).learn(late)
    same_answers(too_late.model(), in_time.model(), new, 1e-7)
    same_answers(
        too_late.unlearn(late).model(),
        OnlineModel.start(base).learn(early).change(5000.0).learn(new).model(),
        new,
        1e-6,
    )


def test_a_row_belongs_to_one_regime_for_good(base: TorqueModel, rows: Rows) -> None:
    """A change is noticed after it began: rows learnt meanwhile stay where they were, and can be taken back."""
    online = OnlineModel.start(base).learn(rows).change(float(rows.time[30]))
    assert online.now.begins > rows.time.max()
    assert online.before is not None
    assert online.unlearn(rows).before is not None
    again = online.unlearn(rows).before
    assert again is not None
    assert abs(again.statistics.samples) < 1e-9
    twice = online.change(float(rows.time.max()) + 9.0)
    with pytest.raises(ForgottenError, match="two changes have come since"):
        twice.unlearn(rows)


def test_novel_rows_are_told_and_stay_uncertain(base: TorqueModel) -> None:
    seen = as_rows(recorded(1))
    beyond = as_rows(recorded(5, motion="full"))
    online = OnlineModel.start(base)
    assert uncovered(base, seen).mean() < 0.02
    novel = uncovered(base, beyond)
    assert novel.mean() > 0.3
    flags: list[np.ndarray] = []
    learnt = online.learn(beyond, novel=flags.append).model().predict(beyond.q, beyond.dq, beyond.ddq)
    # computed along with features, and once more without: rounding may tell them apart at the threshold
    assert (np.concatenate(flags) != novel).mean() < 0.02
    noise = base.noise_std
    # the basis cannot hold what they say: however often they come, the answer there says that it does not know
    for _ in range(20):
        online = online.learn(beyond)
    often = online.model().predict(beyond.q, beyond.dq, beyond.ddq)
    assert (often.tau_std[novel] > noise).any(axis=1).all()
    error = np.abs(learnt.tau - beyond.tau)
    assert (error < 1.96 * np.sqrt(learnt.tau_std**2 + noise**2)).mean() > 0.9


def test_what_cannot_be_is_refused(base: TorqueModel, rows: Rows, tmp_path: Path) -> None:
    for forgetting in (0.0, float("inf"), float("nan")):
        for start in (partial(OnlineModel.start, base), OnlineModel.start(base).with_forgetting):
            with pytest.raises(ValueError, match="forgetting_s is"):
                start(forgetting)
    learnt = OnlineModel.start(base).learn(rows).model()
    with pytest.raises(ValueError, match="learnt online already"):
        OnlineModel.start(learnt)
    with pytest.raises(ValueError, match="expected one as trained"):
        save(learnt, tmp_path / "never")
    revision = Revision.of(learnt)
    for part in ("weights", "packed"):
        with pytest.raises(ValueError, match=f"{part} has shape"):
            replace(revision, **{part: getattr(revision, part)[:-1]}).apply(base)
    for wrong in ({"tau": rows.tau[:-1]}, {"code": np.zeros(3, np.uint8)}):
        with pytest.raises(ValueError, match="has shape"):
            replace(rows, **wrong)


def test_state_of_another_version_or_damaged_is_refused(base: TorqueModel, rows: Rows) -> None:
    payload = transfer.dump(OnlineModel.start(base).learn(rows))
    known = base.posterior.statistics
    assert known is not None
    moved = replace(known, b=known.b + 1)
    other = replace(base, posterior=replace(base.posterior, weights=base.posterior.weights + 1, statistics=moved))
    with pytest.raises(ValueError, match="another version"):
        transfer.load(other, payload)
    for broken in (b"", payload[:-10], b"x" * 100, payload[:8] + b"[" + payload[9:]):
        with pytest.raises(ValueError, match=r"no state|expected|another"):
            transfer.load(base, broken)


@pytest.mark.parametrize("forgetting", [None, 20.0])
def test_adding_in_place_gives_the_same_bits(base: TorqueModel, rows: Rows, forgetting: float | None) -> None:
    parts = [rows.take(slice(0, 40)), rows.take(slice(40, 41)), rows.take(slice(41, None))]
    usual = OnlineModel.start(base, forgetting, since=float(rows.time.min()))
    untouched = transfer.dump(usual)
    own = usual.detached()
    for part in parts:
        usual, own = usual.learn(part), own.learn(part, own=True)
    usual, own = usual.change(5000.0), own.change(5000.0)
    usual, own = usual.unlearn(parts[1]), own.unlearn(parts[1], own=True)
    assert transfer.dump(own.symmetrised()) == transfer.dump(usual)
    assert transfer.dump(OnlineModel.start(base, forgetting, since=float(rows.time.min()))) == untouched
    assert torch.equal(usual.now.statistics.a, usual.now.statistics.a.T)


FLOOR = np.array([0.5, 0.0])


def online(base: TorqueModel, rows: Rows, how: str) -> OnlineModel:
    learnt = OnlineModel.start(base, 3.0 if how == "forgetting" else None).learn(rows.take(slice(0, 50)))
    if how == "changed":
        learnt = learnt.change(float(rows.time[50]))
    return learnt.learn(rows.take(slice(50, None)))


@pytest.mark.parametrize("how", ["plain", "forgetting", "changed"])
@pytest.mark.parametrize("floor", [None, FLOOR], ids=["no floor", "floor"])
def test_answers_alike_to_the_last_bit_also_when_loaded(
    base: TorqueModel, rows: Rows, how: str, floor: np.ndarray | None, tmp_path: Path
) -> None:
    learnt = online(base, rows, how)
    whole = consolidate(learnt, floor)
    save(whole, tmp_path / "model")
    expected = learnt.model(floor).predict(rows.q, rows.dq, rows.ddq, covariance=True)
    trained = base.predict(rows.q, rows.dq, rows.ddq)
    assert np.abs(expected.tau - trained.tau).max() > 1e-3, "nothing was learnt"
    for model in (whole, load(tmp_path / "model")):
        answer = model.predict(rows.q, rows.dq, rows.ddq, covariance=True)
        for name in ("tau", "tau_std", "covariance", "noise_std"):
            assert np.array_equal(getattr(answer, name), getattr(expected, name)), name


def test_manifest_counts_what_was_learnt(base: TorqueModel, rows: Rows, tmp_path: Path) -> None:
    trained = base.posterior.statistics
    assert trained is not None
    weight = float(rows.weight.sum())
    plain = save(consolidate(online(base, rows, "plain")), tmp_path / "plain")
    assert plain["compact"]["data_samples"] == round(trained.samples + weight)
    changed = save(consolidate(online(base, rows, "changed")), tmp_path / "changed")
    assert 0 < changed["compact"]["data_samples"] < trained.samples


def test_floor_below_zero_is_never_loaded(base: TorqueModel, rows: Rows, tmp_path: Path) -> None:
    saved = consolidate(online(base, rows, "plain"), FLOOR)
    saved.posterior.floor[1] = -1.0
    save(saved, tmp_path / "model")
    with pytest.raises(ModelFormatError, match="'floor' has a number below zero"):
        load(tmp_path / "model")


def test_probe_finds_answers_that_are_none(base: TorqueModel) -> None:
    probe(base)
    posterior = base.posterior
    params = {name: value.clone() for name, value in posterior.params.items()}
    params["noise.log_std"] += 400.0
    statistics = posterior.statistics
    assert statistics is not None
    inducing, outputs = posterior.basis.inducing, posterior.basis.outputs
    restored = CompactPosterior.restore(base.estimator.kernel, params, inducing, outputs, statistics)
    broken = replace(base, posterior=restored)
    with pytest.raises(ModelFormatError, match="noise_std of a probe"):
        probe(broken)
