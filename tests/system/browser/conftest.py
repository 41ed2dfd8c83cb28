"""Browser, services, and windows that fail a test on console or network errors."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import httpx
import pytest

from tests.service.data import stream, train, upload
from tests.service.server import Server
from tests.system.browser.chromium import chromium
from tests.system.browser.visitor import Visitor

if TYPE_CHECKING:
    from playwright.sync_api import Browser

for _name in ("LIPSERVE_TRAINING_NICENESS", "LIPSERVE_LEARNER_NICENESS"):
    os.environ.setdefault(_name, "0")


@dataclass(frozen=True)
class Dashboard:
    """A service with a data set and a trained model.

    A test may add data sets, jobs and models with other names, but must not change `dataset` and `model`.
    """

    server: Server
    dataset: dict[str, Any]
    """A recording of a double pendulum, named `pendulum.npz`, as the API shows it."""
    model: str
    """A model trained on it, with one version."""
    job: dict[str, Any]
    """The job that made it."""

    @property
    def client(self) -> httpx.Client:
        """A client of its HTTP API."""
        return self.server.client


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """One browser for all tests of this package; its event loop would disturb other tests."""
    with chromium() as started:
        yield started


@pytest.fixture(scope="package")
def dashboard(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dashboard]:
    """The service that the tests share."""
    with Server(tmp_path_factory.mktemp("dashboard"), warm=True) as server:
        dataset = upload(server.client, stream(samples=120), name="pendulum.npz")
        job = train(server.client, "pendulum", dataset["id"])
        yield Dashboard(server, dataset, "pendulum", job)


@pytest.fixture(scope="module", autouse=True)
def tidied(dashboard: Dashboard) -> Iterator[None]:
    """Delete the models that a module has added: the overview shows only the newest."""

    def names() -> set[str]:
        return {each["name"] for each in dashboard.client.get("/v1/models", params={"limit": 100}).json()["items"]}

    before = names()
    yield
    for name in names() - before:
        dashboard.client.delete(f"/v1/models/{name}")


Visit = Callable[..., Visitor]


@pytest.fixture
def windows(browser: Browser) -> Iterator[Visit]:
    """Open windows: `windows(url, size=PHONE, scheme="dark")`. The test fails if a window has a problem."""
    opened: list[Visitor] = []

    def open_window(url: str, **options: Any) -> Visitor:
        opened.append(Visitor(browser, url, **options))
        return opened[-1]

    yield open_window
    for each in opened:
        each.close()
    assert [problem for each in opened for problem in each.problems] == []


@pytest.fixture
def visitor(windows: Visit, dashboard: Dashboard) -> Visitor:
    """A window of the usual size on the shared service.

    `page = visitor.open("#/data")` is a Playwright page once it is rendered. A test that
    causes errors (4xx) names them before: `visitor.expect_refusals(422)`.
    """
    return windows(dashboard.server.url)
