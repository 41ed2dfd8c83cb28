"""Payloads in a service: detected, declared, used for predictions, kept over kills, and removed."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from tests.service.data import error, eventually
from tests.service.learning.learning_models import read_json
from tests.service.server import Server
from tests.service.streams import PAYLOAD, frame, open_stream, read_hello, send_frame

PANDA = "/v1/models/panda-sim"
PICKUP_S, RELEASE_S, RATE = 20.0, 21.0, 100.0


@pytest.fixture(scope="module")
def robot_stream():
    """Rows of a Panda from 19 s on, with a payload of 1.5 kg from PICKUP_S to RELEASE_S."""
    simulation = Simulation(2200, RATE, speed=5.0, noise=0.05)
    free = simulate(load_robot("panda"), simulation, 300)
    full = simulate(load_robot("panda"), replace(simulation, payload=Payload(1.5, 0.0, (0.02, 0.02, 0.08))), 300)
    with_payload = ((free.t >= PICKUP_S) & (free.t < RELEASE_S))[:, None]
    return replace(free, tau=np.where(with_payload, full.tau, free.tau)).rows(slice(1900, 2200))


def send_rows(client, samples, first, last, stream_id="arm"):
    """Send the rows between two times, ten per batch; return the number of rows by outcome."""
    counts = Counter(accepted=0)
    for start in range(0, len(samples), 10):
        part = samples.rows(slice(start, start + 10))
        if first - 1e-6 <= part.t[0] < last - 1e-6:
            numbers = {name: getattr(part, name).tolist() for name in ("t", "q", "dq", "ddq", "tau")}
            body = {"stream_id": stream_id, "sequence": start, **numbers}
            reply = read_json(client.post(f"{PANDA}/observations", json=body))
            counts.update({"accepted": reply["accepted"], **reply["rejected"]})
    return counts


def find_stream(client, stream_id="arm"):
    """Return the payload of a stream."""
    streams = {each["stream_id"]: each for each in client.get(f"{PANDA}/payload").json()["streams"]}
    return streams[stream_id]


def max_rms_error(client, samples):
    """Return the root mean square error of predicted torques of the joint with the largest one."""
    query = {name: getattr(samples, name).tolist() for name in ("q", "dq", "ddq")}
    tau = np.array(client.post(f"{PANDA}/predict", json=query).json()["tau"])
    return np.sqrt(((tau - samples.tau) ** 2).mean(0)).max()


@pytest.mark.slow
def test_payload_is_detected_and_survives_kill_until_released(tmp_path, robot_stream):
    with_payload, later = robot_stream.rows(slice(170, 200)), robot_stream.rows(slice(220, 300))
    with Server(tmp_path / "home", warm=True) as server:
        client = server.client
        assert send_rows(client, robot_stream, 19.0, PICKUP_S)["accepted"] == 100
        assert find_stream(client)["payload"] is None
        first_error = max_rms_error(client, with_payload)
        send_rows(client, robot_stream, PICKUP_S, PICKUP_S + 0.1)
        eventually(lambda: find_stream(client)["state"] == "payload")
        eventually(lambda: max_rms_error(client, with_payload) < 0.1 * first_error)
        counts = send_rows(client, robot_stream, PICKUP_S + 0.1, PICKUP_S + 0.6)
        assert counts == {"accepted": 0, "payload": 50}
        eventually(lambda: find_stream(client)["rows"] >= 30)
        estimate = find_stream(client)
        mass = estimate["payload"]["mass"]
        assert abs(mass["mean"] - 1.5) < max(4 * mass["std"], 0.02)
        assert not estimate["declared"]
        assert max_rms_error(client, with_payload) < 0.05 * first_error
        (alarm,) = client.get(f"{PANDA}/alarms").json()["items"]
        assert alarm["kind"] == "payload"
        assert "kg" in alarm["message"]
        server.kill()
    with Server(tmp_path / "home", warm=True) as server:
        client = server.client
        assert find_stream(client)["payload"]["mass"]["mean"] == pytest.approx(mass["mean"], rel=0.01)
        # what its rows taught about the arm is kept
        assert max_rms_error(client, with_payload) < 0.05 * first_error
        send_rows(client, robot_stream, PICKUP_S + 0.6, RELEASE_S + 0.1)
        eventually(lambda: find_stream(client)["payload"] is None)
        eventually(lambda: max_rms_error(client, later) < 0.2)
        assert send_rows(client, robot_stream, RELEASE_S + 0.1, RELEASE_S + 0.3)["accepted"] == 20


@pytest.fixture
def panda(tmp_path):
    """Service of this test."""
    with Server(tmp_path / "home", warm=True) as server:
        yield server


@pytest.mark.slow
def test_declared_payload_is_used_until_removed(panda, robot_stream):
    client, with_payload = panda.client, robot_stream.rows(slice(100, 200))
    before = max_rms_error(client, with_payload)
    read_json(client.put(f"{PANDA}/payload", json={"mass": 1.5, "com": [0.0, 0.03, 0.1]}))
    assert max_rms_error(client, with_payload) < 0.5 * before
    with open_stream(panda, f"{PANDA}/stream?payload=1&stream_id=arm") as connection:
        read_hello(connection)
        answer = send_frame(connection, frame(np.zeros((3, 7))))
        assert answer.flags & PAYLOAD
        assert answer.payload[0] == pytest.approx(1.5)
    read_json(client.delete(f"{PANDA}/payload"))
    assert max_rms_error(client, with_payload) == pytest.approx(before)


@pytest.mark.slow
def test_payloads_of_streams_are_independent(panda, robot_stream):
    client = panda.client
    send_rows(client, robot_stream, 19.0, PICKUP_S + 0.3, "one")
    eventually(lambda: find_stream(client, "one")["payload"] is not None)
    send_rows(client, robot_stream, 19.0, PICKUP_S, "two")
    assert find_stream(client, "two")["payload"] is None
    client.put(f"{PANDA}/payload", json={"mass": 0.4, "com": [0, 0, 0.1], "stream_id": "two"})
    assert find_stream(client, "two")["declared"]
    assert not find_stream(client, "one")["declared"]
    client.delete(f"{PANDA}/payload", params={"stream_id": "one"})
    assert find_stream(client, "one")["payload"] is None
    assert find_stream(client, "two")["payload"] is not None


@pytest.mark.slow
def test_disabled_payload_detection_explains_itself(panda, robot_stream):
    client = panda.client
    client.put(f"{PANDA}/learning", json={"payloads": False})
    assert send_rows(client, robot_stream, 19.5, PICKUP_S + 0.3)["payload"] == 0
    shown = client.get(f"{PANDA}/payload").json()
    assert shown["streams"] == []
    assert "payloads" in shown["reason"]


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"mass": 0, "com": [0, 0, 0]}, "mass"),
        ({"mass": "2", "com": [0, 0, 0]}, "mass"),
        ({"mass": 2, "com": [0, 0]}, "com"),
        ({"mass": 2, "com": [0, 0, 11]}, "com[2]"),
        ({"mass": 2, "com": [0, 0, 0], "inertia": [[1, 0, 0], [0, 0, 0], [0, 0, 0]]}, "inertia"),
        ({"mass": 2, "com": [0, 0, 0], "inertia": [[1.7e308, 0, 0], [0, 1.7e308, 0], [0, 0, 1.7e308]]}, "inertia"),
        ({"mass": 2, "com": [0, 0, 0], "stream_id": "../x"}, "stream_id"),
        ({"mass": 2, "com": [0, 0, 0], "tool": 1}, "tool"),
        ({"com": [0, 0, 0]}, "mass"),
    ],
)
def test_invalid_payloads_are_rejected(api, body, field):
    reply = error(api.put(f"{PANDA}/payload", json=body), 422, "invalid_request")
    assert reply["detail"][0]["field"] == field
