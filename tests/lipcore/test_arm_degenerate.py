"""Recordings that tell little of an arm, or something else than they should: a model or a clear refusal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lipcore import FitOptions, Samples, load, save, train
from lipcore.arm import search
from lipcore.posterior.linalg import NotPositiveDefiniteError
from tests.lipcore.arm_oracles import arm, recorded

OPTIONS = FitOptions(device="cpu", search_seconds=0.3, posterior_samples=60)
KINDS = {"R": "revolute", "P": "prismatic"}


@pytest.fixture(autouse=True)
def fewer_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is found does not matter here."""
    monkeypatch.setattr(search, "SCREENED", 40)


def samples(kinds: str = "RRR", size: int = 60, noise: float = 0.01) -> Samples:
    return recorded(arm(kinds, 41)[2], 1, size, noise)


def still(columns: list[int]) -> Samples:
    """Some joints never move."""
    whole = samples()
    q, dq, ddq = whole.q.copy(), whole.dq.copy(), whole.ddq.copy()
    q[:, columns], dq[:, columns], ddq[:, columns] = 0.3, 0.0, 0.0
    return replace(whole, q=q, dq=dq, ddq=ddq)


CASES: dict[str, tuple[str, Callable[[], Samples]]] = {
    "a joint that never moves": ("RRR", lambda: still([1])),
    "no joint moves": ("RRR", lambda: still([0, 1, 2])),
    "constant torque": ("RRR", lambda: replace(samples(), tau=np.tile([1.0, -2.0, 0.5], (60, 1)))),
    "no torque": ("RRR", lambda: replace(samples(), tau=np.zeros((60, 3)))),
    "noise alone": ("RRR", lambda: replace(samples(), tau=np.random.default_rng(0).standard_normal((60, 3)))),
    "free of noise": ("RRR", lambda: samples(noise=0.0)),
    "ten samples": ("RRR", lambda: samples(size=10)),
    "the same sample again and again": ("RRR", lambda: samples().rows(np.zeros(20, np.int64))),
    "revolute declared prismatic": ("RPR", samples),
    "prismatic declared revolute": ("RRR", lambda: samples("RPR")),
    "one joint": ("R", lambda: samples("R")),
    "one joint that slides": ("P", lambda: samples("P")),
    "torques in another unit": ("RRR", lambda: replace(samples(), tau=1e6 * samples().tau)),
    "an angle in degrees": ("RRR", lambda: replace(samples(), q=np.degrees(samples().q))),
}


@pytest.mark.parametrize(
    ("name", "convention"),
    [
        *((name, "gravity_included") for name in CASES),
        *((name, "gravity_compensated") for name in ("no joint moves", "no torque", "ten samples", "one joint")),
    ],
)
def test_it_ends_in_a_model_or_a_clear_refusal(name: str, convention: str, tmp_path: Path) -> None:
    kinds, make = CASES[name]
    data = make()
    try:
        model = train(data, [KINDS[kind] for kind in kinds], "rigid-body", OPTIONS, convention)
    except (ValueError, NotPositiveDefiniteError):
        return
    answer = model.predict(data.q, data.dq, data.ddq, covariance=True)
    for part in (answer.tau, answer.tau_std, answer.covariance, answer.noise_std):
        assert np.isfinite(part).all()
    assert (answer.noise_std > 0).all()
    elsewhere = model.predict(data.q + 1.0, 2 * data.dq + 0.1, data.ddq - 1.0)
    assert np.isfinite(elsewhere.tau).all()
    assert np.isfinite(elsewhere.tau_std).all()
    save(model, tmp_path / "model")
    again = load(tmp_path / "model").predict(data.q, data.dq, data.ddq)
    largest = np.abs(answer.tau).max(initial=1e-9)
    np.testing.assert_allclose(again.tau, answer.tau, rtol=1e-6, atol=1e-6 * largest)
