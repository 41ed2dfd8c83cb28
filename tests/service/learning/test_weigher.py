"""The weigher: streams followed in a process of its own, whatever it knows, loses, or is asked meanwhile."""

import os
import signal
import time
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from sqlalchemy import select

import lipcore
from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from lipcore.online.batch import Rows
from lipcore.online.payload.holding import PayloadTracker
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from service.foundation.settings import Settings
from service.journal.snapshots import retain
from service.learning.weigher import worker
from service.learning.weigher.messages import PosteriorUpdate, StreamRows, UnknownStream, WatchUpdate
from service.learning.weigher.worker import Weigher
from service.storage.database import Database, EventRow
from tests.choosing import slow
from tests.service.data import eventually
from tests.service.learning.payloads import lift, lifting
from tests.service.models.versions import publish_arm_at
from tests.service.server import Server

KEY = ("panda", 1, "arm")
UP, RATE = 1.0, 100.0


@pytest.fixture(scope="module")
def model():
    return lipcore.load(Path(__file__).parents[3] / "models" / "panda-sim")


@pytest.fixture(scope="module")
def batches():
    """Ten rows each, of a Panda that takes 1.5 kg up at UP."""
    seen = simulate(load_robot("panda"), Simulation(300, RATE, speed=5.0, noise=0.05, payload=Payload(1.5, UP)), 7)
    rows = Rows(seen.t, seen.q, seen.dq, seen.ddq, seen.tau, np.zeros(len(seen), np.uint8))
    return [rows.take(slice(at, at + 10)) for at in range(0, 300, 10)]


@pytest.fixture
def weigher(model):
    class Versions:
        def get(self, name, version):
            assert (name, version) == KEY[:2]
            return model

        def forget(self, name):
            assert name == KEY[0]

    return Weigher(Versions())


def follow(weigher, rows, said=0, **more):
    return list(weigher.follow(KEY, [StreamRows(rows, float(rows.time[-1]), said, **more)]))


def told(weigher, batches):
    """What is told of batches, the first of which come from a stream that is known to carry nothing."""
    out = follow(weigher, batches[0], watch=PayloadTracker(7))
    for rows in batches[1:]:
        out += follow(weigher, rows)
    return out


def settle(weigher, monkeypatch):
    """Refine what there is to refine; return what is told."""
    monkeypatch.setattr(worker, "REFINING_S", 1e3)
    weigher._left = 1e3
    out = []
    while weigher.pause() < np.inf:
        out += weigher.refine()
    return out


def test_a_stream_is_asked_for_where_it_is_not_known(weigher, batches):
    assert follow(weigher, batches[0]) == [UnknownStream(KEY)]
    assert [each.watch.state for each in follow(weigher, batches[0], watch=PayloadTracker(7))] == ["none"]
    assert follow(weigher, batches[1]) == []  # nothing new


def test_what_is_taken_up_is_told_at_once_then_refined(weigher, batches, model, monkeypatch):
    first = told(weigher, batches[:11])[-1]
    assert isinstance(first, WatchUpdate)
    assert (first.stream, first.received) == (KEY, batches[10].time[-1])
    assert first.watch.since == pytest.approx(UP, abs=0.011)
    assert len(first.watch.held.rows) == 0
    assert first.watch.held.estimate.mass[0] == pytest.approx(1.5, abs=0.05)
    assert weigher.pause() < np.inf
    better = settle(weigher, monkeypatch)[-1]
    assert better.watch.held.refined == first.watch.held.count
    assert better.watch.held.estimate.draws == ()  # nobody else needs them
    asked = batches[20]
    answer = Carrier(model).with_payload(better.watch.load).predict(asked.q, asked.dq, asked.ddq)
    inside = np.abs(answer.tau - asked.tau) < 1.96 * np.sqrt(answer.tau_std**2 + answer.noise_std**2)
    assert inside.mean() > 0.9


def test_refining_leaves_most_of_the_time_to_rows(weigher, batches, monkeypatch):
    told(weigher, batches[:11])
    while weigher._preparing:
        list(weigher.refine())
    now = time.monotonic()  # nothing is credited while a step is computed, however long the machine takes for it
    monkeypatch.setattr(worker, "time", SimpleNamespace(monotonic=lambda: now, process_time=time.process_time))
    assert weigher.pause() == 0.0
    weigher._left = 1e-9
    list(weigher.refine())
    assert weigher.pause() > 0.0
    before = weigher._streams[KEY].refining
    assert list(weigher.refine()) == []  # not due
    assert weigher._streams[KEY].refining is before


def test_what_the_owner_says_counts_from_then_on(weigher, batches, model):
    told(weigher, batches[:11])
    carrier = Carrier(model)
    declared = PayloadTracker(7).declare(carrier, Body(1.5, np.array([0.0, 0.0, 0.0])), UP).outline()
    late = [StreamRows(batches[11], 0.0, 0), StreamRows(batches[12], 1.0, 5, watch=declared)]
    said = list(weigher.follow(KEY, late))[-1]
    assert (said.event, said.watch.held.count) == (5, 10)  # of the rows since
    assert said.watch.held.estimate.mass[0] == pytest.approx(1.5, abs=0.1)


def test_a_revision_is_followed_with(weigher, batches, model):
    told(weigher, batches[:11])
    weights, root = model.posterior.weights * 1.001, model.posterior.root
    follow(weigher, batches[11], posterior=PosteriorUpdate(weights, root))
    assert weigher._streams[KEY].carrier.model.posterior.weights is weights
    follow(weigher, batches[12])
    assert weigher._streams[KEY].carrier.model.posterior.weights is weights


def test_a_stream_that_cannot_be_followed_is_asked_for_and_others_go_on(weigher, batches, monkeypatch, caplog):
    told(weigher, batches[:2])
    with monkeypatch.context() as patch:
        patch.setattr(PayloadTracker, "step", lambda *_: 1 / 0)
        assert follow(weigher, batches[2]) == []
    assert "is not followed" in caplog.text
    assert follow(weigher, batches[3]) == [UnknownStream(KEY)]


def test_the_stream_that_was_silent_for_longest_is_forgotten(weigher, batches, monkeypatch):
    monkeypatch.setattr(worker, "MAX_STREAMS", 1)
    told(weigher, batches[:2])
    other = (*KEY[:2], "other")
    list(weigher.follow(other, [StreamRows(batches[0], 0.0, 0, watch=PayloadTracker(7))]))
    assert follow(weigher, batches[2]) == [UnknownStream(KEY)]


def test_nothing_is_kept_of_a_model_that_was_deleted(weigher, batches):
    told(weigher, batches[:11])
    weigher.forget(KEY[0])
    assert weigher.pause() == np.inf
    assert follow(weigher, batches[11]) == [UnknownStream(KEY)]


def test_another_model_of_the_same_name_is_another(panda):
    client = panda.client
    publish_arm_at(panda.home, "arm")
    lift(client, "arm", "cell")
    assert client.delete("/v1/models/arm").status_code == 204
    publish_arm_at(panda.home, "arm")
    assert client.get("/v1/models/arm/payload").json()["streams"] == []
    lift(client, "arm", "cell")
    (shown,) = client.get("/v1/models/arm/payload").json()["streams"]
    assert shown["payload"]["mass"]["mean"] == pytest.approx(1.5, abs=0.05)


@pytest.fixture
def panda(tmp_path):
    with Server(tmp_path / "home", warm=True) as server:
        yield server


def masses(client):
    streams = client.get("/v1/models/panda-sim/payload").json()["streams"]
    return {each["stream_id"]: each["payload"] and each["payload"]["mass"]["mean"] for each in streams}


def test_a_weigher_that_is_killed_is_started_again_and_knows_what_was_known(panda):
    client = panda.client
    lift(client, "panda-sim", "one")
    eventually(lambda: masses(client)["one"])
    killed = panda.started()
    for pid in killed:
        os.kill(pid, signal.SIGKILL)
    eventually(lambda: len(panda.started()) == len(killed) and not {*panda.started()} & {*killed})
    lift(client, "panda-sim", "two")
    assert masses(client)["two"] == pytest.approx(1.5, abs=0.05)
    assert masses(client)["one"] == pytest.approx(1.5, abs=0.05)


def test_what_a_payload_has_taught_before_it_was_noticed_is_taken_back(panda):
    client, route = panda.client, "/v1/models/panda-sim/observations"
    client.put("/v1/models/panda-sim/learning", json={"contact_threshold": 100.0})  # so that all of it teaches
    lift(client, "panda-sim", "arm", mass=0.3)
    since = eventually(lambda: masses(client)["arm"]) and client.get("/v1/models/panda-sim/payload").json()
    assert since["streams"][0]["state"] == "payload"
    eventually(lambda: client.get(f"{route}/arm/2").json()["state"] == "unlearnt")
    assert client.get(f"{route}/arm/0").json()["state"] == "learnt"


def test_another_version_carries_what_was_noticed_and_says_what_it_does_not_know(panda):
    client = panda.client
    publish_arm_at(panda.home, "arm")
    lift(client, "arm", "cell")
    (before,) = client.get("/v1/models/arm/payload").json()["streams"]
    publish_arm_at(panda.home, "arm")
    client.put("/v1/models/arm/aliases/serving", json={"version": 2})
    shown = eventually(lambda: (each := client.get("/v1/models/arm/payload").json())["version"] == 2 and each)
    (after,) = shown["streams"]
    assert after["payload"]["mass"]["mean"] == pytest.approx(before["payload"]["mass"]["mean"], rel=0.05)
    assert after["payload"]["com"]["std"][0] > 0.09
    query = dict.fromkeys(("q", "dq", "ddq"), [0.1] * 7)
    vague, exact = (client.post("/v1/models/arm/predict", json=query | {"version": each}).json() for each in (2, 1))
    np.testing.assert_allclose(vague["tau"], exact["tau"], atol=2.0)
    assert max(vague["tau_std"]) > 3 * max(exact["tau_std"])


@pytest.mark.parametrize("others", [20, slow(5000)])
def test_a_payload_outlives_a_rollback_batches_of_other_streams_retention_and_a_restart(tmp_path, others):
    name, home = "panda-sim", tmp_path / "home"
    with Server(home, warm=True) as server:
        client = server.client
        lift(client, name, "arm")
        for body in lifting("declared", mass=0.0):
            assert client.post(f"/v1/models/{name}/observations", json=body).status_code == 200
        body = {"mass": 2.0, "com": [0.0, 0.0, 0.1], "stream_id": "declared"}
        assert client.put(f"/v1/models/{name}/payload", json=body).status_code == 200
        eventually(lambda: client.get(f"/v1/models/{name}/alarms").json()["items"])  # logged, too
        assert client.post(f"/v1/models/{name}/rollback", json={"revision": 0}).status_code == 200
        first = lifting("other", mass=0.0)[0]
        for number in range(others):
            times = (np.array(first["t"]) + 0.25 * number).tolist()
            body = first | {"sequence": number, "t": times}
            assert client.post(f"/v1/models/{name}/observations", json=body).status_code == 200
        learning = f"/v1/models/{name}/learning"
        eventually(lambda: client.get(learning).json()["status"]["lag_events"] == 0)
        server.terminate()
    settings = Settings(home=home, observation_retention_s=1.0)
    with closing(Database.of(settings)) as database:
        retain(database, settings, name, time.time() + 1e6)
        with database.session() as session:
            kinds = session.scalars(select(EventRow.kind).where(EventRow.model == name))
            assert "payload" not in set(kinds)
    with Server(home, warm=True) as server:
        after = masses(server.client)
    assert {stream: mass for stream, mass in after.items() if mass} == pytest.approx(
        {"arm": 1.5, "declared": 2.0}, abs=0.05
    )
