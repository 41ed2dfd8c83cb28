"""Clients of a service in the same process, over connections that can be lost."""

from collections.abc import Callable, Iterator

import httpx
import pytest
from fastapi.testclient import TestClient

from lipserve import Client, sending
from tests.service.data import ADDRESS


class Losing(httpx.BaseTransport):
    """Transport that loses some answers after the service has processed the request.

    lose: returns whether the answer to a request is lost; requests: all sent requests.
    """

    def __init__(self, inner: httpx.BaseTransport, lose: Callable[[httpx.Request, int], bool]) -> None:
        self.inner, self.lose = inner, lose
        self.requests: list[httpx.Request] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        self.requests.append(request)
        response = self.inner.handle_request(request)
        if self.lose(request, len(self.requests)):
            response.read()
            raise httpx.ReadError("the connection was lost")
        return response


def over(transport: httpx.BaseTransport, **options: object) -> Client:
    """Return a client that uses a transport."""
    made = Client(ADDRESS, **options)
    made._http.close()
    made._http = httpx.Client(transport=transport, base_url=ADDRESS)
    return made


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """List of pauses of the client, which does not wait in tests."""
    listed: list[float] = []
    monkeypatch.setattr("lipserve.sync.time.sleep", listed.append)
    return listed


@pytest.fixture
def local(api: TestClient) -> Iterator[Client]:
    """Client of the shared service."""
    with over(api._transport) as client:
        yield client


@pytest.fixture
def losing(api: TestClient, pauses: list[float]) -> Callable[..., tuple[Client, Losing]]:
    """Function that makes a client of the shared service that loses some answers."""

    def make(lose: Callable[[httpx.Request, int], bool] = lambda _, count: count == 1) -> tuple[Client, Losing]:
        transport = Losing(api._transport, lose)
        client = over(transport)
        client._reach.reached = True
        return client, transport

    assert sending.RETRIES > 1
    return make
