"""Traces: a model's torques along a data set, row by row, and what is said where not every row is shown."""

import numpy as np
import pytest

from service.inference.predicting import MAX_COMPONENT_BATCH
from tests.service.data import arrays, error, npz, post, stream, train, upload

PARTS = ["inertial", "coriolis", "gravity", "friction"]


def ask(api, model, dataset, **request):
    return api.post(f"/v1/models/{model}/trace", json={"dataset": dataset} | request)


def traced(api, model, dataset, **request):
    answer = ask(api, model, dataset, **request)
    assert answer.status_code == 200, answer.text
    return answer.json()


def refused(api, model, dataset, **request):
    return error(ask(api, model, dataset, **request), 422, "invalid_request")["detail"][0]


@pytest.fixture(scope="module")
def unseen(api):
    """A data set of the pendulum that no model was trained on."""
    return upload(api, stream(seed=17))["id"]


def test_every_row_is_shown_where_there_are_no_more_than_points(api, trained, unseen):
    samples, answer = stream(seed=17), traced(api, trained.name, unseen)
    predicted = trained.model.predict(samples.q, samples.dq, samples.ddq)
    assert answer["rows"] == list(range(80))
    np.testing.assert_array_equal(answer["t"], samples.t)
    np.testing.assert_array_equal(answer["tau"], samples.tau)
    np.testing.assert_allclose(answer["mean"], predicted.tau, rtol=1e-12)
    np.testing.assert_allclose(answer["std"], predicted.tau_std, rtol=1e-12)
    np.testing.assert_allclose(answer["noise_std"], predicted.noise_std, rtol=1e-12)
    assert answer["components"] == {}


def test_the_answer_says_what_is_shown(api, trained, unseen):
    answer = traced(api, trained.name, unseen, version=1, start=10, stop=70, points=20)
    assert (answer["model"], answer["version"], answer["revision"]) == (trained.name, 1, 0)
    assert (answer["dataset"], answer["part"], answer["torque_convention"]) == (unseen, "all", "gravity_included")
    assert (answer["samples"], answer["in_range"], answer["shown"]) == (80, 60, 20)
    assert answer["joint_names"] == ["joint1", "joint2"]
    assert answer["in_training"] is False
    assert answer["offered"] == PARTS


@pytest.mark.parametrize("points", [1, 7, 61])
def test_rows_are_thinned_evenly(api, trained, unseen, points):
    answer = traced(api, trained.name, unseen, start=10, stop=70, points=points)
    rows, samples = np.array(answer["rows"]), stream(seed=17)
    count = min(points, 60)
    assert len(rows) == answer["shown"] == count
    assert rows[0] == 10
    assert count == 1 or rows[-1] == 69
    assert count == 1 or set(np.diff(rows)) <= {59 // (count - 1), 59 // (count - 1) + 1}
    np.testing.assert_array_equal(answer["tau"], samples.tau[rows])
    np.testing.assert_array_equal(answer["t"], samples.t[rows])


def test_components_are_computed_a_batch_at_a_time(strict):
    """More rows than one request of queries with components may have."""
    dataset = upload(strict, stream("panda", 120, motion="middle"))["id"]
    assert MAX_COMPONENT_BATCH < 120
    answer = traced(strict, "panda-sim", dataset, components=["friction"])
    some = traced(strict, "panda-sim", dataset, components=["friction"], start=90, stop=110)
    assert np.shape(answer["components"]["friction"]["mean"]) == (120, 7)
    for name in ("mean", "std"):
        both = answer["components"]["friction"][name][90:110], some["components"]["friction"][name]
        np.testing.assert_allclose(*both, rtol=1e-6, atol=1e-12)


def test_lines_break_between_episodes(api, trained):
    samples = stream(seed=18)
    episode = np.repeat([0, 1, 2], [30, 20, 30])
    names = np.array(samples.joint_names)
    dataset = post(api, npz(**arrays(samples), episode=episode, joint_names=names)).json()["id"]
    assert traced(api, trained.name, dataset)["breaks"] == [30, 50]
    assert traced(api, trained.name, dataset, start=30, stop=50)["breaks"] == []
    thinned = traced(api, trained.name, dataset, points=9)
    rows = np.array(thinned["rows"])
    assert thinned["breaks"] == [int(np.argmax(rows >= first)) for first in (30, 50)]


@pytest.fixture(scope="module")
def held(api):
    """A model that held blocks out of its data set, and the data set."""
    dataset = upload(api, stream(samples=120, rate=10.0, seed=19))["id"]
    train(api, "traced", dataset, holdout={"kind": "blocks", "share": 0.4, "blocks": 10})
    return "traced", dataset


def test_what_was_held_out_is_traced_alone(api, held):
    entire, part = traced(api, *held), traced(api, *held, part="held_out")
    assert (entire["in_training"], part["in_training"]) == (True, True)  # all rows were learnt once it was judged
    assert part["samples"] == part["in_range"] == part["shown"] == len(part["rows"]) < 120
    rows = np.array(part["rows"])
    np.testing.assert_array_equal(part["tau"], np.array(entire["tau"])[rows])
    assert part["breaks"] == (np.flatnonzero(np.diff(rows) > 1) + 1).tolist()
    assert part["breaks"]


def test_a_range_without_held_out_rows_is_refused(api, held):
    part = np.array(traced(api, *held, part="held_out")["rows"])
    gap = int(part[np.argmax(np.diff(part) > 1)]) + 1
    reply = refused(api, *held, part="held_out", start=gap, stop=gap + 1)
    assert reply["field"] == "start"
    assert f"{part[0]} and {part[-1]}" in reply["expected"]


def test_bad_requests_are_named(api, trained, unseen):
    for request, field in (({"start": 80}, "start"), ({"start": 10, "stop": 10}, "stop"), ({"points": 2001}, "points")):
        assert refused(api, trained.name, unseen, **request)["field"] == field
    problem = refused(api, trained.name, trained.dataset, part="held_out")
    assert (problem["field"], problem["value"]) == ("part", "held_out")
    assert "has held nothing out" in problem["expected"]
