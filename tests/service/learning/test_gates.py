"""Rows that cannot be explained: kept and counted by code, and the model is as if they had never come."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lipcore
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import CODES
from service.foundation.settings import Settings
from service.learning.ingest.screening import limits
from service.learning.schema import LearningOptions
from tests.service.learning.lessons import apart
from tests.service.learning.recordings import codes, learnt_from, logged, part, recording, send

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
    pytest.param({"dq": (3, 0, None)}, "non_finite", id="velocity null"),
    pytest.param({"ddq": (3, 0, None)}, "non_finite", id="acceleration null"),
    pytest.param({"tau": (3, 1, None)}, "non_finite", id="torque null"),
    pytest.param({"t": (3, None)}, "non_finite", id="time null"),
    pytest.param({"q": (3, 1, 12.7)}, "limit", id="position"),
    pytest.param({"q": (3, 0, -57.3)}, "limit", id="degrees"),
    pytest.param({"dq": (3, 0, -51.0)}, "limit", id="velocity"),
    pytest.param({"ddq": (3, 1, 2001.0)}, "limit", id="acceleration"),
    pytest.param({"tau": (3, 0, -2.01)}, "limit", id="torque"),
    pytest.param({"tau": (3, 0, 1.99)}, "saturation", id="saturation"),
    pytest.param({"tau": (3, 1, -2.0)}, "saturation", id="saturation below"),
    pytest.param({"t": (3, 0.001)}, "time_jump", id="time backwards"),
    pytest.param({"t": (3, 0.02)}, "time_jump", id="time repeated"),
    pytest.param({"t": (3, 1e9)}, "time_jump", id="time far ahead"),
    pytest.param({"t": (3, -1e9)}, "time_jump", id="time long ago"),
    pytest.param({"tau": (3, 0, 1.5)}, "contact", id="contact"),
    pytest.param({"tau": (3, 1, -1.5)}, "contact", id="contact of the other joint"),
]


@pytest.mark.parametrize(("change", "code"), SPOILT)
def test_one_bad_row_is_kept_out_and_all_others_are_learnt(school, request, change, code):
    body = part(recording(), 0, ROWS)
    pupil = school.enrol(f"gate-{request.node.callspec.id.replace(' ', '-')}", **STRICT)
    said = send(pupil, 0, spoilt(body, **change))
    assert (said["rows"], said["accepted"], said["rejected"]) == (ROWS, ROWS - 1, {code: 1})
    assert codes(school, pupil) == ["learnt"] * 3 + [code] + ["learnt"] * (ROWS - 4)
    assert apart(pupil.settled(1), learnt_from(school, without(body, 3))) < EXACT


def test_a_robot_at_rest_teaches_nothing(school):
    body = part(recording(), 0, ROWS)
    for row in (2, 5):
        body["dq"][row] = [5e-4, -9e-4]
    body["dq"][7] = [0.0, 0.4]  # one joint moves
    pupil = school.enrol("at-rest")
    assert send(pupil, 0, body)["rejected"] == {"stationary": 2}
    assert apart(pupil.settled(1), learnt_from(school, without(body, 2, 5))) < EXACT


def test_kept_out_rows_are_logged_with_what_was_sent(school):
    pupil = school.enrol("kept", **STRICT)
    body = part(recording(), 0, ROWS)
    sent = spoilt(body, tau=(3, 0, 1.5), q=(5, 1, 100.0), dq=(7, 0, None))
    send(pupil, 0, sent)
    (rows,) = logged(school, pupil)
    for name in ("q", "dq", "ddq", "tau"):
        np.testing.assert_array_equal(getattr(rows, name), np.array(sent[name], float))
    found = {row: CODES[code] for row, code in enumerate(rows.code.tolist()) if code}
    assert found == {3: "contact", 5: "limit", 7: "non_finite"}


def test_the_first_reason_is_told(school):
    """In the order of the documentation: what is not finite, then limits, times, saturation, rest, contacts."""
    body = part(recording(), 0, ROWS)
    body["tau"] = [[5.0, 5.0]] * ROWS  # beyond limits, and a contact
    body["q"][0][0] = None
    body["tau"][1] = [1.99, 0.0]
    body["t"][1] = 1000.0
    body["dq"][2], body["tau"][2] = [0.0, 0.0], [1.99, 0.0]
    body["dq"][3], body["tau"][3] = [0.0, 0.0], [1.5, 0.0]
    pupil = school.enrol("first-reason", **STRICT)
    send(pupil, 0, body)
    assert codes(school, pupil)[:5] == ["non_finite", "time_jump", "saturation", "stationary", "limit"]


def test_without_torque_limits_only_absurd_torques_are_beyond_them(school):
    body = part(recording(), 0, ROWS)
    pupil = school.enrol("unlimited")
    assert send(pupil, 0, spoilt(body, tau=(3, 0, 900.0)))["rejected"] == {}
    assert send(pupil, 1, spoilt(part(recording(), 20, 30), tau=(3, 0, 1e300)))["rejected"] == {"limit": 1}


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


@pytest.mark.parametrize("ahead", [50.0, 1e5, 1e12])
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


def test_a_pause_between_measured_rows_is_no_jump(school):
    pupil = school.enrol("pause")
    body = part(recording(), 0, 20)
    body["t"][10:] = [value + 5.0 for value in body["t"][10:]]
    assert send(pupil, 0, body)["rejected"] == {}


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
    assert limits(model, options, settings).torque is None
    robot = RigidBody.from_profile("double-pendulum", model.joint_names, model.joint_types)
    robot.model.effortLimit = np.array([30.0, 20.0])
    known = replace(model, robot=robot)
    np.testing.assert_array_equal(limits(known, options, settings).torque, [30.0, 20.0])
    chosen = LearningOptions(torque_limits=[5.0, 6.0])
    np.testing.assert_array_equal(limits(known, chosen, settings).torque, [5.0, 6.0])
    robot.model.effortLimit = np.array([30.0, 0.0])  # 0 is what many URDFs say for "not known"
    assert limits(known, options, settings).torque is None


def test_torque_limits_of_a_urdf_come_in_the_order_of_the_joints(model):
    names = model.joint_names[::-1]
    robot = RigidBody.from_profile("double-pendulum", names, model.joint_types)
    robot.model.effortLimit = np.array([30.0, 20.0])  # in the order of the chain
    known = replace(model, robot=robot, joint_names=names)
    np.testing.assert_array_equal(limits(known, LearningOptions(), Settings()).torque, [20.0, 30.0])


def test_the_settings_bound_positions_velocities_and_accelerations(model):
    found = limits(model, LearningOptions(), Settings(max_position=1.0, max_velocity=2.0, max_acceleration=3.0))
    assert (found.position, found.velocity, found.acceleration) == (1.0, 2.0, 3.0)
