"""Streams that follow an alias, and their messages once the alias is removed."""

import pytest
from websockets.exceptions import InvalidStatus

from lipserve import ApiError, Client, StreamClient, StreamError
from tests.service.data import train
from tests.service.streams import MOTION, TAU, frame, open_stream, read_hello, send_frame

pytestmark = pytest.mark.slow

STREAM = "/v1/models/pendulum/stream"


def test_stream_follows_its_alias_and_learns_nothing(streaming):
    server = streaming.server
    with Client(server.url) as client, StreamClient("pendulum", server.url, alias="serving") as served:
        assert served.predict(*MOTION).version == 1
        client.set_alias("pendulum", "arm-cell", 1)
        with StreamClient("pendulum", server.url, alias="arm-cell", stream_id="arm-1") as stream_client:
            assert stream_client.hello.version == stream_client.predict(*MOTION).version == 1
            with pytest.raises(StreamError, match="only the serving version learns"):
                stream_client.predict(*MOTION, tau=TAU)
            client.remove_alias("pendulum", "arm-cell")
            with pytest.raises(StreamError, match="no alias 'arm-cell'") as caught:
                stream_client.predict(*MOTION)
            assert caught.value.code == "not_found"
            assert client.rollback_alias("pendulum", "arm-cell").version == 1
            assert stream_client.predict(*MOTION).version == 1


@pytest.mark.parametrize(
    ("query", "status"), [("alias=nowhere", 404), ("alias=Bad", 422), ("alias=serving&version=1", 422)]
)
def test_wrong_alias_is_rejected_before_the_stream_opens(streaming, query, status):
    with pytest.raises(InvalidStatus) as caught, open_stream(streaming.server, f"{STREAM}?{query}"):
        pass
    response = caught.value.response
    assert response.status_code == status
    assert b'"field":"alias"' in response.body


@pytest.fixture(scope="module")
def two_versions(streaming):
    """A model of two versions."""
    for _ in range(2):
        train(streaming.server.client, "kept", streaming.dataset)
    return "kept"


def test_stream_reports_that_its_version_or_model_was_deleted(streaming, two_versions):
    server, path = streaming.server, f"/v1/models/{two_versions}/stream"
    with (
        Client(server.url) as client,
        open_stream(server, f"{path}?version=1") as pinned,
        open_stream(server, path) as free,
    ):
        assert (read_hello(pinned)["version"], read_hello(free)["version"]) == (1, 2)
        assert send_frame(pinned, frame()).version == 1
        client.delete_version(two_versions, 1)
        assert [each.version for each in client.model(two_versions).versions] == [2]
        assert send_frame(pinned, frame()).error["code"] == "not_found"
        assert send_frame(free, frame()).version == 2
        client.delete_model(two_versions)
        assert send_frame(free, frame()).error["code"] == "not_found"
        with pytest.raises(ApiError, match="no model 'kept'"):
            client.model(two_versions)
