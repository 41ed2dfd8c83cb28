"""Both Python clients against a real server: the synchronous one, the asynchronous one, and streams."""

import asyncio

import httpx
import numpy as np
import pytest

from lipserve import ApiError, AsyncClient, AsyncStreamClient, Client, ServiceUnreachableError, StreamError
from service.cli.simulate import write_recording
from tests.clients.python.conftest import over
from tests.service.data import ADDRESS, DEADLINE, QUICK, stream, upload
from tests.service.server import free_port
from tests.service.streams import MOTION, TAU

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def client(server):
    with Client(server.url) as opened:
        yield opened


def test_wait_cancel_and_retry_jobs(client, server):
    dataset = upload(server.client, stream())["id"]
    looks = []
    job = client.wait(client.train("waited", [dataset], "lip-chain", options=QUICK).id, looks.append)
    assert (job.state, job.version) == ("succeeded", 1)
    assert looks[-1] == job == client.job(job.id)

    endless = {"max_iterations": 10_000, "posterior_samples": 80}
    running = client.train("cancelled", [dataset], "lip-chain", options=endless)
    assert client.cancel(running.id).id == running.id
    seen = list(client.job_events(running.id))
    assert seen[-1].state == client.wait(running.id).state == "cancelled"
    again = client.retry(running.id)
    assert (again.retry_of, again.model) == (running.id, "cancelled")
    assert client.cancel(again.id).id == again.id
    with pytest.raises(ApiError) as caught:
        next(client.job_events("job_nowhere"))
    assert caught.value.status == 404


def test_versions_are_annotated(client, server):
    assert client.annotate("panda-sim", 1, note="spare", tags=["line 2"]).tags == ["line 2"]
    assert client.annotate("panda-sim", 1, tags=[]).note == "spare"
    assert client.model("panda-sim").versions[0].note == "spare"

    async def remove(client):
        return await client.annotate("panda-sim", 1, note="")

    assert ask(server.url, remove).note is None


def test_api_errors_have_code_message_and_detail(client, tmp_path):
    with pytest.raises(ApiError, match="`q` has 6 values; this model has 7 joints: panda_joint1") as caught:
        client.predict("panda-sim", [0.0] * 6, [0.0] * 6, [0.0] * 6)
    error = caught.value
    assert (error.status, error.code, error.detail[0]["field"]) == (422, "invalid_request", "q")
    assert str(error) == error.message
    with pytest.raises(ApiError, match="no model 'nobody'"):
        client.export("nobody", tmp_path / "nobody.tar")
    assert list(tmp_path.iterdir()) == []
    large = tmp_path / "large.csv"
    large.write_bytes(b"x" * 3_000_000)
    with pytest.raises(ApiError) as caught:
        client.upload(large)
    assert (caught.value.status, caught.value.code) == (413, "too_large")


def test_unreachable_service_error_has_a_hint(client, tmp_path):
    assert client.ready() is True
    url = f"http://127.0.0.1:{free_port()}"
    with Client(url) as alone:
        assert alone.ready() is False
        with pytest.raises(ServiceUnreachableError, match=f"no service answers at {url}.*lipserve serve"):
            alone.model("panda-sim")
        with pytest.raises(ValueError, match=r"expected one of the suffixes \.csv, "):  # before anything is sent
            alone.upload(tmp_path / "stream.pickle")


def ask(url, work, transport=None):
    """Run `work` with a client, over a scripted transport if one is given."""

    async def main():
        async with AsyncClient(url) as client:
            if transport is not None:
                client._http = httpx.AsyncClient(transport=transport, base_url=url)
            return await asyncio.wait_for(work(client), DEADLINE)

    return asyncio.run(main())


def test_async_client_from_files_to_torques(streaming, tmp_path):
    write_recording(tmp_path / "train.npz", stream())

    async def work(client):
        dataset = await client.upload(tmp_path / "train.npz")
        assert dataset.id in [each.id async for each in client.datasets()]
        job = await client.train("awaited", [dataset.id], "lip-chain", options=QUICK)
        states = [each.state async for each in client.job_events(job.id)]
        ended = await client.wait(job)
        assert (ended.state, states[-1]) == ("succeeded", "succeeded")
        path = await client.export("awaited", tmp_path / "awaited.tar")
        assert (await client.import_model(path, "awaited-copy", "always")).version == 1
        assert (await client.set_learning("awaited-copy", contact_threshold=8.0)).options.contact_threshold == 8.0
        return await client.predict("awaited", *MOTION), await client.evaluate("awaited", dataset.id)

    answer, evaluated = ask(streaming.server.url, work)
    with Client(streaming.server.url) as client:
        np.testing.assert_allclose(client.predict("awaited", *MOTION).tau, answer.tau, rtol=1e-9)
        assert client.evaluate("awaited", evaluated.dataset).as_dict() == evaluated.as_dict()
    assert not (tmp_path / "awaited.tar.part").exists()


def test_async_client_raises_api_and_connection_errors(streaming, tmp_path):
    async def work(client):
        with pytest.raises(ApiError) as caught:
            await client.model("nobody")
        assert caught.value.status == 404
        with pytest.raises(ApiError):
            await client.export("nobody", tmp_path / "nobody.tar")
        with pytest.raises(ApiError):
            await anext(client.job_events("job_nowhere"))
        assert await client.ready()

    async def alone(client):
        assert not await client.ready()
        with pytest.raises(ServiceUnreachableError, match="lipserve serve"):
            await client.model("pendulum")

    ask(streaming.server.url, work)
    assert list(tmp_path.iterdir()) == []
    ask(f"http://127.0.0.1:{free_port()}", alone)


def test_async_client_retries_after_a_lost_connection():
    sent = []

    def answer(request):
        sent.append(request)
        if len(sent) < 3:
            raise httpx.ReadError("lost")
        return httpx.Response(200, json={"items": [], "next_cursor": None})

    async def work(client):
        return [each async for each in client.models()]

    assert ask(ADDRESS, work, httpx.MockTransport(answer)) == []
    assert len(sent) == 3


def test_answer_of_another_release_raises_an_error_with_a_hint():
    """Answers are the status and live events of 0.2.0, and the page of a proxy."""
    bodies = {
        "/v1/models/arm/learning": b'{"model": "arm", "options": {}, "status": {"version": 1}}',
        "/v1/models/arm/live": b'event: status\ndata: {"model": "arm"}\n\n',
        "/v1/models/arm": b"<html>",
    }
    transport = httpx.MockTransport(lambda request: httpx.Response(200, content=bodies[request.url.path]))
    message = r"The answer to GET /v1/models/arm\S* could not be read: .* Install the client"

    async def work(client):
        for call in (client.learning, client.model, lambda model: anext(client.live(model))):
            with pytest.raises(ApiError, match=message) as caught:
                await call("arm")
            assert (caught.value.status, caught.value.code) == (200, "unreadable_answer")

    ask(ADDRESS, work, transport)
    with over(transport) as client:
        for call in (client.learning, client.model, lambda model: next(client.live(model))):
            with pytest.raises(ApiError, match=message) as caught:
                call("arm")
            assert (caught.value.status, caught.value.code) == (200, "unreadable_answer")


def test_streams(streaming):
    async def work(client):
        async with client.stream("pendulum", stream_id="awaited") as opened:
            assert opened.hello.joint_names == streaming.model.joint_names
            tau, std = streaming.model.answer(MOTION)
            answer = await opened.predict(*MOTION)
            np.testing.assert_allclose(answer.tau, tau, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(answer.tau_std, std, rtol=1e-12, atol=1e-12)
            with pytest.raises(StreamError, match="q"):
                await opened.predict(MOTION[0] * np.inf, *MOTION[1:])
            with pytest.raises(ValueError, match="expected"):
                await opened.send(MOTION[0], MOTION[1], [1.0])
            numbers = [await opened.send(*(MOTION * scale), std=False) for scale in (0.5, 1.0)]
            assert [(await opened.receive()).sequence for _ in numbers] == numbers
            assert (await opened.flush()).accepted == 0
            await opened.predict(*MOTION, deadline=1e-9)
            assert (await opened.predict(*MOTION)).late_answers == 1
            assert opened.refusals == ()

    ask(streaming.server.url, work)


def test_failed_streams(streaming):
    async def work(client):
        with pytest.raises(StreamError, match="no model 'nobody'"):
            async with client.stream("nobody"):
                pass
        async with client.stream("pendulum") as opened:
            with pytest.raises(ValueError, match="stream_id"):
                await opened.predict(*MOTION, tau=TAU)
        with pytest.raises(StreamError, match=r"lost|closed"):
            await opened.predict(*MOTION)
        with pytest.raises(StreamError, match="not open"):
            await AsyncStreamClient("pendulum").predict(*MOTION)
        with pytest.raises(StreamError, match="no service answers"):
            async with AsyncStreamClient("pendulum", f"http://127.0.0.1:{free_port()}"):
                pass

    ask(streaming.server.url, work)
