"""Requests for training that cannot be granted: refused with the field that is wrong, and no job is made."""

import pytest

from lipcore.vocabulary import ESTIMATOR_CHOICES
from tests.service.data import error, queue, stream, upload

QUICK = {"hyperparameter_samples": 20, "posterior_samples": 40, "max_iterations": 4}


@pytest.fixture
def datasets(no_worker):
    """Two data sets of one robot, one of another robot, one of another convention; no job is made of them."""
    result = {
        "one": upload(no_worker, stream())["id"],
        "two": upload(no_worker, stream(seed=2))["id"],
        "other": upload(no_worker, stream("asr-twodof"))["id"],
        "compensated": upload(no_worker, stream(), torque_convention="gravity_compensated")["id"],
    }
    before = no_worker.get("/v1/jobs").json()
    yield result
    assert no_worker.get("/v1/jobs").json() == before


def ask(api, datasets, *names, **request):
    ids = [datasets.get(name, name) for name in names or ["one"]]
    return api.post("/v1/jobs", json={"model": "m", "datasets": ids, "options": QUICK, **request})


@pytest.mark.parametrize(
    ("names", "field", "message"),
    [
        (["one", "one"], "datasets[1]", "every data set once"),
        (["one", "two", "one"], "datasets", "at most 2"),
        (["one", "other"], "datasets[1]", "joint_names of datasets[0]"),
        (["compensated", "one"], "datasets[1]", "torque_convention of datasets[0], gravity_compensated"),
    ],
)
def test_data_sets_that_do_not_go_together(no_worker, datasets, names, field, message):
    body = {"model": "m", "datasets": [datasets.get(name, name) for name in names], "options": QUICK}
    reply = error(no_worker.post("/v1/jobs", json=body), 422, "invalid_request")
    assert reply["detail"][0]["field"] == field
    assert message in reply["message"]


def test_unknown_estimator_is_refused_with_those_that_are_known(no_worker, datasets):
    reply = error(ask(no_worker, datasets, estimator="magic"), 422, "invalid_request")
    assert reply["detail"][0] == {
        "field": "estimator",
        "value": "magic",
        "expected": f"one of {', '.join(ESTIMATOR_CHOICES)}",
    }


@pytest.mark.parametrize(
    ("types", "field", "message"),
    [
        (["revolute"], "joint_types", "expected 2, one a joint: joint1, joint2"),
        ([], "joint_types", "0 types"),
        (["revolute", "screw"], "joint_types[1]", "'revolute' or 'prismatic'"),
    ],
)
def test_joint_types_that_do_not_fit(no_worker, datasets, types, field, message):
    reply = error(ask(no_worker, datasets, joint_types=types), 422, "invalid_request")
    assert reply["detail"][0]["field"] == field
    assert message in reply["message"]


@pytest.mark.parametrize(("name", "most"), [("hyperparameter_samples", 30), ("posterior_samples", 40)])
def test_options_have_the_limits_of_the_service(no_worker, datasets, name, most):
    problem = error(ask(no_worker, datasets, options=QUICK | {name: most + 1}), 422, "invalid_request")
    assert problem["detail"][0]["field"] == f"options.{name}"


def test_a_full_queue_is_said(no_worker):
    dataset = upload(no_worker, stream())["id"]
    waiting = [queue(no_worker, "m", dataset, options=QUICK)["id"] for _ in range(2)]
    body = {"model": "m", "datasets": [dataset], "options": QUICK}
    assert "2 jobs are waiting" in error(no_worker.post("/v1/jobs", json=body), 429, "busy")["message"]

    no_worker.post(f"/v1/jobs/{waiting[0]}/cancel")
    waiting.append(queue(no_worker, "m", dataset, options=QUICK)["id"])
    for name in waiting[1:]:
        assert no_worker.post(f"/v1/jobs/{name}/cancel").json()["state"] == "cancelled"
