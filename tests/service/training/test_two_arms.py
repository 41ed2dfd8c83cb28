"""One model for two arms on one base: trained, asked, streamed, exported, and what is refused."""

from xml.etree import ElementTree

import numpy as np
import pytest

from lipcore.robots.urdf import RigidBody
from lipserve import Client, StreamClient
from tests.lipcore.two_arms import NAMES, TYPES, URDF, record_two_arms
from tests.service.data import DEADLINE, error, train, upload
from tests.service.streams import saved_model

MODEL = "two-arms"


@pytest.fixture(scope="module")
def arms(streaming):
    """Return a server with a model of two arms. In its data, the joints of the arms alternate."""
    api, samples = streaming.server.client, record_two_arms(1)
    answer = api.post("/v1/robots", content=URDF.encode(), headers={"content-type": "application/xml"})
    robot, dataset = answer.json()["id"], upload(api, samples)["id"]
    options = {"posterior_samples": 100}
    train(api, MODEL, dataset, estimator="rigid-body", robot=robot, joint_types=list(TYPES), options=options)
    return streaming.server


def test_two_arms_are_one_model(arms):
    api, samples = arms.client, record_two_arms(2, 20)
    version = api.get(f"/v1/models/{MODEL}/versions/1").json()
    assert version["joint_names"] == list(NAMES)
    assert version["fit"]["arms"] == 2
    geometry = version["parameters"]["geometry"]
    assert [joint["joint"] for joint in geometry["joints"]] == ["left 1", "left 2", "right 1", "right 2"]
    query = {name: getattr(samples, name).tolist() for name in ("q", "dq", "ddq")}
    answer = np.array(api.post(f"/v1/models/{MODEL}/predict", json=query).json()["tau"])
    model = saved_model(arms, MODEL, 1)
    np.testing.assert_allclose(answer, model.predict(samples.q, samples.dq, samples.ddq).tau, atol=1e-12)
    assert (np.square(answer - samples.tau).mean(axis=0) < 1e-2 * samples.tau.var(axis=0)).all()
    with StreamClient(MODEL, arms.url, timeout=DEADLINE, stream_id="both") as client:
        rows = zip(samples.q, samples.dq, samples.ddq, samples.tau, strict=True)
        told = [client.predict(*motion, tau=tau).tau for *motion, tau in rows]
        assert client.flush().through == 20
    np.testing.assert_allclose(told[0], answer[0], atol=1e-12)
    with Client(arms.url) as client:
        frames = client.version(MODEL, 1).arm.frames
        expected = model.geometry.placements(np.zeros(4))[1]
        np.testing.assert_allclose(frames.place, expected, atol=0.01)
    sketch = next(each["arm"] for each in api.get("/v1/overview").json()["items"] if each["name"] == MODEL)
    assert [joint["root"] for joint in sketch["joints"]] == [True, False, True, False]


def test_exports_have_both_arms(arms):
    text = arms.client.get(f"/v1/models/{MODEL}/export", params={"format": "urdf", "version": 1}).text
    assert RigidBody.from_urdf(text, NAMES, TYPES).roots == (0, 2)
    text = arms.client.get(f"/v1/models/{MODEL}/export", params={"format": "mjcf", "version": 1}).text
    base = ElementTree.fromstring(text).find("worldbody/body")
    assert [each.get("name") for each in base.findall("body")] == [f"{NAMES[0]}_link", f"{NAMES[1]}_link"]


def test_what_needs_one_arm_says_so(arms):
    query = {name: [0.0] * 4 for name in ("q", "dq", "ddq")}
    body = {"mass": 1.0, "com": [0.0, 0.0, 0.1]}
    answer = arms.client.post(f"/v1/models/{MODEL}/predict", json={**query, "payload": body})
    message = error(answer, 422, "invalid_request")["message"]
    assert "the model has 2 arms, but payloads are supported for one arm" in message
    answer = arms.client.put(f"/v1/models/{MODEL}/payload", json=body)
    assert "it has 2 arms, but payloads are supported for one arm" in error(answer, 409, "conflict")["message"]
    reason = arms.client.get(f"/v1/models/{MODEL}/payload").json()["reason"]
    assert reason == "it has 2 arms, but payloads are supported for one arm: train a model for each arm"
    answer = arms.client.post(f"/v1/models/{MODEL}/wrench", json={**query, "tau": [0.0] * 4})
    assert "one arm of at least 6 joints" in error(answer, 422, "invalid_request")["message"]
    request = {"model": MODEL, "datasets": [], "options": {"arms": "3"}}
    assert error(arms.client.post("/v1/jobs/check", json=request), 422, "invalid_request")
    dataset = arms.client.get("/v1/datasets").json()["items"][0]["id"]
    request = {"model": "unit", "datasets": [dataset], "base": f"{MODEL}:1", "joint_types": list(TYPES)}
    answer = arms.client.post("/v1/jobs/check", json=request | {"estimator": "rigid-body+lip-chain"})
    assert "the base has 2 arms" in error(answer, 422, "invalid_request")["message"]
