"""Changes of the robot: detection, alarms, and the decisions that follow."""

import dataclasses
import time
from typing import Any

import numpy as np
import pytest

from lipcore.online import judging, screening
from lipcore.online.batch import Rows
from lipcore.online.gates import ContactGate
from lipcore.online.judgement import Innovations, ModelRecord
from lipcore.online.judging import JudgeOptions
from lipcore.online.record import Record
from lipcore.online.screening import PredictedBatch
from lipcore.online.stream import StreamRecord
from service.journal import log
from service.learning.ingest.monitor import Monitor
from tests.service.learning import learning_models
from tests.service.learning.learning_models import LearningModel
from tests.service.learning.recordings import make_recording, read_codes, send_batch, slice_recording

BATCH_ROWS = 50
"""Rows of a batch, half a second."""
EXTERNAL_TORQUE_NM = 0.5
"""Fifty times the noise."""
NOISE_NM = 0.035
"""Four times the noise."""
STRICT_OPTIONS = {"contact_threshold": 8.0}


def list_events(learning_service, learning_model):
    with learning_service.service.database.session() as session:
        return [(event.number, event.kind, event.detail) for event in log.events(session, learning_model.name, 0, 1000)]


def send_recording(
    learning_model: LearningModel,
    numbers: range,
    external_torque: float = 0.0,
    ramp: float = 0.0,
    noise: float = 0.0,
    **more: Any,
) -> list[dict[str, Any]]:
    """Send batches of a recording with added torque: constant, a ramp in N·m/s, or noise."""
    rows = make_recording(samples=4000)
    rng = np.random.default_rng(numbers.start)
    replies = []
    for number in numbers:
        body = slice_recording(rows, number * BATCH_ROWS, (number + 1) * BATCH_ROWS)
        tau = np.array(body["tau"]) + external_torque + noise * rng.standard_normal((BATCH_ROWS, 2))
        tau += ramp * np.arange(BATCH_ROWS)[:, None] / 100
        replies.append(send_batch(learning_model, number, body | {"tau": tau.tolist()}, **more))
    return replies


def test_collision_is_rejected_without_alarm(learning_service):
    learning_model = learning_service.create_model("collision", **STRICT_OPTIONS)
    send_recording(learning_model, range(10))
    (hit,) = send_recording(learning_model, range(10, 11), external_torque=EXTERNAL_TORQUE_NM)
    after = send_recording(learning_model, range(11, 20))
    assert (hit["accepted"], hit["rejected"], hit["held"]) == (0, {"contact": BATCH_ROWS}, False)
    assert all(reply["rejected"] == {} for reply in after)
    assert learning_model.get("alarms")["items"] == []


@pytest.fixture(scope="module")
def paused_model(learning_service):
    """Paused model whose robot has picked up a payload, with the replies since and the prediction before."""
    learning_model = learning_service.create_model("payload", **STRICT_OPTIONS, on_change="hold")
    undisturbed = send_recording(learning_model, range(10))
    assert all(reply["rejected"] == {} for reply in undisturbed)
    before = learning_model.wait_for_revision(10)
    return learning_model, send_recording(learning_model, range(10, 20), external_torque=EXTERNAL_TORQUE_NM), before


@pytest.mark.slow
def test_payload_is_rejected_as_contact_then_as_change(learning_service, paused_model):
    _, replies, _ = paused_model
    reject_codes = [next(iter(each["rejected"])) for each in replies]
    assert [each["accepted"] for each in replies] == [0] * 10
    first = reject_codes.index("change")
    assert reject_codes == ["contact"] * first + ["change"] * (10 - first)
    assert 4 <= first <= 5  # two seconds of patience
    assert [each["held"] for each in replies] == [False] * first + [True] * (10 - first)


def test_change_alarm_contains_the_evidence(paused_model):
    learning_model, replies, _ = paused_model
    (alarm,) = learning_model.get("alarms")["items"]
    assert alarm["kind"] == "change"
    assert "joint1, joint2" in alarm["message"]
    assert "Learning is paused until you decide." in alarm["message"]
    evidence = alarm["evidence"]
    assert evidence["joints"] == ["joint1", "joint2"]
    assert evidence["suspect"] == "payload or contact"
    assert (evidence["stream_id"], evidence["sequence"]) == ("arm", 10 + [each["held"] for each in replies].index(True))
    for joint in evidence["per_joint"].values():
        assert joint["innovation"]["after"] == pytest.approx(EXTERNAL_TORQUE_NM, abs=0.05)
        assert abs(joint["innovation"]["before"]) < 0.02
        assert joint["standardised"]["after"] > 100 * joint["standardised"]["before"]
    held = learning_model.get("learning")["status"]["held"]
    assert held["evidence"] == evidence
    assert held["at"] == evidence["at"]
    line = learning_model.client.get("/v1/audit", params={"model": learning_model.name}).json()["items"][0]
    assert (line["change"], line["after"]["at"]) == ("learning held", held["at"])
    assert line["what"] == "POST /v1/models/{model}/observations"


def test_rejected_and_rolled_back_rows_leave_predictions_bitwise_unchanged(learning_service):
    """Covers an ignored change, a pause, and rows that were learnt and rolled back."""
    learning_model = learning_service.create_model("untouched", **STRICT_OPTIONS, on_change="hold")
    send_recording(learning_model, range(10))
    answers = {name: value for name, value in learning_model.wait_for_revision(10).items() if name != "revision"}

    def unchanged(revision):
        seen = learning_model.wait_for_revision(revision)
        return {name: value for name, value in seen.items() if name != "revision"} == answers

    changed = send_recording(learning_model, range(10, 16), external_torque=EXTERNAL_TORQUE_NM)
    assert changed[-1]["held"]
    assert unchanged(changed[-1]["revision"])
    learning_model.post("learning/change", {"decision": "ignore"})
    assert unchanged(changed[-1]["revision"])
    options = learning_model.get("learning")["options"]
    learning_model.put("learning", {**options, "enabled": False})
    paused = send_recording(learning_model, range(16, 18))
    learning_model.put("learning", {**options, "enabled": True})
    assert unchanged(paused[-1]["revision"])
    learnt = send_recording(learning_model, range(18, 20))[-1]
    assert learnt["accepted"] == BATCH_ROWS
    assert not unchanged(learnt["revision"])
    back = learning_model.post("rollback", {"revision": paused[-1]["revision"]})
    assert unchanged(back["revision"])


@pytest.mark.slow
def test_changed_robot_is_learnt_after_decision_to_adapt(learning_service):
    learning_model = learning_service.create_model("decided", **STRICT_OPTIONS, on_change="hold")
    send_recording(learning_model, range(10))
    assert send_recording(learning_model, range(10, 16), external_torque=EXTERNAL_TORQUE_NM)[-1]["held"]
    learning_model.post("learning/change", {"decision": "adapt"})
    for number in range(16, 30):
        (reply,) = send_recording(learning_model, range(number, number + 1), external_torque=EXTERNAL_TORQUE_NM)
        assert (reply["rejected"], reply["held"]) == ({}, False)
        learning_model.wait_for_revision(reply["revision"])
    assert len(learning_model.get("alarms")["items"]) == 1
    # after learning the change, contacts are detected again
    assert send_recording(learning_model, range(30, 31), external_torque=20 * EXTERNAL_TORQUE_NM)[0]["rejected"] == {
        "contact": BATCH_ROWS
    }


def test_adapt_starts_new_regime_before_the_detecting_batch(learning_service):
    learning_model = learning_service.create_model("adapting", **STRICT_OPTIONS, on_change="adapt")
    send_recording(learning_model, range(10))
    replies = send_recording(learning_model, range(10, 20), external_torque=EXTERNAL_TORQUE_NM)
    first = next(place for place, each in enumerate(replies) if not each["rejected"])
    assert 4 <= first <= 5
    assert all(each["accepted"] == BATCH_ROWS for each in replies[first:])
    assert not any(each["held"] for each in replies)
    changes = [event for event in list_events(learning_service, learning_model) if event[1] == "change"]
    (number, _, detail) = changes[0]
    assert len(changes) == 1
    assert replies[first]["revision"] == number + 1
    with learning_service.service.database.session() as session:
        assert detail["t"] == pytest.approx(log.find_batch(session, learning_model.name, "arm", 10).first, abs=0.02)
    alarm = learning_model.get("alarms")["items"][0]
    assert "The model adapts" in alarm["message"]
    line = learning_model.client.get("/v1/audit", params={"model": learning_model.name}).json()["items"][0]
    assert (line["change"], line["before"]["at"], line["after"]) == (
        "change decided",
        detail["t"],
        {"decision": "adapt"},
    )
    learning_model.wait_for_revision(replies[-1]["revision"])
    rows = make_recording(samples=4000)
    query = slice_recording(rows, 900, 950)
    answer = learning_model.predict({name: query[name] for name in ("q", "dq", "ddq")})
    error = np.array(answer["tau"]) - np.array(query["tau"]) - EXTERNAL_TORQUE_NM
    assert np.sqrt((error**2).mean()) < 0.1


@pytest.mark.slow
def test_small_persistent_errors_are_detected_as_change(learning_service, monkeypatch):
    """Errors of a few standard deviations are no contacts, but together they are a change.

    They contain nothing to learn: the stated uncertainty grows until they fit, which must not hide them.
    """
    learning_model = learning_service.create_model("rattling", **STRICT_OPTIONS, on_change="hold")
    arrivals = (time.time() + 0.5 * number for number in range(80))  # rows arrive as they are measured
    monkeypatch.setattr(learning_service.service.learners._log.clocks, "date_arrival", lambda: next(arrivals))
    learning_model.wait_for_revision(send_recording(learning_model, range(60))[-1]["revision"])
    for number in range(60, 80):
        (reply,) = send_recording(learning_model, range(number, number + 1), noise=NOISE_NM)
        assert reply["held"] or reply["accepted"] > 0.6 * BATCH_ROWS
        learning_model.wait_for_revision(reply["revision"])
    assert reply["held"]
    evidence = learning_model.get("learning")["status"]["held"]["evidence"]
    for joint in evidence["per_joint"].values():
        assert joint["rmse"]["after"] == pytest.approx(NOISE_NM, rel=0.3)


@pytest.mark.slow
def test_pause_and_decision_survive_restart(learning_service, tmp_path):
    home = tmp_path / "home"
    with learning_models.start_service(home, learning_service.trained) as first:
        learning_model = first.create_model("arm", **STRICT_OPTIONS, on_change="hold")
        send_recording(learning_model, range(10))
        send_recording(learning_model, range(10, 16), external_torque=EXTERNAL_TORQUE_NM)
    with learning_models.start_service(home, learning_service.trained) as second:
        learning_model = LearningModel(second.client, "arm")
        assert send_recording(learning_model, range(16, 17), external_torque=EXTERNAL_TORQUE_NM)[0]["held"]
        learning_model.post("learning/change", {"decision": "ignore"})
    with learning_models.start_service(home, learning_service.trained) as third:
        learning_model = LearningModel(third.client, "arm")
        # the gate is open although this service did not receive the decision
        (reply,) = send_recording(learning_model, range(17, 18), external_torque=EXTERNAL_TORQUE_NM)
        assert (reply["rejected"], reply["held"]) == ({}, False)
        assert read_codes(third, learning_model)[-BATCH_ROWS:] == ["learnt"] * BATCH_ROWS


def send_shifted_predictions(learning_model: LearningModel, number: int) -> tuple[dict[str, Any], np.ndarray]:
    """Send a batch labelled with the predicted torque plus one standard deviation; return the reply and the torque."""
    body = slice_recording(make_recording(samples=20_000), number * BATCH_ROWS, (number + 1) * BATCH_ROWS)
    seen = learning_model.predict({name: body[name] for name in ("q", "dq", "ddq")})
    tau, std = (np.array(seen[name]) for name in ("tau", "tau_std"))
    reply = send_batch(learning_model, number, body | {"tau": (tau + np.hypot(std, seen["noise_std"])).tolist()})
    learning_model.wait_for_revision(reply["revision"])
    return reply, tau


@pytest.mark.slow
def test_gradual_drift_from_trained_version_pauses_learning(learning_service, tmp_path):
    """Every label is one standard deviation from the prediction; undetected, 700 batches moved it by two."""
    home = tmp_path / "home"
    number, reply = 0, {"held": False}
    with learning_models.start_service(home, learning_service.trained) as first:
        learning_model = first.create_model("led-away", **STRICT_OPTIONS, on_change="hold")
        queries = slice_recording(make_recording(samples=20_000), 0, 200)
        before = learning_model.predict({name: queries[name] for name in ("q", "dq", "ddq")})
        for number in range(5):
            assert send_shifted_predictions(learning_model, number)[0]["accepted"] == BATCH_ROWS
    # the accumulated drift survives a restart
    with learning_models.start_service(home, learning_service.trained) as second:
        learning_model = LearningModel(second.client, "led-away")
        while not reply["held"] and number < 90:
            number += 1
            reply = send_shifted_predictions(learning_model, number)[0]
        assert reply["held"]
        assert number < 45  # 0.5 per row and ten rows a second take 12 batches, plus some for the stated uncertainty
        (alarm,) = learning_model.get("alarms")["items"]
        assert "has slowly drifted from the training of version 1" in alarm["message"]
        held = learning_model.get("learning")["status"]["held"]
        assert held["evidence"]["cause"] == "drift against the trained version"
        assert held["evidence"]["trained"]["version"] == 1
        assert held["evidence"]["kind"] == "departure"
        after = learning_model.predict({name: queries[name] for name in ("q", "dq", "ddq")})
        moved = np.abs(np.array(after["tau"]) - before["tau"]) - np.array(before["tau_std"])
        assert np.maximum(moved, 0).mean() < 0.5 * np.max(after["noise_std"])
        learning_model.post("learning/change", {"decision": "ignore"})
        assert not send_recording(learning_model, range(number + 1, number + 2))[0]["held"]


def empty_record():
    return Record.empty(1)


def make_predicted_batch(count, external_torque, first=0.0):
    """Return predicted rows of one joint at 100 Hz with an external torque in standard deviations."""
    rng = np.random.default_rng(int(first * 100) + count)
    tau = rng.standard_normal((count, 1)) + external_torque
    time = first + np.arange(count) / 100
    zeros = np.zeros((count, 1))
    rows = Rows(time, zeros, zeros + 0.1, zeros, tau, np.zeros(count, np.uint8))
    every = np.ones(count, np.bool_)
    return PredictedBatch(rows, slice(0, count), every, every, zeros, zeros, zeros, np.ones(1), 1, np.ones(1))


def test_open_gate_closes_once_rows_fit():
    options = JudgeOptions(on_change="learn")
    stream, model, opened = StreamRecord(ContactGate.start().let_all_pass()), ModelRecord(Innovations.empty(1)), []
    for second in range(5):
        judgement = judging.judge(
            make_predicted_batch(100, 0.0, second), stream, model, options, empty_record, second + 1.0
        )
        stream, model = judgement.stream, judgement.model
        opened.append(stream.gate.is_open)
    assert opened == [True, True, False, False, False]
    hit = judging.judge(make_predicted_batch(10, 20.0, 5.0), stream, model, options, empty_record, 5.1)
    assert hit.rows.rejected() == {"contact": 10}


COMPARED_FIELDS = ("detector", "departure", "held")


def to_comparable(value: Any) -> Any:
    """Return a value as strings and numbers that compare bit by bit."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_comparable(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return value.tobytes().hex()
    if isinstance(value, (list, tuple)):
        return [to_comparable(each) for each in value]
    return {key: to_comparable(each) for key, each in value.items()} if isinstance(value, dict) else repr(value)


def monitor_state(monitor: Monitor) -> dict[str, Any]:
    return {name: to_comparable(getattr(monitor.record, name)) for name in COMPARED_FIELDS} | {
        "number": monitor.number,
        "windows": [to_comparable(window._buckets) for window in monitor.windows],
        "streams": to_comparable(dict(monitor.streams.all())),
    }


@dataclasses.dataclass(frozen=True)
class MonitorPair:
    """Monitor of a service, and one that follows the log of the same model from its start."""

    learning_service: Any
    learning_model: Any
    follower: Monitor

    def is_equal(self) -> bool:
        with self.learning_service.service.database.session() as session:
            self.follower.follow(session, self.learning_model.name)
        return monitor_state(self.follower) == monitor_state(
            self.learning_service.service.learners.monitor(self.learning_model.name)
        )


@pytest.fixture
def monitors(learning_service, request):
    """Both monitors, with one model per test."""
    learning_model = learning_service.create_model(
        request.node.name.replace("_", "-")[:60], **STRICT_OPTIONS, on_change="hold"
    )
    monitor = learning_service.service.learners.monitor(learning_model.name)
    return MonitorPair(learning_service, learning_model, Monitor(monitor.joint_names))


def test_monitors_agree_over_collision_change_and_decision(monitors):
    """The follower reads any number of batches at a time, each once and in order."""
    learning_model = monitors.learning_model
    send_recording(learning_model, range(8))
    assert monitors.is_equal()
    send_recording(learning_model, range(8), noise=NOISE_NM, stream_id="other")
    send_recording(learning_model, range(8, 9), external_torque=EXTERNAL_TORQUE_NM)
    assert monitors.is_equal()
    send_recording(learning_model, range(9, 16), external_torque=EXTERNAL_TORQUE_NM)
    assert monitors.follower.record.held is False
    assert monitors.is_equal()
    assert monitors.follower.record.held is True
    learning_model.post("learning/change", {"decision": "adapt"})
    # its gate is open too, and no batch of "arm" has arrived since
    send_recording(learning_model, range(8, 10), stream_id="other")
    assert monitors.is_equal()
    assert monitors.follower.streams.get("arm").gate.is_open
    send_recording(learning_model, range(16, 19), external_torque=EXTERNAL_TORQUE_NM)
    send_recording(learning_model, range(19, 25))
    assert monitors.is_equal()


def test_rebuilt_monitor_restores_contact_gates(monitors):
    send_recording(monitors.learning_model, range(6))
    send_recording(monitors.learning_model, range(6, 8), external_torque=EXTERNAL_TORQUE_NM)  # one second of contact
    service = monitors.learning_service.service
    with service.database.session() as session:
        names = monitors.follower.joint_names
        again = Monitor.rebuilt(session, monitors.learning_model.name, names, time.time())
    assert again.streams.get("arm").gate.patience.contacts > 0
    assert monitor_state(again) == monitor_state(service.learners.monitor(monitors.learning_model.name))


@pytest.mark.parametrize(
    ("rows", "rate", "compared"), [(10, 100.0, 10), (100, 1000.0, 10), (400, 100.0, 160), (0, 100.0, 0)]
)
def test_fast_streams_compare_few_rows_with_trained_version(rows, rate, compared):
    """Ten rows a second are independent (`data.independence`): four per independent row, and at least ten per batch."""
    places = screening.choose_compared(np.full(rows, 10.0 / rate))
    assert len(places) == len(set(places.tolist())) == compared
    if rows:
        assert (places[0], places[-1]) == (0, rows - 1)
