"""A robot that changes: told from a collision, told to its owner, and followed as the owner has chosen."""

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
from tests.service.learning import lessons
from tests.service.learning.lessons import Pupil
from tests.service.learning.recordings import codes, part, recording, send

BATCH = 50
"""Rows of half a second."""
PUSH = 0.5
"""N·m: fifty times the noise."""
RATTLE = 0.035
"""N·m: four times the noise."""
WATCHFUL = {"contact_threshold": 8.0}


def events(school, pupil):
    with school.service.database.session() as session:
        return [(event.number, event.kind, event.detail) for event in log.events(session, pupil.model, 0, 1000)]


def drive(
    pupil: Pupil, numbers: range, push: float = 0.0, ramp: float = 0.0, noise: float = 0.0, **more: Any
) -> list[dict[str, Any]]:
    """Send half seconds of a recording, with torque added: constant, rising by so much a second, or noise."""
    rows = recording(samples=4000)
    rng = np.random.default_rng(numbers.start)
    said = []
    for number in numbers:
        body = part(rows, number * BATCH, (number + 1) * BATCH)
        tau = np.array(body["tau"]) + push + noise * rng.standard_normal((BATCH, 2))
        tau += ramp * np.arange(BATCH)[:, None] / 100
        said.append(send(pupil, number, body | {"tau": tau.tolist()}, **more))
    return said


def test_a_collision_is_kept_out_and_raises_no_alarm(school):
    pupil = school.enrol("collision", **WATCHFUL)
    drive(pupil, range(10))
    (hit,) = drive(pupil, range(10, 11), push=PUSH)
    after = drive(pupil, range(11, 20))
    assert (hit["accepted"], hit["rejected"], hit["held"]) == (0, {"contact": BATCH}, False)
    assert all(said["rejected"] == {} for said in after)
    assert pupil.get("alarms")["items"] == []


@pytest.fixture(scope="module")
def loaded(school):
    """A model whose robot has taken up a payload, held for its owner's decision; and what was said since."""
    pupil = school.enrol("payload", **WATCHFUL, on_change="hold")
    usual = drive(pupil, range(10))
    assert all(said["rejected"] == {} for said in usual)
    before = pupil.settled(10)
    return pupil, drive(pupil, range(10, 20), push=PUSH), before


def test_a_payload_is_first_taken_for_a_contact_and_then_for_a_change(school, loaded):
    _, said, _ = loaded
    kept_out = [next(iter(each["rejected"])) for each in said]
    assert [each["accepted"] for each in said] == [0] * 10
    first = kept_out.index("change")
    assert kept_out == ["contact"] * first + ["change"] * (10 - first)
    assert 4 <= first <= 5  # two seconds of patience
    assert [each["held"] for each in said] == [False] * first + [True] * (10 - first)


def test_the_owner_is_told_with_the_evidence(loaded):
    pupil, said, _ = loaded
    (alarm,) = pupil.get("alarms")["items"]
    assert alarm["kind"] == "change"
    assert "joint1, joint2" in alarm["message"]
    assert "nothing is learnt until its owner has decided" in alarm["message"]
    evidence = alarm["evidence"]
    assert evidence["joints"] == ["joint1", "joint2"]
    assert evidence["suspect"] == "payload or contact"
    assert (evidence["stream_id"], evidence["sequence"]) == ("arm", 10 + [each["held"] for each in said].index(True))
    for joint in evidence["per_joint"].values():
        assert joint["innovation"]["after"] == pytest.approx(PUSH, abs=0.05)
        assert abs(joint["innovation"]["before"]) < 0.02
        assert joint["standardised"]["after"] > 100 * joint["standardised"]["before"]
    held = pupil.get("learning")["status"]["held"]
    assert held["evidence"] == evidence
    assert held["at"] == evidence["at"]
    line = pupil.client.get("/v1/audit", params={"model": pupil.model}).json()["items"][0]
    assert (line["change"], line["after"]["at"]) == ("learning held", held["at"])
    assert line["what"] == "POST /v1/models/{model}/observations"


def test_what_is_kept_out_ignored_or_taken_back_leaves_no_trace_in_answers_to_the_bit(school):
    """A change whose rows the owner leaves out, a pause, and rows that were learnt and rolled back."""
    pupil = school.enrol("untouched", **WATCHFUL, on_change="hold")
    drive(pupil, range(10))
    answers = {name: value for name, value in pupil.settled(10).items() if name != "revision"}

    def unchanged(revision):
        seen = pupil.settled(revision)
        return {name: value for name, value in seen.items() if name != "revision"} == answers

    doubted = drive(pupil, range(10, 16), push=PUSH)
    assert doubted[-1]["held"]
    assert unchanged(doubted[-1]["revision"])
    pupil.post("learning/change", {"decision": "ignore"})
    assert unchanged(doubted[-1]["revision"])
    options = pupil.get("learning")["options"]
    pupil.put("learning", {**options, "enabled": False})
    paused = drive(pupil, range(16, 18))
    pupil.put("learning", {**options, "enabled": True})
    assert unchanged(paused[-1]["revision"])
    learnt = drive(pupil, range(18, 20))[-1]
    assert learnt["accepted"] == BATCH
    assert not unchanged(learnt["revision"])
    back = pupil.post("rollback", {"revision": paused[-1]["revision"]})
    assert unchanged(back["revision"])


@pytest.mark.slow
def test_after_a_decision_the_changed_robot_is_learnt(school):
    pupil = school.enrol("decided", **WATCHFUL, on_change="hold")
    drive(pupil, range(10))
    assert drive(pupil, range(10, 16), push=PUSH)[-1]["held"]
    pupil.post("learning/change", {"decision": "adapt"})
    for number in range(16, 30):
        (said,) = drive(pupil, range(number, number + 1), push=PUSH)
        assert (said["rejected"], said["held"]) == ({}, False)
        pupil.settled(said["revision"])
    assert len(pupil.get("alarms")["items"]) == 1
    # learnt anew, contacts are contacts again
    assert drive(pupil, range(30, 31), push=20 * PUSH)[0]["rejected"] == {"contact": BATCH}


def test_adapting_begins_a_new_regime_before_the_batch_that_told(school):
    pupil = school.enrol("adapting", **WATCHFUL, on_change="adapt")
    drive(pupil, range(10))
    said = drive(pupil, range(10, 20), push=PUSH)
    first = next(place for place, each in enumerate(said) if not each["rejected"])
    assert 4 <= first <= 5
    assert all(each["accepted"] == BATCH for each in said[first:])
    assert not any(each["held"] for each in said)
    changes = [event for event in events(school, pupil) if event[1] == "change"]
    (number, _, detail) = changes[0]
    assert len(changes) == 1
    assert said[first]["revision"] == number + 1
    with school.service.database.session() as session:
        assert detail["t"] == pytest.approx(log.find_batch(session, pupil.model, "arm", 10).first, abs=0.02)
    alarm = pupil.get("alarms")["items"][0]
    assert "a new regime begins" in alarm["message"]
    line = pupil.client.get("/v1/audit", params={"model": pupil.model}).json()["items"][0]
    assert (line["change"], line["before"]["at"], line["after"]) == (
        "change decided",
        detail["t"],
        {"decision": "adapt"},
    )
    pupil.settled(said[-1]["revision"])
    rows = recording(samples=4000)
    query = part(rows, 900, 950)
    answer = pupil.predict({name: query[name] for name in ("q", "dq", "ddq")})
    error = np.array(answer["tau"]) - np.array(query["tau"]) - PUSH
    assert np.sqrt((error**2).mean()) < 0.1


@pytest.mark.slow
def test_errors_below_a_contact_are_a_change_too(school, monkeypatch):
    """What is off by a few standard deviations passes as no contact; together it is told.

    The errors are such that nothing can be learnt of them: the stated uncertainty grows until they fit, which must not
    hide them.
    """
    pupil = school.enrol("rattling", **WATCHFUL, on_change="hold")
    arrivals = (time.time() + 0.5 * number for number in range(80))  # as late as the rows were measured
    monkeypatch.setattr(school.service.learners._log.clocks, "date_arrival", lambda: next(arrivals))
    pupil.settled(drive(pupil, range(60))[-1]["revision"])
    for number in range(60, 80):
        (said,) = drive(pupil, range(number, number + 1), noise=RATTLE)
        assert said["held"] or said["accepted"] > 0.6 * BATCH
        pupil.settled(said["revision"])
    assert said["held"]
    evidence = pupil.get("learning")["status"]["held"]["evidence"]
    for joint in evidence["per_joint"].values():
        assert joint["rmse"]["after"] == pytest.approx(RATTLE, rel=0.3)


@pytest.mark.slow
def test_a_service_that_starts_again_still_waits_and_still_follows(school, tmp_path):
    home = tmp_path / "home"
    with lessons.school(home, school.trained) as first:
        pupil = first.enrol("arm", **WATCHFUL, on_change="hold")
        drive(pupil, range(10))
        drive(pupil, range(10, 16), push=PUSH)
    with lessons.school(home, school.trained) as second:
        pupil = Pupil(second.client, "arm")
        assert drive(pupil, range(16, 17), push=PUSH)[0]["held"]
        pupil.post("learning/change", {"decision": "ignore"})
    with lessons.school(home, school.trained) as third:
        pupil = Pupil(third.client, "arm")
        # the gate stands back although this service has not seen the decision
        (said,) = drive(pupil, range(17, 18), push=PUSH)
        assert (said["rejected"], said["held"]) == ({}, False)
        assert codes(third, pupil)[-BATCH:] == ["learnt"] * BATCH


def flatter(pupil: Pupil, number: int) -> tuple[dict[str, Any], np.ndarray]:
    """Send half a second of the recording labelled with what the model answers and one standard deviation more; return
    what was said, and the answers."""
    body = part(recording(samples=20_000), number * BATCH, (number + 1) * BATCH)
    seen = pupil.predict({name: body[name] for name in ("q", "dq", "ddq")})
    tau, std = (np.array(seen[name]) for name in ("tau", "tau_std"))
    said = send(pupil, number, body | {"tau": (tau + np.hypot(std, seen["noise_std"])).tolist()})
    pupil.settled(said["revision"])
    return said, tau


@pytest.mark.slow
def test_who_leads_a_model_away_step_by_step_is_stopped(school, tmp_path):
    """Every label is one standard deviation from what is answered; 700 batches moved the answer by two of them."""
    home = tmp_path / "home"
    number, said = 0, {"held": False}
    with lessons.school(home, school.trained) as first:
        pupil = first.enrol("led-away", **WATCHFUL, on_change="hold")
        queries = part(recording(samples=20_000), 0, 200)
        before = pupil.predict({name: queries[name] for name in ("q", "dq", "ddq")})
        for number in range(5):
            assert flatter(pupil, number)[0]["accepted"] == BATCH
    with lessons.school(home, school.trained) as second:  # what has added up so far is not forgotten
        pupil = Pupil(second.client, "led-away")
        while not said["held"] and number < 90:
            number += 1
            said = flatter(pupil, number)[0]
        assert said["held"]
        assert number < 45  # at 0.5 a row and ten rows a second it takes 12 batches, and some for what is stated
        (alarm,) = pupil.get("alarms")["items"]
        assert "has left what version 1 was trained on" in alarm["message"]
        held = pupil.get("learning")["status"]["held"]
        assert held["evidence"]["cause"] == "drift against the trained version"
        assert held["evidence"]["trained"]["version"] == 1
        assert held["evidence"]["kind"] == "departure"
        after = pupil.predict({name: queries[name] for name in ("q", "dq", "ddq")})
        moved = np.abs(np.array(after["tau"]) - before["tau"]) - np.array(before["tau_std"])
        assert np.maximum(moved, 0).mean() < 0.5 * np.max(after["noise_std"])
        pupil.post("learning/change", {"decision": "ignore"})
        assert not drive(pupil, range(number + 1, number + 2))[0]["held"]


def nothing():
    return Record.empty(1)


def screened(count, push, first=0.0):
    """Rows of one joint at 100 Hz whose answers are right but for a push in standard deviations."""
    rng = np.random.default_rng(int(first * 100) + count)
    tau = rng.standard_normal((count, 1)) + push
    time = first + np.arange(count) / 100
    zeros = np.zeros((count, 1))
    rows = Rows(time, zeros, zeros + 0.1, zeros, tau, np.zeros(count, np.uint8))
    every = np.ones(count, np.bool_)
    return PredictedBatch(rows, slice(0, count), every, every, zeros, zeros, zeros, np.ones(1), 1, np.ones(1))


def test_a_gate_that_stood_back_returns_once_rows_fit():
    options = JudgeOptions(on_change="learn")
    stream, model, opened = StreamRecord(ContactGate.start().let_all_pass()), ModelRecord(Innovations.empty(1)), []
    for second in range(5):
        judgement = judging.judge(screened(100, 0.0, second), stream, model, options, nothing, second + 1.0)
        stream, model = judgement.stream, judgement.model
        opened.append(stream.gate.is_open)
    assert opened == [True, True, False, False, False]
    hit = judging.judge(screened(10, 20.0, 5.0), stream, model, options, nothing, 5.1)
    assert hit.rows.rejected() == {"contact": 10}


HIDDEN = ("detector", "departure", "held")


def comparable(value: Any) -> Any:
    """A value as texts and numbers that compare bit for bit."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: comparable(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return value.tobytes().hex()
    if isinstance(value, (list, tuple)):
        return [comparable(each) for each in value]
    return {key: comparable(each) for key, each in value.items()} if isinstance(value, dict) else repr(value)


def state(monitor: Monitor) -> dict[str, Any]:
    return {name: comparable(getattr(monitor.record, name)) for name in HIDDEN} | {
        "number": monitor.number,
        "windows": [comparable(window._buckets) for window in monitor.windows],
        "streams": comparable(dict(monitor.streams.all())),
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
    return Beside(school, pupil, Monitor(monitor.joint_names))


def test_a_collision_a_change_and_a_decision(beside):
    """Looked at after any number of batches: each is taken in once and in order."""
    pupil = beside.pupil
    drive(pupil, range(8))
    assert beside.agree()
    drive(pupil, range(8), noise=RATTLE, stream_id="other")
    drive(pupil, range(8, 9), push=PUSH)
    assert beside.agree()
    drive(pupil, range(9, 16), push=PUSH)
    assert beside.follower.record.held is False
    assert beside.agree()
    assert beside.follower.record.held is True
    pupil.post("learning/change", {"decision": "adapt"})
    drive(pupil, range(8, 10), stream_id="other")  # its gate stands back too, and no batch of "arm" has come since
    assert beside.agree()
    assert beside.follower.streams.get("arm").gate.is_open
    drive(pupil, range(16, 19), push=PUSH)
    drive(pupil, range(19, 25))
    assert beside.agree()


def test_a_monitor_of_a_service_that_starts_again_has_the_gates_as_they_were(beside):
    drive(beside.pupil, range(6))
    drive(beside.pupil, range(6, 8), push=PUSH)  # a contact that has lasted for a second
    service = beside.school.service
    with service.database.session() as session:
        names = beside.follower.joint_names
        again = Monitor.rebuilt(session, beside.pupil.model, names, time.time())
    assert again.streams.get("arm").gate.patience.contacts > 0
    assert state(again) == state(service.learners.monitor(beside.pupil.model))


@pytest.mark.parametrize(
    ("rows", "rate", "compared"), [(10, 100.0, 10), (100, 1000.0, 10), (400, 100.0, 160), (0, 100.0, 0)]
)
def test_of_a_fast_stream_a_few_rows_are_compared_with_the_version_as_trained(rows, rate, compared):
    """Ten a second count (`data.independence`): at least four for each of these, and ten of a batch."""
    places = screening.choose_compared(np.full(rows, 10.0 / rate))
    assert len(places) == len(set(places.tolist())) == compared
    if rows:
        assert (places[0], places[-1]) == (0, rows - 1)
