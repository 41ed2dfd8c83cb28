"""Drifting friction is learnt in a service, over a kill, unlearning and rollback."""

from dataclasses import replace

import numpy as np
import pytest

import lipcore
from lipcore import FitOptions
from lipcore.robots.urdf import RigidBody
from service.foundation.settings import Settings
from service.storage.database import Database
from service.storage.files import Files
from tests.service.data import eventually, stream
from tests.service.learning.learning_models import publish, read_json
from tests.service.server import Server

ARM = "/v1/models/arm"
ROWS, SECONDS, RATE = 100, 12, 100.0
OPTIONS = {"contact_threshold": 100.0, "on_change": "learn", "payloads": False, "auto_refresh": False}


def train_model(folder):
    """Save a model of a double pendulum with friction; return its folder."""
    kinds, samples = ("revolute",) * 2, stream(samples=300, coulomb=0.3, noise=0.02)
    robot = RigidBody.from_profile("double-pendulum", samples.joint_names, kinds)
    lipcore.save(lipcore.train(samples, kinds, "rigid-body", FitOptions(device="cpu"), robot=robot), folder)
    return folder


def create_home(home, folder):
    """Create a home with a model."""
    settings = Settings(home=home)
    database = Database.of(settings)
    publish(database, Files.of(settings), folder, "arm")
    database.close()
    return home


def drifting_recording():
    """Return the seconds of another motion, with friction that grows by 60 %."""
    samples = stream(samples=ROWS * SECONDS, seed=3, rate=RATE, noise=0.02, speed=50.0)
    friction = 0.3 * (1 + 0.6 * samples.t / SECONDS)[:, None] * np.sign(samples.dq)
    samples = replace(samples, tau=samples.tau + friction)
    return [samples.rows(slice(first, first + ROWS)) for first in range(0, len(samples), ROWS)]


def learn_batches(client, parts, **options):
    """Learn all parts, unlearn the first, and return the predictions for the last."""
    read_json(client.put(f"{ARM}/learning", json=OPTIONS | options))
    for number, part in enumerate(parts):
        body = {name: getattr(part, name).tolist() for name in ("t", "q", "dq", "ddq", "tau")}
        reply = read_json(client.post(f"{ARM}/observations", json={"stream_id": "arm", "sequence": number, **body}))
        assert reply["accepted"] == ROWS
    reply = read_json(client.delete(f"{ARM}/observations/arm/0"))
    return wait_for_revision(client, parts[-1], reply["revision"])


def wait_for_revision(client, part, revision=0):
    """Return the predictions for a part once they contain a revision."""
    query = {name: getattr(part, name).tolist() for name in ("q", "dq", "ddq")}

    def predict():
        seen = read_json(client.post(f"{ARM}/predict", json=query))
        return seen["revision"] >= revision and seen

    return eventually(predict)


def mean_squared_error(answer, part):
    """Return the mean squared error of torques."""
    return np.mean((np.array(answer["tau"]) - part.tau) ** 2)


@pytest.mark.slow
def test_friction_walk_survives_kill_and_is_undone_by_rollback(tmp_path):
    parts, model = drifting_recording(), train_model(tmp_path / "model")
    with Server(create_home(tmp_path / "plain", model), warm=True) as server:
        plain = learn_batches(server.client, parts)
    with Server(create_home(tmp_path / "home", model), warm=True) as server:
        trained_prediction = wait_for_revision(server.client, parts[-1])
        before = learn_batches(server.client, parts, friction_walk_s=10.0)  # one epoch per second
        server.kill()
    assert mean_squared_error(before, parts[-1]) < 0.8 * mean_squared_error(plain, parts[-1])
    with Server(tmp_path / "home", warm=True) as server:
        client = server.client
        after = wait_for_revision(client, parts[-1], before["revision"])
        for name in ("tau", "tau_std"):
            np.testing.assert_allclose(after[name], before[name], rtol=1e-7, atol=1e-7)
        assert read_json(client.get(f"{ARM}/learning"))["options"]["friction_walk_s"] == 10.0
        reply = read_json(client.post(f"{ARM}/rollback", json={"revision": 0}))
        np.testing.assert_allclose(
            wait_for_revision(client, parts[-1], reply["revision"])["tau"], trained_prediction["tau"], atol=1e-9
        )
        assert read_json(client.get(f"{ARM}/learning"))["options"]["friction_walk_s"] is None
