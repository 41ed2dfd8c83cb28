"""What happens in a laboratory besides its robots' work: each function is one happening, by the name of its claim."""

from __future__ import annotations

import os
import signal
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import httpx

from lipserve import StreamClient
from service.cli.verify import verify_home
from service.foundation.settings import Settings
from service.storage.backup import backup, restore
from tests.service.data import ended, eventually
from tests.year.laboratory import QUOTA_BYTES, Laboratory
from tests.year.ledger import DAY_S
from tests.year.robots import VISCOUS, Robot, recording

CLOCK_STEPS_S = (-DAY_S / 2, -3600.0, -5.0, 5.0, 3600.0, DAY_S / 2)
"""Errors of the host's clock, s."""
MAX_VERSIONS = 3
"""Versions of a model that its owner keeps."""


def kill_with_batch_in_flight(lab: Laboratory) -> None:
    """Kill the service while a batch arrives; the robot sends it again to the next one."""
    robot = lab.random.choice(lab.robots)
    lab.check_counters()
    body, client = robot.batch(lab.clock.now()), httpx.Client(base_url=lab.server.url, timeout=30.0)

    def send() -> None:
        with suppress(httpx.TransportError), client:
            client.post(f"/v1/models/{robot.model}/observations", json=body)

    sender = threading.Thread(target=send)
    sender.start()
    sender.join(lab.random.uniform(0.0, 0.05))  # the batch is anywhere between client and log
    lab.server.kill()
    sender.join()
    lab.client.close()
    lab.ledger.life.clear()
    lab.start()
    lab.send(robot, body)


def kill_child(lab: Laboratory) -> None:
    """Kill a process of the service: the learner, the one that estimates payloads, or a training process."""
    if children := lab.server.started():
        with suppress(ProcessLookupError):
            os.kill(lab.random.choice(children), signal.SIGKILL)
    eventually(lab.is_ready)


def restart(lab: Laboratory) -> None:
    """Stop the service and start it again."""
    lab.restart()


def set_host_clock(lab: Laboratory) -> None:
    """Set the host's clock wrong for a quarter of a day, with a start meanwhile or without."""
    lab.clock.set(lab.random.choice(CLOCK_STEPS_S))
    if lab.random.random() < 0.3:
        lab.restart(kill=True)
    for robot in lab.robots:
        lab.send(robot)
    lab.clock.sleep(DAY_S / 4)
    for robot in lab.robots:
        lab.send(robot)
    lab.clock.set(0.0)


def change_daylight_saving(lab: Laboratory) -> None:
    """Set the clocks of all robots by an hour; after one batch each continues with a new stream."""
    step = lab.random.choice((-3600.0, 3600.0))
    for robot in lab.robots:
        robot.set_clock(step)
        lab.send(robot)
        robot.start_stream()


def fill_disk(lab: Laboratory) -> None:
    """Fill the quota of the home: the robot's batch is refused, and accepted once there is space again."""
    robot, ballast = lab.random.choice(lab.robots), lab.home / "ballast"
    try:
        with ballast.open("wb") as file:
            file.truncate(QUOTA_BYTES)  # a hole, which needs no space
        eventually(lambda: not lab.is_ready())  # the size of the home is measured every ten seconds
        body = robot.batch(lab.clock.now())
        assert lab.request("POST", f"/v1/models/{robot.model}/observations", 507, json=body) is None
    finally:
        ballast.unlink()
    eventually(lab.is_ready)
    lab.send(robot, body)


def train_and_promote(lab: Laboratory) -> None:
    """Train a version, point an alias to it, and delete the oldest versions that nobody needs."""
    robot = lab.random.choice(lab.robots)
    done = lab.train(robot)
    lab.request("PUT", f"/v1/models/{robot.model}/aliases/production", json={"version": done["version"]})
    if lab.random.random() < 0.5:
        lab.request("POST", f"/v1/models/{robot.model}/aliases/production/rollback", 409)
    _tidy(lab, robot)


def refresh(lab: Laboratory) -> None:
    """Retrain the serving version on what it has learnt."""
    robot = lab.random.choice(lab.robots)
    if (job := lab.request("POST", f"/v1/models/{robot.model}/refresh", 409, json={})) is not None:
        done = ended(lab.client, job["id"])
        # rows of a payload that was detected meanwhile are unlearnt
        assert done["state"] == "succeeded" or done["error"]["code"] == "observations_taken_back", done
    _tidy(lab, robot)


def serve_other_version(lab: Laboratory) -> None:
    """Let an earlier version serve, and learn for a quarter of a day, before the newest serves again."""
    robot = lab.random.choice(lab.robots)
    model = lab.request("GET", f"/v1/models/{robot.model}")
    serving, other = model["serving_version"], lab.random.choice(model["versions"])["version"]
    for version in (other, serving):
        lab.request("POST", f"/v1/models/{robot.model}/rollback", 409, json={"version": version})
        lab.send(robot)


def roll_back_learning(lab: Laboratory) -> None:
    """Undo the newest batch of a robot by a rollback to the revision before it."""
    robot = lab.random.choice(lab.robots)
    newest = lab.send(robot)
    revision = lab.send(robot)["revision"]
    if lab.request("POST", f"/v1/models/{robot.model}/rollback", 409, json={"revision": revision - 1}) is not None:
        lab.ledger.batches[robot.model, robot.stream_id, newest["sequence"] + 1].void = True


def unlearn(lab: Laboratory) -> None:
    """Unlearn a batch."""
    robot = lab.random.choice(lab.robots)
    sequence = lab.send(robot)["sequence"]
    path = f"/v1/models/{robot.model}/observations/{robot.stream_id}/{sequence}"
    if lab.request("DELETE", path, 409) is not None:
        lab.ledger.batches[robot.model, robot.stream_id, sequence].void = True


def replay(lab: Laboratory) -> None:
    """Learn rows that were kept out, if the newest batch has such."""
    robot = lab.random.choice(lab.robots)
    sequence = lab.send(robot)["sequence"]
    path = f"/v1/models/{robot.model}/observations/{robot.stream_id}/{sequence}/replay"
    lab.request("POST", path, 409, 422, json={})


def repeat_batches(lab: Laboratory) -> None:
    """Send a batch twice, and one with a gap before it; the first is learnt once."""
    robot = lab.random.choice(lab.robots)
    body = robot.batch(lab.clock.now())
    assert [lab.send(robot, body)["duplicate"] for _ in range(2)] == [False, True]
    robot.sequence += 5
    lab.send(robot)


def stream_torques(lab: Laboratory) -> None:
    """Stream frames with torques from a new stream of a robot; every one of them is logged, once."""
    robot = lab.random.choice(lab.robots)
    robot.start_stream()
    body, frames = robot.batch(lab.clock.now()), 200
    samples = recording(robot.arm)
    with StreamClient(robot.model, lab.server.url, stream_id=robot.stream_id) as client:
        for place in range(frames):
            client.predict(body["q"][place], body["dq"][place], samples.ddq[place], tau=body["tau"][place])
        still = {"q": body["q"][0], "dq": body["dq"][0], "ddq": samples.ddq[0]}
        eventually(lambda: client.predict(**still) and client.learnt.through == frames)
    lab.ledger.life["lipserve_requests_total", "WEBSOCKET", "/v1/models/{model}/stream", "101"] += 1
    path = f"/v1/models/{robot.model}/observations"
    logged = lab.request("GET", path, params={"stream_id": robot.stream_id, "limit": 100})["items"]
    assert sum(each["rows"] for each in logged) == frames
    for each in logged:
        lab.ledger.note_frames(robot.model, each, lab.clock.now())
    robot.start_stream()
    eventually(lambda: "lipserve_streams_open 0.0" in lab.metrics())


def carry_payload(lab: Laboratory) -> None:
    """Declare a payload and remove it, on a robot with an arm."""
    robot = lab.random.choice(lab.robots)
    path, body = f"/v1/models/{robot.model}/payload", {"mass": 0.5, "com": [0.0, 0.0, 0.1]}
    if lab.request("PUT", path, 409, json=body) is not None:
        lab.send(robot)
        lab.request("DELETE", path)


def drift_friction(lab: Laboratory) -> None:
    """Change the friction of a robot for good."""
    robot = lab.random.choice(lab.robots)
    robot.friction = max(robot.friction + lab.random.choice((0.1, 0.3, -0.05)), -VISCOUS)


def set_options(lab: Laboratory) -> None:
    """Change how a model forgets."""
    robot = lab.random.choice(lab.robots)
    options = dict(lab.request("GET", f"/v1/models/{robot.model}/learning")["options"])
    options["forgetting_s"] = lab.random.choice((None, 10 * DAY_S, 30 * DAY_S))
    lab.request("PUT", f"/v1/models/{robot.model}/learning", json=options)


def keep_guest(lab: Laboratory) -> None:
    """Train a model of a guest's robot, learn from it, and delete all of it."""
    name = f"guest-{lab.guests:04}"
    lab.guests += 1
    guest = Robot(name, "double-pendulum", lab.random, lab.clock.now())
    dataset = lab.train(guest)["datasets"][0]
    lab.send(guest)
    lab.request("DELETE", f"/v1/models/{name}")
    lab.request("DELETE", f"/v1/datasets/{dataset}")
    lab.ledger.forget(name)


def look_at_dashboard(lab: Laboratory) -> None:
    """Send the requests of the dashboard's pages."""
    for path in ("/v1/models", "/v1/overview", "/v1/jobs", "/v1/datasets", "/v1/audit"):
        lab.request("GET", path)
    for robot in lab.robots:
        for part in ("", "/learning", "/quality", "/alarms", "/aliases", "/payload", "/observations"):
            lab.request("GET", f"/v1/models/{robot.model}{part}")
        lab.request("POST", f"/v1/models/{robot.model}/predict", json=robot.queries())


def back_up(lab: Laboratory) -> None:
    """Back up the home beside the service; the restored home is sound."""
    with tempfile.TemporaryDirectory(dir=lab.home.parent) as folder:
        backup(lab.home, Path(folder) / "backup.tar")
        restore(Path(folder) / "home", Path(folder) / "backup.tar")
        assert verify_home(Settings(home=Path(folder) / "home")).damages == []


RESTARTS: tuple[Callable[[Laboratory], None], ...] = (kill_with_batch_in_flight, restart)
OTHERS: tuple[Callable[[Laboratory], None], ...] = (
    kill_child,
    set_host_clock,
    change_daylight_saving,
    fill_disk,
    train_and_promote,
    refresh,
    serve_other_version,
    roll_back_learning,
    unlearn,
    replay,
    repeat_batches,
    stream_torques,
    carry_payload,
    drift_friction,
    set_options,
    keep_guest,
    look_at_dashboard,
    back_up,
)


def _tidy(lab: Laboratory, robot: Robot) -> None:
    """Delete the oldest versions of a model beyond MAX_VERSIONS, and the data sets that no version names any more."""
    model = lab.request("GET", f"/v1/models/{robot.model}")
    for each in model["versions"][:-MAX_VERSIONS]:
        lab.request("DELETE", f"/v1/models/{robot.model}/versions/{each['version']}", 409)
    versions = [each["version"] for each in lab.request("GET", f"/v1/models/{robot.model}")["versions"]]
    used = [lab.request("GET", f"/v1/models/{robot.model}/versions/{version}")["lineage"] for version in versions]
    named = {each["id"] for lineage in used for each in lineage["datasets"]}
    for dataset in [each for each in lab.datasets.get(robot.model, []) if each not in named]:
        lab.request("DELETE", f"/v1/datasets/{dataset}", 409)
        lab.datasets[robot.model].remove(dataset)
