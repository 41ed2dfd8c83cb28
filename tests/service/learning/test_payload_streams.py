"""What a robot carries, through a service: noticed from a stream, answered with, kept over kills, declared, gone."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from tests.service.data import error, eventually
from tests.service.server import Server
from tests.service.streams import PAYLOAD, ask, dial, frame, hello

PANDA = "/v1/models/panda-sim"
UP, DOWN, RATE = 20.0, 21.0, 100.0


@pytest.fixture(scope="module")
def robot_stream():
    """Rows of a Panda from 19 s on that carries 1.5 kg from UP to DOWN."""
    asked = Simulation(2200, RATE, speed=5.0, noise=0.05)
    free = simulate(load_robot("panda"), asked, 300)
    full = simulate(load_robot("panda"), replace(asked, payload=Payload(1.5, 0.0, (0.02, 0.02, 0.08))), 300)
    carried = ((free.t >= UP) & (free.t < DOWN))[:, None]
    return replace(free, tau=np.where(carried, full.tau, free.tau)).rows(slice(1900, 2200))


def observed(client, samples, first, last, stream_id="arm"):
    """Send the rows from one time to another, ten a batch; return the rows by what became of them."""
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


def of(client, stream_id="arm"):
    """What a stream's robot carries."""
    streams = {each["stream_id"]: each for each in client.get(f"{PANDA}/payload").json()["streams"]}
    return streams[stream_id]


def rms(client, samples):
    """Root mean square error of the torques of questions, joint by joint."""
    query = {name: getattr(samples, name).tolist() for name in ("q", "dq", "ddq")}
    return np.sqrt(((np.array(client.post(f"{PANDA}/predict", json=query).json()["tau"]) - samples.tau) ** 2).mean(0))


def test_a_payload_is_noticed_answered_with_kept_over_a_kill_and_put_down(tmp_path, robot_stream):
    with Server(tmp_path / "home", warm=True) as server:
        client = server.client
        assert observed(client, robot_stream, 19.0, UP)["accepted"] == 100
        assert of(client)["payload"] is None
        later = robot_stream.rows(slice(170, 200))
        unaware = rms(client, later).max()
        observed(client, robot_stream, UP, UP + 0.1)
        eventually(lambda: of(client)["state"] == "payload" and rms(client, later).max() < 0.1 * unaware)
        counts = observed(client, robot_stream, UP + 0.1, UP + 0.6)
        assert counts == {"accepted": 0, "payload": 50}
        eventually(lambda: of(client)["rows"] >= 30)
        held = of(client)
        mass = held["payload"]["mass"]
        assert abs(mass["mean"] - 1.5) < max(4 * mass["std"], 0.02)
        assert not held["declared"]
        assert rms(client, later).max() < 0.05 * unaware
        alarms = client.get(f"{PANDA}/alarms").json()["items"]
        assert [each["kind"] for each in alarms] == ["payload"]
        assert "kg" in alarms[0]["message"]
        server.kill()
    with Server(tmp_path / "home", warm=True) as server:
        client = server.client
        assert of(client)["payload"]["mass"]["mean"] == pytest.approx(mass["mean"], rel=0.01)
        assert rms(client, later).max() < 0.05 * unaware  # with what its rows had shown of the arm
        observed(client, robot_stream, UP + 0.6, DOWN + 0.1)
        eventually(
            lambda: of(client)["payload"] is None and rms(client, robot_stream.rows(slice(220, 300))).max() < 0.2
        )
        assert observed(client, robot_stream, DOWN + 0.1, DOWN + 0.3)["accepted"] == 20


@pytest.fixture
def panda(tmp_path):
    """A service of its own, whose model no other test teaches."""
    with Server(tmp_path / "home", warm=True) as server:
        yield server


def test_a_declared_payload_is_answered_with_until_it_is_gone(panda, robot_stream):
    client, carried = panda.client, robot_stream.rows(slice(100, 200))
    before = rms(client, carried).max()
    learnt = client.put(f"{PANDA}/payload", json={"mass": 1.5, "com": [0.0, 0.03, 0.1]})
    assert learnt.status_code == 200, learnt.text
    assert rms(client, carried).max() < 0.5 * before
    with dial(panda, f"{PANDA}/stream?payload=1&stream_id=arm") as connection:
        hello(connection)
        answer = ask(connection, frame(np.zeros((3, 7))))
        assert answer.flags & PAYLOAD
        assert answer.payload[0] == pytest.approx(1.5)
    assert client.delete(f"{PANDA}/payload").status_code == 200
    assert rms(client, carried).max() == pytest.approx(before)


def test_streams_carry_what_they_carry_by_themselves(panda, robot_stream):
    client = panda.client
    observed(client, robot_stream, 19.0, UP + 0.3, "one")
    eventually(lambda: of(client, "one")["payload"] is not None)
    free = replace(robot_stream, t=robot_stream.t).rows(slice(0, 100))
    observed(client, free, 19.0, UP, "two")
    assert of(client, "two")["payload"] is None
    client.put(f"{PANDA}/payload", json={"mass": 0.4, "com": [0, 0, 0.1], "stream_id": "two"})
    assert of(client, "two")["declared"]
    assert not of(client, "one")["declared"]
    client.delete(f"{PANDA}/payload", params={"stream_id": "one"})
    assert of(client, "one")["payload"] is None
    assert of(client, "two")["payload"] is not None


def test_what_is_switched_off_notices_nothing_and_says_why(panda, robot_stream):
    client = panda.client
    client.put(f"{PANDA}/learning", json={"payloads": False})
    assert observed(client, robot_stream, 19.5, UP + 0.3).get("payload", 0) == 0
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
def test_what_cannot_be_declared_is_refused(api, body, field):
    said = error(api.put(f"{PANDA}/payload", json=body), 422, "invalid_request")
    assert said["detail"][0]["field"] == field


def test_a_model_without_an_arm_says_so(api, trained):
    shown = api.get(f"/v1/models/{trained.name}/payload").json()
    assert shown["streams"] == []
    assert "knows no arm" in shown["reason"]
    error(api.put(f"/v1/models/{trained.name}/payload", json={"mass": 1, "com": [0, 0, 0]}), 409, "conflict")
    error(api.get("/v1/models/nobody/payload"), 404, "not_found")
