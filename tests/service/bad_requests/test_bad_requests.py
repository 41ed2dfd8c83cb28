"""Wrong requests of every kind: each is refused as it should be, and leaves nothing behind."""

from __future__ import annotations

import pytest

from tests.service.bad_requests import addresses, texts, uploads, values
from tests.service.bad_requests.bad import PREDICT
from tests.service.data import error

BAD = [*texts.BAD, *values.BAD, *addresses.BAD, *uploads.BAD]
KINDS = {(bad.method, bad.path.partition("?")[0], bad.status, bad.code, bad.named): bad for bad in reversed(BAD)}
"""The first request of each kind: what it asks for, and what is wrong with it."""
QUICK = {id(bad) for bad in (*KINDS.values(), *(bad for bad in texts.BAD if bad.path == PREDICT))}
"""These, and every text that is no JSON of one route."""
LISTS = ("/v1/datasets", "/v1/robots", "/v1/jobs", "/v1/models", "/v1/models/panda-sim/observations")


@pytest.fixture(scope="module", autouse=True)
def nothing_stays(api):
    """Check that none of all these requests has changed anything."""
    before = [api.get(path).json() for path in LISTS]
    yield
    assert [api.get(path).json() for path in LISTS] == before


@pytest.mark.parametrize(
    "bad",
    [pytest.param(bad, id=bad.label, marks=[] if id(bad) in QUICK else [pytest.mark.slow]) for bad in BAD],
)
def test_what_is_wrong_is_refused_by_name(api, bad):
    answer = api.request(bad.method, bad.path, content=bad.content, headers=bad.headers)
    assert answer.headers["content-type"] == "application/json"
    if bad.status == 405:
        allowed = answer.headers["allow"].split(", ")
        assert allowed
        assert bad.method not in allowed
    if bad.path.startswith("/v2"):
        assert answer.status_code == bad.status, answer.text
        (said,) = answer.json().values()
        assert said.startswith(bad.named)
        assert said.isprintable()
        return
    found = error(answer, bad.status, bad.code)
    if bad.named is not None:
        first = found["detail"][0]
        assert first["field"] == bad.named
        assert first["expected"]
    for text in (found["message"], *(item[name] for item in found["detail"] for name in item)):
        assert text.isprintable(), text


def test_there_are_many_and_each_is_another_one():
    assert len({(bad.method, bad.path, bad.content, tuple(bad.headers.items())) for bad in BAD}) == len(BAD) >= 150
