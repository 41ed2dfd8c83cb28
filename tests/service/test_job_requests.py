"""Requests for training that cannot be granted: refused with the field that is wrong, and no job is made."""

from __future__ import annotations

import pytest

from lipcore.vocabulary import CHOICES
from tests.service.data import error, queue, stream, upload

QUICK = {"hyperparameter_samples": 20, "posterior_samples": 40, "max_iterations": 4}


@pytest.fixture
def datasets(no_worker):
    """Two data sets of one robot, one of another robot, one of another convention; no job is made of them."""
    found = {
        "one": upload(no_worker, stream())["id"],
        "two": upload(no_worker, stream(seed=2))["id"],
        "other": upload(no_worker, stream("asr-twodof"))["id"],
        "compensated": upload(no_worker, stream(), torque_convention="gravity_compensated")["id"],
    }
    before = no_worker.get("/v1/jobs").json()
    yield found
    assert no_worker.get("/v1/jobs").json() == before


def ask(api, datasets, *names, **request):
    ids = [datasets.get(name, name) for name in names or ["one"]]
    return api.post("/v1/jobs", json={"model": "m", "datasets": ids, "options": QUICK, **request})


@pytest.mark.parametrize(
    "name",
    ["../x", "..", "A", "", "a" * 65, "a" * 100, "ä", "a b", "a/b", "a\\b", "a\n", ".hidden", "-a", "a\0", 7],
)
def test_model_names_that_are_refused(no_worker, datasets, name):
    said = error(ask(no_worker, datasets, model=name), 422, "invalid_request")
    assert said["detail"][0]["field"] == "model"


def test_unknown_data_set_is_not_found(no_worker, datasets):
    assert "ds_nowhere" in error(ask(no_worker, datasets, "one", "ds_nowhere"), 404, "not_found")["message"]


@pytest.mark.parametrize(
    ("names", "field", "message"),
    [
        ([], "datasets", "at least 1"),
        (["one", "one"], "datasets[1]", "every data set once"),
        (["one", "two", "one"], "datasets", "at most 2"),
        (["one", "other"], "datasets[1]", "joint_names of datasets[0]"),
        (["compensated", "one"], "datasets[1]", "torque_convention of datasets[0], gravity_compensated"),
        (["x" * 41], "datasets[0]", "40"),
    ],
)
def test_data_sets_that_do_not_go_together(no_worker, datasets, names, field, message):
    body = {"model": "m", "datasets": [datasets.get(name, name) for name in names], "options": QUICK}
    said = error(no_worker.post("/v1/jobs", json=body), 422, "invalid_request")
    assert said["detail"][0]["field"] == field
    assert message in said["message"]


def test_unknown_estimator_is_refused_with_those_that_are_known(no_worker, datasets):
    said = error(ask(no_worker, datasets, estimator="magic"), 422, "invalid_request")
    assert said["detail"][0] == {"field": "estimator", "value": "magic", "expected": f"one of {', '.join(CHOICES)}"}


@pytest.mark.parametrize(
    ("types", "field", "message"),
    [
        (["revolute"], "joint_types", "expected 2, one a joint: joint1, joint2"),
        (["revolute"] * 3, "joint_types", "3 types"),
        ([], "joint_types", "0 types"),
        (["revolute", "screw"], "joint_types[1]", "'revolute' or 'prismatic'"),
        ("revolute", "joint_types", "list"),
    ],
)
def test_joint_types_that_do_not_fit(no_worker, datasets, types, field, message):
    said = error(ask(no_worker, datasets, joint_types=types), 422, "invalid_request")
    assert said["detail"][0]["field"] == field
    assert message in said["message"]


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"iterations": 5}, "options.iterations"),
        ({"hyperparameter_samples": 9}, "options.hyperparameter_samples"),
        ({"hyperparameter_samples": 31, "posterior_samples": 40}, "options.hyperparameter_samples"),
        ({"hyperparameter_samples": 20, "posterior_samples": 41}, "options.posterior_samples"),
        ({"hyperparameter_samples": "many"}, "options.hyperparameter_samples"),
        ({"posterior_samples": 10**30}, "options.posterior_samples"),
        ({"posterior_samples": 12.5}, "options.posterior_samples"),
        ({"max_iterations": 0}, "options.max_iterations"),
        ({"max_iterations": 10_001}, "options.max_iterations"),
        ({"tied": "perhaps"}, "options.tied"),
        ({"device": "tpu"}, "options.device"),
        ([], "options"),
    ],
)
def test_options_that_are_refused(no_worker, datasets, options, field):
    if isinstance(options, dict):
        options = QUICK | options
    said = error(ask(no_worker, datasets, options=options), 422, "invalid_request")
    assert said["detail"][0]["field"] == field


def test_unknown_and_missing_fields_are_named(no_worker):
    said = error(no_worker.post("/v1/jobs", json={"modle": "m"}), 422, "invalid_request")
    assert {item["field"]: item["expected"] for item in said["detail"]} == {
        "model": "a value",
        "datasets": "a value",
        "modle": "no field of that name",
    }


def test_a_full_queue_is_said(no_worker):
    dataset = upload(no_worker, stream())["id"]
    waiting = [queue(no_worker, "m", dataset, options=QUICK)["id"] for _ in range(2)]
    body = {"model": "m", "datasets": [dataset], "options": QUICK}
    assert "2 jobs are waiting" in error(no_worker.post("/v1/jobs", json=body), 429, "busy")["message"]

    no_worker.post(f"/v1/jobs/{waiting[0]}/cancel")
    waiting.append(queue(no_worker, "m", dataset, options=QUICK)["id"])
    for name in waiting[1:]:
        assert no_worker.post(f"/v1/jobs/{name}/cancel").json()["state"] == "cancelled"
