"""Training a second robot from a base version: what is rejected, what is kept, and when the base may be deleted."""

import numpy as np
import pytest

from service.models import registry
from tests.service.data import error, job, queue, service_of, stream, train, upload
from tests.service.models.archives.packing import exported, imported
from tests.service.training.conftest import refresh

FIRST = "unit-1"


@pytest.fixture(scope="module")
def second(api):
    """A data set of a second Panda with friction of its own."""
    return upload(api, stream("panda", 60, seed=7, viscous=0.5), name="second")


@pytest.fixture
def base_version(api):
    """The number of the first of two versions of the shipped Panda under another name; its alias is `old`."""
    versions = [imported(api, exported(api, "panda-sim"), name=FIRST)["version"] for _ in range(2)]
    api.put(f"/v1/models/{FIRST}/aliases/serving", json={"version": versions[1]})
    api.put(f"/v1/models/{FIRST}/aliases/old", json={"version": versions[0]})
    yield versions[0]
    api.delete(f"/v1/models/{FIRST}")


@pytest.mark.slow
def test_version_trained_from_a_base_outlives_it(api, base_version, second):
    seen = train(api, "unit-2", second["id"], estimator="rigid-body", base=f"{FIRST}@old")
    assert seen["base"] == f"{FIRST}:{base_version}"
    version = api.get("/v1/models/unit-2/versions/1").json()
    tensors = registry.find(service_of(api).database, FIRST, base_version).manifest["tensors"]
    assert version["lineage"]["base"] == {"model": FIRST, "version": base_version, "sha256": tensors["sha256"]}
    assert version["parameters"]["geometry"]["mode"] == "calibrate"
    assert (np.abs(np.array(version["parameters"]["friction"]["viscous"]["mean"]) - 0.5) < 0.1).all()
    assert api.delete(f"/v1/models/{FIRST}").status_code == 204
    unseen = stream("panda", 50, seed=8, viscous=0.5)
    query = {name: getattr(unseen, name).tolist() for name in ("q", "dq", "ddq")}
    tau = np.array(api.post("/v1/models/unit-2/predict", json=query).json()["tau"])
    assert (np.mean((tau - unseen.tau) ** 2, axis=0) < 0.05 * unseen.tau.var(axis=0)).all()
    refreshed = api.get(f"/v1/models/unit-2/versions/{refresh(api, 'unit-2')['version']}").json()
    assert refreshed["lineage"]["base"] == version["lineage"]["base"]
    assert refreshed["parameters"]["geometry"]["mode"] == "calibrate"


def post_job(api, *datasets, **request):
    return api.post("/v1/jobs", json={"model": "refused", "datasets": datasets, "base": "panda-sim:1", **request})


@pytest.mark.parametrize(
    ("given", "field", "message"),
    [
        (
            {"estimator": "lip-chain"},
            "estimator",
            "one of auto, rigid-body, rigid-body+local, rigid-body+lip-chain if",
        ),
        ({"base": "pendulum:1"}, "base", "a version of estimator rigid-body or rigid-body"),
        ({"joint_types": ["prismatic"] * 7}, "base", "joint_types of the data, prismatic, prismatic"),
        ({"robot": "panda"}, "robot", "no robot together with a base"),
        ({"options": {"geometry": "learn"}}, "options.geometry", "auto, calibrate or fixed if a base is given"),
        ({"options": {"prior": "zero"}}, "options.prior", "the default if a base is given"),
        ({"base": "panda-sim@"}, "base", "pattern"),
        ({"base": "panda-sim:0"}, "base", "pattern"),
    ],
)
def test_unsuitable_base_is_rejected(api, trained, second, given, field, message):
    request = {"estimator": "rigid-body", "base": "panda-sim", **given}
    detail = error(post_job(api, second["id"], **request), 422, "invalid_request")["detail"][0]
    assert detail["field"] == field
    assert message in detail["expected"]
    error(api.get("/v1/models/refused"), 404, "not_found")


@pytest.mark.parametrize(
    ("robot", "what", "convention"),
    [
        ("double-pendulum", "joint_names", "gravity_included"),
        ("panda", "torque_convention", "gravity_compensated"),
    ],
)
def test_base_of_other_data_is_rejected(api, robot, what, convention):
    dataset = upload(api, stream(robot, 60), torque_convention=convention)
    detail = error(post_job(api, dataset["id"]), 422, "invalid_request")["detail"][0]
    assert (detail["field"], detail["value"]) == ("base", "panda-sim:1")
    assert f"a version with the {what} of the data" in detail["expected"]


@pytest.mark.parametrize(
    ("base", "message"),
    [("nobody", "no model 'nobody'"), ("panda-sim:99", "no version '99'"), ("panda-sim@none", "no alias 'none'")],
)
def test_missing_base_is_rejected(api, second, base, message):
    assert message in error(post_job(api, second["id"], base=base), 404, "not_found")["message"]


def test_base_is_kept_while_a_job_waits_for_it(api, base_version, second, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(service_of(api).jobs, "submit", lambda job: None)
        waiting = queue(api, "unit-3", second["id"], estimator="rigid-body", base=f"{FIRST}@old")
        api.delete(f"/v1/models/{FIRST}/aliases/old")
        for path in (f"{FIRST}/versions/{base_version}", FIRST):
            refusal = error(api.delete(f"/v1/models/{path}"), 409, "conflict")["message"]
            assert f"{waiting['id']} starts from" in refusal
        api.post(f"/v1/jobs/{waiting['id']}/cancel")
    assert job(api, waiting["id"])["base"] == f"{FIRST}:{base_version}"
    assert api.delete(f"/v1/models/{FIRST}/versions/{base_version}").status_code == 204
