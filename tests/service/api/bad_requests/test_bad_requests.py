"""Wrong requests of every kind: each gets its documented error and changes nothing."""

import re

import pytest

from tests.service.api.bad_requests import addresses, bodies, uploads
from tests.service.data import error

BAD = [*bodies.BAD, *addresses.BAD, *uploads.BAD]
LISTS = ("/v1/datasets", "/v1/robots", "/v1/jobs", "/v1/models", "/v1/models/panda-sim/observations")


@pytest.fixture(scope="module", autouse=True)
def assert_unchanged(api):
    """Check that the requests of this module have changed nothing."""
    before = [api.get(path).json() for path in LISTS]
    yield
    assert [api.get(path).json() for path in LISTS] == before


@pytest.fixture(scope="module")
def documented(api):
    """Return a function that lists the documented statuses of a request; None for an unknown route."""
    paths = api.get("/openapi.json").json()["paths"]
    patterns = {path: re.compile(re.sub(r"\{\w+\}", "[^/]+", path)) for path in paths}
    routes = sorted(patterns, key=lambda path: path.count("{"))

    def statuses(bad):
        address = bad.path.partition("?")[0]
        result = (paths[path].get(bad.method.lower()) for path in routes if patterns[path].fullmatch(address))
        return next((set(map(int, operation["responses"])) for operation in result if operation), None)

    return statuses


@pytest.mark.parametrize("bad", [pytest.param(bad, id=bad.label) for bad in BAD])
def test_wrong_request_gets_an_error_that_names_the_field(api, documented, bad):
    answer = api.request(bad.method, bad.path, content=bad.content, headers=bad.headers)
    assert answer.headers["content-type"] == "application/json"
    allowed = documented(bad)
    assert allowed is None or bad.status in allowed
    if bad.status == 405:
        allowed = answer.headers["allow"].split(", ")
        assert allowed
        assert bad.method not in allowed
    if bad.path.startswith("/v2"):
        assert answer.status_code == bad.status, answer.text
        (message,) = answer.json().values()
        assert message.startswith(bad.named)
        assert message.isprintable()
        return
    refused = error(answer, bad.status, bad.code)
    if bad.named is not None:
        first = refused["detail"][0]
        assert first["field"] == bad.named
        assert first["expected"]
    for text in (refused["message"], *(item[name] for item in refused["detail"] for name in item)):
        assert text.isprintable(), text


def test_all_requests_differ():
    assert len({(bad.method, bad.path, bad.content, tuple(bad.headers.items())) for bad in BAD}) == len(BAD)
