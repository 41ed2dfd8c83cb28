"""The weigher: payload estimation for streams in a process of its own."""

import os
import signal
import time
from contextlib import closing
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
from tests import ROOT
from tests.choosing import slow
from tests.service.data import eventually
from tests.service.learning.payloads import payload_batches, send_payload_batches
from tests.service.models.versions import publish_arm_at
from tests.service.server import Server

KEY = ("panda", 1, "arm")
PICKUP_S, RATE_HZ = 1.0, 100.0


@pytest.fixture(scope="module")
def model():
    return lipcore.load(ROOT / "models" / "panda-sim")


@pytest.fixture(scope="module")
def batches():
    """Batches of ten rows of a Panda that picks up 1.5 kg at PICKUP_S."""
    seen = simulate(
        load_robot("panda"), Simulation(300, RATE_HZ, speed=5.0, noise=0.05, payload=Payload(1.5, PICKUP_S)), 7
    )
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


def follow(weigher, rows, event=0, **more):
    return list(weigher.follow(KEY, [StreamRows(rows, float(rows.time[-1]), event, **more)]))


def follow_batches(weigher, batches):
    """Follow batches of a stream that starts without a payload; return the messages."""
    out = follow(weigher, batches[0], watch=PayloadTracker(7))
    for rows in batches[1:]:
        out += follow(weigher, rows)
    return out


def refine_all(weigher, monkeypatch):
    """Refine until nothing is left to refine; return the messages."""
    monkeypatch.setattr(worker, "REFINING_S", 1e3)
    weigher._left = 1e3
    out = []
    while weigher.pause() < np.inf:
        out += weigher.refine()
    return out


def test_unknown_stream_is_requested(weigher, batches):
    assert follow(weigher, batches[0]) == [UnknownStream(KEY)]
    assert [each.watch.state for each in follow(weigher, batches[0], watch=PayloadTracker(7))] == ["none"]
    assert follow(weigher, batches[1]) == []  # no news


def test_payload_is_reported_at_once_then_refined(weigher, batches, model, monkeypatch):
    first = follow_batches(weigher, batches[:11])[-1]
    assert isinstance(first, WatchUpdate)
    assert (first.stream, first.received) == (KEY, batches[10].time[-1])
    assert first.watch.since == pytest.approx(PICKUP_S, abs=0.011)
    assert len(first.watch.held.rows) == 0
    assert first.watch.held.estimate.mass[0] == pytest.approx(1.5, abs=0.05)
    assert weigher.pause() < np.inf
    better = refine_all(weigher, monkeypatch)[-1]
    assert better.watch.held.refined == first.watch.held.count
    assert better.watch.held.estimate.draws == ()  # draws stay in the weigher
    later_rows = batches[20]
    answer = Carrier(model).with_payload(better.watch.load).predict(later_rows.q, later_rows.dq, later_rows.ddq)
    inside = np.abs(answer.tau - later_rows.tau) < 1.96 * np.sqrt(answer.tau_std**2 + answer.noise_std**2)
    assert inside.mean() > 0.9


def test_refinement_leaves_most_of_the_time_to_rows(weigher, batches, monkeypatch):
    follow_batches(weigher, batches[:11])
    while weigher._preparing:
        list(weigher.refine())
    now = time.monotonic()  # a frozen clock credits no time during a step, however slow the machine
    monkeypatch.setattr(worker, "time", SimpleNamespace(monotonic=lambda: now, process_time=time.process_time))
    assert weigher.pause() == 0.0
    weigher._left = 1e-9
    list(weigher.refine())
    assert weigher.pause() > 0.0
    before = weigher._streams[KEY].refining
    assert list(weigher.refine()) == []  # not due
    assert weigher._streams[KEY].refining is before


def test_declared_payload_applies_to_later_rows(weigher, batches, model):
    follow_batches(weigher, batches[:11])
    carrier = Carrier(model)
    declared = PayloadTracker(7).declare(carrier, Body(1.5, np.array([0.0, 0.0, 0.0])), PICKUP_S).outline()
    late = [StreamRows(batches[11], 0.0, 0), StreamRows(batches[12], 1.0, 5, watch=declared)]
    reply = list(weigher.follow(KEY, late))[-1]
    assert (reply.event, reply.watch.held.count) == (5, 10)  # the rows since the declaration
    assert reply.watch.held.estimate.mass[0] == pytest.approx(1.5, abs=0.1)


def test_posterior_updates_are_applied(weigher, batches, model):
    follow_batches(weigher, batches[:11])
    weights, root = model.posterior.weights * 1.001, model.posterior.root
    follow(weigher, batches[11], posterior=PosteriorUpdate(weights, root))
    assert weigher._streams[KEY].carrier.model.posterior.weights is weights
    follow(weigher, batches[12])
    assert weigher._streams[KEY].carrier.model.posterior.weights is weights


def test_failing_stream_is_requested_again(weigher, batches, monkeypatch, caplog):
    follow_batches(weigher, batches[:2])
    with monkeypatch.context() as patch:
        patch.setattr(PayloadTracker, "step", lambda *_: 1 / 0)
        assert follow(weigher, batches[2]) == []
    assert "could not estimate the payload" in caplog.text
    assert follow(weigher, batches[3]) == [UnknownStream(KEY)]


def test_longest_silent_stream_is_dropped(weigher, batches, monkeypatch):
    monkeypatch.setattr(worker, "MAX_STREAMS", 1)
    follow_batches(weigher, batches[:2])
    other = (*KEY[:2], "other")
    list(weigher.follow(other, [StreamRows(batches[0], 0.0, 0, watch=PayloadTracker(7))]))
    assert follow(weigher, batches[2]) == [UnknownStream(KEY)]


def test_deleted_model_is_forgotten(weigher, batches):
    follow_batches(weigher, batches[:11])
    weigher.forget(KEY[0])
    assert weigher.pause() == np.inf
    assert follow(weigher, batches[11]) == [UnknownStream(KEY)]


@pytest.mark.slow
def test_recreated_model_starts_without_payloads(panda):
    client = panda.client
    publish_arm_at(panda.home, "arm")
    send_payload_batches(client, "arm", "cell")
    assert client.delete("/v1/models/arm").status_code == 204
    publish_arm_at(panda.home, "arm")
    assert client.get("/v1/models/arm/payload").json()["streams"] == []
    send_payload_batches(client, "arm", "cell")
    (shown,) = client.get("/v1/models/arm/payload").json()["streams"]
    assert shown["payload"]["mass"]["mean"] == pytest.approx(1.5, abs=0.05)


@pytest.fixture
def panda(tmp_path):
    with Server(tmp_path / "home", warm=True) as server:
        yield server


def read_masses(client):
    streams = client.get("/v1/models/panda-sim/payload").json()["streams"]
    return {each["stream_id"]: each["payload"] and each["payload"]["mass"]["mean"] for each in streams}


@pytest.mark.slow
def test_killed_weigher_restarts_with_known_payloads(panda):
    client = panda.client
    send_payload_batches(client, "panda-sim", "one")
    eventually(lambda: read_masses(client)["one"])
    killed = panda.started()
    for pid in killed:
        os.kill(pid, signal.SIGKILL)
    eventually(lambda: len(panda.started()) == len(killed) and not {*panda.started()} & {*killed})
    send_payload_batches(client, "panda-sim", "two")
    assert read_masses(client)["two"] == pytest.approx(1.5, abs=0.05)
    assert read_masses(client)["one"] == pytest.approx(1.5, abs=0.05)


@pytest.mark.slow
def test_batches_with_undetected_payload_are_unlearnt(panda):
    client, route = panda.client, "/v1/models/panda-sim/observations"
    client.put("/v1/models/panda-sim/learning", json={"contact_threshold": 100.0})  # all rows are learnt
    send_payload_batches(client, "panda-sim", "arm", mass=0.3)
    since = eventually(lambda: read_masses(client)["arm"]) and client.get("/v1/models/panda-sim/payload").json()
    assert since["streams"][0]["state"] == "payload"
    eventually(lambda: client.get(f"{route}/arm/2").json()["state"] == "unlearnt")
    assert client.get(f"{route}/arm/0").json()["state"] == "learnt"


@pytest.mark.slow
def test_new_version_keeps_payload_with_wider_uncertainty(panda):
    client = panda.client
    publish_arm_at(panda.home, "arm")
    send_payload_batches(client, "arm", "cell")
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


@pytest.mark.slow
@pytest.mark.parametrize("others", [20, slow(5000)])
def test_payloads_survive_rollback_retention_and_restart(tmp_path, others):
    name, home = "panda-sim", tmp_path / "home"
    with Server(home, warm=True) as server:
        client = server.client
        send_payload_batches(client, name, "arm")
        for body in payload_batches("declared", mass=0.0):
            assert client.post(f"/v1/models/{name}/observations", json=body).status_code == 200
        body = {"mass": 2.0, "com": [0.0, 0.0, 0.1], "stream_id": "declared"}
        assert client.put(f"/v1/models/{name}/payload", json=body).status_code == 200
        eventually(lambda: client.get(f"/v1/models/{name}/alarms").json()["items"])  # the payload event is logged
        assert client.post(f"/v1/models/{name}/rollback", json={"revision": 0}).status_code == 200
        first = payload_batches("other", mass=0.0)[0]
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
        after = read_masses(server.client)
    assert {stream: mass for stream, mass in after.items() if mass} == pytest.approx(
        {"arm": 1.5, "declared": 2.0}, abs=0.05
    )
