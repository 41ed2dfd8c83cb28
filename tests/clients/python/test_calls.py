"""Calls of the client: every route has one in both clients; which calls are repeated."""

import inspect

import httpx
import pytest

from lipserve import ApiError, AsyncClient, Client, ServiceUnreachableError, calls
from lipserve.call import ROUTES
from lipserve.sending import FIRST_PAUSE_S, MAX_PAUSE_S, RETRIES
from service.cli.simulate import write_recording
from tests.clients.python.conftest import over
from tests.service.data import QUICK, stream, upload

METHODS = ("get", "post", "put", "patch", "delete")


def made_of(client):
    """Return the name of the call of each method."""
    members = vars(client).items()
    return {name: each.__wrapped__.__name__ for name, each in members if hasattr(each, "__wrapped__")}


def public(client):
    return {name for name in vars(client) if not name.startswith("_")}


def test_every_route_has_a_call_that_is_a_method_of_both_clients(api):
    paths = api.get("/openapi.json").json()["paths"]
    documented = {(method.upper(), path) for path, found in paths.items() for method in found if method in METHODS}
    assert set(ROUTES) == documented
    for client in (Client, AsyncClient):
        methods = made_of(client)
        assert set(methods.values()) == set(ROUTES.values())
        assert all(method == call for method, call in methods.items())


def test_clients_have_the_same_methods_with_signatures_and_docstrings():
    assert public(Client) == public(AsyncClient)
    for name in public(Client):
        one, other = (getattr(client, name) for client in (Client, AsyncClient))
        parameters = [list(inspect.signature(each).parameters.values()) for each in (one, other)]
        assert parameters[0] == parameters[1], name
        assert inspect.getdoc(one), name
        assert inspect.getdoc(other), name
    assert str(inspect.signature(Client.job)) == "(self, /, job: 'str') -> 'Job'"
    assert str(inspect.signature(Client.robots)) == "(self, /) -> 'Iterator[Robot]'"
    assert str(inspect.signature(AsyncClient.live)) == "(self, /, model: 'str') -> 'AsyncIterator[Live]'"


def test_names_are_quoted_and_paths_match_the_given_names():
    assert calls.models.model("a/../b?c").path == "/v1/models/a%2F..%2Fb%3Fc"
    assert calls.inference.model_ready("m").path == "/v2/models/m/ready"
    assert calls.inference.model_ready("m", 2).path == "/v2/models/m/versions/2/ready"


def test_predict_sends_rows_with_times_as_a_trajectory():
    history = (0, [0.1], [0.2])  # of one row
    one = calls.inference.predict("m", [0.0], [0.0], [0.0], t=1, history=history).json
    assert (one["t"], one.get("trajectory")) == (1.0, None)
    assert one["history"] == {"t": [0.0], "q": [[0.1]], "dq": [[0.2]]}
    rows = calls.inference.predict("m", *[[[0.0]] * 2] * 3, t=[0.0, 0.5]).json
    assert (rows["t"], rows["trajectory"]) == ([0.0, 0.5], True)
    assert not {"t", "trajectory", "history"} & calls.inference.predict("m", *[[[0.0]] * 2] * 3).json.keys()


LOST = httpx.ReadError("lost")
MODEL = {
    **{"name": "m", "created_at": "now", "latest_version": 1, "serving_version": 1, "aliases": {}, "versions": []},
    "thresholds": {"max_error": 0.9, "min_coverage": 0.9, "max_width": 1.0},
}


def scripted(*answers, reached=True, **options):
    """Return a client that gets the given answers, then always the last, and the list of its requests."""
    left, sent = list(answers), []

    def answer(request):
        sent.append(request)
        given = left.pop(0) if len(left) > 1 else left[0]
        if isinstance(given, Exception):
            raise given
        return given

    client = over(httpx.MockTransport(answer), **options)
    client._reach.reached = reached
    return client, sent


def test_annotation_sends_what_is_given():
    annotate = calls.models.annotate
    assert annotate("m", 1).json == {}
    assert annotate("m", 1, note="", tags=()).json == {"note": "", "tags": []}
    call = annotate("m", 1, "spare", ["line 2"])
    assert (call.method, call.path, call.json["note"]) == ("PATCH", "/v1/models/m/versions/1", "spare")


def later(status=429, **headers):
    body = {"error": {"code": "busy", "message": "try again later", "detail": []}}
    return httpx.Response(status, json=body, headers={name.replace("_", "-"): value for name, value in headers.items()})


def test_lost_connection_is_retried(pauses):
    client, sent = scripted(LOST, httpx.RemoteProtocolError("cut"), httpx.Response(200, json=MODEL))
    assert client.model("m").name == "m"
    assert (len(sent), len(pauses)) == (3, 2)
    assert FIRST_PAUSE_S / 2 <= pauses[0] <= FIRST_PAUSE_S <= pauses[1] <= 2 * FIRST_PAUSE_S


@pytest.mark.parametrize(
    ("failure", "options", "message", "retries"),
    [
        (LOST, {}, "does not answer any more", RETRIES),
        (LOST, {"retries": 0}, "does not answer any more", 0),
        (httpx.ConnectError("refused"), {"reached": False}, "start one with `lipserve serve`", 0),  # it never answered
        (httpx.ReadTimeout("slow"), {}, r"\(timeout\)", 0),
    ],
)
def test_retries_are_limited_to_lost_connections(pauses, failure, options, message, retries):
    client, sent = scripted(failure, **options)
    with pytest.raises(ServiceUnreachableError, match=message):
        client.model("m")
    assert (len(sent), len(pauses)) == (1 + retries, retries)
    assert sum(pauses) <= FIRST_PAUSE_S * 2**RETRIES


def test_calls_that_are_not_idempotent_are_not_repeated(pauses):
    client, sent = scripted(LOST)
    for ask in (
        lambda: client.rollback("m", revision=1),
        lambda: client.replay("m", "arm", 1),
        lambda: client.rollback_alias("m", "production"),
        lambda: client.cancel("job_1"),
        lambda: client.refresh("m"),
    ):
        with pytest.raises(ServiceUnreachableError):
            ask()
    assert (len(sent), pauses) == (5, [])


def test_client_waits_for_a_service_that_answered_before(pauses):
    refused, fine = httpx.ConnectError("refused"), httpx.Response(200, json=MODEL)
    client, sent = scripted(fine, refused, refused, fine, reached=False)
    client.model("m")
    client.model("m")
    assert len(sent) == 4


@pytest.mark.parametrize("status", [429, 503])
def test_retry_after_is_respected(pauses, status):
    client, sent = scripted(later(status, retry_after="3"), httpx.Response(200, json=MODEL))
    assert client.model("m").name == "m"
    assert (len(sent), pauses) == (2, [3.0])


@pytest.mark.parametrize(
    ("answer", "after"),
    [
        (later(), None),
        (later(503), None),
        (later(retry_after=str(int(MAX_PAUSE_S) + 1)), MAX_PAUSE_S + 1),  # too long
        (later(retry_after="Wed, 21 Oct 2026 07:28:00 GMT"), None),
        (later(500, retry_after="1"), 1.0),
    ],
)
def test_other_errors_keep_retry_after(pauses, answer, after):
    client, sent = scripted(answer)
    with pytest.raises(ApiError, match="try again later") as caught:
        client.model("m")
    assert (len(sent), pauses, caught.value.retry_after) == (1, [], after)


@pytest.mark.parametrize(
    ("body", "text"), [(b"<html>", "<html>"), (b'{"error": "no model"}', "no model"), (b"[]", r"\[\]")]
)
def test_errors_of_any_shape_are_raised(pauses, body, text):
    client, _ = scripted(httpx.Response(502, content=body))
    with pytest.raises(ApiError, match=text) as caught:
        client.model("m")
    assert (caught.value.status, caught.value.code) == (502, "http_error")


def test_delete_succeeds_if_its_answer_was_lost(losing, api):
    dataset = upload(api, stream(seed=71))["id"]
    client, transport = losing()
    client.delete_dataset(dataset)
    assert len(transport.requests) == 2
    with pytest.raises(ApiError, match="no dataset"):
        client.delete_dataset(dataset)


def test_upload_with_lost_answer_makes_one_data_set(losing, api, tmp_path):
    path = tmp_path / "once.csv"
    write_recording(path, stream(seed=72))
    client, transport = losing(lambda _, count: count <= 2)
    made = client.upload(path)
    keys = {request.headers["idempotency-key"] for request in transport.requests}
    assert (len(transport.requests), len(keys)) == (3, 1)
    assert [each.id for each in client.datasets() if each.name == "once.csv"] == [made.id]
    assert client.upload(path).id != made.id  # asked for again, not repeated


@pytest.mark.slow
def test_events_are_followed_after_a_lost_start(losing, pendulum):
    client, transport = losing()
    job = client.train("lost-events", [pendulum["id"]], "lip-chain", options=QUICK)
    transport.lose = lambda request, count: count == 3
    assert [*client.job_events(job.id)][-1].state == "succeeded"
