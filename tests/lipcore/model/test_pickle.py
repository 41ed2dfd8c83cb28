"""Models pass between processes as pickles, with their compiled arrays laid out, and answer as before."""

import pickle
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from lipcore import TorqueModel, load
from lipcore.kernels.drive.play import ELEMENTS
from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from lipcore.online.learner import OnlineModel
from tests import ROOT
from tests.choosing import few
from tests.lipcore.export.models import MODELS, PANDA, draw_motions

KEPT = ("panda", "local", "friction of all kinds, alternatives")


def pass_on(value: Any) -> tuple[Any, int]:
    """Return a copy that shares the arrays of a pickle, and the size of the pickle without them."""
    buffers = list[pickle.PickleBuffer]()
    data = pickle.dumps(value, 5, buffer_callback=buffers.append)
    return pickle.loads(data, buffers=[bytearray(each.raw()) for each in buffers]), len(data)


def assert_same_answers(model: TorqueModel, other: TorqueModel) -> None:
    """Assert that predictions and single answers are equal, to the last bit."""
    motion = draw_motions(model, 20, 1, 1.5)
    deflections = np.random.default_rng(2).uniform(0.0, 1.0, (20, 2 * len(ELEMENTS), model.n_joints))
    for known in (None, deflections if model.remembers else None):
        found, expected = (each.predict(*motion, True, known) for each in (other, model))
        for part in ("mean", "tau", "tau_std", "covariance", "noise_std"):
            np.testing.assert_array_equal(getattr(found, part), getattr(expected, part))
    query = np.ascontiguousarray(motion[:, 0])
    for found, expected in zip(other.answer_fully(query)[:2], model.answer_fully(query)[:2], strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("name", few(MODELS, kept=lambda name: name in KEPT))
def test_pickled_model_answers_like_the_original(name: str) -> None:
    model = MODELS[name]()
    model.warm_up()
    copy, size = pass_on(model)
    assert "evaluator" in vars(copy)
    assert size < 64 * 1024
    assert_same_answers(model, copy)


def test_models_with_payloads_and_revisions_are_pickled() -> None:
    carrier = Carrier(load(PANDA))
    payload = carrier.known(Body(1.5, np.array([0.0, 0.02, 0.1]), None).parameters)
    for model in (carrier.with_payload(payload), OnlineModel.start(carrier.model, None, 0.0).model(None)):
        copy, _ = pass_on(model)
        assert_same_answers(model, copy)
    again = Carrier(pass_on(carrier.model)[0]).with_payload(payload)
    assert_same_answers(carrier.with_payload(payload), again)


def test_caches_that_only_some_requests_need_are_not_pickled() -> None:
    model = load(PANDA)
    model.warm_up()
    before = len(pickle.dumps(model, 5))
    assert model.fast is model
    assert model.linear_bodies is not None
    model.torque(*draw_motions(model, 100, 1, 1.5))
    assert len(vars(model.posterior)["_feature_factors"][1]) == len(model.posterior.weights)
    assert len(pickle.dumps(model, 5)) < before + 4096  # kernels keep a few numbers of their own


def test_another_process_answers_the_same() -> None:
    model, query = load(PANDA), np.random.default_rng(0).normal(size=(3, 7))
    model.warm_up()
    code = (
        "import pickle, sys; model, query = pickle.load(sys.stdin.buffer); "
        "print(*(each.tobytes().hex() for each in model.answer(query)))"
    )
    given = pickle.dumps((model, query), 5)
    run = subprocess.run([sys.executable, "-c", code], input=given, cwd=ROOT, capture_output=True, check=True)
    assert run.stdout.decode().split() == [each.tobytes().hex() for each in model.answer(query)]
