"""Traces: a model's torques along a data set, row by row, and the notes on omitted rows."""

import numpy as np
import pytest

from service.inference.predicting import MAX_COMPONENT_BATCH
from tests.service.data import arrays, error, npz, post, stream, train, upload


def post_trace(api, model, dataset, **request):
    return api.post(f"/v1/models/{model}/trace", json={"dataset": dataset} | request)


def trace(api, model, dataset, **request):
    answer = post_trace(api, model, dataset, **request)
    assert answer.status_code == 200, answer.text
    return answer.json()


def rejection(api, model, dataset, **request):
    return error(post_trace(api, model, dataset, **request), 422, "invalid_request")["detail"][0]


@pytest.fixture(scope="module")
def unseen_dataset(api):
    """A data set of the pendulum that no model was trained on."""
    return upload(api, stream(seed=17))["id"]


def test_every_row_is_shown_if_points_suffice(api, trained, unseen_dataset):
    samples, answer = stream(seed=17), trace(api, trained.name, unseen_dataset)
    predicted = trained.model.predict(samples.q, samples.dq, samples.ddq)
    assert answer["rows"] == list(range(80))
    np.testing.assert_array_equal(answer["t"], samples.t)
    np.testing.assert_array_equal(answer["tau"], samples.tau)
    for name, field in (("mean", "tau"), ("std", "tau_std"), ("noise_std", "noise_std")):
        np.testing.assert_allclose(answer[name], getattr(predicted, field), rtol=1e-12)
    assert answer["components"] == {}


def test_answer_describes_its_rows(api, trained, unseen_dataset):
    answer = trace(api, trained.name, unseen_dataset, version=1, start=10, stop=70, points=20)
    assert (answer["model"], answer["version"], answer["revision"]) == (trained.name, 1, 0)
    assert (answer["dataset"], answer["part"], answer["in_training"]) == (unseen_dataset, "all", False)
    assert (answer["samples"], answer["in_range"], answer["shown"]) == (80, 60, 20)
    assert (answer["torque_convention"], answer["joint_names"]) == ("gravity_included", ["joint1", "joint2"])
    assert answer["offered"] == ["inertial", "coriolis", "gravity", "friction"]


@pytest.mark.parametrize("points", [1, 7, 61])
def test_rows_are_thinned_evenly(api, trained, unseen_dataset, points):
    answer = trace(api, trained.name, unseen_dataset, start=10, stop=70, points=points)
    rows, samples = np.array(answer["rows"]), stream(seed=17)
    count = min(points, 60)
    assert len(rows) == answer["shown"] == count
    assert rows[0] == 10
    if count > 1:
        assert rows[-1] == 69
        assert set(np.diff(rows)) <= {59 // (count - 1), 59 // (count - 1) + 1}
    np.testing.assert_array_equal(answer["tau"], samples.tau[rows])
    np.testing.assert_array_equal(answer["t"], samples.t[rows])


def test_components_are_computed_in_batches(strict):
    """The trace has more rows than one query with components may have."""
    dataset = upload(strict, stream("panda", 120, motion="middle"))["id"]
    assert MAX_COMPONENT_BATCH < 120
    entire, some = (
        trace(strict, "panda-sim", dataset, components=["friction"], **part)["components"]["friction"]
        for part in ({}, {"start": 90, "stop": 110})
    )
    assert np.shape(entire["mean"]) == (120, 7)
    for name in ("mean", "std"):
        np.testing.assert_allclose(entire[name][90:110], some[name], rtol=1e-6, atol=1e-12)


def test_lines_break_between_episodes(api, trained):
    samples = stream(seed=18)
    episode = np.repeat([0, 1, 2], [30, 20, 30])
    names = np.array(samples.joint_names)
    dataset = post(api, npz(**arrays(samples), episode=episode, joint_names=names)).json()["id"]
    assert trace(api, trained.name, dataset)["breaks"] == [30, 50]
    assert trace(api, trained.name, dataset, start=30, stop=50)["breaks"] == []
    thinned = trace(api, trained.name, dataset, points=9)
    rows = np.array(thinned["rows"])
    assert thinned["breaks"] == [int(np.argmax(rows >= first)) for first in (30, 50)]


@pytest.fixture(scope="module")
def held_out_blocks(api):
    """A model that held blocks out of its data set, and the data set."""
    dataset = upload(api, stream(samples=120, rate=10.0, seed=19))["id"]
    train(api, "traced", dataset, holdout={"kind": "blocks", "share": 0.4, "blocks": 10})
    return "traced", dataset


def test_held_out_rows_are_traced_alone(api, held_out_blocks):
    entire, part = trace(api, *held_out_blocks), trace(api, *held_out_blocks, part="held_out")
    # all rows were learnt after the model was judged
    assert (entire["in_training"], part["in_training"]) == (True, True)
    assert part["samples"] == part["in_range"] == part["shown"] == len(part["rows"]) < 120
    rows = np.array(part["rows"])
    np.testing.assert_array_equal(part["tau"], np.array(entire["tau"])[rows])
    assert part["breaks"] == (np.flatnonzero(np.diff(rows) > 1) + 1).tolist()
    assert part["breaks"]


def test_range_without_held_out_rows_is_rejected(api, held_out_blocks):
    part = np.array(trace(api, *held_out_blocks, part="held_out")["rows"])
    gap = int(part[np.argmax(np.diff(part) > 1)]) + 1
    reply = rejection(api, *held_out_blocks, part="held_out", start=gap, stop=gap + 1)
    assert reply["field"] == "start"
    assert reply["expected"] == "a range with held-out rows"


def test_wrong_fields_are_named(api, trained, unseen_dataset):
    for request, field in (({"start": 80}, "start"), ({"start": 10, "stop": 10}, "stop"), ({"points": 2001}, "points")):
        assert rejection(api, trained.name, unseen_dataset, **request)["field"] == field
    problem = rejection(api, trained.name, trained.dataset, part="held_out")
    assert (problem["field"], problem["value"]) == ("part", "held_out")
    assert "has no held-out rows" in problem["expected"]
