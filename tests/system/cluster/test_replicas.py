"""Two services on one database: each serves what the other receives, moves or deletes, and one is killed."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack
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
from tests.service.data import ADDRESS, eventually, service_of
from tests.service.learning.learning_models import QUERIES, LearningModel, observation_batch, publish
from tests.service.learning.test_changes import EXTERNAL_TORQUE_NM, STRICT_OPTIONS, monitor_state, send_recording
from tests.service.learning.test_intervals import biased_batch
from tests.service.server import Server
from tests.system import remembering
from tests.system.cluster.pairs import (
    LEARN_EVERYTHING,
    Pair,
    predict_at_revision,
    publish_models,
    run_concurrently,
    train,
)
from tests.system.cluster.servers import S3, Postgres, Shared, sharing

QUICK_PUBLISHING = {"publish_every_s": 0.02, "min_revision_wait_s": 20.0}
NAMES = (f"shared-{number}" for number in count())


@pytest.fixture(scope="module")
def shared_resources(postgres: Postgres, s3: S3, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shared]:
    """The resources that the services of this file share."""
    with sharing(postgres, s3, tmp_path_factory.mktemp("replicas")) as made:
        yield made


@pytest.fixture(scope="module")
def pair(shared_resources: Shared) -> Iterator[Pair]:
    """Two services in this process, each with its own learner."""
    trained = train(shared_resources.folder / "trained")
    with (
        TestClient(create_app(shared_resources.settings("one", **QUICK_PUBLISHING)), ADDRESS) as one,
        TestClient(create_app(shared_resources.settings("two", **QUICK_PUBLISHING)), ADDRESS) as two,
    ):
        yield Pair((one, two), trained)


@pytest.fixture
def arm(pair: Pair) -> tuple[LearningModel, ...]:
    """A new model, as both services show it."""
    return pair.enrol(next(NAMES))


def send_batches(pupils, numbers, seed=0):
    """Send each batch to a random service; return the last acknowledged revision."""
    rng = np.random.default_rng(seed)
    responses = [
        pupils[rng.integers(len(pupils))].post("observations", observation_batch(number)) for number in numbers
    ]
    assert [each["revision"] for each in responses] == sorted(each["revision"] for each in responses)
    return responses[-1]["revision"]


def logged_sequences(pair, model):
    """Return the sequences of the logged batches of a model."""
    with service_of(pair.clients[0]).database.session() as session:
        found = session.scalars(select(EventRow.sequence).where(EventRow.model == model, EventRow.kind == "batch"))
        return sorted(found)


def test_both_services_learn_identical_models(arm):
    one, two = predict_at_revision(arm, send_batches(arm, range(20)))
    assert one == two
    assert one["revision"] == 20


def test_undo_and_rollback_reach_both_services(arm):
    first, second = arm
    send_batches(arm, range(8), seed=1)
    assert first.delete("observations/arm/3")["revision"] == 9
    send_batches(arm, range(8, 12), seed=2)
    one, two = predict_at_revision(arm, second.post("rollback", {"revision": 11})["revision"])
    assert one == two
    one, two = predict_at_revision(arm, send_batches(arm, range(12, 16), seed=3))
    assert one == two


def test_batch_sent_to_both_is_learnt_once(pair, arm):
    for number in range(6):
        responses = run_concurrently(*(partial(pupil.post, "observations", observation_batch(number)) for pupil in arm))
        assert sorted(each["duplicate"] for each in responses) == [False, True]
        assert responses[0]["revision"] == responses[1]["revision"] == number + 1
    assert logged_sequences(pair, arm[0].name) == list(range(6))
    one, two = predict_at_revision(arm, 6)
    assert one == two


def test_min_revision_holds_at_either_service(arm):
    for number in range(6):
        response = arm[number % 2].post("observations", observation_batch(number))
        answer = arm[(number + 1) % 2].post("predict", QUERIES | {"min_revision": response["revision"]})
        assert answer["revision"] >= response["revision"]
        single = {name: rows[0] for name, rows in QUERIES.items()}
        other = arm[number % 2].post(
            "predict", single | {"min_revision": response["revision"], "version": response["version"]}
        )
        assert (other["tau"], other["tau_std"]) == (answer["tau"][0], answer["tau_std"][0])


def test_interval_scale_is_shared(arm):
    first, second = arm
    own = second.predict()["scale"]
    for number, pupil in enumerate((first, second, first)):
        pupil.post("observations", biased_batch(number))
        here = pupil.predict()["scale"]
        assert here[1] > 1.5 * own[1]
        eventually(lambda here=here: [each.predict()["scale"] for each in arm] == [here, here])
    first.put("learning", LEARN_EVERYTHING | {"adaptive_intervals": False})
    eventually(lambda: [each.predict()["scale"] for each in arm] == [own, own])


def test_gates_and_change_detector_share_state(pair):
    """A change is detected once, at the service that receives the batch; a decision applies to both."""
    pupils = first, second = pair.enrol(next(NAMES), **STRICT_OPTIONS, on_change="hold")
    responses = [send_recording(pupils[number % 2], range(number, number + 1))[0] for number in range(10)]
    assert all(each["rejected"] == {} for each in responses)
    responses = [
        send_recording(pupils[number % 2], range(number, number + 1), external_torque=EXTERNAL_TORQUE_NM)[0]
        for number in range(10, 18)
    ]
    assert [each["held"] for each in responses] == [False] * 4 + [True] * 4 or responses[5]["held"]
    for pupil in pupils:
        assert len(pupil.get("alarms")["items"]) == 1
        assert pupil.get("learning")["status"]["held"] is not None
    first.post("learning/change", {"decision": "adapt"})
    after = [
        send_recording(pupils[number % 2], range(number, number + 1), external_torque=EXTERNAL_TORQUE_NM)[0]
        for number in range(18, 20)
    ]
    assert [each["held"] for each in after] == [False, False]
    monitors = [service_of(client).learners.monitor(first.name) for client in pair.clients]
    assert monitor_state(monitors[0]) == monitor_state(monitors[1])
    shown = [pupil.get("quality")["windows"][0] for pupil in pupils]
    assert shown[0] == shown[1]
    one, two = predict_at_revision((first, second), after[-1]["revision"])
    assert one == two


def test_alias_changes_reach_other_service(pair, arm):
    first, second = arm
    service = service_of(pair.clients[0])
    publish(service.database, service.files, pair.trained, first.name)
    for version in (1, 2):
        first.put("aliases/stable", {"version": version, "override": True})
        eventually(
            lambda v=version: (
                (answer := second.client.post(second.url("predict"), json=QUERIES | {"alias": "stable"})).is_success
                and answer.json()["version"] == v
            )
        )
    assert first.client.delete(first.url("aliases/stable")).status_code == 204
    eventually(lambda: second.client.post(second.url("predict"), json=QUERIES | {"alias": "stable"}).status_code == 404)


def test_alias_list_tolerates_concurrent_removal(pair, arm, monkeypatch):
    """An alias that another service removes meanwhile may be listed or not."""
    first, second = arm
    for alias in ("stable", "trial"):
        first.put(f"aliases/{alias}", {"version": 1, "override": True})
    names = aliases.names

    def names_then_delete(session, model):
        found = names(session, model)
        monkeypatch.setattr(aliases, "names", names)
        assert second.client.delete(second.url("aliases/stable")).status_code == 204
        return found

    monkeypatch.setattr(aliases, "names", names_then_delete)
    for expected in (["serving", "stable", "trial"], ["serving", "trial"]):
        assert [each["alias"] for each in first.get("aliases")["items"]] == expected


def test_serving_version_follows_at_other_service(pair, arm):
    first, second = arm
    service = service_of(pair.clients[0])
    publish(service.database, service.files, pair.trained, first.name)
    eventually(lambda: second.predict()["version"] == 2)
    first.post("rollback", {"version": 1})
    eventually(lambda: second.predict()["version"] == 1)


def test_deletions_reach_other_service(pair, arm):
    first, second = arm
    service = service_of(pair.clients[0])
    publish(service.database, service.files, pair.trained, first.name)
    eventually(lambda: second.predict()["version"] == 2)
    second.post("predict", QUERIES | {"version": 1})  # load it into memory
    assert first.client.delete(f"/v1/models/{first.name}/versions/1").status_code == 204
    eventually(lambda: service_of(second.client).loaded.hot(first.name, 1) is None)
    second.expect_error("POST", "predict", 404, "not_found", json=QUERIES | {"version": 1})
    assert first.client.delete(f"/v1/models/{first.name}").status_code == 204
    eventually(lambda: second.client.post(second.url("predict"), json=QUERIES).status_code == 404)
    assert first.name not in service_of(second.client).learners.monitors()
    # a new model of that name inherits nothing
    again = pair.enrol(first.name)
    assert [pupil.predict()["version"] for pupil in again] == [3, 3]


def test_late_service_predicts_the_same(shared_resources, pair, arm):
    """It starts from the snapshots of the others and newer events."""
    send_batches(arm, range(10), seed=5)
    with TestClient(create_app(shared_resources.settings("late", **QUICK_PUBLISHING)), ADDRESS) as client:
        late = LearningModel(client, arm[0].name)
        found = predict_at_revision((*arm, late), send_batches((*arm, late), range(10, 15), seed=6))
        assert found[0] == found[1] == found[2]


def test_lost_connections_lose_no_notices(postgres, shared_resources, arm):
    """Missed notices are looked up after reconnection."""
    first, second = arm
    send_batches(arm, range(2))
    postgres.disconnect(shared_resources.database)
    revision = eventually(lambda: _post_batch(first, 2))
    one, two = predict_at_revision((first, second), revision)
    assert one == two


def _post_batch(pupil, number):
    """Send a batch; return its revision, or False while the service has no connections."""
    answer = pupil.client.post(pupil.url("observations"), json=observation_batch(number))
    assert answer.status_code in (httpx.codes.OK, httpx.codes.SERVICE_UNAVAILABLE), answer.text
    return answer.is_success and answer.json()["revision"]


def test_service_polls_without_notices(pair, arm, monkeypatch):
    first, second = arm
    monkeypatch.setattr(replication, "FULL_CHECK_S", 0.2)
    for client in pair.clients:  # each takes the other's notices for its own
        monkeypatch.setattr(service_of(client).database, "origin", "the same")
    one, two = predict_at_revision((first, second), send_batches((first,), range(3)))
    assert one == two
    first.put("aliases/late", {"version": 1, "override": True})
    eventually(lambda: second.client.post(second.url("predict"), json=QUERIES | {"alias": "late"}).is_success)


MODEL = "arm"
BATCHES = 30


@pytest.fixture
def servers(shared: Shared) -> Iterator[list[Server]]:
    """Two services of one model, in their own processes."""
    publish_models(shared, train(shared.folder / "trained"), MODEL)
    with start_service(shared, "one") as one, start_service(shared, "two") as two:
        pupil(one).put("learning", LEARN_EVERYTHING)
        yield [one, two]


def start_service(shared: Shared, name: str) -> Server:
    """Start a service with its own home."""
    return Server(shared.home(name), **(shared.env() | {"LIPSERVE_FILES_URL": shared.folder_url}))


def pupil(server: Server, model: str = MODEL) -> LearningModel:
    """Return the model as a service shows it."""
    return LearningModel(server.client, model)


def send_until_acknowledged(servers: list[Server], number: int, rng: np.random.Generator) -> int:
    """Send a batch to random services until one acknowledges it; return the revision."""
    while True:
        server = servers[rng.integers(len(servers))]
        try:
            answer = server.client.post(f"/v1/models/{MODEL}/observations", json=observation_batch(number))
        except httpx.TransportError:
            continue
        if answer.is_success:
            return int(answer.json()["revision"])
        assert answer.status_code == httpx.codes.SERVICE_UNAVAILABLE, answer.text


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_killed_service_loses_no_acknowledged_batch(shared, servers, seed):
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
        acknowledged.append(send_until_acknowledged(servers, number, rng))
    killed.wait()
    assert acknowledged == list(range(1, BATCHES + 1))  # each exactly once
    database = Database.of(shared.settings("looking"))
    with database.session() as session:
        rows = session.query(EventRow.sequence, EventRow.number).filter(EventRow.kind == "batch")
        assert dict(rows.all()) == {number: number + 1 for number in range(BATCHES)}
    database.close()
    with start_service(shared, victim.home.name) as again:
        one, two = predict_at_revision([pupil(again), pupil(other)], BATCHES)
        assert one == two


def test_services_follow_the_motion_of_a_stream_whichever_is_killed(shared):
    """Its batches reach the services in turn, each of them is killed once, and a batch is unlearnt meanwhile."""
    publish_models(shared, remembering.save_model(shared.folder / "remembering"), remembering.MODEL)
    names = ["one", "two"]
    with ExitStack() as running:
        servers = [running.enter_context(start_service(shared, name)) for name in names]
        pupil(servers[0], remembering.MODEL).put("learning", LEARN_EVERYTHING)
        for number in range(remembering.BATCHES):
            at = number % 2
            pupil(servers[at], remembering.MODEL).post("observations", remembering.stream_batch(number))
            if number == 6:
                unlearnt = f"observations/{remembering.STREAM}/{remembering.UNLEARNT}"
                pupil(servers[1], remembering.MODEL).delete(unlearnt)
            if number in (4, 7):
                servers[at].kill()
                servers[at] = running.enter_context(start_service(shared, names[at]))
        pupils = [pupil(server, remembering.MODEL) for server in servers]
        predict_at_revision(pupils, remembering.BATCHES + 1)
        one, two = (each.predict(remembering.query_along()) for each in pupils)
    assert one == two
    database = Database.of(shared.settings("looking"))
    logged = remembering.read_stream(database)
    database.close()
    remembering.assert_deflections_known(logged)
    expected = remembering.predict_learnt(logged, remembering.UNLEARNT)
    np.testing.assert_allclose(one["tau"], expected, atol=remembering.TOLERANCE_NM)
