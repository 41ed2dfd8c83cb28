"""Rejected batches with the field at fault, and rejected rows that leave no trace."""

from dataclasses import replace

import numpy as np
import pytest

import lipcore
from lipcore.robots.urdf import RigidBody
from service.contract.observations import LearningOptions
from service.foundation.settings import Settings
from service.journal import log, snapshots
from service.learning.ingest.observations import MAX_ROWS, row_limits
from tests.service.learning.learning_models import max_difference
from tests.service.learning.recordings import (
    make_recording,
    make_request,
    predict_after_learning,
    read_codes,
    read_logged_rows,
    send_batch,
    slice_recording,
)


@pytest.fixture(scope="module")
def body():
    return slice_recording(make_recording(), 0, 6)


@pytest.fixture(scope="module")
def learning_model(learning_service):
    """Model that must stay without observations."""
    made = learning_service.create_model("refusing")
    yield made
    assert read_logged_rows(learning_service, made) == []
    assert made.get("learning")["status"]["streams"] == []


def expect_error(learning_model, sent, status=422, code="invalid_request"):
    return learning_model.expect_error("POST", "observations", status, code, json=sent)


@pytest.mark.parametrize(
    ("name", "rows", "field"),
    [
        ("tau", [[0.0, 0.0]] * 5, "tau"),
        ("tau", [[0.0]] * 6, "tau"),
        ("q", [[0.0, 0.0]] * 5, "dq"),  # if the shape of q differs from all others, the first other field is named
        ("ddq", [[0.0, 0.0]] * 5 + [[0.0]], "ddq[5]"),
        ("dq", [[0.0, 0.0]] * 5 + [0.0], "dq[5]"),
        ("tau", [[0.0, 0.0]] * 5 + [[0.0, "1"]], "tau[5][1]"),
    ],
)
def test_arrays_must_have_the_same_shape(learning_model, body, name, rows, field):
    assert expect_error(learning_model, make_request(0, body | {name: rows}))["detail"][0]["field"] == field


@pytest.mark.parametrize(
    ("names", "field", "value"),
    [
        (["joint1", "joint1"], "joint_names[1]", "joint1"),
        (["joint2"], "joint_names", "without joint1"),
        (["joint1", "joint2", "gripper"], "joint_names[2]", "gripper"),
    ],
)
def test_joint_names_must_match_the_model(learning_model, body, names, field, value):
    reply = expect_error(learning_model, make_request(0, body, joint_names=names))
    assert reply["detail"][0]["field"] == field
    assert reply["detail"][0]["value"] == value


def test_accelerations_or_times_are_required(learning_model, body):
    reply = expect_error(learning_model, make_request(0, body, t=None, ddq=None))
    assert reply["detail"][0]["field"] == "ddq"
    assert "required unless" in reply["message"]


def test_too_many_rows_are_rejected(learning_model):
    max_rows = MAX_ROWS
    rows = [[0.1, 0.1]] * (max_rows + 1)
    reply = expect_error(learning_model, make_request(0, dict.fromkeys(("q", "dq", "ddq", "tau"), rows)))
    assert reply["detail"] == [
        {"field": "q", "value": f"{max_rows + 1} rows", "expected": f"at most {max_rows} in one batch"}
    ]


def test_rows_of_paused_model_are_logged_and_can_be_replayed(learning_service, body):
    learning_model = learning_service.create_model("paused-ingest")
    before = learning_model.wait_for_revision(0)
    learning_model.put("learning", {"enabled": False})
    reply = send_batch(learning_model, 0, body)
    assert (reply["accepted"], reply["effective_samples"], reply["rejected"]) == (0, 0.0, {"paused": reply["rows"]})
    assert learning_model.get("quality")["windows"][0]["rows"] == reply["rows"]
    assert learning_model.wait_for_revision(1)["tau"] == before["tau"]
    learning_model.put("learning", {"enabled": True})
    assert learning_model.post("observations/arm/0/replay", {})["codes"] == {"paused": reply["rows"]}
    assert send_batch(learning_model, 1, slice_recording(make_recording(), 20, 24))["accepted"] == 4


def test_expired_batches_are_not_accepted_again(learning_service, body):
    learning_model = learning_service.create_model("expiring")
    parts = [slice_recording(make_recording(), 4 * k, 4 * k + 4) for k in range(6)]
    for sequence in (0, 1, 3, 4, 5):
        send_batch(learning_model, sequence, parts[sequence])
    learning_model.wait_for_revision(5)
    with learning_service.service.database.transaction() as session:
        for sequence in (0, 1, 3):
            event = log.find_batch(session, learning_model.name, "arm", sequence)
            snapshots._note_forgotten(session, event)
            session.delete(event)
    for sequence in (0, 1, 3):
        reply = expect_error(learning_model, make_request(sequence, parts[sequence]), 409, "expired")
        assert f"batch {sequence} of stream 'arm'" in reply["message"]
    assert send_batch(learning_model, 2, parts[2])["duplicate"] is False  # a known gap
    assert send_batch(learning_model, 5, parts[5])["duplicate"] is True


def test_too_many_streams_are_rejected(learning_service, body, monkeypatch):
    monkeypatch.setattr("service.learning.ingest.append.MAX_STREAMS", 2)
    learning_model, other = learning_service.create_model("popular"), learning_service.create_model("unpopular")
    for stream_id in ("a", "b"):
        send_batch(learning_model, 0, body, stream_id)
    reply = expect_error(learning_model, make_request(0, body, "c"), 429, "busy")
    assert "already has 2 active streams" in reply["message"]
    assert send_batch(learning_model, 1, slice_recording(make_recording(), 10, 16), "b")["accepted"] == 6
    assert send_batch(other, 0, body, "c")["accepted"] == 6


def test_extreme_values_do_not_change_the_model(learning_service, body):
    """One batch per extreme value, in all fields at once: rows are logged with codes, and predictions continue."""
    learning_model = learning_service.create_model("robust")
    before = learning_model.predict()
    numbers = (1e308, -1e308, 1e-308, None)
    for sequence, value in enumerate(numbers):
        reply = send_batch(learning_model, sequence, {name: [[value] * 2] * 3 for name in ("q", "dq", "ddq", "tau")})
        assert reply["accepted"] == 0
    for sequence, text in enumerate(("NaN", "Infinity", "-Infinity", "1e400"), start=len(numbers)):
        row = f"[[{text}, {text}]]"
        numbers_sent = ", ".join(f'"{name}": {row}' for name in ("q", "dq", "ddq", "tau"))
        sent = f'{{"stream_id": "arm", "sequence": {sequence}, "t": [{text}], {numbers_sent}}}'
        answer = learning_model.client.post(
            learning_model.url("observations"), content=sent, headers={"content-type": "application/json"}
        )
        assert answer.status_code == 200, answer.text
        assert answer.json()["rejected"] == {"non_finite": 1}
    after = learning_model.wait_for_revision(8)
    np.testing.assert_allclose(after["tau"], before["tau"], rtol=1e-9)
    np.testing.assert_allclose(after["tau_std"], before["tau_std"], rtol=1e-6)


MAX_DIFFERENCE = 1e-8
ROWS = 12
STRICT_OPTIONS = {"contact_threshold": 8.0, "on_change": "hold", "torque_limits": [2.0, 2.0]}


def change_values(body, **changes):
    """Return rows with changed values: name=(row, joint, value), or (row, value) for times."""
    made = {name: [[*row] if isinstance(row, list) else row for row in rows] for name, rows in body.items()}
    for name, (row, *joint, value) in changes.items():
        if joint:
            made[name][row][joint[0]] = value
        else:
            made[name][row] = value
    return made


def drop_rows(body, *rows):
    return {name: [value for row, value in enumerate(values) if row not in rows] for name, values in body.items()}


BAD_ROWS = [
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


@pytest.mark.parametrize(("change", "code"), BAD_ROWS)
def test_only_the_bad_row_is_rejected(learning_service, request, change, code):
    body = slice_recording(make_recording(), 0, ROWS)
    learning_model = learning_service.create_model(
        f"gate-{request.node.callspec.id.replace(' ', '-')}", **STRICT_OPTIONS
    )
    reply = send_batch(learning_model, 0, change_values(body, **change))
    assert (reply["rows"], reply["accepted"], reply["rejected"]) == (ROWS, ROWS - 1, {code: 1})
    assert read_codes(learning_service, learning_model) == ["learnt"] * 3 + [code] + ["learnt"] * (ROWS - 4)
    assert (
        max_difference(
            learning_model.wait_for_revision(1), predict_after_learning(learning_service, drop_rows(body, 3))
        )
        < MAX_DIFFERENCE
    )


def test_batch_with_backward_time_is_rejected_once(learning_service):
    learning_model = learning_service.create_model("backwards")
    send_batch(learning_model, 0, slice_recording(make_recording(), 50, 60))
    earlier = send_batch(learning_model, 1, slice_recording(make_recording(), 0, 10))
    assert earlier["rejected"] == {"time_jump": 10}
    # the clock was set: later batches are accepted
    assert send_batch(learning_model, 2, slice_recording(make_recording(), 10, 20))["rejected"] == {}
    assert read_codes(learning_service, learning_model) == ["learnt"] * 10 + ["time_jump"] * 10 + ["learnt"] * 10


def test_late_batch_must_fit_between_its_neighbours(learning_service):
    learning_model = learning_service.create_model("between")
    send_batch(learning_model, 0, slice_recording(make_recording(), 0, 10))
    send_batch(learning_model, 2, slice_recording(make_recording(), 20, 30))
    reply = send_batch(learning_model, 1, slice_recording(make_recording(), 5, 25))
    assert (reply["accepted"], reply["rejected"]) == (10, {"time_jump": 10})


@pytest.mark.parametrize("ahead", [50.0, 1e12])
@pytest.mark.parametrize("first", [True, False], ids=["first batch", "later batch"])
def test_wrong_last_time_rejects_only_that_row(learning_service, ahead, first):
    learning_model = learning_service.create_model(f"leap-{ahead:g}-{first}".replace("+", "").lower())
    parts = [slice_recording(make_recording(), 10 * k, 10 * k + 10) for k in range(4)]
    parts[0 if first else 1]["t"][-1] += ahead
    rejected = [send_batch(learning_model, sequence, body)["rejected"] for sequence, body in enumerate(parts)]
    expected: list[dict[str, int]] = [{}, {}, {}, {}]
    expected[0 if first else 1] = {"time_jump": 1}
    assert rejected == expected
    times = np.concatenate([rows.time[rows.code == 0] for rows in read_logged_rows(learning_service, learning_model)])
    np.testing.assert_allclose(times - times[0], np.delete(np.arange(40), 9 if first else 19) / 100, atol=1e-5)


def test_recording_can_be_sent_faster_than_real_time(learning_service):
    learning_model = learning_service.create_model("in-one-go")
    rows = make_recording(samples=400)
    for sequence in range(4):
        body = slice_recording(rows, 100 * sequence, 100 * sequence + 100)
        body["t"] = [20 * value for value in body["t"]]  # 80 s of event time
        assert send_batch(learning_model, sequence, body)["rejected"] == {}


@pytest.fixture(scope="module")
def model(learning_service):
    return lipcore.load(learning_service.trained)


def test_torque_limits_come_from_owner_then_from_urdf(model):
    settings, options = Settings(), LearningOptions()
    assert row_limits(model, options, settings).torque is None
    robot = RigidBody.from_profile("double-pendulum", model.joint_names, model.joint_types)
    robot.model.effortLimit = np.array([30.0, 20.0])
    model_with_robot = replace(model, robot=robot)
    np.testing.assert_array_equal(row_limits(model_with_robot, options, settings).torque, [30.0, 20.0])
    chosen = LearningOptions(torque_limits=[5.0, 6.0])
    np.testing.assert_array_equal(row_limits(model_with_robot, chosen, settings).torque, [5.0, 6.0])
    turned = RigidBody.from_profile("double-pendulum", model.joint_names[::-1], model.joint_types)
    turned.model.effortLimit = np.array([30.0, 20.0])  # in the order of the chain
    turned_limits = row_limits(replace(model, robot=turned), options, settings).torque
    np.testing.assert_array_equal(turned_limits, [20.0, 30.0])
    robot.model.effortLimit = np.array([30.0, 0.0])  # many URDFs use 0 for "unknown"
    assert row_limits(model_with_robot, options, settings).torque is None
