"""Invalid training requests: each is rejected with the wrong field named, and no job is created."""

from functools import cache

import pytest

from lipcore.vocabulary import ESTIMATOR_CHOICES
from tests.service.data import error, queue, stream, upload
from tests.service.training.conftest import assert_invalid

QUICK = {"hyperparameter_samples": 20, "posterior_samples": 40, "max_iterations": 4}


DATASETS = {
    "one": (stream(), {}),
    "two": (stream(seed=2), {}),
    "other": (stream("asr-twodof"), {}),
    "compensated": (stream(), {"torque_convention": "gravity_compensated"}),
}
"""Two data sets of one robot, one of another robot and one of another convention."""


@pytest.fixture
def dataset(no_worker):
    """Upload a data set once; return its id. No job uses it."""
    before = no_worker.get("/v1/jobs").json()
    yield cache(lambda name: upload(no_worker, DATASETS[name][0], **DATASETS[name][1])["id"])
    assert no_worker.get("/v1/jobs").json() == before


def post_job(api, *datasets, **request):
    return api.post("/v1/jobs", json={"model": "m", "datasets": datasets, "options": QUICK, **request})


@pytest.mark.parametrize(
    ("names", "request_", "field", "message"),
    [
        (["one", "one"], {}, "datasets[1]", "repeats data set"),
        (["one", "two", "one"], {}, "datasets", "at most 2"),
        (["one", "other"], {}, "datasets[1]", "`joint_names` of data set"),
        (["compensated", "one"], {}, "datasets[1]", "is gravity_included, that of"),
        (["one"], {"joint_types": ["revolute"]}, "joint_types", "1 entries; the data have 2 joints: joint1, joint2"),
        (["one"], {"joint_types": []}, "joint_types", "0 entries"),
        (["one"], {"joint_types": ["revolute", "screw"]}, "joint_types[1]", "'revolute' or 'prismatic'"),
        (["one"], {"options": {**QUICK, "hyperparameter_samples": 31}}, "options.hyperparameter_samples", ""),
        (["one"], {"options": {**QUICK, "posterior_samples": 41}}, "options.posterior_samples", ""),
        (["one"], {"promotion": "never"}, "promotion", ""),
        (["one"], {"promotion": True}, "promotion", ""),
    ],
)
def test_invalid_request_is_rejected(no_worker, dataset, names, request_, field, message):
    assert_invalid(post_job(no_worker, *map(dataset, names), **request_), field, message)


def test_unknown_estimator_is_rejected_with_the_known_ones(no_worker, dataset):
    reply = error(post_job(no_worker, dataset("one"), estimator="magic"), 422, "invalid_request")
    expected = f"one of {', '.join(ESTIMATOR_CHOICES)}"
    assert reply["detail"][0] == {"field": "estimator", "value": "magic", "expected": expected}


def test_full_queue_is_reported(no_worker):
    dataset = upload(no_worker, stream())["id"]
    waiting = [queue(no_worker, "m", dataset, options=QUICK)["id"] for _ in range(2)]
    assert "2 waiting jobs" in error(post_job(no_worker, dataset), 429, "busy")["message"]

    no_worker.post(f"/v1/jobs/{waiting[0]}/cancel")
    waiting.append(queue(no_worker, "m", dataset, options=QUICK)["id"])
    for name in waiting[1:]:
        assert no_worker.post(f"/v1/jobs/{name}/cancel").json()["state"] == "cancelled"


def test_robot_of_the_data_sets_is_the_default(api, run_here):
    data = upload(api, stream(samples=60, seed=72), robot="double-pendulum")["id"]
    other = upload(api, stream(samples=60, seed=73))["id"]

    def robot(*datasets, **request):
        return post_job(api, *datasets, **{"model": "default-robot", "estimator": "rigid-body", **request}).json()[
            "robot"
        ]

    assert robot(data) == "double-pendulum"
    assert robot(data, robot=None) is None
    assert robot(data, estimator="se") is None
    assert robot(data, other) is None  # one of them has no robot
