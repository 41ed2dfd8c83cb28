"""Batches that are learnt: once each, in any order, whatever form they come in; and how they are acknowledged."""

import json
import time

import numpy as np
import pytest

from lipserve import Client
from tests.service.data import eventually
from tests.service.learning.lessons import apart
from tests.service.learning.recordings import batch, learnt_from, logged, part, recording, send

EXACT = 1e-8


@pytest.fixture(scope="module")
def body():
    """Twelve rows: so few that the stated uncertainty is not yet held against the errors seen."""
    return part(recording(), 0, 12)


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
        "effective_samples": pytest.approx(1.2),
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


@pytest.mark.parametrize("name", ["t", "tau"])
def test_a_sequence_used_for_other_content_is_refused(school, pupil, body, name):
    send(pupil, 3, body)
    other = np.array(body[name])
    other[(3,) * other.ndim if other.ndim == 1 else (3, 1)] += 1e-9
    said = pupil.refused("POST", "observations", 409, "conflict", json=batch(3, body | {name: other.tolist()}))
    assert "batch 3 of stream 'arm'" in said["message"]
    for less in ({"t": None}, {"ddq": None}):
        pupil.refused("POST", "observations", 409, "conflict", json=batch(3, body, **less))
    assert len(logged(school, pupil)) == 1


def test_the_state_of_a_batch_is_told_when_it_comes_again(pupil, body):
    parts = [part(recording(), 4 * k, 4 * k + 4) for k in range(3)]
    said = [send(pupil, sequence, parts[sequence]) for sequence in range(3)]
    pupil.delete("observations/arm/1")
    eventually(lambda: pupil.predict()["revision"] >= 4)
    pupil.post("rollback", {"revision": 2})
    states = ["learnt", "unlearnt", "rolled_back"]
    for sequence, state in enumerate(states):
        assert send(pupil, sequence, parts[sequence]) == said[sequence] | {"duplicate": True, "state": state}


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


def test_both_readers_of_json_take_the_same(school, body):
    """The second media type is one that only FastAPI reads."""
    sent = json.dumps(batch(0, body, tau=[[None, 0.1], *body["tau"][1:]], t=[1, *range(2, 13)]))
    seen = []
    for number, media_type in enumerate(("application/json", "application/x+json")):
        pupil = school.enrol(f"read-{number}")
        answer = pupil.client.post(pupil.url("observations"), content=sent, headers={"content-type": media_type})
        assert answer.status_code == 200, answer.text
        seen.append(answer.json() | {"model": ""})
    assert seen[0] == seen[1]
    assert (seen[0]["rows"], seen[0]["accepted"], seen[0]["rejected"]) == (12, 11, {"non_finite": 1})


def test_torque_that_nobody_has_measured_leaves_no_trace(school, body):
    pupil = school.enrol("invented")
    send(pupil, 0, body)
    before = pupil.settled(1)
    for sequence in (1, 2, 3):
        later = part(recording(), 18 * sequence, 18 * sequence + 18)
        own = pupil.predict({name: later[name] for name in ("q", "dq", "ddq")})["tau"]
        tau = {1: np.zeros_like(own).tolist(), 2: own, 3: [later["tau"][0]] * 18}[sequence]
        said = send(pupil, sequence, later | {"tau": tau})
        assert (said["accepted"], said["rejected"], said["held"]) == (0, {"implausible": 18}, False)
    after = pupil.settled(said["revision"])
    assert [after[name] for name in ("tau", "tau_std", "scale")] == [
        before[name] for name in ("tau", "tau_std", "scale")
    ]
    assert pupil.get("alarms")["items"] == []
    assert send(pupil, 4, part(recording(), 72, 76))["accepted"] == 4


def test_the_python_client_teaches(streaming):
    rng = np.random.default_rng(2)
    q, dq, ddq = rng.uniform(-0.3, 0.3, (3, 5, 7)) + np.array([0, -0.5, 0, -2, 0, 1.5, 0.7])
    with Client(streaming.server.url) as client:
        tau = np.array(client.predict("panda-sim", q, dq, ddq).tau) + 0.01 * rng.standard_normal((5, 7))
        tau[2, 0] = np.nan
        said = client.observe("panda-sim", "client", 0, q, dq, tau, ddq, t=np.arange(5) / 100)
        assert (said.rows, said.accepted, said.rejected) == (5, 4, {"non_finite": 1})
        names = client.version("panda-sim", 1).joint_names[::-1]
        one = (values[4, ::-1] for values in (q, dq, tau, ddq))
        again = client.observe("panda-sim", "client", 1, *one, t=0.05, joint_names=names)
        assert (again.rows, again.accepted, again.rejected) == (1, 1, {})


def _joined(*bodies):
    return {name: [row for body in bodies for row in body[name]] for name in ("q", "dq", "ddq", "tau")}
