"""Batches that are learnt: once each, in any order, whatever form they come in; and how they are acknowledged."""

from __future__ import annotations

import json
import time
from itertools import count

import numpy as np
import pytest

from service.client import Client
from service.foundation.settings import Settings
from service.journal import log
from service.learning.schema import ObservationResponse
from service.storage.database import Database, EventRow
from tests.service.data import error, eventually
from tests.service.learning import lessons
from tests.service.learning.lessons import LESSON, apart, lesson
from tests.service.learning.recordings import batch, learnt_from, logged, part, recording, send

EXACT = 1e-8
COUNT = count()


@pytest.fixture(scope="module")
def body():
    """Twelve rows: so few that the stated uncertainty is not yet held against the errors seen."""
    return part(recording(), 0, 12)


@pytest.fixture
def pupil(school):
    """A model of the test's own."""
    return school.enrol(f"observing-{next(COUNT)}")


def test_a_batch_is_acknowledged_and_learnt(school, pupil, body):
    before = pupil.predict()
    said = send(pupil, 5, body)
    assert said == {
        "model": pupil.model,
        "version": 1,
        "revision": 1,
        "stream_id": "arm",
        "sequence": 5,
        "rows": 12,
        "accepted": 12,
        "duplicate": False,
        "state": "learnt",
        "rejected": {},
        "gaps": [],
        "derived": None,
        "held": False,
    }
    after = pupil.settled(1)
    assert after["version"] == 1
    assert apart(before, after) > 5e-4
    assert apart(after, learnt_from(school, body)) < EXACT


def test_learning_goes_on_from_batch_to_batch(school, pupil):
    for sequence in range(3):
        assert send(pupil, sequence, part(recording(), 4 * sequence, 4 * sequence + 4))["revision"] == sequence + 1
    assert apart(pupil.settled(3), learnt_from(school, part(recording(), 0, 12))) < EXACT


def test_the_order_in_which_batches_come_makes_no_difference(school):
    ordered, shuffled = (school.enrol(f"in-{name}") for name in ("order", "disorder"))
    parts = [part(recording(), 4 * k, 4 * k + 4) for k in range(5)]
    for sequence in range(5):
        send(ordered, sequence, parts[sequence])
    gaps = [send(shuffled, sequence, parts[sequence])["gaps"] for sequence in (2, 4, 0, 3, 1)]
    assert gaps == [[], [[3, 3]], [[1, 1], [3, 3]], [[1, 1]], []]
    assert apart(ordered.settled(5), shuffled.settled(5)) < EXACT


def test_a_batch_sent_again_is_acknowledged_again_and_applied_once(school, pupil, body):
    first = send(pupil, 0, body)
    send(pupil, 1, part(recording(), 20, 24))
    for _ in range(3):
        assert send(pupil, 0, body) == first | {"duplicate": True}
    assert len(logged(school, pupil)) == 2
    assert apart(pupil.settled(2), learnt_from(school, _joined(body, part(recording(), 20, 24)))) < EXACT
    assert school.service.learners.monitor(pupil.model).counts["duplicates"] == 3


def test_the_same_content_in_another_form_is_the_same_batch(pupil, body):
    names = list(recording().joint_names)
    send(pupil, 0, body)
    turned = {name: np.array(body[name])[:, ::-1].tolist() for name in ("q", "dq", "ddq", "tau")}
    assert send(pupil, 0, body | turned, joint_names=names[::-1])["duplicate"] is True
    spaced = json.dumps(batch(0, body), indent=3)
    answer = pupil.client.post(
        pupil.url("observations"), content=spaced, headers={"content-type": "application/json; charset=utf-8"}
    )
    assert answer.json()["duplicate"] is True
    with_zeros = body | {"t": [0.0, *body["t"][1:]]}
    assert send(pupil, 0, with_zeros | {"t": [-0.0, *body["t"][1:]]})["duplicate"] is True
    assert send(pupil, 0, with_zeros | {"t": [0, *body["t"][1:]]})["duplicate"] is True


@pytest.mark.parametrize("name", ["t", "q", "dq", "ddq", "tau"])
def test_a_sequence_used_for_other_content_is_refused(school, pupil, body, name):
    send(pupil, 3, body)
    other = np.array(body[name])
    other[(3,) * other.ndim if other.ndim == 1 else (3, 1)] += 1e-9
    said = pupil.refused("POST", "observations", 409, "conflict", json=batch(3, body | {name: other.tolist()}))
    assert "batch 3 of stream 'arm'" in said["message"]
    for less in ({"t": None}, {"ddq": None}):
        pupil.refused("POST", "observations", 409, "conflict", json=batch(3, body, **less))
    assert len(logged(school, pupil)) == 1


def test_streams_count_on_their_own(school, pupil, body):
    for stream_id in ("a", "b", "B", "a.1_x-2"):
        assert send(pupil, 0, body, stream_id)["duplicate"] is False
    assert len(logged(school, pupil)) == 4


def test_the_state_of_a_batch_is_told_when_it_comes_again(pupil, body):
    parts = [part(recording(), 4 * k, 4 * k + 4) for k in range(3)]
    said = [send(pupil, sequence, parts[sequence]) for sequence in range(3)]
    pupil.delete("observations/arm/1")
    eventually(lambda: pupil.predict()["revision"] >= 4)
    pupil.post("rollback", {"revision": 2})
    states = ["learnt", "unlearnt", "rolled_back"]
    for sequence, state in enumerate(states):
        assert send(pupil, sequence, parts[sequence]) == said[sequence] | {"duplicate": True, "state": state}


def test_joints_in_another_order_are_told_apart_by_name(school, body):
    usual, turned = school.enrol("joints-usual"), school.enrol("joints-turned")
    send(usual, 0, body, joint_names=list(recording().joint_names))
    columns = {name: np.array(body[name])[:, ::-1].tolist() for name in ("q", "dq", "ddq", "tau")}
    send(turned, 0, body | columns, joint_names=list(recording().joint_names)[::-1])
    assert apart(usual.settled(1), turned.settled(1)) == 0
    assert apart(usual.settled(1), learnt_from(school, body)) < EXACT


def test_one_row_may_come_without_a_list_around_it(school, pupil, body):
    one = {name: body[name][0] for name in ("t", "q", "dq", "ddq", "tau")}
    assert send(pupil, 0, one)["rows"] == 1
    assert send(pupil, 0, part(recording(), 0, 1))["duplicate"] is True
    assert apart(pupil.settled(1), learnt_from(school, part(recording(), 0, 1), 1.0)) < EXACT


def test_event_time_follows_the_clock_of_the_stream(school, pupil):
    before = time.time()
    send(pupil, 0, part(recording(), 0, 50))
    after = time.time()
    send(pupil, 1, part(recording(), 100, 150))
    first, second = (rows.time for rows in logged(school, pupil))
    assert before <= first[-1] <= after
    expected = recording().t[np.r_[0:50, 100:150]] - recording().t[49] + first[-1]
    np.testing.assert_allclose(np.concatenate([first, second]), expected, rtol=0, atol=1e-6)


def test_without_times_rows_count_as_of_their_arrival(school, pupil, body):
    before = time.time()
    assert send(pupil, 0, body, t=None)["accepted"] == 12
    (rows,) = logged(school, pupil)
    assert (rows.time == rows.time[0]).all()
    assert before <= rows.time[0] <= time.time()
    assert apart(pupil.settled(1), learnt_from(school, body, 1.0)) < EXACT
    send(pupil, 1, part(recording(), 20, 30))  # times from here on: they are dated by this batch's arrival
    assert before <= logged(school, pupil)[1].time[-1] <= time.time()


def test_every_row_is_durable_before_it_is_acknowledged(school, pupil, body):
    send(pupil, 0, body)
    reader = Database.of(
        Settings(home=school.service.settings.home)
    )  # its own connections: they see what is committed only
    try:
        with reader.session() as session:
            event = log.find_batch(session, pupil.model, "arm", 0)
            assert (event.rows, event.learnt, event.version, event.revision) == (12, 12, 1, 0)
            assert ObservationResponse.model_validate(event.report).accepted == 12
    finally:
        reader.close()


@pytest.mark.parametrize("media_type", ["application/json", "application/x+json"])
def test_both_readers_of_json_take_the_same(school, media_type, body):
    """The second media type is one that only FastAPI reads."""
    pupil = school.enrol(f"read-as-{'fast' if media_type.endswith('/json') else 'slow'}")
    sent = batch(0, body, tau=[[None, 0.1], *body["tau"][1:]], t=[1, *range(2, 13)])
    answer = pupil.client.post(
        pupil.url("observations"), content=json.dumps(sent), headers={"content-type": media_type}
    )
    assert answer.status_code == 200, answer.text
    assert {**answer.json(), "model": ""} == {
        **ObservationResponse(
            model="",
            version=1,
            revision=1,
            stream_id="arm",
            sequence=0,
            rows=12,
            accepted=11,
            duplicate=False,
            state="learnt",
            rejected={"non_finite": 1},
            gaps=[],
            held=False,
        ).model_dump()
    }


def test_the_python_client_teaches(streaming):
    rng = np.random.default_rng(2)
    q, dq, ddq = rng.uniform(-0.3, 0.3, (3, 5, 7)) + np.array([0, -0.5, 0, -2, 0, 1.5, 0.7])
    with Client(streaming.server.url) as client:
        tau = np.array(client.predict("panda-sim", q, dq, ddq).tau)
        tau[2, 0] = np.nan
        said = client.observe("panda-sim", "client", 0, q, dq, tau, ddq, t=np.arange(5) / 100)
        assert (said.rows, said.accepted, said.rejected) == (5, 4, {"non_finite": 1})
        names = client.version("panda-sim", 1).joint_names[::-1]
        one = (values[4, ::-1] for values in (q, dq, tau, ddq))
        again = client.observe("panda-sim", "client", 1, *one, t=0.05, joint_names=names)
        assert (again.rows, again.accepted, again.rejected) == (1, 1, {})


@pytest.mark.slow
def test_a_service_that_starts_again_knows_what_has_come(school, tmp_path):
    home = tmp_path / "home"
    with lessons.school(home, school.trained) as first:
        pupil = first.enrol("arm")
        said = [pupil.post("observations", lesson(number)) for number in range(3)]
        taught = pupil.settled(3)
        seen = first.service.learners.monitor("arm").windows[0].record(time.time())
    with lessons.school(home, school.trained) as second:
        pupil = lessons.Pupil(second.client, "arm")
        for number in range(3):
            assert pupil.post("observations", lesson(number)) == said[number] | {"duplicate": True}
        error(pupil.client.post(pupil.url("observations"), json=lesson(3) | {"sequence": 2}), 409, "conflict")
        assert apart(pupil.settled(3), taught) < EXACT
        again = second.service.learners.monitor("arm").windows[0].record(time.time())
        assert again.rows == seen.rows == 3 * LESSON
        np.testing.assert_allclose(again.nlpd, seen.nlpd, rtol=1e-12)
        with second.service.database.session() as session:
            assert session.query(EventRow).filter_by(model="arm", kind="batch").count() == 3


def _joined(*bodies):
    return {name: [row for body in bodies for row in body[name]] for name in ("q", "dq", "ddq", "tau")}
