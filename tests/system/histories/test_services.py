"""Histories of real services under kills, pauses, clock changes and broken networks: they are consistent."""

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
from service.cli.verify import verify_home
from service.foundation.settings import Settings
from service.journal import log
from service.storage.database import Database, VersionRow
from service.storage.files import Files
from tests.service.data import ended, eventually, stream, upload
from tests.service.learning.learning_models import QUERIES, publish
from tests.service.server import Server, free_port
from tests.system.cluster.pairs import LEARN_EVERYTHING, train
from tests.system.cluster.servers import Shared
from tests.system.histories.actors import ALIASES, JOB_MODEL, Client, History
from tests.system.histories.checker import find_contradictions
from tests.system.histories.clock import Clock
from tests.system.histories.disturbances import Disturbances, run_disturbed
from tests.system.histories.proxy import Proxy
from tests.system.histories.rules import ABSENT, alias, find_faulty_answers, is_alias_read, job, journal

MODEL = "arm"
CLIENTS = 4
SECONDS = float(os.environ.get("LIPSERVE_HISTORY_S", "2"))
"""Length of the history: seconds in `make test`, five minutes in `make nightly`, half an hour in `make test-all`."""
LONG = SECONDS > 60
SEED = int(os.environ.get("LIPSERVE_HISTORY_SEED", str(time.time_ns() % 10**6) if LONG else "50"))
"""Seed of clients and disturbances; a new one for each long run."""
EVERY_S = min(SECONDS / 3, 5.0)
"""Mean interval between disturbances."""
FAST_TAKEOVER = {"LIPSERVE_REPLICA_LOST_S": "3"}
"""Makes other services take over soon."""


class ServiceGroup:
    """Services with their own clocks, an API key, clients, and the history of their operations."""

    def __init__(self, settings: Settings, folder: Path, jobs: bool) -> None:
        self.settings, self.folder, self.jobs = settings, folder, jobs
        self.trained = train(folder / "trained")
        self.servers: list[Server] = []
        self.history = History()
        with closing(Database.of(settings)) as database:
            for _ in range(3):
                publish(database, Files.of(settings), self.trained, MODEL)
            self.key = keys.create(database, "histories", ["admin"], None)[1]
        self.headers = {"Authorization": f"Bearer {self.key}"}

    def start(self, home: Path, port: int, clock: Clock, **more: str) -> Server:
        """Start a service; its client sends the key."""
        server = Server(home, port=port, **{"LIPSERVE_KEYS": "on", **clock.environment, **more})
        server.client.headers.update(self.headers)
        return server

    def clients(self) -> list[Client]:
        """Return the clients of the history."""
        first = self.servers[0].client
        first.put(f"/v1/models/{MODEL}/learning", json=LEARN_EVERYTHING).raise_for_status()
        dataset = str(upload(first, stream())["id"]) if self.jobs else None
        made = (self.servers, MODEL, self.history, SEED, self.headers, dataset)
        return [Client(number, *made) for number in range(CLIENTS)]

    @contextmanager
    def closing(self) -> Iterator[None]:
        """Stop all services after the block."""
        try:
            yield
        finally:
            for server in self.servers:
                with server:
                    pass

    def check(self, disturbances: Disturbances) -> Counter[str]:
        """Check that the history is consistent; return the number of operations of each kind."""
        history = self.history
        counts = Counter(each.call[0] if isinstance(each.call[0], str) else "teach" for each in history.operations)
        counts["named"], counts["answers"] = len(history.alias_reads), len(history.answers)
        counts["without an answer"] = sum(not each.answered for each in (*history.operations, *history.alias_reads))
        # shown if the test fails, or with -s
        print(f"seed {SEED}, {SECONDS:g} s: {dict(counts)}, {dict(disturbances.done)}")  # noqa: T201
        assert find_contradictions(history.operations_on("alias"), ABSENT, alias, is_alias_read) == []
        assert find_contradictions(history.operations_on("journal"), (*[-1] * CLIENTS, 0), journal) == []
        assert find_contradictions(history.operations_on("job"), ABSENT, job) == []
        assert find_faulty_answers(history.answers, ExpectedTorque(self.settings, self.trained)) == []
        self._check_log()
        self._check_jobs()
        assert verify_home(self.settings).damages == []
        return counts

    def _check_log(self) -> None:
        """Check that every acknowledged batch is in the log, once, in the order of its stream."""
        acknowledged = {each.call for each in self.history.operations_on("journal") if each.answered}
        with closing(Database.of(self.settings)) as database, database.session() as session:
            rows = [row for row in log.events(session, MODEL, 0, 10**9) if row.kind == "batch"]
        logged = [(int(row.stream_id.removeprefix("arm-")), row.sequence) for row in rows]
        assert len(set(logged)) == len(logged)
        assert acknowledged <= set(logged)
        for number in range(CLIENTS):
            sequences = [sequence for stream, sequence in logged if stream == number]
            assert sequences == list(range(len(sequences)))

    def _check_jobs(self) -> None:
        """Check that every job has ended, with one version if it succeeded, else none."""
        if not self.jobs:
            return
        page = self.servers[0].client.get("/v1/jobs", params={"limit": 100}).json()["items"]
        done = [ended(self.servers[0].client, each["id"]) for each in page]
        with closing(Database.of(self.settings)) as database, database.session() as session:
            made = Counter(row.job for row in session.query(VersionRow).filter(VersionRow.model == JOB_MODEL))
        for each in done:
            assert made[each["id"]] == (each["state"] == "succeeded"), each
        failed = [each for each in done if each["state"] == "failed"]
        # repeated disturbances may use up the attempts of a job
        assert {each["error"]["code"] for each in failed} <= {"interrupted"}, done


class ExpectedTorque:
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


@pytest.mark.journey
def test_history_of_one_disturbed_service_is_consistent(tmp_path: Path) -> None:
    group = ServiceGroup(Settings(home=tmp_path / "home"), tmp_path, jobs=LONG)
    port, clock = free_port(), Clock(tmp_path / "clock")
    with group.closing():
        group.servers.append(group.start(tmp_path / "home", port, clock))
        clients = group.clients()
        disturbances = Disturbances(group.servers, lambda _: group.start(tmp_path / "home", port, clock), SEED, [clock])
        assert run_disturbed(clients, disturbances, SECONDS, EVERY_S) == []
        # with one service, predictions through an alias must agree with the list
        group.history.operations += group.history.alias_reads
        assert group.check(disturbances)["teach"]
        assert disturbances.done


def test_history_of_three_services_with_broken_network_is_consistent(shared: Shared) -> None:
    group = ServiceGroup(shared.settings("before"), shared.folder, jobs=True)
    proxies = [Proxy(shared.database_url) for _ in range(3)]
    clocks = [Clock(shared.folder / f"clock-{number}") for number in range(3)]
    ports = [free_port() for _ in range(3)]

    def restart(number: int) -> Server:
        env = shared.env() | FAST_TAKEOVER | {"LIPSERVE_DATABASE_URL": proxies[number].url}
        return group.start(shared.home(f"service-{number}"), ports[number], clocks[number], **env)

    try:
        with group.closing():
            group.servers.extend(map(restart, range(3)))
            clients = group.clients()
            disturbances = Disturbances(group.servers, restart, SEED, clocks, proxies)
            assert run_disturbed(clients, disturbances, max(SECONDS, 30.0), EVERY_S) == []
            wait_until_services_agree(group)
            assert group.check(disturbances)["teach"]
            moved = {each.call[1] for each in group.history.operations_on("alias") if each.call[0] == "move"}
            assert {each.result for each in group.history.alias_reads if each.answered} <= {ABSENT, *moved}
    finally:
        for proxy in proxies:
            proxy.close()


def wait_until_services_agree(group: ServiceGroup) -> None:
    """Wait until all services return the same predictions, by every alias, with everything logged."""
    listed = group.servers[0].client.get(f"/v1/models/{MODEL}/aliases").json()["items"]
    points = {each["alias"]: each["version"] for each in listed}
    learning = group.servers[0].client.get(f"/v1/models/{MODEL}/learning").json()["status"]

    def answer(server: Server, **chosen: str) -> httpx.Response:
        return server.client.post(f"/v1/models/{MODEL}/predict", json={**QUERIES, **chosen})

    def is_same() -> bool:
        responses = [answer(server) for server in group.servers]
        alias_reads = [answer(server, alias=each) for server in group.servers for each in ALIASES]
        versions = [each.json().get("version") for each in alias_reads]
        return (
            all(each.status_code == 200 and each.json()["revision"] == learning["revision"] for each in responses)
            and len({json.dumps(each.json()["tau"]) for each in responses}) == 1
            and versions == [points.get(each) for _ in group.servers for each in ALIASES]
        )

    eventually(is_same)
