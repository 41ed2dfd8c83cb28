"""Rejected batches with the field at fault, and rejected rows that leave no trace."""

from dataclasses import replace

import numpy as np
import pytest

import lipcore
from lipcore.robots.urdf import RigidBody
from service.contract.observations import LearningOptions
from service.foundation.settings import Settings
from service.learning.ingest.observations import MAX_ROWS, row_limits
from tests.service.learning.recordings import (
    assert_learnt,
    expect_rejection,
    make_recording,
    make_request,
    read_codes,
    read_logged_rows,
    send_batch,
    slice_recording,
)

VALUES = ("q", "dq", "ddq", "tau")


@pytest.fixture(scope="module")
def body():
    return slice_recording(make_recording(), 0, 6)


@pytest.fixture(scope="module")
def empty_model(learning_service):
    """Model that must stay without observations."""
    made = learning_service.create_model()
    yield made
    assert read_logged_rows(learning_service, made) == []
    assert made.get("learning")["status"]["streams"] == []


ZEROS = [[0.0, 0.0]] * 5
REJECTED_BATCHES = {
    "too few rows": ({"tau": ZEROS}, {"field": "tau"}),
    "too few joints": ({"tau": [[0.0]] * 6}, {"field": "tau"}),
    # if the shape of q differs from all others, the first other field is named
    "too few positions": ({"q": ZEROS}, {"field": "dq"}),
    "short row": ({"ddq": [*ZEROS, [0.0]]}, {"field": "ddq[5]"}),
    "number as row": ({"dq": [*ZEROS, 0.0]}, {"field": "dq[5]"}),
    "text as number": ({"tau": [*ZEROS, [0.0, "1"]]}, {"field": "tau[5][1]"}),
    "joint twice": ({"joint_names": ["joint1", "joint1"]}, {"field": "joint_names[1]", "value": "joint1"}),
    "missing joint": ({"joint_names": ["joint2"]}, {"field": "joint_names", "value": "without joint1"}),
    "unknown joint": (
        {"joint_names": ["joint1", "joint2", "gripper"]},
        {"field": "joint_names[2]", "value": "gripper"},
    ),
    "neither accelerations nor times": (
        {"t": None, "ddq": None},
        {"field": "ddq", "message": "`ddq` is required unless `t` is given."},
    ),
    "too many rows": (
        {"t": None, **dict.fromkeys(VALUES, [[0.1, 0.1]] * (MAX_ROWS + 1))},
        {"field": "q", "value": f"{MAX_ROWS + 1} rows", "expected": f"at most {MAX_ROWS} in one batch"},
    ),
}


@pytest.mark.parametrize(("changes", "expected"), REJECTED_BATCHES.values(), ids=REJECTED_BATCHES)
def test_malformed_batches_are_rejected_with_the_field(empty_model, body, changes, expected):
    reply = expect_rejection(empty_model, make_request(0, body | changes))
    (item,) = reply["detail"]
    item["message"] = reply["message"]
    assert item | expected == item


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("µs", 1e6), ("ns", 1e9)])
def test_times_in_another_unit_are_named(empty_model, unit, factor):
    rows = slice_recording(make_recording(), 0, 60)
    t = (factor * np.asarray(rows["t"])).tolist()
    (item,) = expect_rejection(empty_model, make_request(0, rows | {"t": t}))["detail"]
    assert item["field"] == "t"
    assert f"as if these were {unit}. Multiply them by {1 / factor:g}" in item["expected"]


def test_rows_of_paused_model_are_logged_and_can_be_replayed(learning_model, body):
    before = learning_model.wait_for_revision(0)
    learning_model.put("learning", {"enabled": False})
    reply = send_batch(learning_model, 0, body)
    assert (reply["accepted"], reply["effective_samples"], reply["rejected"]) == (0, 0.0, {"paused": reply["rows"]})
    assert learning_model.get("quality")["windows"][0]["rows"] == reply["rows"]
    assert learning_model.wait_for_revision(1)["tau"] == before["tau"]
    learning_model.put("learning", {"enabled": True})
    assert learning_model.post("observations/arm/0/replay", {})["codes"] == {"paused": reply["rows"]}
    assert send_batch(learning_model, 1, slice_recording(make_recording(), 20, 24))["accepted"] == 4


def test_expired_batches_are_not_accepted_again(learning_model):
    parts = [slice_recording(make_recording(), 4 * k, 4 * k + 4) for k in range(6)]
    for sequence in (0, 1, 3, 4, 5):
        send_batch(learning_model, sequence, parts[sequence])
    learning_model.wait_for_revision(5)
    learning_model.delete_from_log(0, 1, 3)
    for sequence in (0, 1, 3):
        reply = expect_rejection(learning_model, make_request(sequence, parts[sequence]), 409, "expired")
        assert f"batch {sequence} of stream 'arm'" in reply["message"]
    assert send_batch(learning_model, 2, parts[2])["duplicate"] is False  # a known gap
    assert send_batch(learning_model, 5, parts[5])["duplicate"] is True


def test_too_many_streams_are_rejected(learning_service, learning_model, body, monkeypatch):
    monkeypatch.setattr("service.learning.ingest.append.MAX_STREAMS", 2)
    for stream_id in ("a", "b"):
        send_batch(learning_model, 0, body, stream_id)
    reply = expect_rejection(learning_model, make_request(0, body, "c"), 429, "busy")
    assert "already has 2 active streams" in reply["message"]
    assert send_batch(learning_model, 1, slice_recording(make_recording(), 10, 16), "b")["accepted"] == 6
    assert send_batch(learning_service.create_model(), 0, body, "c")["accepted"] == 6


def test_extreme_values_do_not_change_the_model(learning_model):
    """One batch per extreme value, in all fields at once: rows are logged with codes, and predictions continue."""
    before = learning_model.predict()
    numbers = (1e308, -1e308, 1e-308, None)
    for sequence, value in enumerate(numbers):
        assert send_batch(learning_model, sequence, dict.fromkeys(VALUES, [[value] * 2] * 3))["accepted"] == 0
    for sequence, text in enumerate(("NaN", "Infinity", "-Infinity", "1e400"), start=len(numbers)):
        numbers_sent = ", ".join(f'"{name}": [[{text}, {text}]]' for name in VALUES)
        sent = f'{{"stream_id": "arm", "sequence": {sequence}, "t": [{text}], {numbers_sent}}}'
        answer = learning_model.client.post(
            learning_model.url("observations"), content=sent, headers={"content-type": "application/json"}
        )
        assert answer.status_code == 200, answer.text
        assert answer.json()["rejected"] == {"non_finite": 1}
    after = learning_model.wait_for_revision(8)
    np.testing.assert_allclose(after["tau"], before["tau"], rtol=1e-9)
    np.testing.assert_allclose(after["tau_std"], before["tau_std"], rtol=1e-6)


ROWS = 12
STRICT_OPTIONS = {"contact_threshold": 8.0, "on_change": "hold", "torque_limits": [2.0, 2.0]}
BAD_ROWS = {
    "position null": ("q", 1, None, "non_finite"),
    "time null": ("t", ..., None, "non_finite"),
    "position": ("q", 1, 12.7, "limit"),
    "velocity": ("dq", 0, -51.0, "limit"),
    "acceleration": ("ddq", 1, 2001.0, "limit"),
    "torque": ("tau", 0, -2.01, "limit"),
    "saturation": ("tau", 0, 1.99, "saturation"),
    "saturation below": ("tau", 1, -2.0, "saturation"),
    "time backwards": ("t", ..., 0.001, "time_jump"),
    "time far ahead": ("t", ..., 1e9, "time_jump"),
    "time long ago": ("t", ..., -1e9, "time_jump"),
    "contact": ("tau", 1, -1.5, "contact"),
}
"""Field and joint of a bad value in row 3, the value, and the code of the row."""


@pytest.mark.parametrize(("name", "joint", "value", "code"), BAD_ROWS.values(), ids=BAD_ROWS)
def test_only_the_bad_row_is_rejected(learning_service, name, joint, value, code):
    body = slice_recording(make_recording(), 0, ROWS)
    good_rows = {field: [row for place, row in enumerate(rows) if place != 3] for field, rows in body.items()}
    changed = np.array(body[name], object)
    changed[3, joint] = value
    learning_model = learning_service.create_model(**STRICT_OPTIONS)
    reply = send_batch(learning_model, 0, body | {name: changed.tolist()})
    assert (reply["rows"], reply["accepted"], reply["rejected"]) == (ROWS, ROWS - 1, {code: 1})
    assert read_codes(learning_service, learning_model) == ["learnt"] * 3 + [code] + ["learnt"] * (ROWS - 4)
    assert_learnt(learning_service, learning_model, 1, good_rows)


LEARNT, JUMP = ["learnt"], ["time_jump"]


@pytest.mark.parametrize(
    ("batches", "codes"),
    [
        # the clock was set: later batches are accepted
        pytest.param([(0, 50, 60), (1, 0, 10), (2, 10, 20)], LEARNT * 10 + JUMP * 10 + LEARNT * 10, id="backwards"),
        pytest.param(
            [(0, 0, 10), (2, 20, 30), (1, 5, 25)], LEARNT * 20 + JUMP * 5 + LEARNT * 10 + JUMP * 5, id="overlapping"
        ),
    ],
)
def test_batches_must_fit_between_their_neighbours(learning_service, learning_model, batches, codes):
    """Batches are sequences with the first and last row of a recording."""
    for sequence, first, last in batches:
        send_batch(learning_model, sequence, slice_recording(make_recording(), first, last))
    assert read_codes(learning_service, learning_model) == codes


@pytest.mark.parametrize("ahead", [50.0, 1e12])
@pytest.mark.parametrize("number", [0, 1], ids=["first batch", "later batch"])
def test_wrong_last_time_rejects_only_that_row(learning_service, learning_model, ahead, number):
    parts = [slice_recording(make_recording(), 10 * k, 10 * k + 10) for k in range(4)]
    parts[number]["t"][-1] += ahead
    rejected = [send_batch(learning_model, sequence, body)["rejected"] for sequence, body in enumerate(parts)]
    assert rejected == [{"time_jump": 1} if sequence == number else {} for sequence in range(4)]
    times = np.concatenate([rows.time[rows.code == 0] for rows in read_logged_rows(learning_service, learning_model)])
    np.testing.assert_allclose(times - times[0], np.delete(np.arange(40), 10 * number + 9) / 100, atol=1e-5)


def test_recording_can_be_sent_faster_than_real_time(learning_service):
    learning_model = learning_service.create_model(forgetting_s=600.0)
    rows = make_recording(samples=400)
    for sequence in range(4):
        body = slice_recording(rows, 100 * sequence, 100 * sequence + 100)
        body["t"] = [75 * value for value in body["t"]]  # 300 s of event time
        reply = send_batch(learning_model, sequence, body)
        assert (reply["accepted"], reply["rejected"]) == (100, {})
    assert learning_model.get("alarms")["items"] == []


def test_torque_limits_come_from_owner_then_from_urdf(learning_service):
    model, options = lipcore.load(learning_service.trained), LearningOptions()

    def torque_limits(efforts, options=options, order=1):
        robot = RigidBody.from_profile("double-pendulum", model.joint_names[::order], model.joint_types)
        robot.model.effortLimit = np.array(efforts)  # in the order of the chain
        return row_limits(replace(model, robot=robot), options, Settings()).torque

    assert row_limits(model, options, Settings()).torque is None
    np.testing.assert_array_equal(torque_limits([30.0, 20.0]), [30.0, 20.0])
    chosen = LearningOptions(torque_limits=[5.0, 6.0])
    np.testing.assert_array_equal(torque_limits([30.0, 20.0], chosen), [5.0, 6.0])
    np.testing.assert_array_equal(torque_limits([30.0, 20.0], order=-1), [20.0, 30.0])
    assert torque_limits([30.0, 0.0]) is None  # many URDFs use 0 for "unknown"
