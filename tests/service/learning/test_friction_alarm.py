"""The alarm of learnt friction that is negative: raised once, ended once, and only for the serving version."""

import time

import pytest

import lipcore
from lipcore import FitOptions
from lipcore.model.parameters import NegativeFriction
from lipcore.robots.urdf import RigidBody
from service.learning.friction import report_friction
from service.learning.learner.publication import Publication
from tests.service.data import stream
from tests.service.learning.learning_models import DEFAULT_OPTIONS, MODEL_NUMBERS, LearningModel, publish

ROWS, COULOMB = 100, 0.3
END = "Learnt friction is plausible again."


@pytest.fixture(scope="module")
def trained_arm(tmp_path_factory):
    """Folder of a double pendulum with Coulomb friction."""
    kinds, samples = ("revolute",) * 2, stream(samples=300, coulomb=COULOMB, noise=0.02)
    robot = RigidBody.from_profile("double-pendulum", samples.joint_names, kinds)
    folder = tmp_path_factory.mktemp("friction") / "model"
    lipcore.save(lipcore.train(samples, kinds, "rigid-body", FitOptions(geometry="fixed"), robot=robot), folder)
    return folder


@pytest.fixture
def arm(learning_service, trained_arm):
    service = learning_service.service
    model = LearningModel(learning_service.client, f"own-{next(MODEL_NUMBERS)}")
    publish(service.database, service.files, trained_arm, model.name)
    model.put("learning", DEFAULT_OPTIONS)
    return model


def learn_batches(arm, count):
    """Learn batches with the friction of the training, one after another."""
    recording = stream(samples=ROWS * count, seed=3, coulomb=COULOMB, noise=0.02)
    for number in range(count):
        part = recording.rows(slice(number * ROWS, (number + 1) * ROWS))
        body = {name: getattr(part, name).tolist() for name in ("t", "q", "dq", "ddq", "tau")}
        reply = arm.post("observations", {"stream_id": "arm", "sequence": number, **body})
        assert reply["accepted"] == ROWS, reply
        arm.wait_for_revision(reply["revision"], {name: body[name] for name in ("q", "dq", "ddq")})


def list_alarms(arm):
    return [each["message"] for each in arm.get("alarms")["items"] if each["kind"] == "friction"]


def test_ordinary_friction_raises_no_alarm(arm):
    learn_batches(arm, 4)
    assert list_alarms(arm) == []


@pytest.fixture
def report(learning_service, learning_model):
    """Report a publication with the Coulomb friction of joint 1, N·m, and 0.1 as standard deviation of both joints."""

    def report(revision, *means, version=1):
        found = tuple(NegativeFriction(joint, "coulomb", mean, 0.1) for joint, mean in enumerate(means) if mean < 0)
        about = learning_model.name, version, revision, revision, None, 30.0, 0, 0.0, 0.1, time.time()
        report_friction(learning_service.service.database, Publication(*about, negative_friction=found))
        return list_alarms(learning_model)

    return report


def test_alarm_is_raised_once_and_ends_once(report, learning_model):
    assert report(1, -0.19, 0.2) == []
    [alarm] = report(2, -0.25, 0.2)
    assert "(Coulomb −0.25 ± 0.1 N·m)" in alarm
    assert report(3, -0.5, 0.2) == [alarm]
    assert report(4, -0.15, 0.2) == [alarm]  # not clearly plausible yet
    assert report(1, 0.2, 0.2) == [alarm]  # from a service that is behind
    two = report(5, -0.3, -0.3)
    assert two[1:] == [alarm]
    assert report(6, 0.2, 0.2) == [END, *two]
    assert report(7, 0.2, 0.2) == [END, *two]
    assert len(report(8, -0.3, 0.2)) == 4
    types = ["alarm.raised", "alarm.raised", "alarm.cleared", "alarm.raised"]
    assert learning_model.list_alarm_events() == [(each, "friction") for each in types]


def test_version_that_does_not_serve_raises_no_alarm(report):
    assert report(1, -0.5, -0.5, version=2) == []
