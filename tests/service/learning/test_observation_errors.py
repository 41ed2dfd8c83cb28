"""Batches that are refused, with the place of what is wrong; nothing of them is logged."""

from __future__ import annotations

import numpy as np
import pytest

from service.journal import log, snapshots
from tests.service.data import error
from tests.service.learning import lessons
from tests.service.learning.recordings import batch, logged, part, recording, send

NAMES = "joint1, joint2"


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


def test_unknown_models(school, body):
    error(school.client.post("/v1/models/nobody/observations", json=batch(0, body)), 404, "not_found")


@pytest.mark.parametrize("name", ["stream_id", "sequence", "q", "dq", "tau"])
def test_nothing_may_be_left_out(pupil, body, name):
    sent = batch(0, body)
    del sent[name]
    assert refused(pupil, sent)["detail"] == [{"field": name, "value": "missing", "expected": "a value"}]


@pytest.mark.each_once
@pytest.mark.parametrize("name", ["q", "dq", "ddq", "tau"])
@pytest.mark.parametrize(
    ("rows", "field"),
    [
        pytest.param([], "", id="empty"),
        pytest.param([[0.0, 0.0]] * 5, "", id="too few rows"),
        pytest.param([[0.0, 0.0]] * 7, "", id="too many rows"),
        pytest.param([0.0, 0.0], "", id="one row"),
        pytest.param([[0.0]] * 6, "", id="too few joints"),
        pytest.param([[0.0] * 3] * 6, "", id="too many joints"),
        pytest.param([[0.0, 0.0]] * 5 + [[0.0]], "[5]", id="ragged"),
        pytest.param([[0.0, 0.0]] * 5 + [0.0], "[5]", id="rows and a number"),
        pytest.param([[0.0, 0.0]] * 5 + [None], "[5]", id="no row"),
        pytest.param([[0.0, 0.0]] * 5 + [[0.0, "1"]], "[5][1]", id="text"),
        pytest.param([[0.0, 0.0]] * 5 + [[0.0, True]], "[5][1]", id="boolean"),
        pytest.param([[0.0, 0.0]] * 5 + [[0.0, 10**400]], "[5][1]", id="huge whole number"),
        pytest.param("0, 0", "", id="a text"),
    ],
)
def test_numbers_come_in_rows_of_one_shape(pupil, body, name, rows, field):
    said = refused(pupil, batch(0, body | {name: rows}))
    where = said["detail"][0]["field"]
    # where q is another shape than all others, the first of the others is named
    assert where == name + field or (name == "q" and where == "dq" and not field)


def test_too_many_joints_are_listed(pupil, body):
    wide = {name: [[*row, 0.0] for row in body[name]] for name in ("q", "dq", "ddq", "tau")}
    said = refused(pupil, batch(0, body | wide))
    assert said["detail"] == [{"field": "q", "value": "3 numbers long", "expected": f"2 numbers: {NAMES}"}]


@pytest.mark.parametrize(
    ("t", "field"), [([0.0] * 5, "t"), ([0.0] * 7, "t"), (0.0, "t"), ([], "t"), ("0", "t"), ([0, 1, "2"], "t[2]")]
)
def test_there_is_one_time_a_row(pupil, body, t, field):
    assert refused(pupil, batch(0, body, t=t))["detail"][0]["field"].startswith(field)


@pytest.mark.parametrize(
    ("names", "field", "value"),
    [
        (["joint1", "joint3"], "joint_names[1]", "joint3"),
        (["joint1", "joint1"], "joint_names[1]", "joint1"),
        (["joint2"], "joint_names", "without joint1"),
        ([], "joint_names", "without joint1, joint2"),
        (["joint1", "joint2", "joint2"], "joint_names[2]", "joint2"),
        (["joint1", "joint2", "gripper"], "joint_names[2]", "gripper"),
    ],
)
def test_joints_are_those_of_the_model(pupil, body, names, field, value):
    said = refused(pupil, batch(0, body, joint_names=names))
    assert said["detail"][0]["field"] == field
    assert said["detail"][0]["value"] == value


@pytest.mark.parametrize("names", ["joint1", [1, 2], {"joint1": 0}])
def test_joint_names_are_a_list_of_texts(pupil, body, names):
    assert refused(pupil, batch(0, body, joint_names=names))["detail"][0]["field"].startswith("joint_names")


def test_accelerations_or_times_are_needed(pupil, body):
    said = refused(pupil, batch(0, body, t=None, ddq=None))
    assert said["detail"][0]["field"] == "ddq"
    assert "times to derive them from" in said["message"]


def test_unknown_fields_are_named(pupil, body):
    said = refused(pupil, batch(0, body, torque=[1.0]))
    assert (said["detail"][0]["field"], said["detail"][0]["expected"]) == ("torque", "no field of that name")


def test_too_many_rows(pupil, school):
    most = school.service.settings.max_observation_rows
    rows = [[0.1, 0.1]] * (most + 1)
    said = refused(pupil, batch(0, dict.fromkeys(("q", "dq", "ddq", "tau"), rows)))
    assert said["detail"] == [{"field": "q", "value": f"{most + 1} rows", "expected": f"at most {most} in one batch"}]


def test_models_whose_learning_is_switched_off(school, body):
    pupil = school.enrol("switched-off")
    send(pupil, 0, body)
    pupil.put("learning", {"enabled": False})
    for sequence in (0, 1):
        refused(pupil, batch(sequence, body), 409, "learning_disabled")
    pupil.put("learning", {"enabled": True})
    assert send(pupil, 1, body)["revision"] == 2


def test_batches_that_are_no_longer_kept_are_not_taken_for_new(school, body):
    pupil = school.enrol("expiring")
    parts = [part(recording(), 4 * k, 4 * k + 4) for k in range(6)]
    for sequence in (0, 1, 3, 4, 5):
        send(pupil, sequence, parts[sequence])
    pupil.settled(5)
    with school.service.database.transaction() as session:
        for sequence in (0, 1, 3):
            event = log.find_batch(session, pupil.model, "arm", sequence)
            snapshots._forget(session, event)
            session.delete(event)
    for sequence in (0, 1, 3):
        said = refused(pupil, batch(sequence, parts[sequence]), 409, "expired")
        assert f"batch {sequence} of stream 'arm'" in said["message"]
    assert send(pupil, 2, parts[2])["duplicate"] is False  # known not to have come
    assert send(pupil, 5, parts[5])["duplicate"] is True


def test_more_streams_than_a_model_may_have(school, tmp_path, body):
    with lessons.school(tmp_path / "home", school.trained, max_observation_streams=2) as narrow:
        pupil = narrow.enrol("popular")
        for stream_id in ("a", "b"):
            send(pupil, 0, body, stream_id)
        said = refused(pupil, batch(0, body, "c"), 429, "busy")
        assert "LIPSERVE_MAX_OBSERVATION_STREAMS" in said["message"]
        assert send(pupil, 1, part(recording(), 10, 16), "b")["accepted"] == 6


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
