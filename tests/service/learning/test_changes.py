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


def send_recording(
    learning_model: LearningModel, numbers: range, external_torque: float = 0.0, noise: float = 0.0, **more: Any
) -> list[dict[str, Any]]:
    """Send batches of a recording with added torque: constant, or noise."""
    rows = make_recording(samples=4000)
    rng = np.random.default_rng(numbers.start)
    replies = []
    for number in numbers:
        body = slice_recording(rows, number * BATCH_ROWS, (number + 1) * BATCH_ROWS)
        tau = np.array(body["tau"]) + external_torque + noise * rng.standard_normal((BATCH_ROWS, 2))
        replies.append(send_batch(learning_model, number, body | {"tau": tau.tolist()}, **more))
    return replies


def create_pausing_model(learning_service, on_change="hold"):
    """Return a model that has learnt ten batches and pauses at a change."""
    learning_model = learning_service.create_model(**STRICT_OPTIONS, on_change=on_change)
    assert all(reply["rejected"] == {} for reply in send_recording(learning_model, range(10)))
    return learning_model


def send_pushed(learning_model, *numbers):
    """Send the batches of a range with an external torque; return the replies."""
    return send_recording(learning_model, range(*numbers), external_torque=EXTERNAL_TORQUE_NM)


def test_collision_is_rejected_without_alarm(learning_service):
    learning_model = create_pausing_model(learning_service)
    (hit,) = send_pushed(learning_model, 10, 11)
    after = send_recording(learning_model, range(11, 20))
    assert (hit["accepted"], hit["rejected"], hit["held"]) == (0, {"contact": BATCH_ROWS}, False)
    assert all(reply["rejected"] == {} for reply in after)
    assert learning_model.get("alarms")["items"] == []


def test_payload_is_rejected_as_contact_then_as_change_with_alarm(learning_service):
    learning_model = create_pausing_model(learning_service)
    learning_model.wait_for_revision(10)
    replies = send_pushed(learning_model, 10, 20)
    codes = [next(iter(each["rejected"])) for each in replies]
    assert [each["accepted"] for each in replies] == [0] * 10
    first = codes.index("change")
    assert codes == ["contact"] * first + ["change"] * (10 - first)
    assert 4 <= first <= 5  # two seconds of patience
    assert [each["held"] for each in replies] == [False] * first + [True] * (10 - first)

    (alarm,) = (each for each in learning_model.get("alarms")["items"] if each["kind"] == "change")
    assert alarm["kind"] == "change"
    assert "joint1, joint2" in alarm["message"]
    assert "Learning is paused until you decide." in alarm["message"]
    evidence = alarm["evidence"]
    assert evidence["joints"] == ["joint1", "joint2"]
    assert evidence["suspect"] == "payload or contact"
    assert (evidence["stream_id"], evidence["sequence"]) == ("arm", 10 + first)
    for joint in evidence["per_joint"].values():
        assert joint["innovation"]["after"] == pytest.approx(EXTERNAL_TORQUE_NM, abs=0.05)
        assert abs(joint["innovation"]["before"]) < 0.02
        assert joint["standardised"]["after"] > 100 * joint["standardised"]["before"]
    held = learning_model.get("learning")["status"]["held"]
    assert held["evidence"] == evidence
    assert held["at"] == evidence["at"]
    entry = learning_model.last_audit_entry()
    assert (entry["change"], entry["after"]["at"]) == ("learning held", held["at"])
    assert entry["what"] == "POST /v1/models/{model}/observations"


def test_rejected_and_rolled_back_rows_leave_predictions_bitwise_unchanged(learning_service):
    """Covers an ignored change, a pause, and rows that were learnt and rolled back."""
    learning_model = create_pausing_model(learning_service)

    def predict_at(revision):
        return {**learning_model.wait_for_revision(revision), "revision": None}

    before = predict_at(10)
    changed = send_pushed(learning_model, 10, 16)[-1]
    assert changed["held"]
    assert predict_at(changed["revision"]) == before
    learning_model.post("learning/change", {"decision": "ignore"})
    assert learning_model.list_alarm_events() == [("alarm.raised", "change"), ("alarm.cleared", "change")]
    assert predict_at(changed["revision"]) == before
    options = learning_model.get("learning")["options"]
    learning_model.put("learning", {**options, "enabled": False})
    paused = send_recording(learning_model, range(16, 18))[-1]
    learning_model.put("learning", {**options, "enabled": True})
    assert predict_at(paused["revision"]) == before
    learnt = send_recording(learning_model, range(18, 20))[-1]
    assert learnt["accepted"] == BATCH_ROWS
    assert predict_at(learnt["revision"]) != before
    back = learning_model.post("rollback", {"revision": paused["revision"]})
    assert predict_at(back["revision"]) == before


@pytest.mark.slow
def test_changed_robot_is_learnt_after_decision_to_adapt(learning_service):
    learning_model = create_pausing_model(learning_service)
    assert send_pushed(learning_model, 10, 16)[-1]["held"]
    learning_model.post("learning/change", {"decision": "adapt"})
    for number in range(16, 30):
        (reply,) = send_pushed(learning_model, number, number + 1)
        assert (reply["rejected"], reply["held"]) == ({}, False)
        learning_model.wait_for_revision(reply["revision"])
    assert len(learning_model.get("alarms")["items"]) == 1
    # after learning the change, contacts are detected again
    (hit,) = send_recording(learning_model, range(30, 31), external_torque=20 * EXTERNAL_TORQUE_NM)
    assert hit["rejected"] == {"contact": BATCH_ROWS}


def test_adapt_starts_new_regime_before_the_detecting_batch(learning_service):
    learning_model = create_pausing_model(learning_service, on_change="adapt")
    replies = send_pushed(learning_model, 10, 20)
    first = next(place for place, each in enumerate(replies) if not each["rejected"])
    assert 4 <= first <= 5
    assert all(each["accepted"] == BATCH_ROWS for each in replies[first:])
    assert not any(each["held"] for each in replies)
    with learning_service.service.database.session() as session:
        events = log.events(session, learning_model.name, 0, 1000)
    (change,) = (event for event in events if event.kind == "change")
    assert replies[first]["revision"] == change.number + 1
    assert change.detail["t"] == pytest.approx(learning_model.find_batch(10).first, abs=0.02)
    assert "The model adapts" in learning_model.get("alarms")["items"][0]["message"]
    entry = learning_model.last_audit_entry()
    assert (entry["change"], entry["before"]["at"]) == ("change decided", change.detail["t"])
    assert entry["after"] == {"decision": "adapt"}
    learning_model.wait_for_revision(replies[-1]["revision"])
    query = slice_recording(make_recording(samples=4000), 900, 950)
    error = np.array(learning_model.predict_motion(query)["tau"]) - query["tau"] - EXTERNAL_TORQUE_NM
    assert np.sqrt((error**2).mean()) < 0.1


@pytest.mark.slow
def test_small_persistent_errors_are_detected_as_change(learning_service, monkeypatch):
    """Errors of a few standard deviations are no contacts, but together they are a change.

    They contain nothing to learn: the stated uncertainty grows until they fit, which must not hide them.
    """
    learning_model = learning_service.create_model(**STRICT_OPTIONS, on_change="hold")
    arrivals = (time.time() + 0.5 * number for number in range(80))  # rows arrive as they are measured
    monkeypatch.setattr(learning_service.service.learners._log.clocks, "date_arrival", lambda: next(arrivals))
    learning_model.wait_for_revision(send_recording(learning_model, range(60))[-1]["revision"])
    for number in range(60, 80):
        (reply,) = send_recording(learning_model, range(number, number + 1), noise=NOISE_NM)
        assert reply["held"] or reply["accepted"] > 0.6 * BATCH_ROWS
        learning_model.wait_for_revision(reply["revision"])
    assert reply["held"]
    for joint in learning_model.get("learning")["status"]["held"]["evidence"]["per_joint"].values():
        assert joint["rmse"]["after"] == pytest.approx(NOISE_NM, rel=0.3)


@pytest.mark.slow
def test_pause_and_decision_survive_restart(learning_service, tmp_path):
    def start_service():
        return learning_models.start_service(tmp_path / "home", learning_service.trained)

    with start_service() as first:
        learning_model = create_pausing_model(first)
        send_pushed(learning_model, 10, 16)
    with start_service() as second:
        learning_model = LearningModel(second.client, learning_model.name)
        assert send_pushed(learning_model, 16, 17)[0]["held"]
        learning_model.post("learning/change", {"decision": "ignore"})
    with start_service() as third:
        learning_model = LearningModel(third.client, learning_model.name)
        # the gate is open although this service did not receive the decision
        (reply,) = send_pushed(learning_model, 17, 18)
        assert (reply["rejected"], reply["held"]) == ({}, False)
        assert read_codes(third, learning_model)[-BATCH_ROWS:] == ["learnt"] * BATCH_ROWS


def send_shifted_predictions(learning_model: LearningModel, number: int) -> dict[str, Any]:
    """Send a batch labelled with the predicted torque plus one standard deviation; return the reply."""
    body = slice_recording(make_recording(samples=20_000), number * BATCH_ROWS, (number + 1) * BATCH_ROWS)
    seen = learning_model.predict_motion(body)
    tau = np.array(seen["tau"]) + np.hypot(seen["tau_std"], seen["noise_std"])
    reply = send_batch(learning_model, number, body | {"tau": tau.tolist()})
    learning_model.wait_for_revision(reply["revision"])
    return reply


@pytest.mark.slow
def test_gradual_drift_from_trained_version_pauses_learning(learning_service, tmp_path):
    """Every label is one standard deviation from the prediction; undetected, 700 batches moved it by two."""
    home = tmp_path / "home"
    queries = slice_recording(make_recording(samples=20_000), 0, 200)
    number, reply = 4, {"held": False}
    with learning_models.start_service(home, learning_service.trained) as first:
        learning_model = first.create_model("led-away", **STRICT_OPTIONS, on_change="hold")
        before = learning_model.predict_motion(queries)
        for sequence in range(number + 1):
            assert send_shifted_predictions(learning_model, sequence)["accepted"] == BATCH_ROWS
    # the accumulated drift survives a restart
    with learning_models.start_service(home, learning_service.trained) as second:
        learning_model = LearningModel(second.client, "led-away")
        while not reply["held"] and number < 90:
            number += 1
            reply = send_shifted_predictions(learning_model, number)
        assert reply["held"]
        assert number < 45  # 0.5 per row and ten rows a second take 12 batches, plus some for the stated uncertainty
        (alarm,) = (each for each in learning_model.get("alarms")["items"] if each["kind"] == "change")
        assert "has slowly drifted from the training of version 1" in alarm["message"]
        evidence = learning_model.get("learning")["status"]["held"]["evidence"]
        assert evidence["cause"] == "drift against the trained version"
        assert evidence["trained"]["version"] == 1
        assert evidence["kind"] == "departure"
        after = learning_model.predict_motion(queries)
        moved = np.abs(np.array(after["tau"]) - before["tau"]) - np.array(before["tau_std"])
        assert np.maximum(moved, 0).mean() < 0.5 * np.max(after["noise_std"])
        learning_model.post("learning/change", {"decision": "ignore"})
        assert not send_recording(learning_model, range(number + 1, number + 2))[0]["held"]


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

    def judge(batch, at):
        return judging.judge(batch, stream, model, options, lambda: Record.empty(1), at)

    for second in range(5):
        judgement = judge(make_predicted_batch(100, 0.0, second), second + 1.0)
        stream, model = judgement.stream, judgement.model
        opened.append(stream.gate.is_open)
    assert opened == [True, True, False, False, False]
    assert judge(make_predicted_batch(10, 20.0, 5.0), 5.1).rows.rejected() == {"contact": 10}


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


def test_monitors_agree_over_collision_change_and_decision(learning_service):
    """Another monitor reads the log from its start, any number of batches at a time, each once and in order."""
    learning_model = learning_service.create_model(**STRICT_OPTIONS, on_change="hold")
    database, monitor_of = learning_service.service.database, learning_service.service.learners.monitor
    follower = Monitor(monitor_of(learning_model.name).joint_names)

    def assert_agreement():
        with database.session() as session:
            follower.follow(session, learning_model.name)
        assert monitor_state(follower) == monitor_state(monitor_of(learning_model.name))

    send_recording(learning_model, range(8))
    assert_agreement()
    send_recording(learning_model, range(8), noise=NOISE_NM, stream_id="other")
    send_pushed(learning_model, 8, 9)
    assert_agreement()
    send_pushed(learning_model, 9, 16)
    assert follower.record.held is False
    assert_agreement()
    assert follower.record.held is True
    learning_model.post("learning/change", {"decision": "adapt"})
    # its gate is open too, and no batch of "arm" has arrived since
    send_recording(learning_model, range(8, 10), stream_id="other")
    assert_agreement()
    assert follower.streams.get("arm").gate.is_open
    send_pushed(learning_model, 16, 19)
    send_recording(learning_model, range(19, 25))
    assert_agreement()


def test_rebuilt_monitor_restores_contact_gates(learning_service):
    learning_model = learning_service.create_model(**STRICT_OPTIONS, on_change="hold")
    send_recording(learning_model, range(6))
    send_pushed(learning_model, 6, 8)  # one second of contact
    monitor = learning_service.service.learners.monitor(learning_model.name)
    with learning_service.service.database.session() as session:
        again = Monitor.rebuilt(session, learning_model.name, monitor.joint_names, time.time())
    assert again.streams.get("arm").gate.patience.contacts > 0
    assert monitor_state(again) == monitor_state(monitor)


@pytest.mark.parametrize(
    ("rows", "rate", "compared"), [(10, 100.0, 10), (100, 1000.0, 10), (400, 100.0, 160), (0, 100.0, 0)]
)
def test_fast_streams_compare_few_rows_with_trained_version(rows, rate, compared):
    """Ten rows a second are independent (`data.independence`): four per independent row, and at least ten per batch."""
    places = screening.choose_compared(np.full(rows, 10.0 / rate))
    assert len(places) == len(set(places.tolist())) == compared
    if rows:
        assert (places[0], places[-1]) == (0, rows - 1)
