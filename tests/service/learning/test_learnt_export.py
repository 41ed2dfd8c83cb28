"""What a model has learnt goes with it to another service, or stays behind, as is asked for."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.service.archives.packing import exported, send, unpack
from tests.service.learning.lessons import QUERIES, answered


@pytest.fixture(scope="module")
def pupil(school):
    pupil = school.enrol("travels")
    pupil.teach(0, 1, 2)
    return pupil


def same(one, other):
    for name in ("tau", "tau_std"):
        np.testing.assert_allclose(one[name], other[name], rtol=1e-9, atol=1e-12)


def test_imported_version_answers_as_the_one_that_has_learnt(school, pupil):
    archive = exported(school.client, pupil.model)
    about = json.loads(unpack(archive)["export.json"])
    assert (about["learnt"], about["revision"]) == (True, pupil.predict()["revision"])
    version = send(school.client, archive, name="arrived").json()
    assert version["lineage"]["learnt"]["revision"] == about["revision"]
    answer = answered(school.client.post("/v1/models/arrived/predict", json=QUERIES))
    assert answer["revision"] == 0
    same(answer, pupil.predict())


def test_version_as_trained_is_exported_where_asked(school, pupil):
    archive = exported(school.client, pupil.model, learnt=False)
    about = json.loads(unpack(archive)["export.json"])
    assert (about["learnt"], about["revision"]) == (False, 0)
    assert send(school.client, archive, name="untaught").status_code == 201
    answer = answered(school.client.post("/v1/models/untaught/predict", json=QUERIES))
    fresh = school.enrol("fresh").predict()
    same(answer, fresh)
    assert np.abs(np.array(fresh["tau"]) - np.array(pupil.predict()["tau"])).max() > 1e-6


def test_imported_version_learns_on(school, pupil):
    assert send(school.client, exported(school.client, pupil.model), name="taken-elsewhere").status_code == 201
    other = type(pupil)(school.client, "taken-elsewhere")
    other.put("learning", {"contact_threshold": 1e6, "on_change": "learn", "auto_refresh": False})
    other.teach(3)
    before = exported(school.client, "taken-elsewhere")
    about = json.loads(unpack(before)["manifest.json"])["lineage"]
    assert about["learnt"]["before"]["model"] == pupil.model
    same(
        answered(send_and_ask(school.client, before, "third-home")),
        other.predict(),
    )


def send_and_ask(client, archive, name):
    assert send(client, archive, name=name).status_code == 201
    return client.post(f"/v1/models/{name}/predict", json=QUERIES)
