"""A payload declared in a query: the answer is that of lipcore's model with it, independent of other queries."""

import asyncio
import gc
import io
import json
import tarfile
import threading
import weakref
from dataclasses import replace

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

PREDICT = "/v1/models/panda-sim/predict"
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
    """Four states of seven joints: (3, 4, 7)."""
    low, high = (np.array(panda.training_range["q"][end]) for end in ("min", "max"))
    draw = np.random.default_rng(4)
    return np.stack([draw.uniform(low, high, (4, 7)), *draw.uniform(-1, 1, (2, 4, 7))])


def model_with_payload(model, payload):
    """Return the library's model with a payload."""
    inertia = payload.get("inertia")
    body = Body(payload["mass"], np.array(payload["com"]), None if inertia is None else np.array(inertia))
    carrier = Carrier(model)
    return carrier.with_payload(carrier.known(body.parameters))


def query(motion, **more):
    return dict(zip(("q", "dq", "ddq"), motion.tolist(), strict=True)) | more


def post_query(api, motion, media_type="application/json", **more):
    content = json.dumps(query(motion, **more))
    answer = api.post(PREDICT, content=content, headers={"content-type": media_type})
    assert answer.status_code == 200, answer.text
    return answer.json()


@pytest.mark.parametrize("payload", [PAYLOAD, POINT, PAYLOAD | {"inertia": None}])
def test_answer_equals_the_library(api, panda, motion, payload):
    model = model_with_payload(panda, payload)
    expected = model.predict(*motion, covariance=True)
    tau = expected.tau + 0.1
    names = list(dynamics.COMPONENTS)
    answer = post_query(api, motion, payload=payload, covariance=True, components=names, tau=tau.tolist())
    assert np.abs(expected.tau - panda.predict(*motion).tau).max() > 1
    for name in ("tau", "tau_std", "covariance"):
        assert_allclose(answer[name], getattr(expected, name), **EXACT)
    parts = dynamics.components(model, Motion.from_arrays(*motion), names, tau)
    for name, part in parts.items():
        size = float(np.abs(part.mean).max())
        assert_allclose(answer["components"][name]["mean"], part.mean, rtol=1e-6, atol=1e-9 * size)
        assert_allclose(answer["components"][name]["std"], part.std, rtol=1e-4, atol=1e-6 * size)


def test_known_payload_is_answered_on_the_event_loop(api, panda, motion, monkeypatch):
    expected = model_with_payload(panda, POINT).predict(*motion)
    computed, predict = [], predicting.predict
    monkeypatch.setattr(predicting, "predict", lambda *given: computed.append(1) or predict(*given))
    service_of(api).loaded.get("panda-sim", None).declared_payloads._kept.clear()
    for row in range(4):
        for payload in (POINT, {**POINT, "com": [0, 0, 0.2], "mass": 5e-1}, {**POINT, "inertia": None}):
            answer = post_query(api, motion[:, row], payload=payload)
            assert_allclose(answer["tau"], expected.tau[row], **EXACT)
            assert_allclose(answer["tau_std"], expected.tau_std[row], rtol=1e-6)
    assert len(computed) == 1
    elsewhere = post_query(api, motion[:, 0], "application/x+json", payload=POINT)  # validated by pydantic
    assert len(computed) == 2
    assert_allclose(elsewhere["tau"], expected.tau[0], **EXACT)
    assert post_query(api, motion[:, 0], payload=None) == post_query(api, motion[:, 0])
    assert_allclose(post_query(api, motion)["tau"], panda.predict(*motion).tau, **EXACT)


@pytest.mark.parametrize("rows", [1, 4])
def test_model_without_an_arm_rejects_a_payload(api, trained, rows):
    zeros = np.zeros((3, 2) if rows == 1 else (3, rows, 2))
    answer = api.post(f"/v1/models/{trained.name}/predict", json=query(zeros, payload=POINT))
    (problem,) = error(answer, 422, "invalid_request")["detail"]
    assert (problem["field"], problem["value"]) == ("payload", "given")
    assert problem["expected"].startswith("no payload, or a model of estimator rigid-body")
    assert api.post(f"/v1/models/{trained.name}/predict", json=query(zeros, payload=None)).status_code == 200


def test_impossible_payload_error_names_the_expected_value(api, motion):
    def predict_rejected(**more):
        answer = api.post(PREDICT, json=query(motion, payload=PAYLOAD | more))
        (problem,) = error(answer, 422, "invalid_request")["detail"]
        return problem["field"], problem["expected"]

    sum_of = "no principal moment above the sum of the other two"
    assert predict_rejected(inertia=[[1, 0, 0], [0, 1, 0], [0, 0, 3]]) == ("payload.inertia", sum_of)
    assert predict_rejected(inertia=[[1, 1, 0], [0, 1, 0], [0, 0, 1]]) == ("payload.inertia", "a symmetric matrix")
    assert predict_rejected(mass=0) == ("payload.mass", "greater than 0")
    assert predict_rejected(com=[0, 1]) == ("payload.com", "a list of three")


@pytest.mark.slow
def test_clients_send_a_payload(server, panda, motion):
    expected = model_with_payload(panda, PAYLOAD).predict(*motion)

    async def predict():
        async with AsyncClient(server.url) as client:
            given = {name: np.array(value) for name, value in PAYLOAD.items()}
            return await client.predict("panda-sim", *motion, payload=given)

    assert_allclose(asyncio.run(predict()).tau, expected.tau, **EXACT)


def test_stored_and_served_model_is_unchanged(api, motion):
    def tensors():
        with tarfile.open(fileobj=io.BytesIO(api.get("/v1/models/panda-sim/export").content)) as archive:
            return archive.extractfile("model.safetensors").read()

    version = "/v1/models/panda-sim/versions/1"
    before = api.get(version).json(), post_query(api, motion), tensors()
    post_query(api, motion, payload=PAYLOAD)
    assert (api.get(version).json(), post_query(api, motion), tensors()) == before


PAYLOADS = [(mass, (0.0, 0.01 * place, 0.1), None) for place, mass in enumerate((0.5, 1.0, 2.0, 4.0))]


@pytest.fixture(scope="module")
def revisions(panda):
    """Two revisions, and the answer of each with each payload at one motion."""
    weights = panda.posterior.weights * 1.01
    models = panda, replace(panda, posterior=replace(panda.posterior, weights=weights))
    at = np.full((3, 7), 0.3)
    answers = {}
    for revision, model in enumerate(models):
        for mass, com, _ in PAYLOADS:
            tau, _ = model_with_payload(model, {"mass": mass, "com": com}).answer(at)
            answers[revision, mass] = tau
    return models, at, answers


@settings(max_examples=10, deadline=None)
@given(
    query_lists=st.lists(
        st.lists(st.tuples(st.sampled_from([0, 1]), st.sampled_from(PAYLOADS)), min_size=1, max_size=6),
        min_size=2,
        max_size=4,
    )
)
def test_threads_get_the_answers_to_their_queries(revisions, query_lists):
    models, at, answers = revisions
    kept = [DeclaredPayloads(model) for model in models]
    wrong = []

    def work(questions):
        for revision, payload in questions:
            model = kept[revision].cached(payload) or kept[revision].model(payload)
            if not np.allclose(model.answer(at)[0], answers[revision, payload[0]], rtol=1e-9):
                wrong.append((revision, payload))
            if len(kept[revision]._kept) > 2:
                wrong.append("more are kept than may be")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(declared, "MAX_KEPT_MODELS", 2)
        threads = [threading.Thread(target=work, args=(questions,)) for questions in query_lists]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert not wrong


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
    served = replace(service_of(api).loaded.get("panda-sim", None))
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
