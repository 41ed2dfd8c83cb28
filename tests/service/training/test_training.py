"""A training job from the request to the version that it creates."""

import logging
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from lipcore.data.outliers import CorruptRows
from lipcore.posterior.linalg import NotPositiveDefiniteError
from service.contract.holdout import HoldoutLineage
from service.datasets import staging
from service.training import planned_fit
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
from tests.service.models.versions import predict_json
from tests.service.training.conftest import version_of


@pytest.fixture(scope="module")
def two_versions(api, pendulum):
    """A model trained twice, the second time on two data sets: for each version the job and the data sets."""
    more = upload(api, stream(seed=2), name="more")
    inputs = [pendulum], [more, pendulum]
    return [(train(api, "twice", *(each["id"] for each in given)), given) for given in inputs]


@pytest.mark.parametrize("number", [1, 2])
def test_succeeded_job_names_its_version_and_the_version_its_data(api, two_versions, number):
    seen, datasets = two_versions[number - 1]
    assert (seen["state"], seen["version"], seen["attempts"], seen["error"]) == ("succeeded", number, 1, None)
    assert (seen["model"], seen["estimator"]) == ("twice", "lip-chain")
    assert (seen["progress"]["stage"], seen["progress"]["fraction"]) == ("done", 1.0)
    assert seen["created_at"] <= seen["started_at"] <= seen["heartbeat_at"] <= seen["finished_at"]
    view = version_of(api, "twice", number)
    assert view["job"] == view["lineage"]["job"] == seen["id"]
    assert view["fit"]["samples_given"] == 80 * len(datasets)
    for listed, dataset in zip(view["lineage"]["datasets"], datasets, strict=True):
        expected = {name: dataset[name] for name in ("id", "name", "sha256")} | {"rows": dataset["report"]["rows"]}
        assert {name: listed[name] for name in expected} == expected
        assert listed["recipe"]["cutoff_hz"] == 4.0


def test_version_shows_how_it_was_made(api, two_versions):
    view = version_of(api, "twice")
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


def test_progress_moves_while_the_objective_falls(api):
    name = queue(api, "progress", upload(api, stream("panda", 200))["id"], options=ENDLESS)["id"]
    first = running(api, name)
    before = first["progress"]
    assert (first["state"], before["stage"], before["max_iterations"]) == ("running", "hyperparameters", 10_000)
    later = eventually(lambda: (seen := job(api, name))["progress"]["iteration"] > before["iteration"] and seen)
    after = later["progress"]
    assert 0 < before["fraction"] < after["fraction"] < 1
    assert after["elapsed_s"] > before["elapsed_s"]
    assert after["objective"] < before["objective"]
    assert later["heartbeat_at"] > first["heartbeat_at"]
    api.post(f"/v1/jobs/{name}/cancel")


def record_progress(method, seen):
    """Wrap a method of a heartbeat so that it records the progress afterwards."""

    def call(self, *given):
        method(self, *given)
        seen.append({"fraction": 0.0, **self.as_json()})

    return call


@pytest.mark.parametrize(
    ("statistics", "passes", "learnt"), [("chosen", [], QUICK["posterior_samples"]), ("all", ["statistics"], 150)]
)
def test_fraction_done_never_falls(api, run_here, monkeypatch, statistics, passes, learnt):
    model, seen = f"learns-{statistics}", []
    for name in ("plan", "progress", "last_fit", "share", "stage"):
        monkeypatch.setattr(Heartbeat, name, record_progress(getattr(Heartbeat, name), seen))
    dataset = upload(api, stream(samples=150, seed=4))["id"]
    name = queue(api, model, dataset, options={**QUICK, "statistics": statistics}, holdout={"share": 0.3})["id"]
    service_of(api).jobs.replicas.claim(name, None)
    assert run_here(name)["state"] == "succeeded"
    fractions = [each["fraction"] for each in seen]
    assert fractions == sorted(fractions)
    assert fractions[-1] < 1
    stages = [*dict.fromkeys(each["stage"] for each in seen)]
    end = ["evaluating", "learning_curve", "all_rows", "saving"]
    assert stages == ["loading", "hyperparameters", "posterior", *passes, *end]
    fit = version_of(api, model)["fit"]
    assert (fit["samples_given"], fit["samples_posterior"]) == (150, learnt)


def test_version_keeps_its_learning_curve(api):
    dataset = upload(api, stream(samples=300, seed=6))["id"]
    train(api, "curved", dataset, options=QUICK, holdout={"share": 0.3})
    stored = version_of(api, "curved")["lineage"]["holdout"]
    held_out = HoldoutLineage.model_validate(stored)
    curve = held_out.learning_curve
    assert curve is not None
    rows = [point.rows for point in curve.points]
    assert rows == sorted(rows)
    assert rows[-1] == held_out.judged_rows
    assert [point.spread for point in curve.points] == [True, True, False, True]
    assert curve.points[-1].nmse == pytest.approx(np.mean(stored["nmse"]), rel=0.01)
    assert "samples" in curve.text


def test_version_states_why_it_has_no_learning_curve(api, run_here, monkeypatch):
    failure = Mock(side_effect=NotPositiveDefiniteError("the matrix is singular"))
    monkeypatch.setattr(planned_fit, "learning_curve", failure)
    dataset = upload(api, stream(samples=150, seed=6))["id"]
    assert (
        run_here(queue(api, "uncurved", dataset, options=QUICK, holdout={"share": 0.3})["id"])["state"] == "succeeded"
    )
    curve = HoldoutLineage.model_validate(version_of(api, "uncurved")["lineage"]["holdout"]).learning_curve
    assert curve is not None
    assert curve.points == []
    assert curve.text == "The learning curve could not be computed: NotPositiveDefiniteError: the matrix is singular"


def test_convention_and_options_of_the_job_are_kept(api):
    dataset = upload(api, stream(), torque_convention="gravity_compensated")["id"]
    train(api, "compensated", dataset, options={**QUICK, "tied": False})
    made = version_of(api, "compensated")
    assert (made["torque_convention"], made["options"]["tied"]) == ("gravity_compensated", False)
    assert predict_json(api, "compensated")["torque_convention"] == "gravity_compensated"


def with_torque(samples, *place, value):
    """Return samples with another torque at a place."""
    tau = samples.tau.copy()
    tau[place] = value
    return replace(samples, tau=tau)


def test_upload_omits_and_reports_corrupt_rows(api):
    sound = stream(samples=300, seed=8)
    few = with_torque(sound, 120, 1, value=1e12)
    seen = upload(api, few)["report"]
    assert (seen["rows_uploaded"], seen["rows"]) == (300, 299)
    assert "1 row inconsistent with neighbouring rows left out, the first is row 121" in seen["preparation"]
    many = with_torque(few, slice(None, None, 30), value=1e9)
    problem = error(post(api, npz(**arrays(many))), 422, "invalid_data")["detail"][0]
    assert (problem["field"], problem["expected"]) == ("rows", "at most 6")
    assert "10 corrupt of 300 (the first are 1, 31" in problem["value"]


@pytest.mark.slow
def test_job_learns_nothing_from_stored_corrupt_rows(api, monkeypatch):
    """An earlier release stored such data sets unchanged."""
    sound, row = stream(samples=300, seed=9), 120
    monkeypatch.setattr(
        staging, "find_corrupt_rows", lambda t, episode, *_: CorruptRows(np.zeros(len(episode), bool), episode)
    )
    spoilt = upload(api, with_torque(sound, row, 0, value=1e12))["id"]
    without = upload(api, sound.rows(np.arange(300) != row))["id"]
    for name, dataset in (("spoilt", spoilt), ("without", without)):
        train(api, name, dataset)
    found, expected = version_of(api, "spoilt"), version_of(api, "without")
    assert found["lineage"]["corrupt"] == [{"id": spoilt, "rows": 1, "first": [row], "why": {"magnitude": 1}}]
    assert (found["fit"]["samples_corrupt"], found["fit"]["samples_given"]) == (1, 299)
    assert "corrupt" not in expected["lineage"]
    np.testing.assert_allclose(found["noise_std"], expected["noise_std"], rtol=1e-6)


def test_job_logs_three_lines(api, run_here, caplog):
    caplog.set_level(logging.INFO, "service.training")
    job = queue(api, "logged", upload(api, stream(samples=60, seed=71))["id"])["id"]
    assert run_here(job)["state"] == "succeeded"
    said = [record.getMessage() for record in caplog.records if job in record.getMessage()]
    assert [line.split(": ")[1].split(" ")[0] for line in said] == ["queued", "started", "version"]
