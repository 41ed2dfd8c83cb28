"""Training a second unit from a version of another: what is refused, what is kept, and that the other may go."""

import numpy as np
import pytest

from service.models import registry
from tests.service.archives.packing import exported, send
from tests.service.data import ended, error, job, queue, service_of, stream, train, upload

FIRST = "unit-1"


@pytest.fixture(scope="module")
def second(api):
    """A data set of a second Panda, with friction of its own."""
    return upload(api, stream("panda", 60, seed=7, viscous=0.5), name="second")


@pytest.fixture
def first(api):
    """The shipped Panda under another name, in two versions; the number of the first, which is called `old`."""
    versions = [send(api, exported(api, "panda-sim"), name=FIRST).json()["version"] for _ in range(2)]
    api.put(f"/v1/models/{FIRST}/aliases/serving", json={"version": versions[1]})
    api.put(f"/v1/models/{FIRST}/aliases/old", json={"version": versions[0]})
    yield versions[0]
    api.delete(f"/v1/models/{FIRST}")


def test_a_unit_starts_from_another_which_may_go(api, first, second):
    seen = train(api, "unit-2", second["id"], estimator="rigid-body", base=f"{FIRST}@old")
    assert seen["base"] == f"{FIRST}:{first}"
    version = api.get("/v1/models/unit-2/versions/1").json()
    tensors = registry.find(service_of(api).database, FIRST, first).manifest["tensors"]
    assert version["lineage"]["base"] == {"model": FIRST, "version": first, "sha256": tensors["sha256"]}
    assert version["parameters"]["geometry"]["mode"] == "calibrate"
    assert (np.abs(np.array(version["parameters"]["friction"]["viscous"]["mean"]) - 0.5) < 0.1).all()
    assert api.delete(f"/v1/models/{FIRST}").status_code == 204
    unseen = stream("panda", 50, seed=8, viscous=0.5)
    query = {name: getattr(unseen, name).tolist() for name in ("q", "dq", "ddq")}
    tau = np.array(api.post("/v1/models/unit-2/predict", json=query).json()["tau"])
    assert (np.mean((tau - unseen.tau) ** 2, axis=0) < 0.05 * unseen.tau.var(axis=0)).all()
    again = ended(api, api.post("/v1/models/unit-2/refresh", json={}).json()["id"])
    refreshed = api.get(f"/v1/models/unit-2/versions/{again['version']}").json()
    assert refreshed["lineage"]["base"] == version["lineage"]["base"]
    assert refreshed["parameters"]["geometry"]["mode"] == "calibrate"


@pytest.mark.parametrize(
    ("given", "field", "message"),
    [
        (
            {"estimator": "lip-chain"},
            "estimator",
            "one of auto, rigid-body, rigid-body+local, rigid-body+lip-chain with",
        ),
        ({"base": "pendulum:1"}, "base", "a version whose estimator has an arm, rigid-body or rigid-body"),
        ({"joint_types": ["prismatic"] * 7}, "base", "joint_types of the data, prismatic, prismatic"),
        ({"robot": "panda"}, "robot", "none with a base"),
        ({"options": {"geometry": "learn"}}, "options.geometry", "auto, calibrate or fixed with a base"),
        ({"options": {"prior": "zero"}}, "options.prior", "the default with a base"),
        ({"base": "panda-sim@"}, "base", "pattern"),
        ({"base": "panda-sim:0"}, "base", "pattern"),
    ],
)
def test_a_base_that_cannot_be_started_from(api, trained, second, given, field, message):
    body = {"model": "refused", "datasets": [second["id"]], "estimator": "rigid-body", "base": "panda-sim", **given}
    reply = error(api.post("/v1/jobs", json=body), 422, "invalid_request")
    assert reply["detail"][0]["field"] == field
    assert message in reply["detail"][0]["expected"]
    error(api.get("/v1/models/refused"), 404, "not_found")


@pytest.mark.parametrize(("what", "params"), [("joint_names", {}), ("torque_convention", {})])
def test_a_base_of_other_data(api, pendulum, what, params):
    dataset = pendulum
    if what == "torque_convention":
        dataset = upload(api, stream("panda", 60), torque_convention="gravity_compensated")
    body = {"model": "refused", "datasets": [dataset["id"]], "base": "panda-sim:1"}
    detail = error(api.post("/v1/jobs", json=body), 422, "invalid_request")["detail"][0]
    assert (detail["field"], detail["value"]) == ("base", "panda-sim:1")
    assert f"a version with the {what} of the data" in detail["expected"]


@pytest.mark.parametrize(
    ("base", "message"),
    [("nobody", "no model 'nobody'"), ("panda-sim:99", "no version '99'"), ("panda-sim@none", "no alias 'none'")],
)
def test_a_base_that_there_is_not(api, second, base, message):
    body = {"model": "refused", "datasets": [second["id"]], "base": base}
    assert message in error(api.post("/v1/jobs", json=body), 404, "not_found")["message"]


def test_a_base_stays_while_a_job_waits_for_it(api, first, second, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(service_of(api).jobs, "submit", lambda job: None)
        waiting = queue(api, "unit-3", second["id"], estimator="rigid-body", base=f"{FIRST}@old")
        api.delete(f"/v1/models/{FIRST}/aliases/old")
        for path in (f"{FIRST}/versions/{first}", FIRST):
            refusal = error(api.delete(f"/v1/models/{path}"), 409, "conflict")["message"]
            assert f"{waiting['id']} starts from" in refusal
        api.post(f"/v1/jobs/{waiting['id']}/cancel")
    assert job(api, waiting["id"])["base"] == f"{FIRST}:{first}"
    assert api.delete(f"/v1/models/{FIRST}/versions/{first}").status_code == 204
