"""The asynchronous client says what the synchronous one says, and streams."""

from __future__ import annotations

import asyncio

import httpx
import numpy as np
import pytest

from service.cli.simulate import write_recording
from service.client import ApiError, AsyncClient, Client, ServiceUnreachableError
from service.client.stream import AsyncStreamClient, StreamError
from tests.service.data import DEADLINE, QUICK, stream
from tests.service.server import free_port
from tests.service.streams import MOTION, TAU


def ask(server, work):
    """Run `work` with a client."""

    async def main():
        async with AsyncClient(server.url) as client:
            return await asyncio.wait_for(work(client), DEADLINE)

    return asyncio.run(main())


def test_from_files_to_torques(streaming, tmp_path):
    write_recording(tmp_path / "train.npz", stream())

    async def work(client):
        dataset = await client.upload(tmp_path / "train.npz")
        assert dataset.id in [each.id async for each in client.datasets()]
        job = await client.train("awaited", [dataset.id], "lip-chain", options=QUICK)
        states = [each.state async for each in client.job_events(job.id)]
        ended = await client.wait(job)
        assert (ended.state, states[-1]) == ("succeeded", "succeeded")
        path = await client.export("awaited", tmp_path / "awaited.tar")
        assert (await client.import_model(path, "awaited-copy")).version == 1
        assert (await client.set_learning("awaited-copy", contact_threshold=8.0)).options.contact_threshold == 8.0
        return await client.predict("awaited", *MOTION), await client.evaluate("awaited", dataset.id)

    found, evaluated = ask(streaming.server, work)
    with Client(streaming.server.url) as client:
        np.testing.assert_allclose(client.predict("awaited", *MOTION).tau, found.tau, rtol=1e-9)
        assert client.evaluate("awaited", evaluated.dataset).as_dict() == evaluated.as_dict()
    assert not (tmp_path / "awaited.tar.part").exists()


def test_many_at_once(streaming):
    async def work(client):
        return await asyncio.gather(*(client.predict("pendulum", *(MOTION * scale)) for scale in (0.5, 1.0, 0.5)))

    first, other, again = ask(streaming.server, work)
    np.testing.assert_array_equal(first.tau, again.tau)
    assert (first.tau != other.tau).all()


def test_refusals_and_silence_are_told(streaming, tmp_path):
    async def work(client):
        with pytest.raises(ApiError) as caught:
            await client.model("nobody")
        assert caught.value.status == 404
        with pytest.raises(ApiError):
            await client.export("nobody", tmp_path / "nobody.tar")
        with pytest.raises(ApiError):
            await anext(client.job_events("job_nowhere"))
        assert await client.ready()

    ask(streaming.server, work)
    assert list(tmp_path.iterdir()) == []

    async def alone():
        async with AsyncClient(f"http://127.0.0.1:{free_port()}") as client:
            assert not await client.ready()
            with pytest.raises(ServiceUnreachableError, match="lipserve serve"):
                await client.model("pendulum")

    asyncio.run(alone())


def test_a_lost_connection_is_tried_again(monkeypatch):
    sent = []

    def answer(request):
        sent.append(request)
        if len(sent) < 3:
            raise httpx.ReadError("lost")
        return httpx.Response(200, json={"items": [], "next_cursor": None})

    async def work():
        client = AsyncClient()
        client._http = httpx.AsyncClient(transport=httpx.MockTransport(answer), base_url="http://localhost")
        return [each async for each in client.models()]

    assert asyncio.run(work()) == []
    assert len(sent) == 3


def test_streams(streaming):
    async def work(client):
        async with client.stream("pendulum", stream_id="awaited") as opened:
            assert opened.hello.joint_names == streaming.model.joint_names
            tau, std = streaming.model.answer(MOTION)
            answer = await opened.ask(*MOTION)
            np.testing.assert_allclose(answer.tau, tau, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(answer.tau_std, std, rtol=1e-12, atol=1e-12)
            with pytest.raises(StreamError, match="q"):
                await opened.ask(MOTION[0] * np.inf, *MOTION[1:])
            with pytest.raises(ValueError, match="expected"):
                await opened.send(MOTION[0], MOTION[1], [1.0])
            numbers = [await opened.send(*(MOTION * scale), std=False) for scale in (0.5, 1.0)]
            assert [(await opened.receive()).sequence for _ in numbers] == numbers
            assert (await opened.flush()).accepted == 0
            await opened.ask(*MOTION, deadline=1e-9)
            assert (await opened.ask(*MOTION)).late_answers == 1
            assert opened.refusals == ()

    ask(streaming.server, work)


def test_streams_that_cannot_be_had(streaming):
    async def work(client):
        with pytest.raises(StreamError, match="no model 'nobody'"):
            async with client.stream("nobody"):
                pass
        async with client.stream("pendulum") as opened:
            with pytest.raises(ValueError, match="stream_id"):
                await opened.ask(*MOTION, tau=TAU)
        with pytest.raises(StreamError, match=r"lost|closed"):
            await opened.ask(*MOTION)
        with pytest.raises(StreamError, match="not open"):
            await AsyncStreamClient("pendulum").ask(*MOTION)
        with pytest.raises(StreamError, match="no service answers"):
            async with AsyncStreamClient("pendulum", f"http://127.0.0.1:{free_port()}"):
                pass

    ask(streaming.server, work)


def test_the_synchronous_client_opens_streams(streaming):
    with Client(streaming.server.url) as client, client.stream("pendulum", version=1, timeout=DEADLINE) as opened:
        np.testing.assert_allclose(opened.ask(*MOTION).tau, streaming.model.answer(MOTION)[0], rtol=1e-12, atol=1e-12)
