"""A monitor that takes in what another service took: gates, detector and windows are the same to the last bit."""

from __future__ import annotations

import dataclasses
import json
import time
from typing import Any

import numpy as np
import pytest

from lipcore.online.gates import Patience
from service.learning.ingest.judging import ContactGate
from service.learning.ingest.monitor import Monitor
from tests.service.learning.test_changes import PUSH, RATTLE, WATCHFUL, drive

HIDDEN = ("_gates", "_detector", "held", "number")


def told(value: Any) -> Any:
    """A value as texts and numbers that compare bit for bit."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: told(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return value.tobytes().hex()
    if isinstance(value, (list, tuple)):
        return [told(each) for each in value]
    return {key: told(each) for key, each in value.items()} if isinstance(value, dict) else repr(value)


def state(monitor: Monitor) -> dict[str, Any]:
    return {name: told(getattr(monitor, name)) for name in HIDDEN} | {
        "windows": [told(window._buckets) for window in monitor.windows]
    }


@dataclasses.dataclass(frozen=True)
class Beside:
    """A service's monitor of a model, and one that follows the log from before the first batch."""

    school: Any
    pupil: Any
    follower: Monitor

    def agree(self) -> bool:
        with self.school.service.database.session() as session:
            self.follower.follow(session, self.pupil.model)
        return state(self.follower) == state(self.school.service.learners.monitor(self.pupil.model))


@pytest.fixture
def beside(school, request):
    """Both monitors; of a model for each test."""
    pupil = school.enrol(request.node.name.replace("_", "-")[:60], **WATCHFUL, on_change="hold")
    monitor = school.service.learners.monitor(pupil.model)
    return Beside(school, pupil, Monitor(monitor.joint_names, school.service.settings))


def test_a_collision_a_change_and_a_decision(beside):
    """Looked at after any number of batches: each is taken in once and in order."""
    pupil = beside.pupil
    drive(pupil, range(8))
    assert beside.agree()
    drive(pupil, range(8), noise=RATTLE, stream_id="other")
    drive(pupil, range(8, 9), push=PUSH)
    assert beside.agree()
    drive(pupil, range(9, 16), push=PUSH)
    assert beside.follower.held is False
    assert beside.agree()
    assert beside.follower.held is True
    pupil.post("learning/change", {"decision": "adapt"})
    drive(pupil, range(8, 10), stream_id="other")  # its gate stands back too, and no batch of "arm" has come since
    assert beside.agree()
    assert beside.follower._gates["arm"].open
    drive(pupil, range(16, 19), push=PUSH)
    drive(pupil, range(19, 25))
    assert beside.agree()


def test_a_monitor_of_a_service_that_starts_again_has_the_gates_as_they_were(beside):
    drive(beside.pupil, range(6))
    drive(beside.pupil, range(6, 8), push=PUSH)  # a contact that has lasted for a second
    service = beside.school.service
    with service.database.session() as session:
        names = beside.follower.joint_names
        again = Monitor.rebuilt(session, beside.pupil.model, names, service.settings, time.time())
    assert again._gates["arm"].patience.contacts > 0
    assert state(again) == state(service.learners.monitor(beside.pupil.model))


@pytest.mark.parametrize(
    "gate",
    [
        ContactGate.start(2.0),
        ContactGate(Patience(2.0, True, 2.0 / 3.0, 7, 4, 1e9 + 0.1)),
        ContactGate(Patience(2.0), Patience(2.0, False, 0.1 + 0.2, 3, 3, -1.5)),
    ],
)
def test_a_gate_is_read_as_it_was_written(gate):
    assert ContactGate.from_json(json.loads(json.dumps(gate.to_json())), 2.0) == gate
