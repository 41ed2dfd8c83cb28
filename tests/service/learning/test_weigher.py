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
PICKUP_BATCH = 10


@pytest.fixture(scope="module")
def model():
    return lipcore.load(ROOT / "models" / "panda-sim")


@pytest.fixture(scope="module")
def batches():
    """Batches of ten rows of a Panda that picks up 1.5 kg at PICKUP_S, in batch PICKUP_BATCH."""
    simulation = Simulation(300, RATE_HZ, speed=5.0, noise=0.05, payload=Payload(1.5, PICKUP_S))
    seen = simulate(load_robot("panda"), simulation, 7)
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


def follow(weigher, rows, event=0, key=KEY, **more):
    return list(weigher.follow(key, [StreamRows(rows, float(rows.time[-1]), event, **more)]))


def follow_batches(weigher, batches):
    """Follow batches of a stream that starts without a payload; return the messages."""
    out = follow(weigher, batches[0], watch=PayloadTracker(7))
    for rows in batches[1:]:
        out += follow(weigher, rows)
    return out


@pytest.fixture
def loaded_weigher(weigher, batches):
    """Weigher whose stream has picked up the payload; it has refined nothing yet."""
    follow_batches(weigher, batches[: PICKUP_BATCH + 1])
    return weigher


def test_unknown_stream_is_requested(weigher, batches):
    assert follow(weigher, batches[0]) == [UnknownStream(KEY)]
    assert [each.watch.state for each in follow(weigher, batches[0], watch=PayloadTracker(7))] == ["none"]
    assert follow(weigher, batches[1]) == []  # no news


def test_payload_is_reported_at_once_then_refined(weigher, batches, model, monkeypatch):
    first = follow_batches(weigher, batches[: PICKUP_BATCH + 1])[-1]
    assert isinstance(first, WatchUpdate)
    assert (first.stream, first.received) == (KEY, batches[PICKUP_BATCH].time[-1])
    assert first.watch.since == pytest.approx(PICKUP_S, abs=0.011)
    assert len(first.watch.held.rows) == 0
    assert first.watch.held.estimate.mass[0] == pytest.approx(1.5, abs=0.05)
    assert weigher.pause() < np.inf
    monkeypatch.setattr(worker, "REFINING_S", 1e3)
    weigher._left = 1e3
    refined = []
    while weigher.pause() < np.inf:
        refined += weigher.refine()
    better = refined[-1]
    assert better.watch.held.refined == first.watch.held.count
    assert better.watch.held.estimate.draws == ()  # draws stay in the weigher
    later_rows = batches[20]
    answer = Carrier(model).with_payload(better.watch.load).predict(later_rows.q, later_rows.dq, later_rows.ddq)
    inside = np.abs(answer.tau - later_rows.tau) < 1.96 * np.sqrt(answer.tau_std**2 + answer.noise_std**2)
    assert inside.mean() > 0.9


def test_refinement_leaves_most_of_the_time_to_rows(loaded_weigher, monkeypatch):
    while loaded_weigher._preparing:
        list(loaded_weigher.refine())
    now = time.monotonic()  # a frozen clock credits no time during a step, however slow the machine
    monkeypatch.setattr(worker, "time", SimpleNamespace(monotonic=lambda: now, process_time=time.process_time))
    assert loaded_weigher.pause() == 0.0
    loaded_weigher._left = 1e-9
    list(loaded_weigher.refine())
    assert loaded_weigher.pause() > 0.0
    before = loaded_weigher._streams[KEY].refining
    assert list(loaded_weigher.refine()) == []  # not due
    assert loaded_weigher._streams[KEY].refining is before


def test_declared_payload_applies_to_later_rows(loaded_weigher, batches, model):
    body = Body(1.5, np.array([0.0, 0.0, 0.0]))
    declared = PayloadTracker(7).declare(Carrier(model), body, PICKUP_S).outline()
    late = [StreamRows(batches[11], 0.0, 0), StreamRows(batches[12], 1.0, 5, watch=declared)]
    reply = list(loaded_weigher.follow(KEY, late))[-1]
    assert (reply.event, reply.watch.held.count) == (5, 10)  # the rows since the declaration
    assert reply.watch.held.estimate.mass[0] == pytest.approx(1.5, abs=0.1)


def test_posterior_updates_are_applied(loaded_weigher, batches, model):
    update = PosteriorUpdate(model.posterior.weights * 1.001, model.posterior.root)
    for rows, posterior in ((batches[11], update), (batches[12], None)):
        follow(loaded_weigher, rows, posterior=posterior)
        assert loaded_weigher._streams[KEY].carrier.model.posterior.weights is update.weights


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
    follow(weigher, batches[0], key=(*KEY[:2], "other"), watch=PayloadTracker(7))
    assert follow(weigher, batches[2]) == [UnknownStream(KEY)]


def test_deleted_model_is_forgotten(loaded_weigher, batches):
    loaded_weigher.forget(KEY[0])
    assert loaded_weigher.pause() == np.inf
    assert follow(loaded_weigher, batches[11]) == [UnknownStream(KEY)]


@pytest.fixture
def panda(tmp_path):
    with Server(tmp_path / "home", warm=True) as server:
        yield server


def list_streams(client, model="panda-sim"):
    return client.get(f"/v1/models/{model}/payload").json()["streams"]


def read_masses(client):
    return {each["stream_id"]: each["payload"] and each["payload"]["mass"]["mean"] for each in list_streams(client)}


@pytest.mark.slow
def test_recreated_model_starts_without_payloads(panda):
    publish_arm_at(panda.home, "arm")
    send_payload_batches(panda.client, "arm", "cell")
    assert panda.client.delete("/v1/models/arm").status_code == 204
    publish_arm_at(panda.home, "arm")
    assert list_streams(panda.client, "arm") == []
    send_payload_batches(panda.client, "arm", "cell")
    (shown,) = list_streams(panda.client, "arm")
    assert shown["payload"]["mass"]["mean"] == pytest.approx(1.5, abs=0.05)


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
    assert read_masses(client) == pytest.approx({"one": 1.5, "two": 1.5}, abs=0.05)


@pytest.mark.slow
def test_batches_with_undetected_payload_are_unlearnt(panda):
    client, route = panda.client, "/v1/models/panda-sim/observations"
    client.put("/v1/models/panda-sim/learning", json={"contact_threshold": 100.0})  # all rows are learnt
    send_payload_batches(client, "panda-sim", "arm", mass=0.3)
    eventually(lambda: read_masses(client)["arm"])
    assert list_streams(client)[0]["state"] == "payload"
    eventually(lambda: client.get(f"{route}/arm/2").json()["state"] == "unlearnt")
    assert client.get(f"{route}/arm/0").json()["state"] == "learnt"


@pytest.mark.slow
def test_new_version_keeps_payload_with_wider_uncertainty(panda):
    client = panda.client
    publish_arm_at(panda.home, "arm")
    send_payload_batches(client, "arm", "cell")
    (before,) = list_streams(client, "arm")
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

        def request(method, path, body=None):
            answer = server.client.request(method, f"/v1/models/{name}/{path}", json=body)
            assert answer.status_code == 200, answer.text
            return answer.json()

        send_payload_batches(server.client, name, "arm")
        for body in payload_batches("declared", mass=0.0):
            request("POST", "observations", body)
        request("PUT", "payload", {"mass": 2.0, "com": [0.0, 0.0, 0.1], "stream_id": "declared"})
        eventually(lambda: request("GET", "alarms")["items"])  # the payload event is logged
        request("POST", "rollback", {"revision": 0})
        first = payload_batches("other", mass=0.0)[0]
        for number in range(others):
            times = (np.array(first["t"]) + 0.25 * number).tolist()
            request("POST", "observations", first | {"sequence": number, "t": times})
        eventually(lambda: request("GET", "learning")["status"]["lag_events"] == 0)
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
