"""Drifting friction is learnt in a service, over a kill, unlearning and rollback."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

import lipcore
from lipcore import FitOptions
from lipcore.robots.urdf import RigidBody
from service.foundation.settings import Settings
from service.storage.database import Database
from service.storage.files import Files
from tests.service.data import stream
from tests.service.learning.learning_models import LearningModel, publish
from tests.service.server import Server

ROWS, SECONDS, RATE = 100, 12, 100.0
OPTIONS = {"contact_threshold": 100.0, "on_change": "learn", "payloads": False, "auto_refresh": False}


def train_model(folder):
    """Save a model of a double pendulum with friction; return its folder."""
    kinds, samples = ("revolute",) * 2, stream(samples=300, coulomb=0.3, noise=0.02)
    robot = RigidBody.from_profile("double-pendulum", samples.joint_names, kinds)
    lipcore.save(lipcore.train(samples, kinds, "rigid-body", FitOptions(device="cpu"), robot=robot), folder)
    return folder


def drifting_recording():
    """Return the seconds of another motion, with friction that grows by 60 %."""
    samples = stream(samples=ROWS * SECONDS, seed=3, rate=RATE, noise=0.02, speed=50.0)
    friction = 0.3 * (1 + 0.6 * samples.t / SECONDS)[:, None] * np.sign(samples.dq)
    samples = replace(samples, tau=samples.tau + friction)
    return [samples.rows(slice(first, first + ROWS)) for first in range(0, len(samples), ROWS)]


def to_lists(part, *names):
    return {name: getattr(part, name).tolist() for name in names}


def learn_batches(arm, parts, **options):
    """Learn all parts, unlearn the first, and return the predictions for the last."""
    arm.put("learning", OPTIONS | options)
    for number, part in enumerate(parts):
        body = to_lists(part, "t", "q", "dq", "ddq", "tau")
        assert arm.post("observations", {"stream_id": "arm", "sequence": number, **body})["accepted"] == ROWS
    reply = arm.delete("observations/arm/0")
    return arm.wait_for_revision(reply["revision"], to_lists(parts[-1], "q", "dq", "ddq"))


@pytest.mark.slow
def test_friction_walk_survives_kill_and_is_undone_by_rollback(tmp_path):
    parts, model = drifting_recording(), train_model(tmp_path / "model")
    last = to_lists(parts[-1], "q", "dq", "ddq")

    def mean_squared_error(answer):
        return np.mean((np.array(answer["tau"]) - parts[-1].tau) ** 2)

    settings = Settings(home=tmp_path / "home")
    with closing(Database.of(settings)) as database:
        for name in ("plain", "arm"):
            publish(database, Files.of(settings), model, name)
    with Server(settings.home, warm=True) as server:
        plain, arm = (LearningModel(server.client, name) for name in ("plain", "arm"))
        trained_prediction = arm.predict(last)
        without = learn_batches(plain, parts)
        before = learn_batches(arm, parts, friction_walk_s=10.0)  # one epoch per second
        server.kill()
    assert mean_squared_error(before) < 0.8 * mean_squared_error(without)
    with Server(settings.home, warm=True) as server:
        arm = LearningModel(server.client, "arm")
        after = arm.wait_for_revision(before["revision"], last)
        for name in ("tau", "tau_std"):
            np.testing.assert_allclose(after[name], before[name], rtol=1e-7, atol=1e-7)
        assert arm.get("learning")["options"]["friction_walk_s"] == 10.0
        revision = arm.post("rollback", {"revision": 0})["revision"]
        rolled_back = arm.wait_for_revision(revision, last)
        np.testing.assert_allclose(rolled_back["tau"], trained_prediction["tau"], atol=1e-9)
        assert arm.get("learning")["options"]["friction_walk_s"] is None
