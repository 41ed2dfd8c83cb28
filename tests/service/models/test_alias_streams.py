"""Streams that follow an alias, and what they say once it is gone."""

import pytest
from websockets.exceptions import InvalidStatus

from lipserve import ApiError, Client, StreamClient, StreamError
from tests.service.data import train
from tests.service.streams import MOTION, TAU, ask, dial, frame, hello

STREAM = "/v1/models/pendulum/stream"


def test_a_stream_follows_its_alias_and_learns_nothing(streaming):
    server = streaming.server
    with Client(server.url) as client, StreamClient("pendulum", server.url, alias="serving") as served:
        assert served.predict(*MOTION).version == 1
        client.set_alias("pendulum", "arm-cell", 1)
        with StreamClient("pendulum", server.url, alias="arm-cell", stream_id="arm-1") as talk:
            assert talk.hello.version == talk.predict(*MOTION).version == 1
            with pytest.raises(StreamError, match="only the version that serves learns"):
                talk.predict(*MOTION, tau=TAU)
            client.remove_alias("pendulum", "arm-cell")
            with pytest.raises(StreamError, match="no alias 'arm-cell'") as caught:
                talk.predict(*MOTION)
            assert caught.value.code == "not_found"
            assert client.rollback_alias("pendulum", "arm-cell").version == 1
            assert talk.predict(*MOTION).version == 1


@pytest.mark.parametrize(
    ("query", "status"), [("alias=nowhere", 404), ("alias=Bad", 422), ("alias=serving&version=1", 422)]
)
def test_bad_aliases_are_refused_before_the_stream_opens(streaming, query, status):
    with pytest.raises(InvalidStatus) as caught, dial(streaming.server, f"{STREAM}?{query}"):
        pass
    response = caught.value.response
    assert response.status_code == status
    assert b'"field":"alias"' in response.body


@pytest.fixture(scope="module")
def kept(streaming):
    """A model of two versions."""
    for _ in range(2):
        train(streaming.server.client, "kept", streaming.dataset)
    return "kept"


def test_a_stream_says_that_its_version_or_its_model_was_deleted(streaming, kept):
    server, path = streaming.server, f"/v1/models/{kept}/stream"
    with Client(server.url) as client, dial(server, f"{path}?version=1") as pinned, dial(server, path) as free:
        assert (hello(pinned)["version"], hello(free)["version"]) == (1, 2)
        assert ask(pinned, frame()).version == 1
        client.delete_version(kept, 1)
        assert [each.version for each in client.model(kept).versions] == [2]
        assert ask(pinned, frame()).error["code"] == "not_found"
        assert ask(free, frame()).version == 2
        client.delete_model(kept)
        assert ask(free, frame()).error["code"] == "not_found"
        with pytest.raises(ApiError, match="no model 'kept'"):
            client.model(kept)
