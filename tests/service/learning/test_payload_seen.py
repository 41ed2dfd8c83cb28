"""Payloads as shown by the clients, live events, metrics and alarms."""

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
from tests.service.learning.event_listener import follow_model
from tests.service.learning.payloads import MASS_KG, OFFSET_M, payload_batches, send_payload_batches
from tests.service.models.versions import publish_arm_at

STREAM_ID = "cell"


@pytest.fixture(scope="module")
def payload_model(server):
    """Model of an arm in the shared service whose stream STREAM_ID has picked up MASS_KG."""
    publish_arm_at(server.home, "carrier")
    send_payload_batches(server.client, "carrier", STREAM_ID)
    return "carrier"


@pytest.fixture
def client(server):
    with Client(server.url) as made:
        yield made


def read_stream_gauges(server, model):
    """Return the numbers of streams, and of streams with a payload, from the metrics."""
    families = parse(server.client.get("/metrics").text)
    samples = [each for family in families for each in family.samples]
    assert not any("stream" in each.labels for each in samples)  # one series per stream would be too many
    known = {each.name: each.value for each in samples if each.labels.get("model") == model}
    return known.get("lipserve_streams"), known.get("lipserve_streams_with_payload")


@pytest.mark.slow
def test_answers_forget_rows_of_a_detected_payload_without_a_further_batch(server, payload_model):
    def read_status():
        return server.client.get(f"/v1/models/{payload_model}/learning").json()["status"]

    eventually(lambda: read_status()["events"] > len(payload_batches(STREAM_ID)))  # the payload is logged
    eventually(lambda: read_status()["lag_events"] == 0, 60.0)


@pytest.mark.slow
def test_payload_is_the_same_on_all_interfaces(server, client, payload_model):
    def read_views():
        """Return all views once two reads agree; a refinement between reads changes them."""
        reads = []
        for _ in range(2):
            (live_view,) = (each for each in next(client.live(payload_model)).payloads if each.stream_id == STREAM_ID)
            raw = server.client.get(f"/v1/models/{payload_model}/payload").json()
            reads.append((client.payload(payload_model), raw, live_view, read_stream_gauges(server, payload_model)))
        return reads[0] if reads[0] == reads[1] else None

    seen, raw, live_view, metrics = eventually(read_views)
    assert seen.as_dict() == raw
    assert (seen.frame, seen.link, seen.reason, seen.default) == ("learnt", "panda_joint7", None, None)
    (stream,) = (each for each in seen.streams if each.stream_id == STREAM_ID)
    assert (stream.state, stream.declared) == ("payload", False)
    body = stream.payload
    assert body.mass.mean == pytest.approx(MASS_KG, abs=5 * body.mass.std)
    assert 0.0 < body.mass.std < 0.05
    np.testing.assert_array_less(np.abs(np.subtract(body.com.mean, OFFSET_M)), 5 * np.array(body.com.std))
    for name in ("state", "declared", "since", "rows"):
        assert getattr(live_view, name) == getattr(stream, name), name
    assert live_view.mass == body.mass
    assert metrics[1] >= 1
    (alarm,) = (each for each in client.alarms(payload_model) if each.kind == "payload")
    assert re.search(rf"Stream {STREAM_ID} carries 1\.\d\d ±", alarm.message)


def test_payload_is_declared_and_removed_for_one_stream(server, client, payload_model):
    inertia = np.diag([0.01, 0.02, 0.02])
    with pytest.raises(ApiError, match="no stream 'tool'") as caught:  # mistyped names are rejected
        client.declare_payload(payload_model, 2.0, np.array([0.0, 0.0, 0.1]), inertia, stream_id="tool")
    assert caught.value.status == 404
    (known, *_) = payload_batches("tool", 0.0)
    assert server.client.post(f"/v1/models/{payload_model}/observations", json=known).status_code == 200
    reply = client.declare_payload(payload_model, 2.0, np.array([0.0, 0.0, 0.1]), inertia, stream_id="tool")
    (tool,) = (each for each in reply.streams if each.stream_id == "tool")
    assert (tool.state, tool.declared, tool.rows) == ("payload", True, 0)
    assert tool.payload.mass.mean == pytest.approx(2.0)
    np.testing.assert_allclose(tool.payload.inertia.mean, inertia, atol=1e-5)
    streams, carrying = read_stream_gauges(server, payload_model)
    gone = client.remove_payload(payload_model, "tool")
    assert [each.payload for each in gone.streams if each.stream_id == "tool"] == [None]
    assert read_stream_gauges(server, payload_model) == (streams, carrying - 1)
    client.delete_stream(payload_model, "tool")
    assert "tool" not in {each.stream_id for each in client.learning(payload_model).status.streams}
    assert read_stream_gauges(server, payload_model) == (streams - 1, carrying - 1)
    with pytest.raises(ApiError, match="no stream 'tool'"):
        client.remove_payload(payload_model, "tool")
    assert client.observation(payload_model, "tool", 0).state == "learnt"  # its batches stay learnt


def test_async_client_declares_and_removes_payloads(server):
    publish_arm_at(server.home, "carrier-async")

    async def work():
        async with AsyncClient(server.url) as client:
            reply = await client.declare_payload("carrier-async", 3.0, [0.0, 0.0, 0.1])
            assert reply.default.mass.mean == pytest.approx(3.0)
            assert await client.payload("carrier-async") == reply
            gone = await client.remove_payload("carrier-async")
            assert (gone.default, gone.streams) == (None, [])
            with pytest.raises(ApiError) as caught:
                await client.declare_payload("carrier-async", 3.0, [0.0, 0.0, 0.1], np.diag([9.0, 1.0, 1.0]))
            assert (caught.value.status, caught.value.code) == (422, "invalid_request")

    asyncio.run(work())


def test_drawn_inertias_match_bodies():
    drawn = np.random.default_rng(4).multivariate_normal(ETA_MEAN, np.diag(ETA_STD**2), 20)
    expected = [Body.of(parameters_of(eta)[0]).inertia for eta in drawn]
    np.testing.assert_allclose(payload._inertias(drawn), expected, rtol=1e-6, atol=1e-9)


def test_model_without_arm_has_no_payload(learning_service, streaming):
    learning_service.create_model("armless")
    with follow_model(learning_service.client, "armless") as listener:
        assert listener.list_data("status")[0]["payloads"] is None
    with Client(streaming.server.url) as client:
        shown = client.payload("pendulum")
        assert shown.streams == []
        assert "has no arm" in shown.reason
        with pytest.raises(ApiError) as caught:
            client.declare_payload("pendulum", 1.0, [0.0, 0.0, 0.1])
        assert (caught.value.status, caught.value.code) == (409, "conflict")
    assert read_stream_gauges(streaming.server, "pendulum")[1] in (None, 0)
