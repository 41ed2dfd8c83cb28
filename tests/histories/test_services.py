"""Histories of real services under kills, standstills, steps of the clock and broken networks: nothing that anybody was
told contradicts anything else."""

import json
import os
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import httpx
import pytest

import lipcore
from lipcore.online.learner import OnlineModel
from service.api.access import keys
from service.foundation.settings import Settings
from service.journal import log
from service.storage.database import Database, VersionRow
from service.storage.files import Files
from tests.cluster.pairs import HARMLESS, train
from tests.cluster.servers import Shared
from tests.histories.actors import ALIASES, WORK, Book, Client
from tests.histories.checker import contradictions
from tests.histories.clock import Clock
from tests.histories.proxy import Proxy
from tests.histories.rules import ABSENT, alias, faults, job, journal, reads
from tests.histories.trouble import Trouble, disturbed
from tests.service.data import ended, eventually, stream, upload
from tests.service.learning.lessons import QUERIES, publish
from tests.service.server import Server, free_port

MODEL = "arm"
CLIENTS = 4
SECONDS = float(os.environ.get("LIPSERVE_HISTORY_S", "6"))
"""How long clients ask: seconds in `make test`, five minutes in `make nightly`, half an hour in `make test-all`."""
LONG = SECONDS > 60
SEED = int(os.environ.get("LIPSERVE_HISTORY_SEED", str(time.time_ns() % 10**6) if LONG else "50"))
"""Of what clients ask and who is disturbed when; another one each time in long runs."""
EVERY_S = min(SECONDS / 3, 5.0)
"""Seconds between two disturbances, about."""
HASTE = {"LIPSERVE_REPLICA_LOST_S": "3"}
"""Of services that others are to give up soon."""


class Bed:
    """What a history needs: services with clocks of their own, a key that they know, clients and their book."""

    def __init__(self, settings: Settings, folder: Path, jobs: bool) -> None:
        self.settings, self.folder, self.jobs = settings, folder, jobs
        self.trained = train(folder / "trained")
        self.servers: list[Server] = []
        self.book = Book()
        with closing(Database.of(settings)) as database:
            for _ in range(3):
                publish(database, Files.of(settings), self.trained, MODEL)
            self.key = keys.create(database, "histories", ["admin"], None)[1]
        self.headers = {"Authorization": f"Bearer {self.key}"}

    def start(self, home: Path, port: int, clock: Clock, **more: str) -> Server:
        """A service; its client has the key."""
        server = Server(home, port=port, **{"LIPSERVE_KEYS": "on", **clock.environment, **more})
        server.client.headers.update(self.headers)
        return server

    def clients(self) -> list[Client]:
        """Who asks."""
        first = self.servers[0].client
        first.put(f"/v1/models/{MODEL}/learning", json=HARMLESS).raise_for_status()
        dataset = str(upload(first, stream())["id"]) if self.jobs else None
        made = (self.servers, MODEL, self.book, SEED, self.headers, dataset)
        return [Client(number, *made) for number in range(CLIENTS)]

    @contextmanager
    def closing(self) -> Iterator[None]:
        """End all services after the block."""
        try:
            yield
        finally:
            for server in self.servers:
                with server:
                    pass

    def check(self, trouble: Trouble) -> Counter[str]:
        """Fail on what contradicts itself; return how many operations there were of each kind."""
        book = self.book
        counts = Counter(each.call[0] if isinstance(each.call[0], str) else "teach" for each in book.operations)
        counts["named"], counts["answers"] = len(book.named), len(book.answers)
        counts["without an answer"] = sum(not each.certain for each in (*book.operations, *book.named))
        # of a history that fails, or with -s
        print(f"seed {SEED}, {SECONDS:g} s: {dict(counts)}, {dict(trouble.done)}")  # noqa: T201
        assert contradictions(book.of("alias"), ABSENT, alias, reads) == []
        assert contradictions(book.of("journal"), (*[-1] * CLIENTS, 0), journal) == []
        assert contradictions(book.of("job"), ABSENT, job) == []
        assert faults(book.answers, Expected(self.settings, self.trained)) == []
        self._check_log()
        self._check_jobs()
        return counts

    def _check_log(self) -> None:
        """Every acknowledged batch is in the log, once, in the order of its stream."""
        taught = {each.call for each in self.book.of("journal") if each.certain}
        with closing(Database.of(self.settings)) as database, database.session() as session:
            rows = [row for row in log.events(session, MODEL, 0, 10**9) if row.kind == "batch"]
        logged = [(int(row.stream_id.removeprefix("arm-")), row.sequence) for row in rows]
        assert len(set(logged)) == len(logged)
        assert taught <= set(logged)
        for number in range(CLIENTS):
            sequences = [sequence for stream, sequence in logged if stream == number]
            assert sequences == list(range(len(sequences)))

    def _check_jobs(self) -> None:
        """Every job ends, and has made one version where it succeeded, else none."""
        if not self.jobs:
            return
        page = self.servers[0].client.get("/v1/jobs", params={"limit": 100}).json()["items"]
        done = [ended(self.servers[0].client, each["id"]) for each in page]
        with closing(Database.of(self.settings)) as database, database.session() as session:
            made = Counter(row.job for row in session.query(VersionRow).filter(VersionRow.model == WORK))
        for each in done:
            assert made[each["id"]] == (each["state"] == "succeeded"), each
        failed = [each for each in done if each["state"] == "failed"]
        # of what is done to the services, a job may be interrupted more often than it is started
        assert {each["error"]["code"] for each in failed} <= {"interrupted"}, done


class Expected:
    """Torques of a model that learns the log in this process, by revision."""

    def __init__(self, settings: Settings, trained: Path) -> None:
        self.model = OnlineModel.start(lipcore.load(trained))
        with closing(Database.of(settings)) as database, database.session() as session:
            self.events = log.events(session, MODEL, 0, 10**9, void=True)
        self.tau: list[list[float]] = []

    def __call__(self, revision: int) -> list[float]:
        while len(self.tau) <= revision:
            if self.tau:
                event = self.events[len(self.tau) - 1]
                if event.payload is not None:
                    self.model = self.model.learn(log.rows_of(event))
            self.tau.append(self.model.model().predict(*QUERIES.values()).tau.ravel().tolist())
        return self.tau[revision]


def test_one_service_that_is_killed_and_stopped_and_whose_clock_is_set(tmp_path: Path) -> None:
    bed = Bed(Settings(home=tmp_path / "home"), tmp_path, jobs=LONG)
    port, clock = free_port(), Clock(tmp_path / "clock")
    with bed.closing():
        bed.servers.append(bed.start(tmp_path / "home", port, clock))
        clients = bed.clients()
        trouble = Trouble(bed.servers, lambda _: bed.start(tmp_path / "home", port, clock), SEED, [clock])
        assert disturbed(clients, trouble, SECONDS, EVERY_S) == []
        # one service: who asks by an alias sees the same as who reads the list
        bed.book.operations += bed.book.named
        assert bed.check(trouble)["teach"]
        assert trouble.done


@pytest.mark.slow
def test_three_services_on_one_database_with_a_broken_network(shared: Shared) -> None:
    bed = Bed(shared.settings("before"), shared.folder, jobs=True)
    proxies = [Proxy(shared.database_url) for _ in range(3)]
    clocks = [Clock(shared.folder / f"clock-{number}") for number in range(3)]
    ports = [free_port() for _ in range(3)]

    def again(number: int) -> Server:
        env = shared.env() | HASTE | {"LIPSERVE_DATABASE_URL": proxies[number].url}
        return bed.start(shared.home(f"service-{number}"), ports[number], clocks[number], **env)

    try:
        with bed.closing():
            bed.servers.extend(map(again, range(3)))
            clients = bed.clients()
            trouble = Trouble(bed.servers, again, SEED, clocks, proxies)
            assert disturbed(clients, trouble, max(SECONDS, 30.0), EVERY_S) == []
            agreed(bed)
            assert bed.check(trouble)["teach"]
            moved = {each.call[1] for each in bed.book.of("alias") if each.call[0] == "move"}
            assert {each.result for each in bed.book.named if each.certain} <= {ABSENT, *moved}
    finally:
        for proxy in proxies:
            proxy.close()


def agreed(bed: Bed) -> None:
    """Wait until all services answer alike, by each alias as its list says, and with all that is logged."""
    listed = bed.servers[0].client.get(f"/v1/models/{MODEL}/aliases").json()["items"]
    points = {each["alias"]: each["version"] for each in listed}
    learning = bed.servers[0].client.get(f"/v1/models/{MODEL}/learning").json()["status"]

    def answer(server: Server, **chosen: str) -> httpx.Response:
        return server.client.post(f"/v1/models/{MODEL}/predict", json={**QUERIES, **chosen})

    def same() -> bool:
        everybody = [answer(server) for server in bed.servers]
        named = [answer(server, alias=each) for server in bed.servers for each in ALIASES]
        versions = [each.json().get("version") for each in named]
        return (
            all(each.status_code == 200 and each.json()["revision"] == learning["revision"] for each in everybody)
            and len({json.dumps(each.json()["tau"]) for each in everybody}) == 1
            and versions == [points.get(each) for _ in bed.servers for each in ALIASES]
        )

    eventually(same)
