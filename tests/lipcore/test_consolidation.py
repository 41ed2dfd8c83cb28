"""What was learnt online, made part of the model: the same answers, also after it was saved and loaded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lipcore import FitOptions, ModelFormatError, TorqueModel, load, save, train
from lipcore.files.probing import probe
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.online.transfer import consolidate
from lipcore.posterior.compact import CompactPosterior
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Stream, simulate
from tests.lipcore.online_checks import as_rows

FLOOR = np.array([0.5, 0.0])


@pytest.fixture(scope="module")
def base() -> TorqueModel:
    samples = simulate(load_robot("double-pendulum"), Stream(n_samples=60, speed=10), seed=1)
    options = FitOptions(hyperparameter_samples=20, max_iterations=4, starts=1, device="cpu")
    return train(samples, ("revolute",) * 2, "lip-chain", options)


@pytest.fixture(scope="module")
def rows() -> Rows:
    return as_rows(simulate(load_robot("double-pendulum"), Stream(n_samples=80, speed=10, viscous=1.0), seed=2))


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
