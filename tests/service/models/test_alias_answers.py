"""An alias can replace a version number everywhere; answers follow it atomically and name the version."""

import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import pytest

from service.inference.predicting import queries
from tests.service.api.oip.requests import message
from tests.service.data import service_of, stream, upload
from tests.service.models.versions import QUERY, predict, publish, train_worse


@pytest.fixture(scope="module")
def arm(api):
    """A model whose version 1, `production`, differs from version 2, which serves."""
    assert [publish(api, "alias-answers"), publish(api, "alias-answers", train_worse())] == [1, 2]
    assert api.put("/v1/models/alias-answers/aliases/production", json={"version": 1}).status_code == 200
    return "alias-answers"


def test_queries_are_answered_by_the_alias_target(api, arm):
    by_number, by_alias = predict(api, arm, version=1).json(), predict(api, arm, alias="production").json()
    assert by_alias == by_number
    assert by_alias["version"] == 1
    assert by_alias["tau"] != predict(api, arm).json()["tau"]
    assert predict(api, arm, alias="serving").json() == predict(api, arm).json()
    batch = {name: [values] * 2 for name, values in QUERY.items()}
    assert predict(api, arm, **batch, alias="production").json()["tau"] == [by_number["tau"]] * 2


def test_hot_route_resolves_aliases(api, arm):
    def decode(more):
        return queries.decode(b'{"q": [0, 0], "dq": [0, 0], "ddq": [0, 0], "alias": "production' + more + b"}")

    query = decode(b'"')
    assert query.alias == "production"
    assert service_of(api).loaded.hot(arm, query.version, query.alias).version == 1
    assert decode(b'\\n"') is None
    assert decode(b'", "version": 1') is None


def test_evaluations_follow_an_alias(api, arm):
    dataset = upload(api, stream(seed=7))["id"]
    choices = ({"alias": "production"}, {"version": 1})
    first, second = (api.post(f"/v1/models/{arm}/evaluate", json={"dataset": dataset, **each}) for each in choices)
    assert first.json()["version"] == 1
    assert first.json() == second.json()


def test_open_inference_protocol_resolves_aliases(api, arm):
    versions = f"/v2/models/{arm}/versions"
    answer = api.post(f"{versions}/production/infer", json=message(QUERY)).json()
    assert answer["model_version"] == "1"
    assert answer["outputs"][0]["data"] == predict(api, arm, version=1).json()["tau"]
    assert api.get(f"{versions}/production").json()["parameters"]["version"] == "1"
    assert api.get(f"{versions}/serving/ready").json()["ready"]
    assert api.post(f"{versions}/serving/infer", json=message(QUERY)).json()["model_version"] == "2"
    refused = api.post(f"{versions}/nowhere/infer", json=message(QUERY))
    assert refused.status_code == 404
    assert "one of production, 1, 2" in refused.json()["error"]


def test_queries_follow_every_move_at_once_without_failure(api, arm):
    """Each answer equals, bit for bit, that of a version to which the alias pointed during the query."""
    expected = {version: predict(api, arm, version=version).json()["tau"] for version in (1, 2)}
    api.put(f"/v1/models/{arm}/aliases/moving", json={"version": 1})
    loaded, seen, stop = service_of(api).loaded, [], threading.Event()

    def query_repeatedly():
        while not stop.is_set():
            served = loaded.hot(arm, None, "moving")
            seen.append(None if served is None else served.version)

    with ThreadPoolExecutor(1) as pool:
        pool.submit(query_repeatedly)
        try:
            for version in (2, 1) * 5:
                assert api.put(f"/v1/models/{arm}/aliases/moving", json={"version": version}).status_code == 200
                answer = predict(api, arm, alias="moving").json()
                assert (answer["version"], answer["tau"]) == (version, expected[version])
        finally:
            stop.set()
    assert set(seen) == {1, 2}
    assert sum(one != other for one, other in pairwise(seen)) <= 10


def test_concurrent_moves_leave_memory_and_database_equal(api, arm):
    def move_repeatedly(version):
        for _ in range(5):
            assert api.put(f"/v1/models/{arm}/aliases/contested", json={"version": version}).status_code == 200

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(move_repeatedly, (1, 2)))
    listed = {item["alias"]: item for item in api.get(f"/v1/models/{arm}/aliases").json()["items"]}["contested"]
    assert service_of(api).loaded.newest(arm, "contested") == listed["version"]
    moves = listed["history"]
    assert all(later["before"] == earlier["version"] for later, earlier in pairwise(moves))


def test_alias_to_a_version_not_in_memory_loads_it(api, arm):
    loaded = service_of(api).loaded
    for number in range(loaded.capacity):
        publish(api, f"crowd-{number}")
        predict(api, f"crowd-{number}")
        assert len(loaded.snapshot.served) <= loaded.capacity
    assert loaded.hot(arm, None, "production") is None
    assert predict(api, arm, alias="production").json()["version"] == 1
    assert loaded.hot(arm, None, "production").version == 1
