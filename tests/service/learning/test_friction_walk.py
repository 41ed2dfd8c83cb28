"""Friction that is followed, through a service: over a kill, over unlearning what is folded, and back again."""

from dataclasses import replace

import numpy as np

import lipcore
from lipcore import FitOptions
from lipcore.robots.urdf import RigidBody
from service.foundation.settings import Settings
from service.storage.database import Database
from service.storage.files import Files
from tests.service.data import eventually, stream
from tests.service.learning.lessons import answered, publish
from tests.service.server import Server

ARM = "/v1/models/arm"
ROWS, SECONDS, RATE = 100, 12, 100.0
OPTIONS = {"contact_threshold": 100.0, "on_change": "learn", "payloads": False, "auto_refresh": False}


def trained(folder):
    """The folder of a model of a double pendulum with friction."""
    kinds, samples = ("revolute",) * 2, stream(samples=300, coulomb=0.3, noise=0.02)
    robot = RigidBody.from_profile("double-pendulum", samples.joint_names, kinds)
    lipcore.save(lipcore.train(samples, kinds, "rigid-body", FitOptions(device="cpu"), robot=robot), folder)
    return folder


def installed(home, folder):
    """A home with a model."""
    settings = Settings(home=home)
    database = Database.of(settings)
    publish(database, Files.of(settings), folder, "arm")
    database.close()
    return home


def drifting():
    """Another motion, second by second, of a pendulum whose friction grows by 60 %."""
    samples = stream(samples=ROWS * SECONDS, seed=3, rate=RATE, noise=0.02, speed=50.0)
    friction = 0.3 * (1 + 0.6 * samples.t / SECONDS)[:, None] * np.sign(samples.dq)
    samples = replace(samples, tau=samples.tau + friction)
    return [samples.rows(slice(first, first + ROWS)) for first in range(0, len(samples), ROWS)]


def learnt(client, parts, **options):
    """The answers of a model that has learnt all parts but the first, which is taken back."""
    answered(client.put(f"{ARM}/learning", json=OPTIONS | options))
    for number, part in enumerate(parts):
        body = {name: getattr(part, name).tolist() for name in ("t", "q", "dq", "ddq", "tau")}
        said = answered(client.post(f"{ARM}/observations", json={"stream_id": "arm", "sequence": number, **body}))
        assert said["accepted"] == ROWS
    said = answered(client.delete(f"{ARM}/observations/arm/0"))
    return settled(client, parts[-1], said["revision"])


def settled(client, part, revision=0):
    """What is answered to the questions of a part once it contains a revision."""
    query = {name: getattr(part, name).tolist() for name in ("q", "dq", "ddq")}

    def asked():
        seen = answered(client.post(f"{ARM}/predict", json=query))
        return seen["revision"] >= revision and seen

    return eventually(asked)


def error(answer, part):
    """Mean squared error of torques."""
    return np.mean((np.array(answer["tau"]) - part.tau) ** 2)


def test_friction_is_followed_over_a_kill_and_undone(tmp_path):
    parts, model = drifting(), trained(tmp_path / "model")
    with Server(installed(tmp_path / "plain", model), warm=True) as server:
        plain = learnt(server.client, parts)
    with Server(installed(tmp_path / "home", model), warm=True) as server:
        untaught = settled(server.client, parts[-1])
        before = learnt(server.client, parts, friction_walk_s=10.0)  # epochs of a second
        server.kill()
    assert error(before, parts[-1]) < 0.8 * error(plain, parts[-1])
    with Server(tmp_path / "home", warm=True) as server:
        client = server.client
        after = settled(client, parts[-1], before["revision"])
        for name in ("tau", "tau_std"):
            np.testing.assert_allclose(after[name], before[name], rtol=1e-7, atol=1e-7)
        assert answered(client.get(f"{ARM}/learning"))["options"]["friction_walk_s"] == 10.0
        said = answered(client.post(f"{ARM}/rollback", json={"revision": 0}))
        np.testing.assert_allclose(settled(client, parts[-1], said["revision"])["tau"], untaught["tau"], atol=1e-9)
        assert answered(client.get(f"{ARM}/learning"))["options"]["friction_walk_s"] is None
