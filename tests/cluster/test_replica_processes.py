"""Services in processes of their own: a client that alternates, and one of them that dies in the middle of a batch."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from service.storage.database import Database, EventRow
from tests.cluster.pairs import HARMLESS, answers, folder_store, made, train
from tests.cluster.servers import Shared
from tests.service.learning.lessons import Pupil, lesson
from tests.service.server import Server

MODEL = "arm"
BATCHES = 30


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a trained model lies."""
    return train(tmp_path_factory.mktemp("trained") / "model")


@pytest.fixture
def servers(shared: Shared, trained: Path) -> Iterator[list[Server]]:
    """Two services of one model."""
    made(shared, trained, MODEL)
    with started(shared, "one") as one, started(shared, "two") as two:
        pupil(one).put("learning", HARMLESS)
        yield [one, two]


def started(shared: Shared, name: str) -> Server:
    """A service with a home of its own."""
    return Server(shared.home(name), **(shared.env() | {"LIPSERVE_FILES_URL": folder_store(shared)}))


def pupil(server: Server) -> Pupil:
    """The model as a service shows it."""
    return Pupil(server.client, MODEL)


def sent(servers: list[Server], number: int, rng: np.random.Generator) -> int:
    """Send a lesson to one service after the other until one acknowledges it; return the revision."""
    while True:
        server = servers[rng.integers(len(servers))]
        try:
            answer = server.client.post(f"/v1/models/{MODEL}/observations", json=lesson(number))
        except httpx.TransportError:
            continue
        if answer.is_success:
            return int(answer.json()["revision"])
        assert answer.status_code == httpx.codes.SERVICE_UNAVAILABLE, answer.text


@pytest.mark.slow
def test_a_client_that_alternates_gets_the_same_bits_from_both(servers):
    rng = np.random.default_rng(1)
    pupils = [pupil(server) for server in servers]
    revision = max(sent(servers, number, rng) for number in range(BATCHES))
    assert revision == BATCHES
    one, two = answers(pupils, revision)
    assert one == two
    revision = pupils[0].delete("observations/arm/7")["revision"]
    one, two = answers(pupils, revision)
    assert one == two


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_a_service_that_is_killed_in_the_middle_of_batches_loses_nothing(shared, servers, seed):
    rng = np.random.default_rng(seed)
    victim, other = servers
    acknowledged: list[int] = []
    killed = threading.Event()

    def kill() -> None:
        victim.kill()
        killed.set()

    timer = threading.Timer(rng.uniform(0.0, 0.3), kill)
    for number in range(BATCHES):
        if number == 5:
            timer.start()
        acknowledged.append(sent(servers, number, rng))
    killed.wait()
    assert acknowledged == list(range(1, BATCHES + 1))  # each once: none lost, none twice
    database = Database.of(shared.settings("looking"))
    with database.session() as session:
        rows = session.query(EventRow.sequence, EventRow.number).filter(EventRow.kind == "batch")
        assert dict(rows.all()) == {number: number + 1 for number in range(BATCHES)}
    database.close()
    with started(shared, victim.home.name) as again:
        one, two = answers([pupil(again), pupil(other)], BATCHES)
        assert one == two
