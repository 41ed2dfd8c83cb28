"""Two services of one database: what one takes, moves or deletes, the other answers with; and one of them dies."""

import threading
from collections.abc import Iterator
from functools import partial
from itertools import count

import httpx
import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from service import replication
from service.app import create_app
from service.models import aliases
from service.storage.database import Database, EventRow
from tests.cluster.pairs import HARMLESS, Pair, answers, both, folder_store, made, train
from tests.cluster.servers import S3, Postgres, Shared, sharing
from tests.service.data import ADDRESS, eventually, service_of
from tests.service.learning.lessons import QUERIES, Pupil, lesson, publish
from tests.service.learning.test_changes import PUSH, WATCHFUL, drive, state
from tests.service.learning.test_intervals import off
from tests.service.server import Server

QUICK_PUBLISHING = {"publish_every_s": 0.02, "min_revision_wait_s": 20.0}
NAMES = (f"shared-{number}" for number in count())


@pytest.fixture(scope="module")
def place(postgres: Postgres, s3: S3, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shared]:
    """What the services of this file share."""
    with sharing(postgres, s3, tmp_path_factory.mktemp("replicas")) as made:
        yield made


@pytest.fixture(scope="module")
def pair(place: Shared) -> Iterator[Pair]:
    """Two services in this process, each with a learner of its own."""
    trained = train(place.folder / "trained")
    with (
        TestClient(create_app(place.settings("one", **QUICK_PUBLISHING)), ADDRESS) as one,
        TestClient(create_app(place.settings("two", **QUICK_PUBLISHING)), ADDRESS) as two,
    ):
        yield Pair((one, two), trained)


@pytest.fixture
def arm(pair: Pair) -> tuple[Pupil, ...]:
    """A model that nobody else uses, as both services show it."""
    return pair.enrol(next(NAMES))


def teach(pupils, numbers, seed=0):
    """Send each lesson to one of the services; return the last revision that was acknowledged."""
    rng = np.random.default_rng(seed)
    said = [pupils[rng.integers(len(pupils))].post("observations", lesson(number)) for number in numbers]
    assert [each["revision"] for each in said] == sorted(each["revision"] for each in said)
    return said[-1]["revision"]


def batches(pair, model):
    """How many events each batch of a model has."""
    with service_of(pair.clients[0]).database.session() as session:
        found = session.scalars(select(EventRow.sequence).where(EventRow.model == model, EventRow.kind == "batch"))
        return sorted(found)


def test_batches_at_either_service_lead_both_to_the_same_bits(arm):
    one, two = answers(arm, teach(arm, range(20)))
    assert one == two
    assert one["revision"] == 20


def test_what_one_takes_back_or_rolls_back_the_other_does_too(arm):
    first, second = arm
    teach(arm, range(8), seed=1)
    assert first.delete("observations/arm/3")["revision"] == 9
    teach(arm, range(8, 12), seed=2)
    one, two = answers(arm, second.post("rollback", {"revision": 11})["revision"])
    assert one == two
    one, two = answers(arm, teach(arm, range(12, 16), seed=3))
    assert one == two


def test_a_batch_that_both_get_at_once_is_learnt_once(pair, arm):
    for number in range(6):
        said = both(*(partial(pupil.post, "observations", lesson(number)) for pupil in arm))
        assert sorted(each["duplicate"] for each in said) == [False, True]
        assert said[0]["revision"] == said[1]["revision"] == number + 1
    assert batches(pair, arm[0].model) == list(range(6))
    one, two = answers(arm, 6)
    assert one == two


def test_who_asks_for_a_revision_gets_it_from_either_service(arm):
    for number in range(6):
        said = arm[number % 2].post("observations", lesson(number))
        answer = arm[(number + 1) % 2].post("predict", QUERIES | {"min_revision": said["revision"]})
        assert answer["revision"] >= said["revision"]
        single = {name: rows[0] for name, rows in QUERIES.items()}
        other = arm[number % 2].post("predict", single | {"min_revision": said["revision"], "version": said["version"]})
        assert (other["tau"], other["tau_std"]) == (answer["tau"][0], answer["tau_std"][0])


def test_intervals_of_both_are_as_wide_as_what_either_has_measured_asks_for(arm):
    first, second = arm
    own = second.predict()["scale"]
    for number, pupil in enumerate((first, second, first)):
        pupil.post("observations", off(number))
        here = pupil.predict()["scale"]
        assert here[1] > 1.5 * own[1]
        eventually(lambda here=here: [each.predict()["scale"] for each in arm] == [here, here])
    first.put("learning", HARMLESS | {"adaptive_intervals": False})
    eventually(lambda: [each.predict()["scale"] for each in arm] == [own, own])


def test_gates_and_detector_of_both_judge_as_one(pair):
    """A change is found once, by whoever gets the batch that shows it; decided at one, it is decided at both."""
    pupils = first, second = pair.enrol(next(NAMES), **WATCHFUL, on_change="hold")
    said = [drive(pupils[number % 2], range(number, number + 1))[0] for number in range(10)]
    assert all(each["rejected"] == {} for each in said)
    said = [drive(pupils[number % 2], range(number, number + 1), push=PUSH)[0] for number in range(10, 18)]
    assert [each["held"] for each in said] == [False] * 4 + [True] * 4 or said[5]["held"]
    for pupil in pupils:
        assert len(pupil.get("alarms")["items"]) == 1
        assert pupil.get("learning")["status"]["held"] is not None
    first.post("learning/change", {"decision": "adapt"})
    after = [drive(pupils[number % 2], range(number, number + 1), push=PUSH)[0] for number in range(18, 20)]
    assert [each["held"] for each in after] == [False, False]
    monitors = [service_of(client).learners.monitor(first.model) for client in pair.clients]
    assert state(monitors[0]) == state(monitors[1])
    shown = [pupil.get("quality")["windows"][0] for pupil in pupils]
    assert shown[0] == shown[1]
    one, two = answers((first, second), after[-1]["revision"])
    assert one == two


def test_an_alias_that_is_moved_or_removed_at_one_is_at_the_other(pair, arm):
    first, second = arm
    service = service_of(pair.clients[0])
    publish(service.database, service.files, pair.trained, first.model)
    for version in (1, 2):
        first.put("aliases/stable", {"version": version})
        eventually(
            lambda v=version: (
                (answer := second.client.post(second.url("predict"), json=QUERIES | {"alias": "stable"})).is_success
                and answer.json()["version"] == v
            )
        )
    assert first.client.delete(first.url("aliases/stable")).status_code == 204
    eventually(lambda: second.client.post(second.url("predict"), json=QUERIES | {"alias": "stable"}).status_code == 404)


def test_aliases_are_listed_as_of_one_moment(pair, arm, monkeypatch):
    """One that another service removes meanwhile is in the list or not, and nothing fails."""
    first, second = arm
    for alias in ("stable", "trial"):
        first.put(f"aliases/{alias}", {"version": 1})
    names = aliases.names

    def names_and_then(session, model):
        found = names(session, model)
        monkeypatch.setattr(aliases, "names", names)
        assert second.client.delete(second.url("aliases/stable")).status_code == 204
        return found

    monkeypatch.setattr(aliases, "names", names_and_then)
    for expected in (["serving", "stable", "trial"], ["serving", "trial"]):
        assert [each["alias"] for each in first.get("aliases")["items"]] == expected


def test_a_version_that_is_published_or_taken_back_to_at_one_answers_at_the_other(pair, arm):
    first, second = arm
    service = service_of(pair.clients[0])
    publish(service.database, service.files, pair.trained, first.model)
    eventually(lambda: second.predict()["version"] == 2)
    first.post("rollback", {"version": 1})
    eventually(lambda: second.predict()["version"] == 1)


def test_what_is_deleted_at_one_is_gone_at_the_other(pair, arm):
    first, second = arm
    service = service_of(pair.clients[0])
    publish(service.database, service.files, pair.trained, first.model)
    eventually(lambda: second.predict()["version"] == 2)
    second.post("predict", QUERIES | {"version": 1})  # in memory there
    assert first.client.delete(f"/v1/models/{first.model}/versions/1").status_code == 204
    eventually(lambda: service_of(second.client).loaded.hot(first.model, 1) is None)
    second.refused("POST", "predict", 404, "not_found", json=QUERIES | {"version": 1})
    assert first.client.delete(f"/v1/models/{first.model}").status_code == 204
    eventually(lambda: second.client.post(second.url("predict"), json=QUERIES).status_code == 404)
    assert first.model not in service_of(second.client).learners.monitors()
    # one of the same name has nothing of the one before
    again = pair.enrol(first.model)
    assert [pupil.predict()["version"] for pupil in again] == [3, 3]


@pytest.mark.slow
def test_a_service_that_starts_late_answers_the_same(place, pair, arm):
    """From the snapshots that the others have stored, and what came since."""
    teach(arm, range(10), seed=5)
    with TestClient(create_app(place.settings("late", **QUICK_PUBLISHING)), ADDRESS) as client:
        late = Pupil(client, arm[0].model)
        found = answers((*arm, late), teach((*arm, late), range(10, 15), seed=6))
        assert found[0] == found[1] == found[2]


def test_connections_that_are_lost_lose_nothing(postgres, place, arm):
    """Notices that nobody heard are looked up once they are heard again."""
    first, second = arm
    teach(arm, range(2))
    postgres.disconnect(place.database)
    revision = eventually(lambda: _taken(first, 2))
    one, two = answers((first, second), revision)
    assert one == two


def _taken(pupil, number):
    """The revision of a lesson once the service takes it: without its connections it is busy for a moment."""
    answer = pupil.client.post(pupil.url("observations"), json=lesson(number))
    assert answer.status_code in (httpx.codes.OK, httpx.codes.SERVICE_UNAVAILABLE), answer.text
    return answer.is_success and answer.json()["revision"]


@pytest.mark.slow
def test_without_any_notice_a_service_looks_for_itself(pair, arm, monkeypatch):
    first, second = arm
    monkeypatch.setattr(replication, "FULL_LOOK_S", 0.2)
    for client in pair.clients:  # each takes notices of the other for its own
        monkeypatch.setattr(service_of(client).database, "origin", "the same")
    one, two = answers((first, second), teach((first,), range(3)))
    assert one == two
    first.put("aliases/late", {"version": 1})
    eventually(lambda: second.client.post(second.url("predict"), json=QUERIES | {"alias": "late"}).is_success)


MODEL = "arm"
BATCHES = 30


@pytest.fixture
def servers(shared: Shared) -> Iterator[list[Server]]:
    """Two services of one model, in processes of their own."""
    made(shared, train(shared.folder / "trained"), MODEL)
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
@pytest.mark.parametrize("seed", [1, 2, 3])
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
