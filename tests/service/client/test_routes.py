"""The client is complete: every route has a call, and both clients have all of them."""

from __future__ import annotations

import inspect

import pytest

from service.client import AsyncClient, Client, calls
from service.client.call import ROUTES, Call

METHODS = ("get", "post", "put", "patch", "delete")


def made_of(client):
    """Calls by the name of the method that is made of them."""
    found = {}
    for name, member in vars(client).items():
        call = getattr(member, "__wrapped__", None)
        if call is not None:
            found[name] = call.__name__
    return found


def public(client):
    return {name for name in vars(client) if not name.startswith("_")}


def test_every_route_has_a_call(api):
    paths = api.get("/openapi.json").json()["paths"]
    documented = {(method.upper(), path) for path, found in paths.items() for method in found if method in METHODS}
    assert set(ROUTES) == documented


@pytest.mark.parametrize("client", [Client, AsyncClient])
def test_every_call_is_a_method_of_its_own_name(client):
    methods = made_of(client)
    assert set(methods.values()) == set(ROUTES.values())
    assert all(method == call for method, call in methods.items())


def test_the_clients_have_the_same_methods():
    assert public(Client) == public(AsyncClient)
    for name in public(Client):
        one, other = (inspect.signature(getattr(client, name)) for client in (Client, AsyncClient))
        assert list(one.parameters.values()) == list(other.parameters.values()), name


def test_help_shows_arguments_results_and_what_they_are():
    assert str(inspect.signature(Client.job)) == "(self, /, job: 'str') -> 'Job'"
    assert str(inspect.signature(Client.datasets)) == "(self, /) -> 'Iterator[Dataset]'"
    assert str(inspect.signature(AsyncClient.live)) == "(self, /, model: 'str') -> 'AsyncIterator[Live]'"
    for client in (Client, AsyncClient):
        for name in public(client):
            assert inspect.getdoc(getattr(client, name)), name


def test_what_may_be_repeated():
    def repeatable(call: Call[object]) -> bool:
        return call.repeatable

    zero = [0.0]
    assert repeatable(calls.inference.predict("m", zero, zero, zero))
    assert repeatable(calls.models.train("m", ["ds_1"]))
    assert repeatable(calls.learning.unlearn("m", "arm", 1))
    assert repeatable(calls.models.set_alias("m", "production", 1))
    for call in (
        calls.learning.rollback("m", revision=1),
        calls.learning.replay("m", "arm", 1),
        calls.models.rollback_alias("m", "production"),
        calls.models.cancel("job_1"),
        calls.inference.health(),
    ):
        assert not repeatable(call), call.path


def test_names_are_quoted_and_paths_chosen_by_what_is_given():
    assert calls.models.model("a/../b?c").path == "/v1/models/a%2F..%2Fb%3Fc"
    assert calls.inference.model_ready("m").path == "/v2/models/m/ready"
    assert calls.inference.model_ready("m", 2).path == "/v2/models/m/versions/2/ready"
