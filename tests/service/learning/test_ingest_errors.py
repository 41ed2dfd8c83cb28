"""Batches that are refused with the place of what is wrong, and rows that are kept out as if they had not come."""

from dataclasses import replace

import numpy as np
import pytest

import lipcore
from lipcore.robots.urdf import RigidBody
from service.contract.observations import LearningOptions
from service.foundation.settings import Settings
from service.journal import log, snapshots
from service.learning.ingest.observations import MAX_ROWS, row_limits
from tests.service.learning.lessons import apart
from tests.service.learning.recordings import batch, codes, learnt_from, logged, part, recording, send


@pytest.fixture(scope="module")
def body():
    return part(recording(), 0, 6)


@pytest.fixture(scope="module")
def pupil(school):
    """A model that is taught nothing."""
    made = school.enrol("refusing")
    yield made
    assert logged(school, made) == []
    assert made.get("learning")["status"]["streams"] == []


def refused(pupil, sent, status=422, code="invalid_request"):
    return pupil.refused("POST", "observations", status, code, json=sent)


@pytest.mark.parametrize(
    ("name", "rows", "field"),
    [
        ("tau", [[0.0, 0.0]] * 5, "tau"),
        ("tau", [[0.0]] * 6, "tau"),
        ("q", [[0.0, 0.0]] * 5, "dq"),  # where q is another shape than all others, the first of the others is named
        ("ddq", [[0.0, 0.0]] * 5 + [[0.0]], "ddq[5]"),
        ("dq", [[0.0, 0.0]] * 5 + [0.0], "dq[5]"),
        ("tau", [[0.0, 0.0]] * 5 + [[0.0, "1"]], "tau[5][1]"),
    ],
)
def test_numbers_come_in_rows_of_one_shape(pupil, body, name, rows, field):
    assert refused(pupil, batch(0, body | {name: rows}))["detail"][0]["field"] == field


@pytest.mark.parametrize(
    ("names", "field", "value"),
    [
        (["joint1", "joint1"], "joint_names[1]", "joint1"),
        (["joint2"], "joint_names", "without joint1"),
        (["joint1", "joint2", "gripper"], "joint_names[2]", "gripper"),
    ],
)
def test_joints_are_those_of_the_model(pupil, body, names, field, value):
    said = refused(pupil, batch(0, body, joint_names=names))
    assert said["detail"][0]["field"] == field
    assert said["detail"][0]["value"] == value


def test_accelerations_or_times_are_needed(pupil, body):
    said = refused(pupil, batch(0, body, t=None, ddq=None))
    assert said["detail"][0]["field"] == "ddq"
    assert "times to derive them from" in said["message"]


def test_too_many_rows(pupil):
    most = MAX_ROWS
    rows = [[0.1, 0.1]] * (most + 1)
    said = refused(pupil, batch(0, dict.fromkeys(("q", "dq", "ddq", "tau"), rows)))
    assert said["detail"] == [{"field": "q", "value": f"{most + 1} rows", "expected": f"at most {most} in one batch"}]


def test_while_learning_is_paused_rows_are_compared_and_logged_and_can_be_learnt_later(school, body):
    pupil = school.enrol("paused-ingest")
    before = pupil.settled(0)
    pupil.put("learning", {"enabled": False})
    said = send(pupil, 0, body)
    assert (said["accepted"], said["effective_samples"], said["rejected"]) == (0, 0.0, {"paused": said["rows"]})
    assert pupil.get("quality")["windows"][0]["rows"] == said["rows"]
    assert pupil.settled(1)["tau"] == before["tau"]
    pupil.put("learning", {"enabled": True})
    assert pupil.post("observations/arm/0/replay", {})["codes"] == {"paused": said["rows"]}
    assert send(pupil, 1, part(recording(), 20, 24))["accepted"] == 4


def test_batches_that_are_no_longer_kept_are_not_taken_for_new(school, body):
    pupil = school.enrol("expiring")
    parts = [part(recording(), 4 * k, 4 * k + 4) for k in range(6)]
    for sequence in (0, 1, 3, 4, 5):
        send(pupil, sequence, parts[sequence])
    pupil.settled(5)
    with school.service.database.transaction() as session:
        for sequence in (0, 1, 3):
            event = log.find_batch(session, pupil.model, "arm", sequence)
            snapshots._note_forgotten(session, event)
            session.delete(event)
    for sequence in (0, 1, 3):
        said = refused(pupil, batch(sequence, parts[sequence]), 409, "expired")
        assert f"batch {sequence} of stream 'arm'" in said["message"]
    assert send(pupil, 2, parts[2])["duplicate"] is False  # known not to have come
    assert send(pupil, 5, parts[5])["duplicate"] is True


def test_more_streams_than_a_model_may_have(school, body, monkeypatch):
    monkeypatch.setattr("service.learning.ingest.append.MAX_STREAMS", 2)
    pupil, other = school.enrol("popular"), school.enrol("unpopular")
    for stream_id in ("a", "b"):
        send(pupil, 0, body, stream_id)
    said = refused(pupil, batch(0, body, "c"), 429, "busy")
    assert "has 2 sources of observations in use" in said["message"]
    assert send(pupil, 1, part(recording(), 10, 16), "b")["accepted"] == 6
    assert send(other, 0, body, "c")["accepted"] == 6


def test_values_beyond_all_measure_do_no_harm(school, body):
    """Every number of a batch at once, one batch a number: logged, coded, and the model goes on answering."""
    pupil = school.enrol("robust")
    before = pupil.predict()
    numbers = (1e308, -1e308, 1e-308, None)
    for sequence, value in enumerate(numbers):
        said = send(pupil, sequence, {name: [[value] * 2] * 3 for name in ("q", "dq", "ddq", "tau")})
        assert said["accepted"] == 0
    for sequence, text in enumerate(("NaN", "Infinity", "-Infinity", "1e400"), start=len(numbers)):
        row = f"[[{text}, {text}]]"
        numbers_sent = ", ".join(f'"{name}": {row}' for name in ("q", "dq", "ddq", "tau"))
        sent = f'{{"stream_id": "arm", "sequence": {sequence}, "t": [{text}], {numbers_sent}}}'
        answer = pupil.client.post(
            pupil.url("observations"), content=sent, headers={"content-type": "application/json"}
        )
        assert answer.status_code == 200, answer.text
        assert answer.json()["rejected"] == {"non_finite": 1}
    after = pupil.settled(8)
    np.testing.assert_allclose(after["tau"], before["tau"], rtol=1e-9)
    np.testing.assert_allclose(after["tau_std"], before["tau_std"], rtol=1e-6)


EXACT = 1e-8
ROWS = 12
STRICT = {"contact_threshold": 8.0, "on_change": "hold", "torque_limits": [2.0, 2.0]}


def spoilt(body, **changes):
    """Rows with some numbers changed: name=(row, joint, value) or, of times, (row, value)."""
    made = {name: [[*row] if isinstance(row, list) else row for row in rows] for name, rows in body.items()}
    for name, (row, *joint, value) in changes.items():
        if joint:
            made[name][row][joint[0]] = value
        else:
            made[name][row] = value
    return made


def without(body, *rows):
    return {name: [value for row, value in enumerate(values) if row not in rows] for name, values in body.items()}


SPOILT = [
    pytest.param({"q": (3, 1, None)}, "non_finite", id="position null"),
    pytest.param({"t": (3, None)}, "non_finite", id="time null"),
    pytest.param({"q": (3, 1, 12.7)}, "limit", id="position"),
    pytest.param({"dq": (3, 0, -51.0)}, "limit", id="velocity"),
    pytest.param({"ddq": (3, 1, 2001.0)}, "limit", id="acceleration"),
    pytest.param({"tau": (3, 0, -2.01)}, "limit", id="torque"),
    pytest.param({"tau": (3, 0, 1.99)}, "saturation", id="saturation"),
    pytest.param({"tau": (3, 1, -2.0)}, "saturation", id="saturation below"),
    pytest.param({"t": (3, 0.001)}, "time_jump", id="time backwards"),
    pytest.param({"t": (3, 1e9)}, "time_jump", id="time far ahead"),
    pytest.param({"t": (3, -1e9)}, "time_jump", id="time long ago"),
    pytest.param({"tau": (3, 1, -1.5)}, "contact", id="contact"),
]


@pytest.mark.parametrize(("change", "code"), SPOILT)
def test_one_bad_row_is_kept_out_and_all_others_are_learnt(school, request, change, code):
    body = part(recording(), 0, ROWS)
    pupil = school.enrol(f"gate-{request.node.callspec.id.replace(' ', '-')}", **STRICT)
    said = send(pupil, 0, spoilt(body, **change))
    assert (said["rows"], said["accepted"], said["rejected"]) == (ROWS, ROWS - 1, {code: 1})
    assert codes(school, pupil) == ["learnt"] * 3 + [code] + ["learnt"] * (ROWS - 4)
    assert apart(pupil.settled(1), learnt_from(school, without(body, 3))) < EXACT


def test_batches_whose_time_goes_backwards(school):
    pupil = school.enrol("backwards")
    send(pupil, 0, part(recording(), 50, 60))
    earlier = send(pupil, 1, part(recording(), 0, 10))
    assert earlier["rejected"] == {"time_jump": 10}
    # the clock has been set: what follows it is believed
    assert send(pupil, 2, part(recording(), 10, 20))["rejected"] == {}
    assert codes(school, pupil) == ["learnt"] * 10 + ["time_jump"] * 10 + ["learnt"] * 10


def test_late_batches_lie_between_their_neighbours(school):
    pupil = school.enrol("between")
    send(pupil, 0, part(recording(), 0, 10))
    send(pupil, 2, part(recording(), 20, 30))
    said = send(pupil, 1, part(recording(), 5, 25))
    assert (said["accepted"], said["rejected"]) == (10, {"time_jump": 10})


@pytest.mark.parametrize("ahead", [50.0, 1e12])
@pytest.mark.parametrize("first", [True, False], ids=["first batch", "later batch"])
def test_a_wrong_time_at_the_end_of_a_batch_costs_that_row_only(school, ahead, first):
    pupil = school.enrol(f"leap-{ahead:g}-{first}".replace("+", "").lower())
    parts = [part(recording(), 10 * k, 10 * k + 10) for k in range(4)]
    parts[0 if first else 1]["t"][-1] += ahead
    rejected = [send(pupil, sequence, body)["rejected"] for sequence, body in enumerate(parts)]
    expected: list[dict[str, int]] = [{}, {}, {}, {}]
    expected[0 if first else 1] = {"time_jump": 1}
    assert rejected == expected
    times = np.concatenate([rows.time[rows.code == 0] for rows in logged(school, pupil)])
    np.testing.assert_allclose(times - times[0], np.delete(np.arange(40), 9 if first else 19) / 100, atol=1e-5)


def test_a_recording_may_be_sent_faster_than_it_was_made(school):
    pupil = school.enrol("in-one-go")
    rows = recording(samples=400)
    for sequence in range(4):
        body = part(rows, 100 * sequence, 100 * sequence + 100)
        body["t"] = [20 * value for value in body["t"]]  # 80 s of it
        assert send(pupil, sequence, body)["rejected"] == {}


@pytest.fixture(scope="module")
def model(school):
    return lipcore.load(school.trained)


def test_torque_limits_are_those_of_the_owner_else_those_of_the_urdf(model):
    settings, options = Settings(), LearningOptions()
    assert row_limits(model, options, settings).torque is None
    robot = RigidBody.from_profile("double-pendulum", model.joint_names, model.joint_types)
    robot.model.effortLimit = np.array([30.0, 20.0])
    known = replace(model, robot=robot)
    np.testing.assert_array_equal(row_limits(known, options, settings).torque, [30.0, 20.0])
    chosen = LearningOptions(torque_limits=[5.0, 6.0])
    np.testing.assert_array_equal(row_limits(known, chosen, settings).torque, [5.0, 6.0])
    turned = RigidBody.from_profile("double-pendulum", model.joint_names[::-1], model.joint_types)
    turned.model.effortLimit = np.array([30.0, 20.0])  # in the order of the chain
    turned_limits = row_limits(replace(model, robot=turned), options, settings).torque
    np.testing.assert_array_equal(turned_limits, [20.0, 30.0])
    robot.model.effortLimit = np.array([30.0, 0.0])  # 0 is what many URDFs say for "not known"
    assert row_limits(known, options, settings).torque is None
