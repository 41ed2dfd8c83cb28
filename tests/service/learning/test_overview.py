"""The overview of models: it matches the other routes and loads no model."""

import math

import numpy as np
import pytest

from lipcore.online.record import Record
from lipcore.online.window import Window
from service.journal.alarms import raise_alarm
from service.learning import owner
from tests.service.data import stream, train, upload
from tests.service.learning.learning_models import BATCH_ROWS, observation_batch, read_json


def find_overview(client, name):
    """Return the overview of a model, read in pages of two."""
    params, seen = {"limit": 2}, []
    while params.get("cursor", "") is not None:
        page = read_json(client.get("/v1/overview", params=params))
        assert len(page["items"]) <= 2
        seen += page["items"]
        params["cursor"] = page["next_cursor"]
    assert len({each["name"] for each in seen}) == len(seen)
    return next(each for each in seen if each["name"] == name)


@pytest.mark.slow
def test_recent_window_matches_predictions(learning_model):
    before = find_overview(learning_model.client, learning_model.name)
    assert (before["idle_s"], before["held"], before["failure"], before["alarm"]) == (None, False, None, None)
    assert before["recent"] is None or before["recent"]["rows"] == 0
    span = learning_model.get("versions/1")["training_range"]["q"]
    assert (np.array(span["min"]) < before["position"]).all()
    assert (np.array(span["max"]) > before["position"]).all()

    ratios = []
    for number in range(3):
        batch = observation_batch(number)
        answer = learning_model.predict({name: batch[name] for name in ("q", "dq", "ddq")})
        total = np.sqrt(np.square(answer["tau_std"]) + np.square(answer["noise_std"]))
        ratios.append((np.array(batch["tau"]) - answer["tau"]) / total)
        learning_model.send_batches(number)
    seen, quality = find_overview(learning_model.client, learning_model.name), learning_model.get("quality")
    recent = seen["recent"]
    window = next(each for each in quality["windows"] if each["seconds"] == recent["seconds"] == 3600)
    assert (recent["rows"], recent["nmse"], recent["coverage"]) == (3 * BATCH_ROWS, window["nmse"], window["coverage"])
    assert sum(point["rows"] for point in recent["course"]) == 3 * BATCH_ROWS
    squares = [point["rows"] * np.square(point["innovation"]) for point in recent["course"]]
    mean = np.sum(squares, axis=0) / (3 * BATCH_ROWS)
    assert np.sqrt(mean) == pytest.approx(np.sqrt(np.square(np.vstack(ratios)).mean(0)), abs=2e-3)
    assert seen["position"] == pytest.approx(observation_batch(2)["q"][-1], abs=1e-6)
    assert seen["idle_s"] >= 0
    assert seen["lag_s"] >= 0


def test_window_course_lists_buckets_oldest_first():
    seen = Window(600.0, 1)  # buckets of ten seconds
    for at, error in ((1003.0, 3.0), (1008.0, 4.0), (1021.0, 2.0), (1700.0, 1.0)):
        seen.add(Record.of(np.full((2, 1), error), np.zeros((2, 1)), np.zeros((2, 1)), np.ones(1)), {}, at)
        if at == 1021.0:
            early = [(began, each.rows, math.sqrt(each.standardised[0])) for began, each in seen.course(1025.0)]
            assert early == [(1000.0, 4, pytest.approx(math.sqrt(12.5))), (1020.0, 2, pytest.approx(2.0))]
    assert [began for began, _ in seen.course(1701.0)] == [1700.0]


def test_overview_loads_no_model(learning_service):
    learning_service.publish("never-asked")
    loaded = set(learning_service.service.loaded.versions())
    seen = find_overview(learning_service.client, "never-asked")
    assert (seen["recent"], seen["payloads"], seen["lag_s"]) == (None, None, None)
    assert set(learning_service.service.loaded.versions()) == loaded


def test_overview_shows_pauses_and_alarms(learning_service, learning_model):
    name = learning_model.name
    with learning_service.service.database.transaction(name) as session:
        owner.pause(session, name, {"at": 1.0})
        raise_alarm(session, name, "novelty", "the first", {})
        raise_alarm(session, name, "change", "the newest", {"joint": 1})
    seen = find_overview(learning_service.client, name)
    assert seen["held"]
    assert seen["alarm"] == learning_model.get("alarms")["items"][0]
    assert seen["alarm"]["message"] == "the newest"


def test_overview_shows_the_arm_of_the_version(learning_service):
    seen = find_overview(learning_service.client, "panda-sim")
    version = read_json(learning_service.client.get("/v1/models/panda-sim/versions/1"))
    bodies, geometry = version["parameters"]["inertia"]["bodies"], version["parameters"]["geometry"]
    assert [each["joint"] for each in seen["arm"]["joints"]] == geometry["order"]
    for sketched, learnt in zip(seen["arm"]["joints"], geometry["joints"], strict=True):
        assert version["joint_names"][sketched["joint"]] == learnt["joint"]
        for name in ("rotation", "translation", "axis", "type"):
            assert sketched[name] == learnt[name]
        body = bodies[sketched["joint"]]["plausible"]
        assert np.multiply(sketched["centre"], sketched["mass"]) == pytest.approx(body["first_moment"])
    assert len(seen["position"]) == 7


@pytest.mark.slow
def test_verdict_is_the_same_on_all_routes(api):
    data = upload(api, stream(samples=150, seed=8))["id"]
    job = train(api, "judged-everywhere", data, holdout={"kind": "last", "share": 0.3})
    kept = read_json(api.get("/v1/models/judged-everywhere/versions/1"))["lineage"]["holdout"]
    [summary] = read_json(api.get("/v1/models/judged-everywhere"))["versions"]
    listed = read_json(api.get("/v1/jobs", params={"limit": 1}))["items"][0]
    verdict = summary["verdict"]
    assert [each["rmse"] for each in verdict["joints"]] == kept["rmse"]
    assert [each["coverage"] for each in verdict["joints"]] == kept["coverage"]
    shown = read_json(api.get("/v1/models/judged-everywhere/versions/1"))
    assert shown["verdict"] == job["verdict"] == listed["verdict"] == verdict
    assert find_overview(api, "judged-everywhere")["verdict"] == verdict
    assert verdict["reason"] in summary["promotion"]["reason"]

    train(api, "judged-nowhere", data, holdout=None)
    [summary] = read_json(api.get("/v1/models/judged-nowhere"))["versions"]
    assert (summary["verdict"]["level"], summary["verdict"]["judged_on"]) == ("not_judged", "nothing")
    assert find_overview(api, "judged-nowhere")["arm"] is None
