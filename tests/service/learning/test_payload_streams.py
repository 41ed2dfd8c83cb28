"""Payloads in a service: detected, declared, used for predictions, kept over kills, and removed."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from tests.service.data import error, eventually
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
    counts = {"accepted": 0}
    for start in range(0, len(samples), 10):
        part = samples.rows(slice(start, start + 10))
        if not first - 1e-6 <= part.t[0] < last - 1e-6:
            continue
        numbers = {name: getattr(part, name).tolist() for name in ("t", "q", "dq", "ddq", "tau")}
        answer = client.post(f"{PANDA}/observations", json={"stream_id": stream_id, "sequence": start, **numbers})
        assert answer.status_code == 200, answer.text
        counts["accepted"] += answer.json()["accepted"]
        for code, number in answer.json()["rejected"].items():
            counts[code] = counts.get(code, 0) + number
    return counts


def find_stream(client, stream_id="arm"):
    """Return the payload of a stream."""
    streams = {each["stream_id"]: each for each in client.get(f"{PANDA}/payload").json()["streams"]}
    return streams[stream_id]


def rms_error(client, samples):
    """Return the root mean square error of predicted torques per joint."""
    query = {name: getattr(samples, name).tolist() for name in ("q", "dq", "ddq")}
    return np.sqrt(((np.array(client.post(f"{PANDA}/predict", json=query).json()["tau"]) - samples.tau) ** 2).mean(0))


@pytest.mark.slow
def test_payload_is_detected_and_survives_kill_until_released(tmp_path, robot_stream):
    with Server(tmp_path / "home", warm=True) as server:
        client = server.client
        assert send_rows(client, robot_stream, 19.0, PICKUP_S)["accepted"] == 100
        assert find_stream(client)["payload"] is None
        later = robot_stream.rows(slice(170, 200))
        error_without_payload = rms_error(client, later).max()
        send_rows(client, robot_stream, PICKUP_S, PICKUP_S + 0.1)
        eventually(
            lambda: (
                find_stream(client)["state"] == "payload"
                and rms_error(client, later).max() < 0.1 * error_without_payload
            )
        )
        counts = send_rows(client, robot_stream, PICKUP_S + 0.1, PICKUP_S + 0.6)
        assert counts == {"accepted": 0, "payload": 50}
        eventually(lambda: find_stream(client)["rows"] >= 30)
        estimate = find_stream(client)
        mass = estimate["payload"]["mass"]
        assert abs(mass["mean"] - 1.5) < max(4 * mass["std"], 0.02)
        assert not estimate["declared"]
        assert rms_error(client, later).max() < 0.05 * error_without_payload
        alarms = client.get(f"{PANDA}/alarms").json()["items"]
        assert [each["kind"] for each in alarms] == ["payload"]
        assert "kg" in alarms[0]["message"]
        server.kill()
    with Server(tmp_path / "home", warm=True) as server:
        client = server.client
        assert find_stream(client)["payload"]["mass"]["mean"] == pytest.approx(mass["mean"], rel=0.01)
        # what its rows taught about the arm is kept
        assert rms_error(client, later).max() < 0.05 * error_without_payload
        send_rows(client, robot_stream, PICKUP_S + 0.6, RELEASE_S + 0.1)
        eventually(
            lambda: (
                find_stream(client)["payload"] is None
                and rms_error(client, robot_stream.rows(slice(220, 300))).max() < 0.2
            )
        )
        assert send_rows(client, robot_stream, RELEASE_S + 0.1, RELEASE_S + 0.3)["accepted"] == 20


@pytest.fixture
def panda(tmp_path):
    """Service of this test."""
    with Server(tmp_path / "home", warm=True) as server:
        yield server


@pytest.mark.slow
def test_declared_payload_is_used_until_removed(panda, robot_stream):
    client, with_payload = panda.client, robot_stream.rows(slice(100, 200))
    before = rms_error(client, with_payload).max()
    learnt = client.put(f"{PANDA}/payload", json={"mass": 1.5, "com": [0.0, 0.03, 0.1]})
    assert learnt.status_code == 200, learnt.text
    assert rms_error(client, with_payload).max() < 0.5 * before
    with open_stream(panda, f"{PANDA}/stream?payload=1&stream_id=arm") as connection:
        read_hello(connection)
        answer = send_frame(connection, frame(np.zeros((3, 7))))
        assert answer.flags & PAYLOAD
        assert answer.payload[0] == pytest.approx(1.5)
    assert client.delete(f"{PANDA}/payload").status_code == 200
    assert rms_error(client, with_payload).max() == pytest.approx(before)


@pytest.mark.slow
def test_payloads_of_streams_are_independent(panda, robot_stream):
    client = panda.client
    send_rows(client, robot_stream, 19.0, PICKUP_S + 0.3, "one")
    eventually(lambda: find_stream(client, "one")["payload"] is not None)
    free = replace(robot_stream, t=robot_stream.t).rows(slice(0, 100))
    send_rows(client, free, 19.0, PICKUP_S, "two")
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
    assert send_rows(client, robot_stream, 19.5, PICKUP_S + 0.3).get("payload", 0) == 0
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


def test_model_without_arm_explains_missing_payloads(api, trained):
    shown = api.get(f"/v1/models/{trained.name}/payload").json()
    assert shown["streams"] == []
    assert "has no arm" in shown["reason"]
    error(api.put(f"/v1/models/{trained.name}/payload", json={"mass": 1, "com": [0, 0, 0]}), 409, "conflict")
    error(api.get("/v1/models/nobody/payload"), 404, "not_found")
