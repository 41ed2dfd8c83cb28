"""A payload declared in a query: the answer is that of lipcore's model with it, independent of other queries."""

import asyncio
import gc
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from unittest.mock import Mock, patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

import lipcore
from lipcore.data.motion import Motion
from lipcore.model import dynamics
from lipcore.model.body import Body
from lipcore.model.payload import Carrier, NoArmError
from lipserve import AsyncClient
from service.inference import predicting
from service.models import declared
from service.models.declared import DeclaredPayloads
from tests import ROOT
from tests.service.data import error, service_of
from tests.service.models.archives.packing import TENSORS, exported, unpack
from tests.service.models.versions import predict, predict_json

MODEL = "panda-sim"
INERTIA = [[0.02, 0.003, 0.001], [0.003, 0.015, -0.002], [0.001, -0.002, 0.01]]
PAYLOAD = {"mass": 2, "com": [0.05, -0.03, 0.12], "inertia": INERTIA}
POINT = {"mass": 0.5, "com": [0, 0.0, 0.2]}
EXACT = {"rtol": 1e-9, "atol": 1e-12}


@pytest.fixture(scope="module")
def panda():
    """The shipped model, loaded by lipcore."""
    return lipcore.load(ROOT / "models" / "panda-sim")


@pytest.fixture(scope="module")
def motion(panda):
    """Four states of seven joints, (4, 7) each."""
    low, high = (np.array(panda.training_range["q"][end]) for end in ("min", "max"))
    draw = np.random.default_rng(4)
    return {"q": draw.uniform(low, high, (4, 7)), "dq": draw.uniform(-1, 1, (4, 7)), "ddq": draw.uniform(-1, 1, (4, 7))}


def row_of(motion, row):
    return {name: values[row] for name, values in motion.items()}


def model_with_payload(model, payload):
    """Return the library's model with a payload."""
    inertia = payload.get("inertia")
    body = Body(payload["mass"], np.array(payload["com"]), None if inertia is None else np.array(inertia))
    carrier = Carrier(model)
    return carrier.with_payload(carrier.known(body.parameters))


@pytest.mark.parametrize("payload", [PAYLOAD, POINT, PAYLOAD | {"inertia": None}])
def test_answer_equals_the_library(api, panda, motion, payload):
    model, names = model_with_payload(panda, payload), list(dynamics.COMPONENTS)
    expected = model.predict(**motion, covariance=True)
    tau = expected.tau + 0.1
    answer = predict_json(api, MODEL, **motion, payload=payload, covariance=True, components=names, tau=tau)
    assert np.abs(expected.tau - panda.predict(**motion).tau).max() > 1
    for name in ("tau", "tau_std", "covariance"):
        assert_allclose(answer[name], getattr(expected, name), **EXACT)
    for name, part in dynamics.components(model, Motion.from_arrays(**motion), names, tau).items():
        size = float(np.abs(part.mean).max())
        assert_allclose(answer["components"][name]["mean"], part.mean, rtol=1e-6, atol=1e-9 * size)
        assert_allclose(answer["components"][name]["std"], part.std, rtol=1e-4, atol=1e-6 * size)


def test_known_payload_is_answered_on_the_event_loop(api, panda, motion, monkeypatch):
    expected, compute = model_with_payload(panda, POINT).predict(**motion), Mock(wraps=predicting.predict)
    monkeypatch.setattr(predicting, "predict", compute)
    service_of(api).loaded.get(MODEL, None).declared_payloads._kept.clear()
    for row in range(4):
        for payload in (POINT, {**POINT, "com": [0, 0, 0.2], "mass": 5e-1}, {**POINT, "inertia": None}):
            answer = predict_json(api, MODEL, **row_of(motion, row), payload=payload)
            assert_allclose(answer["tau"], expected.tau[row], **EXACT)
            assert_allclose(answer["tau_std"], expected.tau_std[row], rtol=1e-6)
    assert compute.call_count == 1
    first = row_of(motion, 0)
    body = {name: values.tolist() for name, values in first.items()} | {"payload": POINT}
    validated = api.post(f"/v1/models/{MODEL}/predict", json=body, headers={"content-type": "application/x+json"})
    assert compute.call_count == 2  # pydantic validates this media type
    assert_allclose(validated.json()["tau"], expected.tau[0], **EXACT)
    assert predict_json(api, MODEL, **first, payload=None) == predict_json(api, MODEL, **first)
    assert_allclose(predict_json(api, MODEL, **motion)["tau"], panda.predict(**motion).tau, **EXACT)


@pytest.mark.parametrize("rows", [(), (4,)])
def test_model_without_an_arm_rejects_a_payload(api, trained, rows):
    query = dict.fromkeys(("q", "dq", "ddq"), np.zeros((*rows, 2)))
    answer = predict(api, trained.name, **query, payload=POINT)
    (problem,) = error(answer, 422, "invalid_request")["detail"]
    assert (problem["field"], problem["value"]) == ("payload", "given")
    assert problem["expected"].startswith("no payload, or a model of one arm, of estimator rigid-body")
    assert predict_json(api, trained.name, **query, payload=None)


@pytest.mark.parametrize(
    ("changed", "field", "expected"),
    [
        (
            {"inertia": [[1, 0, 0], [0, 1, 0], [0, 0, 3]]},
            "inertia",
            "no principal moment above the sum of the other two",
        ),
        ({"inertia": [[1, 1, 0], [0, 1, 0], [0, 0, 1]]}, "inertia", "a symmetric matrix"),
        ({"mass": 0}, "mass", "greater than 0"),
        ({"com": [0, 1]}, "com", "a list of three"),
    ],
)
def test_impossible_payload_error_names_the_expected_value(api, motion, changed, field, expected):
    answer = predict(api, MODEL, **motion, payload=PAYLOAD | changed)
    (problem,) = error(answer, 422, "invalid_request")["detail"]
    assert (problem["field"], problem["expected"]) == (f"payload.{field}", expected)


@pytest.mark.slow
def test_clients_send_a_payload(server, panda, motion):
    expected = model_with_payload(panda, PAYLOAD).predict(**motion)

    async def predict_with_client():
        async with AsyncClient(server.url) as client:
            given = {name: np.array(value) for name, value in PAYLOAD.items()}
            return await client.predict(MODEL, **motion, payload=given)

    assert_allclose(asyncio.run(predict_with_client()).tau, expected.tau, **EXACT)


def test_stored_and_served_model_is_unchanged(api, motion):
    def state():
        version, tensors = api.get(f"/v1/models/{MODEL}/versions/1").json(), unpack(exported(api, MODEL))[TENSORS]
        return version, predict_json(api, MODEL, **motion), tensors

    before = state()
    predict_json(api, MODEL, **motion, payload=PAYLOAD)
    assert state() == before


PAYLOADS = [(mass, (0.0, 0.01 * place, 0.1), None) for place, mass in enumerate((0.5, 1.0, 2.0, 4.0))]


@pytest.fixture(scope="module")
def revisions(panda):
    """Two revisions, and the answer of each with each payload at one motion."""
    weights = panda.posterior.weights * 1.01
    models = panda, replace(panda, posterior=replace(panda.posterior, weights=weights))
    at = np.full((3, 7), 0.3)
    answers = {
        (revision, mass): model_with_payload(model, {"mass": mass, "com": com}).answer(at)[0]
        for revision, model in enumerate(models)
        for mass, com, _ in PAYLOADS
    }
    return models, at, answers


QUERIES = st.tuples(st.sampled_from([0, 1]), st.sampled_from(PAYLOADS))


@settings(max_examples=10, deadline=None)
@given(query_lists=st.lists(st.lists(QUERIES, min_size=1, max_size=6), min_size=2, max_size=4))
def test_threads_get_the_answers_to_their_queries(revisions, query_lists):
    models, at, answers = revisions
    kept = [DeclaredPayloads(model) for model in models]

    def work(questions):
        for revision, payload in questions:
            model = kept[revision].cached(payload) or kept[revision].model(payload)
            assert np.allclose(model.answer(at)[0], answers[revision, payload[0]], rtol=1e-9)
            assert len(kept[revision]._kept) <= 2

    with patch.object(declared, "MAX_KEPT_MODELS", 2), ThreadPoolExecutor(len(query_lists)) as pool:
        list(pool.map(work, query_lists))


def test_repeated_payload_is_cached_and_unused_one_dropped(panda, monkeypatch):
    monkeypatch.setattr(declared, "MAX_KEPT_MODELS", 2)
    kept = DeclaredPayloads(panda)
    one, two, three, _ = PAYLOADS
    first, second = kept.model(one), kept.model(two)
    assert kept.model(one) is first
    kept.model(three)
    assert kept.cached(one) is first
    assert kept.cached(two) is None
    assert kept.model(two) is not second


def test_rejection_leaves_nothing_behind(panda, trained):
    kept = DeclaredPayloads(panda)
    with pytest.raises(ValueError, match="mass"):
        kept.model((0.0, (0.0, 0.0, 0.0), None))
    assert not kept._kept
    with pytest.raises(NoArmError):
        DeclaredPayloads(trained.model).model(PAYLOADS[0])


def test_payload_cache_belongs_to_its_revision(api):
    served = replace(service_of(api).loaded.get(MODEL, None))
    model = weakref.ref(served.declared_payloads.model(PAYLOADS[0]))
    later = replace(served, revision=served.revision + 1)
    assert later.declared_payloads is not served.declared_payloads
    assert later.declared_payloads.cached(PAYLOADS[0]) is None
    gc.disable()  # the cache is in no reference cycle, as the collector ignores loaded versions, see `LoadedModels`
    try:
        del served
        assert model() is None
    finally:
        gc.enable()
