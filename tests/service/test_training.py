"""A training job from the request to the version it makes."""

from __future__ import annotations

import numpy as np
import pytest

from lipcore.robots.library import load_robot
from tests.service.data import DEADLINE, ENDLESS, QUICK, eventually, job, queue, running, stream, train, upload

QUERY = {"q": [0.3, -0.2], "dq": [0.1, 0.4], "ddq": [1.0, -0.5]}


@pytest.fixture(scope="module")
def two_versions(api, pendulum):
    """A model trained twice, the second time on two data sets; both jobs and all data sets."""
    more = upload(api, stream(seed=2), name="more")
    jobs = [train(api, "twice", pendulum["id"]), train(api, "twice", more["id"], pendulum["id"])]
    return jobs, [pendulum, more]


def test_a_job_is_accepted_and_found_at_its_location(api, pendulum):
    body = {"model": "located", "datasets": [pendulum["id"]], "estimator": "lip-chain", "options": QUICK}
    answer = api.post("/v1/jobs", json=body)
    assert answer.status_code == 202
    accepted = answer.json()
    assert answer.headers["location"] == f"/v1/jobs/{accepted['id']}"
    assert (accepted["state"], accepted["attempts"], accepted["version"]) == ("queued", 0, None)
    assert accepted["progress"]["stage"] == "waiting"
    assert api.get(answer.headers["location"]).json()["id"] == accepted["id"]
    assert api.get("/v1/jobs", params={"limit": 1}).json()["items"][0]["id"] == accepted["id"]


def test_a_succeeded_job_says_what_it_made(two_versions):
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


def test_lineage_names_the_data_with_their_hashes(api, two_versions):
    jobs, (pendulum, more) = two_versions
    for version, expected in ((1, [pendulum]), (2, [more, pendulum])):
        shown = api.get(f"/v1/models/twice/versions/{version}").json()
        told = ("id", "name", "sha256", "rows")
        assert [{name: each[name] for name in told} for each in shown["lineage"]["datasets"]] == [
            {"id": d["id"], "name": d["name"], "sha256": d["sha256"], "rows": d["report"]["rows"]} for d in expected
        ]
        assert [each["recipe"]["cutoff_hz"] for each in shown["lineage"]["datasets"]] == [4.0] * len(expected)
        assert shown["job"] == shown["lineage"]["job"] == jobs[version - 1]["id"]
        assert shown["fit"]["samples_given"] == 80 * len(expected)


def test_version_shows_how_it_was_made(api, two_versions):
    shown = api.get("/v1/models/twice/versions/1").json()
    assert (shown["model"], shown["version"], shown["estimator"]) == ("twice", 1, "lip-chain")
    assert shown["joint_names"] == ["joint1", "joint2"]
    assert shown["joint_types"] == ["revolute", "revolute"]
    assert shown["torque_convention"] == "gravity_included"
    assert {**shown["options"], **QUICK} == shown["options"]
    assert shown["fit"]["iterations"] <= QUICK["max_iterations"]
    assert shown["fit"]["samples_posterior"] == 80  # of a slow recording all are worth learning
    q = stream().q
    assert (shown["training_range"]["q"]["min"] >= q.min(axis=0)).all()
    assert (shown["training_range"]["q"]["max"] <= q.max(axis=0)).all()


def test_model_lists_its_versions(api, two_versions):
    shown = api.get("/v1/models/twice").json()
    assert (shown["name"], shown["latest_version"]) == ("twice", 2)
    assert [(v["version"], v["estimator"]) for v in shown["versions"]] == [(1, "lip-chain"), (2, "lip-chain")]
    assert shown in api.get("/v1/models", params={"limit": 100}).json()["items"]


def test_latest_version_answers_unless_another_is_named(api, two_versions):
    answers = {
        version: api.post("/v1/models/twice/predict", json=QUERY | ({"version": version} if version else {})).json()
        for version in (None, 1, 2)
    }
    assert [answers[version]["version"] for version in (None, 1, 2)] == [2, 1, 2]
    assert answers[None] == answers[2]
    assert answers[1]["tau"] != answers[2]["tau"]


def test_a_new_version_answers_at_once(api, pendulum):
    for version in (1, 2):
        train(api, "fresh", pendulum["id"], options={**QUICK, "max_iterations": version})
        assert api.post("/v1/models/fresh/predict", json=QUERY).json()["version"] == version


def test_prismatic_joints(api):
    """Tiago's torso lifts: its force is the weight above it, and does not depend on the height."""
    robot = load_robot("tiago")
    assert robot.joint_types[0] == "prismatic"
    samples = stream("tiago", 100)
    options = {**QUICK, "max_iterations": 10}
    train(api, "tiago", upload(api, samples)["id"], joint_types=list(robot.joint_types), options=options)
    assert api.get("/v1/models/tiago/versions/1").json()["joint_types"] == list(robot.joint_types)

    unseen = stream("tiago", 100, seed=2)
    dataset = upload(api, unseen)["id"]
    rmse = np.array(api.post("/v1/models/tiago/evaluate", json={"dataset": dataset}).json()["rmse"])
    weight = abs(unseen.tau[:, 0].mean())
    assert weight > 100
    assert rmse[0] < 0.02 * weight


def test_torque_convention_goes_from_the_data_to_the_answers(api):
    dataset = upload(api, stream(), torque_convention="gravity_compensated")["id"]
    train(api, "compensated", dataset)
    assert api.get("/v1/models/compensated/versions/1").json()["torque_convention"] == "gravity_compensated"
    answer = api.post("/v1/models/compensated/predict", json=QUERY).json()
    assert answer["torque_convention"] == "gravity_compensated"


def test_untied_kernels_are_trained_too(api, pendulum):
    train(api, "untied", pendulum["id"], options={**QUICK, "tied": False})
    assert api.get("/v1/models/untied/versions/1").json()["options"]["tied"] is False


def test_several_jobs_wait_for_each_other_and_number_their_versions(api, pendulum):
    ids = [queue(api, "busy", pendulum["id"])["id"] for _ in range(4)]
    seen = [eventually(lambda name=name: (now := job(api, name))["finished_at"] and now, DEADLINE) for name in ids]
    assert [now["version"] for now in seen] == [1, 2, 3, 4]
