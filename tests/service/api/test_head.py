"""HEAD has the status and headers of GET, and no body."""

from contextlib import closing
from http.client import HTTPConnection

import pytest

PATHS = ("/health", "/health/live", "/health/ready", "/metrics", "/v1/models", "/v1/models/panda-sim", "/v2", "/")
OWN_HEADERS = {"x-request-id", "date", "content-length"}
"""Headers that differ between two answers; the length of `/metrics` does, too."""


@pytest.mark.parametrize("path", PATHS)
def test_head_has_status_and_headers_of_get_and_no_body(api, path):
    head, get = api.head(path), api.get(path)
    assert (head.status_code, head.content) == (200, b"")
    assert {name: head.headers[name] for name in head.headers.keys() - OWN_HEADERS} == {
        name: get.headers[name] for name in get.headers.keys() - OWN_HEADERS
    }
    assert ("content-length" in head.headers) == ("content-length" in get.headers)


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/v1/models/nobody", 404),
        ("/nowhere", 404),
        ("/v1/models/panda-sim/predict", 405),
        ("/v1/models/panda-sim/live", 405),
    ],
)
def test_head_of_missing_things_of_posts_and_of_event_streams_is_refused(api, path, status):
    assert api.head(path).status_code == status


def test_allowed_methods_name_head_beside_get(api):
    assert api.patch("/v1/models").headers["allow"] == "GET, HEAD"


def test_next_request_on_the_connection_of_a_head_is_answered(server):
    with closing(HTTPConnection("127.0.0.1", server.port)) as connection:
        for method, empty in (("HEAD", True), ("GET", False), ("HEAD", True), ("GET", False)):
            connection.request(method, "/health")
            answer = connection.getresponse()
            assert (answer.status, answer.read() == b"") == (200, empty)
