"""Tests of large batches: means without features, and rows shared among threads."""

import threading

import numpy as np
import pytest

from lipcore import load
from lipcore.kernels.drive.play import ELEMENTS
from lipcore.posterior import threads
from lipcore.posterior.batch_mean import BatchMean
from tests.choosing import few
from tests.lipcore.export.models import MODELS, PANDA, draw_motions

KEPT = ("panda", "local", "energies", "friction of all kinds, alternatives")


@pytest.mark.parametrize("name", few(MODELS, kept=lambda name: name in KEPT))
def test_mean_alone_is_that_of_the_prediction(name: str) -> None:
    model = MODELS[name]()
    motion = draw_motions(model, 100, 1, 1.5)
    deflections = np.random.default_rng(2).uniform(0.0, 1.0, (100, 2 * len(ELEMENTS), model.n_joints))
    for known in (None, deflections if model.remembers else None):
        expected = model.predict(*motion, deflections=known).mean
        size = np.abs(expected).max()
        np.testing.assert_allclose(model.torque(*motion, known), expected, rtol=0, atol=1e-11 * size)
    assert model.torque(*motion[:, 0]).shape == (1, model.n_joints)
    assert BatchMean.applies_to(model.posterior) == (model.estimator.name in ("rigid-body", "rigid-body+local"))


def test_parts_of_a_batch_equal_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two parts wait for each other, so that each has a thread of its own."""
    model, meet, seen = load(PANDA), threading.Barrier(2, timeout=60), set[int]()
    motion = draw_motions(model, 100, 3, 3.0)
    alone = model.predict(*motion, covariance=True), model.torque(*motion)
    monkeypatch.setattr(threads, "PART", 50)
    monkeypatch.setattr(threads, "_processors", lambda: 2)
    threads._pool.cache_clear()
    answer = model.evaluator._answer

    def answer_together(*arguments: object) -> bool:
        if threading.get_ident() not in seen:
            seen.add(threading.get_ident())
            meet.wait()
        return answer(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(model.evaluator, "_answer", answer_together)
    together = model.predict(*motion, covariance=True)
    threads._pool.cache_clear()
    assert len(seen) == 2
    for name in ("tau", "tau_std", "covariance"):
        np.testing.assert_array_equal(getattr(together, name), getattr(alone[0], name))
    np.testing.assert_array_equal(model.torque(*motion), alone[1])


def test_threads_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "_most", [])
    monkeypatch.setattr(threads, "PART", 1)
    threads.limit_threads(1)
    seen = set[int]()
    threads.run_parts(3, lambda _: seen.add(threading.get_ident()))
    assert seen == {threading.get_ident()}


def test_an_error_in_a_part_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "PART", 1)

    def fail(rows: slice) -> None:
        if rows.start == 3:
            raise ValueError("row 3")

    with pytest.raises(ValueError, match="row 3"):
        threads.run_parts(5, fail)


def test_wrong_shapes_are_rejected() -> None:
    model = load(PANDA)
    with pytest.raises(ValueError, match="q has 6 joints, expected 7"):
        model.torque(*np.zeros((3, 2, 6)))
    with pytest.raises(ValueError, match="deflections has shape"):
        model.torque(*np.zeros((3, 2, 7)), np.zeros((2, 3, 7)))
