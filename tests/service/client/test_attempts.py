"""When a call is made again, and when not."""

from __future__ import annotations

import httpx
import pytest

from service.client import ApiError, ServiceUnreachableError
from service.client.sending import FIRST_PAUSE_S, LONGEST_PAUSE_S, RETRIES
from tests.service.client.conftest import over
from tests.service.data import QUICK, stream, upload

LOST = httpx.ReadError("lost")
MODEL = {
    "name": "m",
    "created_at": "now",
    "latest_version": 1,
    "serving_version": 1,
    "aliases": {},
    "versions": [],
}


def scripted(*answers, reached=True, **options):
    """A client that gets one answer after the other, the last one again and again; and the requests it has sent."""
    left, sent = list(answers), []

    def answer(request):
        sent.append(request)
        found = left.pop(0) if len(left) > 1 else left[0]
        if isinstance(found, Exception):
            raise found
        return found

    client = over(httpx.MockTransport(answer), **options)
    client._reach.reached = reached
    return client, sent


def later(status=429, **headers):
    body = {"error": {"code": "busy", "message": "try again later", "detail": []}}
    return httpx.Response(status, json=body, headers={name.replace("_", "-"): value for name, value in headers.items()})


def test_a_lost_connection_is_tried_again(pauses):
    client, sent = scripted(LOST, httpx.RemoteProtocolError("cut"), httpx.Response(200, json=MODEL))
    assert client.model("m").name == "m"
    assert len(sent) == 3
    assert len(pauses) == 2
    assert FIRST_PAUSE_S / 2 <= pauses[0] <= FIRST_PAUSE_S <= pauses[1] <= 2 * FIRST_PAUSE_S


def test_it_ends_at_some_time(pauses):
    client, sent = scripted(LOST)
    with pytest.raises(ServiceUnreachableError, match="does not answer any more"):
        client.model("m")
    assert len(sent) == 1 + RETRIES
    assert sum(pauses) <= FIRST_PAUSE_S * 2**RETRIES
    client, sent = scripted(LOST, retries=0)
    with pytest.raises(ServiceUnreachableError):
        client.model("m")
    assert len(sent) == 1


def test_what_does_more_each_time_is_not_repeated(pauses):
    client, sent = scripted(LOST)
    for ask in (lambda: client.rollback("m", revision=1), lambda: client.cancel("job_1"), lambda: client.refresh("m")):
        with pytest.raises(ServiceUnreachableError):
            ask()
    assert (len(sent), pauses) == (3, [])


def test_a_service_that_never_answered_is_missing_at_once(pauses):
    client, sent = scripted(httpx.ConnectError("refused"), reached=False)
    with pytest.raises(ServiceUnreachableError, match="start one with `lipserve serve`"):
        client.model("m")
    assert (len(sent), pauses) == (1, [])


def test_a_service_that_answered_before_is_waited_for(pauses):
    client, sent = scripted(
        httpx.Response(200, json=MODEL),
        httpx.ConnectError("refused"),
        httpx.ConnectError("refused"),
        httpx.Response(200, json=MODEL),
        reached=False,
    )
    client.model("m")
    client.model("m")
    assert len(sent) == 4


def test_what_takes_too_long_is_not_asked_again(pauses):
    client, sent = scripted(httpx.ReadTimeout("slow"))
    with pytest.raises(ServiceUnreachableError, match="takes longer"):
        client.model("m")
    assert (len(sent), pauses) == (1, [])


@pytest.mark.parametrize("status", [429, 503])
def test_a_service_that_says_when_is_asked_again_then(pauses, status):
    client, sent = scripted(later(status, retry_after="3"), httpx.Response(200, json=MODEL))
    assert client.model("m").name == "m"
    assert (len(sent), pauses) == (2, [3.0])


@pytest.mark.parametrize(
    "answer",
    [
        later(),  # it does not say when
        later(503),
        later(retry_after=str(int(LONGEST_PAUSE_S) + 1)),  # too long
        later(retry_after="Wed, 21 Oct 2026 07:28:00 GMT"),
        later(500, retry_after="1"),
    ],
)
def test_other_refusals_are_told(pauses, answer):
    client, sent = scripted(answer)
    with pytest.raises(ApiError, match="try again later"):
        client.model("m")
    assert (len(sent), pauses) == (1, [])


def test_an_error_says_when_to_come_back(pauses):
    client, _ = scripted(later(retry_after="30"))
    with pytest.raises(ApiError) as caught:
        client.train("m", ["ds_1"])
    assert caught.value.retry_after == 30.0


def test_errors_of_any_shape_are_told(pauses):
    for body, said in ((b"<html>", "<html>"), (b'{"error": "no model"}', "no model"), (b"[]", r"\[\]")):
        client, _ = scripted(httpx.Response(502, content=body))
        with pytest.raises(ApiError, match=said) as caught:
            client.model("m")
        assert (caught.value.status, caught.value.code) == (502, "http_error")


def test_what_is_gone_after_a_lost_answer_was_removed(losing, api):
    dataset = upload(api, stream(seed=71))["id"]
    client, transport = losing()
    client.delete_dataset(dataset)
    assert len(transport.requests) == 2
    with pytest.raises(ApiError, match="no dataset"):
        client.delete_dataset(dataset)


def test_a_lost_upload_makes_one_data_set(losing, api, tmp_path):
    path = tmp_path / "once.csv"
    s = stream(seed=72)
    rows = "\n".join(",".join(f"{x:.9g}" for x in (s.t[i], *s.q[i], *s.dq[i], *s.tau[i])) for i in range(len(s)))
    path.write_text("t,q1,q2,dq1,dq2,tau1,tau2\n" + rows + "\n")
    client, transport = losing(lambda _, count: count <= 2)
    made = client.upload(path)
    keys = {request.headers["idempotency-key"] for request in transport.requests}
    assert (len(transport.requests), len(keys)) == (3, 1)
    assert [each.id for each in client.datasets() if each.name == "once.csv"] == [made.id]
    assert client.upload(path).id != made.id  # asked for again, not repeated


def test_a_lost_job_is_queued_once(losing, pendulum):
    client, transport = losing()
    job = client.train("lost-job", [pendulum["id"]], "lip-chain", options=QUICK)
    assert len(transport.requests) == 2
    assert [each.id for each in client.jobs() if each.model == "lost-job"] == [job.id]
    client.cancel(job.id)
    client.wait(job.id)


def test_events_are_followed_though_their_start_is_lost(losing, pendulum):
    client, transport = losing()
    job = client.train("lost-events", [pendulum["id"]], "lip-chain", options=QUICK)
    transport.lose = lambda request, count: count == 3
    assert [*client.job_events(job.id)][-1].state == "succeeded"
