"""Observation batches: acknowledged, and learnt once each, in any order and form."""

import json
import time

import numpy as np
import pytest

from lipserve import Client
from tests.service.data import eventually
from tests.service.learning.learning_models import max_difference
from tests.service.learning.recordings import (
    assert_learnt,
    make_recording,
    make_request,
    read_logged_rows,
    send_batch,
    slice_recording,
)

MAX_DIFFERENCE = 1e-8


@pytest.fixture(scope="module")
def body():
    """Twelve rows; too few to raise the floor of the stated uncertainty."""
    return slice_rows(0, 12)


def slice_rows(first, last):
    return slice_recording(make_recording(), first, last)


def test_batch_is_acknowledged_and_learnt(learning_service, learning_model, body):
    before = learning_model.predict()
    reply = send_batch(learning_model, 5, body)
    assert reply == {
        "model": learning_model.name,
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
    assert_learnt(learning_service, learning_model, 1, body)
    after = learning_model.predict()
    assert after["version"] == 1
    assert max_difference(before, after) > 5e-4


def test_batch_order_does_not_change_predictions(learning_service):
    ordered, shuffled = (learning_service.create_model(f"in-{name}") for name in ("order", "disorder"))
    parts = [slice_rows(4 * k, 4 * k + 4) for k in range(5)]
    for sequence, part in enumerate(parts):
        send_batch(ordered, sequence, part)
    gaps = [send_batch(shuffled, sequence, parts[sequence])["gaps"] for sequence in (2, 4, 0, 3, 1)]
    assert gaps == [[], [[3, 3]], [[1, 1], [3, 3]], [[1, 1]], []]
    assert max_difference(ordered.wait_for_revision(5), shuffled.wait_for_revision(5)) < MAX_DIFFERENCE


def test_repeated_batch_is_learnt_once(learning_service, learning_model, body):
    first, later = send_batch(learning_model, 0, body), slice_rows(20, 24)
    send_batch(learning_model, 1, later)
    for _ in range(3):
        assert send_batch(learning_model, 0, body) == first | {"duplicate": True}
    assert len(read_logged_rows(learning_service, learning_model)) == 2
    assert_learnt(learning_service, learning_model, 2, {name: rows + later[name] for name, rows in body.items()})
    assert learning_service.service.learners.monitor(learning_model.name).counts["duplicates"] == 3


def test_same_content_in_another_form_is_a_duplicate(learning_model, body):
    names = list(make_recording().joint_names)
    send_batch(learning_model, 0, body)
    turned = {name: np.array(body[name])[:, ::-1].tolist() for name in ("q", "dq", "ddq", "tau")}
    zero, minus_zero, integer = ({"t": [first, *body["t"][1:]]} for first in (0.0, -0.0, 0))
    for changes in (turned | {"joint_names": names[::-1]}, zero, minus_zero, integer):
        assert send_batch(learning_model, 0, body | changes)["duplicate"] is True, changes
    spaced = json.dumps(make_request(0, body), indent=3)
    answer = learning_model.client.post(
        learning_model.url("observations"), content=spaced, headers={"content-type": "application/json; charset=utf-8"}
    )
    assert answer.json()["duplicate"] is True


@pytest.mark.parametrize("name", ["t", "tau"])
def test_sequence_reused_for_other_content_is_rejected(learning_service, learning_model, body, name):
    send_batch(learning_model, 3, body)
    other = np.array(body[name])
    other[(3,) * other.ndim if other.ndim == 1 else (3, 1)] += 1e-9
    reply = learning_model.expect_error(
        "POST", "observations", 409, "conflict", json=make_request(3, body | {name: other.tolist()})
    )
    assert "batch 3 of stream 'arm'" in reply["message"]
    for missing in ("t", "ddq"):
        request = make_request(3, body, **{missing: None})
        learning_model.expect_error("POST", "observations", 409, "conflict", json=request)
    assert len(read_logged_rows(learning_service, learning_model)) == 1


def test_duplicate_reports_the_state_of_the_batch(learning_model, body):
    parts = [slice_rows(4 * k, 4 * k + 4) for k in range(3)]
    replies = [send_batch(learning_model, sequence, part) for sequence, part in enumerate(parts)]
    learning_model.delete("observations/arm/1")
    eventually(lambda: learning_model.predict()["revision"] >= 4)
    learning_model.post("rollback", {"revision": 2})
    for sequence, state in enumerate(("learnt", "unlearnt", "rolled_back")):
        expected = replies[sequence] | {"duplicate": True, "state": state}
        assert send_batch(learning_model, sequence, parts[sequence]) == expected


def test_single_row_needs_no_list(learning_service, learning_model, body):
    one = {name: body[name][0] for name in ("t", "q", "dq", "ddq", "tau")}
    assert send_batch(learning_model, 0, one)["rows"] == 1
    assert send_batch(learning_model, 0, slice_rows(0, 1))["duplicate"] is True
    assert_learnt(learning_service, learning_model, 1, slice_rows(0, 1), 1.0)


def test_event_time_follows_the_stream_clock(learning_service, learning_model):
    before = time.time()
    send_batch(learning_model, 0, slice_rows(0, 50))
    after = time.time()
    send_batch(learning_model, 1, slice_rows(100, 150))
    first, second = (rows.time for rows in read_logged_rows(learning_service, learning_model))
    assert before <= first[-1] <= after
    expected = make_recording().t[np.r_[0:50, 100:150]] - make_recording().t[49] + first[-1]
    np.testing.assert_allclose(np.concatenate([first, second]), expected, rtol=0, atol=1e-6)


def test_rows_without_times_get_their_arrival_time(learning_service, learning_model, body):
    before = time.time()
    assert send_batch(learning_model, 0, body, t=None)["accepted"] == 12
    (rows,) = read_logged_rows(learning_service, learning_model)
    assert (rows.time == rows.time[0]).all()
    assert before <= rows.time[0] <= time.time()
    assert_learnt(learning_service, learning_model, 1, body, 1.0)
    # the first batch with times; its arrival dates them
    send_batch(learning_model, 1, slice_rows(20, 30))
    assert before <= read_logged_rows(learning_service, learning_model)[1].time[-1] <= time.time()


def test_both_json_readers_agree(learning_service, body):
    """Only FastAPI reads the second media type."""
    sent = json.dumps(make_request(0, body, tau=[[None, 0.1], *body["tau"][1:]], t=[1, *range(2, 13)]))
    seen = []
    for number, media_type in enumerate(("application/json", "application/x+json")):
        learning_model = learning_service.create_model(f"read-{number}")
        answer = learning_model.client.post(
            learning_model.url("observations"), content=sent, headers={"content-type": media_type}
        )
        assert answer.status_code == 200, answer.text
        seen.append(answer.json() | {"model": ""})
    assert seen[0] == seen[1]
    assert (seen[0]["rows"], seen[0]["accepted"], seen[0]["rejected"]) == (12, 11, {"non_finite": 1})


def test_implausible_torque_is_not_learnt(learning_model, body):
    send_batch(learning_model, 0, body)
    before = learning_model.wait_for_revision(1)
    for sequence in (1, 2, 3):
        later = slice_rows(18 * sequence, 18 * sequence + 18)
        own = learning_model.predict({name: later[name] for name in ("q", "dq", "ddq")})["tau"]
        tau = {1: np.zeros_like(own).tolist(), 2: own, 3: [later["tau"][0]] * 18}[sequence]
        reply = send_batch(learning_model, sequence, later | {"tau": tau})
        assert (reply["accepted"], reply["rejected"], reply["held"]) == (0, {"implausible": 18}, False)
    after = learning_model.wait_for_revision(reply["revision"])
    for name in ("tau", "tau_std", "scale"):
        assert after[name] == before[name]
    assert learning_model.get("alarms")["items"] == []
    assert send_batch(learning_model, 4, slice_rows(72, 76))["accepted"] == 4


def test_python_client_sends_observations(streaming):
    rng = np.random.default_rng(2)
    q, dq, ddq = rng.uniform(-0.3, 0.3, (3, 5, 7)) + np.array([0, -0.5, 0, -2, 0, 1.5, 0.7])
    with Client(streaming.server.url) as client:
        tau = np.array(client.predict("panda-sim", q, dq, ddq).tau) + 0.01 * rng.standard_normal((5, 7))
        tau[2, 0] = np.nan
        reply = client.observe("panda-sim", "client", 0, q, dq, tau, ddq, t=np.arange(5) / 100)
        assert (reply.rows, reply.accepted, reply.rejected) == (5, 4, {"non_finite": 1})
        names = client.version("panda-sim", 1).joint_names[::-1]
        one = (values[4, ::-1] for values in (q, dq, tau, ddq))
        again = client.observe("panda-sim", "client", 1, *one, t=0.05, joint_names=names)
        assert (again.rows, again.accepted, again.rejected) == (1, 1, {})
