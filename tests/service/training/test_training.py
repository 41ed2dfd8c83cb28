"""A training job from the request to the version that it creates."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.outliers import CorruptRows
from service.datasets import staging
from service.training import worker
from service.training.pulse import Heartbeat
from tests.service.data import (
    ENDLESS,
    QUICK,
    arrays,
    error,
    eventually,
    job,
    npz,
    post,
    queue,
    running,
    service_of,
    stream,
    train,
    upload,
)

QUERY = {"q": [0.3, -0.2], "dq": [0.1, 0.4], "ddq": [1.0, -0.5]}


@pytest.fixture(scope="module")
def two_versions(api, pendulum):
    """A model trained twice, the second time on two data sets: both jobs and all data sets."""
    more = upload(api, stream(seed=2), name="more")
    jobs = [train(api, "twice", pendulum["id"]), train(api, "twice", more["id"], pendulum["id"])]
    return jobs, [pendulum, more]


def test_succeeded_job_names_its_version(two_versions):
    for version, seen in enumerate(two_versions[0], start=1):
        assert (seen["state"], seen["version"], seen["attempts"], seen["error"]) == ("succeeded", version, 1, None)
        assert (seen["model"], seen["estimator"]) == ("twice", "lip-chain")
        assert (seen["progress"]["stage"], seen["progress"]["fraction"]) == ("done", 1.0)
        assert seen["created_at"] <= seen["started_at"] <= seen["heartbeat_at"] <= seen["finished_at"]


def test_progress_moves_while_the_objective_falls(api):
    dataset = upload(api, stream("panda", 200))["id"]
    seen = queue(api, "progress", dataset, options=ENDLESS)
    first = running(api, seen["id"])
    assert (first["state"], first["progress"]["stage"]) == ("running", "hyperparameters")
    assert first["progress"]["max_iterations"] == 10_000
    later = eventually(
        lambda: (now := job(api, seen["id"]))["progress"]["iteration"] > first["progress"]["iteration"] and now
    )
    assert 0 < first["progress"]["fraction"] < later["progress"]["fraction"] < 1
    assert later["progress"]["elapsed_s"] > first["progress"]["elapsed_s"]
    assert later["progress"]["objective"] < first["progress"]["objective"]
    assert later["heartbeat_at"] > first["heartbeat_at"]
    api.post(f"/v1/jobs/{seen['id']}/cancel")


@pytest.mark.parametrize("statistics", ["chosen", "all"])
def test_fraction_done_never_falls(api, monkeypatch, statistics):
    service, seen = service_of(api), []
    monkeypatch.setattr(service.jobs, "submit", lambda job: None)
    for name in ("plan", "progress", "last_fit", "share", "stage"):
        monkeypatch.setattr(Heartbeat, name, record_progress(getattr(Heartbeat, name), seen))
    dataset = upload(api, stream(samples=150, seed=4))["id"]
    options = {**QUICK, "statistics": statistics}
    name = queue(api, f"learns-{statistics}", dataset, options=options, holdout={"share": 0.3})["id"]
    service.jobs.replicas.claim(name, None)
    worker.run(service.settings, name)
    assert job(api, name)["state"] == "succeeded"
    fractions = [each["fraction"] for each in seen]
    assert fractions == sorted(fractions)
    assert fractions[-1] < 1
    stages = [*dict.fromkeys(each["stage"] for each in seen)]
    passes = ["statistics"] if statistics == "all" else []
    assert stages == ["loading", "hyperparameters", "posterior", *passes, "evaluating", "all_rows", "saving"]
    fit = api.get(f"/v1/models/learns-{statistics}/versions/1").json()["fit"]
    assert (fit["samples_given"], fit["samples_posterior"]) == (150, 150 if statistics == "all" else 60)


def record_progress(method, seen):
    """Wrap a method of a heartbeat so that it records the progress afterwards."""

    def call(self, *given):
        method(self, *given)
        seen.append({"fraction": 0.0, **self.as_json()})

    return call


def test_lineage_names_the_data_with_their_hashes(api, two_versions):
    jobs, (pendulum, more) = two_versions
    for version, expected in ((1, [pendulum]), (2, [more, pendulum])):
        view = api.get(f"/v1/models/twice/versions/{version}").json()
        record = ("id", "name", "sha256", "rows")
        assert [{name: each[name] for name in record} for each in view["lineage"]["datasets"]] == [
            {"id": d["id"], "name": d["name"], "sha256": d["sha256"], "rows": d["report"]["rows"]} for d in expected
        ]
        assert [each["recipe"]["cutoff_hz"] for each in view["lineage"]["datasets"]] == [4.0] * len(expected)
        assert view["job"] == view["lineage"]["job"] == jobs[version - 1]["id"]
        assert view["fit"]["samples_given"] == 80 * len(expected)


def test_version_shows_how_it_was_made(api, two_versions):
    view = api.get("/v1/models/twice/versions/1").json()
    assert (view["model"], view["version"], view["estimator"]) == ("twice", 1, "lip-chain")
    assert view["joint_names"] == ["joint1", "joint2"]
    assert view["joint_types"] == ["revolute", "revolute"]
    assert view["torque_convention"] == "gravity_included"
    assert {**view["options"], **QUICK} == view["options"]
    assert view["fit"]["iterations"] <= QUICK["max_iterations"]
    assert view["fit"]["samples_posterior"] == 80  # all rows of a slow recording are learnt
    q = stream().q
    assert (view["training_range"]["q"]["min"] >= q.min(axis=0)).all()
    assert (view["training_range"]["q"]["max"] <= q.max(axis=0)).all()


def test_convention_and_options_of_the_job_are_kept(api):
    dataset = upload(api, stream(), torque_convention="gravity_compensated")["id"]
    train(api, "compensated", dataset, options={**QUICK, "tied": False})
    version = api.get("/v1/models/compensated/versions/1").json()
    assert (version["torque_convention"], version["options"]["tied"]) == ("gravity_compensated", False)
    assert api.post("/v1/models/compensated/predict", json=QUERY).json()["torque_convention"] == "gravity_compensated"


def test_upload_omits_and_reports_corrupt_rows(api):
    sound = stream(samples=300, seed=8)
    tau = sound.tau.copy()
    tau[120, 1] = 1e12
    seen = upload(api, replace(sound, tau=tau))["report"]
    assert (seen["rows_uploaded"], seen["rows"]) == (300, 299)
    assert "1 row inconsistent with neighbouring rows left out, the first is row 121" in seen["preparation"]
    tau[::30] = 1e9
    body = error(post(api, npz(**arrays(replace(sound, tau=tau)))), 422, "invalid_data")
    assert body["detail"][0]["field"] == "rows"
    assert "10 corrupt of 300 (the first are 1, 31" in body["detail"][0]["value"]
    assert body["detail"][0]["expected"] == "at most 6"


@pytest.mark.slow
def test_job_learns_nothing_from_stored_corrupt_rows(api, monkeypatch):
    """An earlier release stored such data sets unchanged."""
    sound, row = stream(samples=300, seed=9), 120
    tau = sound.tau.copy()
    tau[row, 0] = 1e12
    monkeypatch.setattr(
        staging, "find_corrupt_rows", lambda t, episode, *_: CorruptRows(np.zeros(len(episode), bool), episode)
    )
    spoilt = upload(api, replace(sound, tau=tau))["id"]
    without = upload(api, sound.rows(np.arange(300) != row))["id"]
    for name, dataset in (("spoilt", spoilt), ("without", without)):
        train(api, name, dataset)
    version, expected = (api.get(f"/v1/models/{name}/versions/1").json() for name in ("spoilt", "without"))
    assert version["lineage"]["corrupt"] == [{"id": spoilt, "rows": 1, "first": [row], "why": {"magnitude": 1}}]
    assert (version["fit"]["samples_corrupt"], version["fit"]["samples_given"]) == (1, 299)
    assert "corrupt" not in expected["lineage"]
    np.testing.assert_allclose(version["noise_std"], expected["noise_std"], rtol=1e-6)
