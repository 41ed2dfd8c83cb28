"""A payload that a stream's arm takes up, as its owner sees it: clients, live page's feed, metrics, alarms."""

import asyncio
import re

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families as parse

from lipcore.model.body import Body
from lipcore.online.payload.bodies import ETA_MEAN, ETA_STD
from lipcore.online.payload.bodies import body as parameters_of
from lipserve import ApiError, AsyncClient, Client
from service.learning.control import payload
from tests.service.data import eventually
from tests.service.learning.following import following
from tests.service.learning.payloads import MASS, OFFSET, lift, lifting
from tests.service.models.versions import publish_arm_at

CELL = "cell"


@pytest.fixture(scope="module")
def carrier(server):
    """A model of an arm in the shared service; the stream CELL has taken up MASS."""
    publish_arm_at(server.home, "carrier")
    lift(server.client, "carrier", CELL)
    return "carrier"


@pytest.fixture
def client(server):
    with Client(server.url) as made:
        yield made


def gauges(server, model):
    """Streams of a model that are known, and that carry something, by the metrics."""
    families = parse(server.client.get("/metrics").text)
    samples = [each for family in families for each in family.samples]
    assert not any("stream" in each.labels for each in samples)  # no series a stream
    known = {each.name: each.value for each in samples if each.labels.get("model") == model}
    return known.get("lipserve_streams"), known.get("lipserve_streams_with_payload")


def test_what_is_taken_up_is_seen_everywhere_alike(server, client, carrier):
    def alike():
        """What is seen, once nothing was refined between the first look and the last."""
        looks = []
        for _ in range(2):
            (told,) = (each for each in next(client.live(carrier)).payloads if each.stream_id == CELL)
            raw = server.client.get(f"/v1/models/{carrier}/payload").json()
            looks.append((client.payload(carrier), raw, told, gauges(server, carrier)))
        return looks[0] if looks[0] == looks[1] else None

    seen, raw, told, metrics = eventually(alike)
    assert seen.as_dict() == raw
    assert (seen.frame, seen.link, seen.reason, seen.default) == ("learnt", "panda_joint7", None, None)
    (stream,) = (each for each in seen.streams if each.stream_id == CELL)
    assert (stream.state, stream.declared) == ("payload", False)
    body = stream.payload
    assert body.mass.mean == pytest.approx(MASS, abs=5 * body.mass.std)
    assert 0.0 < body.mass.std < 0.05
    np.testing.assert_array_less(np.abs(np.subtract(body.com.mean, OFFSET)), 5 * np.array(body.com.std))
    for name in ("state", "declared", "since", "rows"):
        assert getattr(told, name) == getattr(stream, name), name
    assert told.mass == body.mass
    assert metrics[1] >= 1
    (alarm,) = (each for each in client.alarms(carrier) if each.kind == "payload")
    assert re.search(rf"stream {CELL} carries 1\.\d\d ±", alarm.message)


def test_it_is_declared_and_removed_for_one_robot_or_for_all(server, client, carrier):
    inertia = np.diag([0.01, 0.02, 0.02])
    with pytest.raises(ApiError, match="no stream 'tool'") as caught:  # whoever mistypes a name is told
        client.declare_payload(carrier, 2.0, np.array([0.0, 0.0, 0.1]), inertia, stream_id="tool")
    assert caught.value.status == 404
    (known, *_) = lifting("tool", 0.0)
    assert server.client.post(f"/v1/models/{carrier}/observations", json=known).status_code == 200
    said = client.declare_payload(carrier, 2.0, np.array([0.0, 0.0, 0.1]), inertia, stream_id="tool")
    (tool,) = (each for each in said.streams if each.stream_id == "tool")
    assert (tool.state, tool.declared, tool.rows) == ("payload", True, 0)
    assert tool.payload.mass.mean == pytest.approx(2.0)
    np.testing.assert_allclose(tool.payload.inertia.mean, inertia, atol=1e-5)
    streams, carrying = gauges(server, carrier)
    gone = client.remove_payload(carrier, "tool")
    assert [each.payload for each in gone.streams if each.stream_id == "tool"] == [None]
    assert gauges(server, carrier) == (streams, carrying - 1)
    client.delete_stream(carrier, "tool")
    assert "tool" not in {each.stream_id for each in client.learning(carrier).status.streams}
    assert gauges(server, carrier) == (streams - 1, carrying - 1)
    with pytest.raises(ApiError, match="no stream 'tool'"):
        client.remove_payload(carrier, "tool")
    assert client.observation(carrier, "tool", 0).state == "learnt"  # what it has taught stays


def test_the_asynchronous_client_does_the_same(server):
    publish_arm_at(server.home, "carrier-async")

    async def work():
        async with AsyncClient(server.url) as client:
            said = await client.declare_payload("carrier-async", 3.0, [0.0, 0.0, 0.1])
            assert said.default.mass.mean == pytest.approx(3.0)
            assert await client.payload("carrier-async") == said
            gone = await client.remove_payload("carrier-async")
            assert (gone.default, gone.streams) == (None, [])
            with pytest.raises(ApiError) as caught:
                await client.declare_payload("carrier-async", 3.0, [0.0, 0.0, 0.1], np.diag([9.0, 1.0, 1.0]))
            assert (caught.value.status, caught.value.code) == (422, "invalid_request")

    asyncio.run(work())


def test_inertias_of_draws_are_those_of_bodies():
    drawn = np.random.default_rng(4).multivariate_normal(ETA_MEAN, np.diag(ETA_STD**2), 20)
    expected = [Body.of(parameters_of(eta)[0]).inertia for eta in drawn]
    np.testing.assert_allclose(payload._inertias(drawn), expected, rtol=1e-6, atol=1e-9)


def test_a_model_without_an_arm_has_none(school, streaming):
    school.enrol("armless")
    with following(school.client, "armless") as listener:
        assert listener.of("status")[0]["payloads"] is None
    with Client(streaming.server.url) as client:
        assert "knows no arm" in client.payload("pendulum").reason
        with pytest.raises(ApiError) as caught:
            client.declare_payload("pendulum", 1.0, [0.0, 0.0, 0.1])
        assert (caught.value.status, caught.value.code) == (409, "conflict")
    assert gauges(streaming.server, "pendulum")[1] in (None, 0)
