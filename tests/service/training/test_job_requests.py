"""Invalid training requests: each is rejected with the wrong field named, and no job is created."""

import pytest

from lipcore.vocabulary import ESTIMATOR_CHOICES
from tests.service.data import error, queue, stream, upload

QUICK = {"hyperparameter_samples": 20, "posterior_samples": 40, "max_iterations": 4}


@pytest.fixture
def datasets(no_worker):
    """Two data sets of one robot, one of another robot and one of another convention; no job uses them."""
    result = {
        "one": upload(no_worker, stream())["id"],
        "two": upload(no_worker, stream(seed=2))["id"],
        "other": upload(no_worker, stream("asr-twodof"))["id"],
        "compensated": upload(no_worker, stream(), torque_convention="gravity_compensated")["id"],
    }
    before = no_worker.get("/v1/jobs").json()
    yield result
    assert no_worker.get("/v1/jobs").json() == before


def post_job(api, datasets, *names, **request):
    ids = [datasets.get(name, name) for name in names or ["one"]]
    return api.post("/v1/jobs", json={"model": "m", "datasets": ids, "options": QUICK, **request})


@pytest.mark.parametrize(
    ("names", "field", "message"),
    [
        (["one", "one"], "datasets[1]", "repeats data set"),
        (["one", "two", "one"], "datasets", "at most 2"),
        (["one", "other"], "datasets[1]", "`joint_names` of data set"),
        (["compensated", "one"], "datasets[1]", "is gravity_included, that of"),
    ],
)
def test_incompatible_data_sets_are_rejected(no_worker, datasets, names, field, message):
    body = {"model": "m", "datasets": [datasets.get(name, name) for name in names], "options": QUICK}
    reply = error(no_worker.post("/v1/jobs", json=body), 422, "invalid_request")
    assert reply["detail"][0]["field"] == field
    assert message in reply["message"]


def test_unknown_estimator_is_rejected_with_the_known_ones(no_worker, datasets):
    reply = error(post_job(no_worker, datasets, estimator="magic"), 422, "invalid_request")
    assert reply["detail"][0] == {
        "field": "estimator",
        "value": "magic",
        "expected": f"one of {', '.join(ESTIMATOR_CHOICES)}",
    }


@pytest.mark.parametrize(
    ("types", "field", "message"),
    [
        (["revolute"], "joint_types", "1 entries; the data have 2 joints: joint1, joint2"),
        ([], "joint_types", "0 entries"),
        (["revolute", "screw"], "joint_types[1]", "'revolute' or 'prismatic'"),
    ],
)
def test_wrong_joint_types_are_rejected(no_worker, datasets, types, field, message):
    reply = error(post_job(no_worker, datasets, joint_types=types), 422, "invalid_request")
    assert reply["detail"][0]["field"] == field
    assert message in reply["message"]


@pytest.mark.parametrize(("name", "maximum"), [("hyperparameter_samples", 30), ("posterior_samples", 40)])
def test_options_obey_the_limits_of_the_service(no_worker, datasets, name, maximum):
    problem = error(post_job(no_worker, datasets, options=QUICK | {name: maximum + 1}), 422, "invalid_request")
    assert problem["detail"][0]["field"] == f"options.{name}"


def test_full_queue_is_reported(no_worker):
    dataset = upload(no_worker, stream())["id"]
    waiting = [queue(no_worker, "m", dataset, options=QUICK)["id"] for _ in range(2)]
    body = {"model": "m", "datasets": [dataset], "options": QUICK}
    assert "2 waiting jobs" in error(no_worker.post("/v1/jobs", json=body), 429, "busy")["message"]

    no_worker.post(f"/v1/jobs/{waiting[0]}/cancel")
    waiting.append(queue(no_worker, "m", dataset, options=QUICK)["id"])
    for name in waiting[1:]:
        assert no_worker.post(f"/v1/jobs/{name}/cancel").json()["state"] == "cancelled"
