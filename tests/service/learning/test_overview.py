"""Models at a glance: what one request says of each is what all the others say, and no model is loaded for it."""

import math

import numpy as np
import pytest

from lipcore.online.record import Record
from lipcore.online.window import Window
from service.journal.alarms import raise_alarm
from service.learning import owner
from tests.service.data import stream, train, upload
from tests.service.learning.lessons import LESSON, answered, lesson


def glance(client, name):
    """What the overview says of a model."""
    cursor, seen = None, []
    while True:
        page = answered(client.get("/v1/overview", params={"limit": 2} | ({"cursor": cursor} if cursor else {})))
        assert len(page["items"]) <= 2
        seen += page["items"]
        if (cursor := page["next_cursor"]) is None:
            break
    assert len({each["name"] for each in seen}) == len(seen)
    return next(each for each in seen if each["name"] == name)


def test_what_came_lately_is_shown_as_it_was_predicted(school):
    pupil = school.enrol("glanced-at")
    before = glance(school.client, "glanced-at")
    assert (before["idle_s"], before["held"], before["failure"], before["alarm"]) == (None, False, None, None)
    assert before["recent"] is None or before["recent"]["rows"] == 0
    span = pupil.get("versions/1")["training_range"]["q"]
    assert (np.array(span["min"]) < before["position"]).all()
    assert (np.array(span["max"]) > before["position"]).all()

    ratios = []
    for number in range(3):
        batch = lesson(number)
        answer = pupil.predict({name: batch[name] for name in ("q", "dq", "ddq")})
        total = np.sqrt(np.square(answer["tau_std"]) + np.square(answer["noise_std"]))
        ratios.append((np.array(batch["tau"]) - answer["tau"]) / total)
        pupil.teach(number)
    seen, quality = glance(school.client, "glanced-at"), pupil.get("quality")
    recent = seen["recent"]
    window = next(each for each in quality["windows"] if each["seconds"] == recent["seconds"] == 3600)
    assert (recent["rows"], recent["nmse"], recent["coverage"]) == (3 * LESSON, window["nmse"], window["coverage"])
    assert sum(point["rows"] for point in recent["course"]) == 3 * LESSON
    squares = [point["rows"] * np.square(point["innovation"]) for point in recent["course"]]
    mean = np.sum(squares, axis=0) / (3 * LESSON)
    assert np.sqrt(mean) == pytest.approx(np.sqrt(np.square(np.vstack(ratios)).mean(0)), abs=2e-3)
    assert seen["position"] == pytest.approx(lesson(2)["q"][-1], abs=1e-6)
    assert seen["idle_s"] >= 0


def test_the_course_of_a_window_is_its_buckets_oldest_first():
    seen = Window(600.0, 1)  # in buckets of ten seconds
    for at, error in ((1003.0, 3.0), (1008.0, 4.0), (1021.0, 2.0), (1700.0, 1.0)):
        seen.add(Record.of(np.full((2, 1), error), np.zeros((2, 1)), np.zeros((2, 1)), np.ones(1)), {}, at)
        if at == 1021.0:
            early = [(began, each.rows, math.sqrt(each.standardised[0])) for began, each in seen.course(1025.0)]
            assert early == [(1000.0, 4, pytest.approx(math.sqrt(12.5))), (1020.0, 2, pytest.approx(2.0))]
    assert [began for began, _ in seen.course(1701.0)] == [1700.0]


def test_no_model_is_loaded_to_be_shown(school):
    school.publish("never-asked")
    loaded = set(school.service.loaded.versions())
    seen = glance(school.client, "never-asked")
    assert (seen["recent"], seen["payloads"]) == (None, None)
    assert set(school.service.loaded.versions()) == loaded


def test_what_needs_a_decision_is_shown(school):
    pupil = school.enrol("hesitant")
    with school.service.database.transaction("hesitant") as session:
        owner.pause(session, "hesitant", {"at": 1.0})
        raise_alarm(session, "hesitant", "novelty", "the first", {})
        raise_alarm(session, "hesitant", "change", "the newest", {"joint": 1})
    seen = glance(school.client, "hesitant")
    assert seen["held"]
    assert seen["alarm"] == pupil.get("alarms")["items"][0]
    assert seen["alarm"]["message"] == "the newest"


def test_the_arm_is_that_of_the_version(school):
    seen = glance(school.client, "panda-sim")
    version = answered(school.client.get("/v1/models/panda-sim/versions/1"))
    bodies = version["parameters"]["inertia"]["bodies"]
    assert [each["joint"] for each in seen["arm"]["joints"]] == version["parameters"]["geometry"]["order"]
    for sketched, learnt in zip(seen["arm"]["joints"], version["parameters"]["geometry"]["joints"], strict=True):
        assert version["joint_names"][sketched["joint"]] == learnt["joint"]
        assert {name: sketched[name] for name in ("rotation", "translation", "axis", "type")} == {
            name: learnt[name] for name in ("rotation", "translation", "axis", "type")
        }
        body = bodies[sketched["joint"]]["plausible"]
        assert np.multiply(sketched["centre"], sketched["mass"]) == pytest.approx(body["first_moment"])
    assert len(seen["position"]) == 7


@pytest.mark.slow
def test_quality_on_what_was_held_out_is_the_same_wherever_it_is_shown(api):
    data = upload(api, stream(samples=150, seed=8))["id"]
    job = train(api, "judged-everywhere", data, holdout={"kind": "last", "share": 0.3})
    kept = answered(api.get("/v1/models/judged-everywhere/versions/1"))["lineage"]["holdout"]
    expected = {name: kept[name] for name in ("samples", "nmse", "coverage", "coverage_low", "coverage_high")}
    assert None not in expected["nmse"]
    [summary] = answered(api.get("/v1/models/judged-everywhere"))["versions"]
    listed = answered(api.get("/v1/jobs", params={"limit": 1}))["items"][0]
    assert summary["quality"] == job["quality"] == listed["quality"] == expected
    assert glance(api, "judged-everywhere")["quality"] == expected
    assert summary["promotion"]["passed"] in (True, False)
    assert summary["promotion"]["reason"]

    train(api, "judged-nowhere", data, holdout=None)
    [summary] = answered(api.get("/v1/models/judged-nowhere"))["versions"]
    assert (summary["quality"], glance(api, "judged-nowhere")["quality"]) == (None, None)
    assert glance(api, "judged-nowhere")["arm"] is None
