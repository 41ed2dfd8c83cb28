"""The client's methods say what their routes say, and what a model has learnt goes with it to another service."""

import json

import numpy as np
import pytest

from lipserve import ApiError, Client
from service.journal.alarms import raise_alarm
from tests.service.archives.packing import exported, send, unpack
from tests.service.learning.lessons import LESSON, QUERIES, answered


@pytest.fixture
def client(school):
    made = Client()
    made.close()
    made._http = school.client  # the same requests, without a socket
    return made


def same(answer, body):
    assert answer.as_dict() == body


def same_items(answers, body):
    assert [each.as_dict() for each in answers] == body["items"]


def test_what_is_seen(school, client):
    pupil = school.enrol("seen-by-client")
    tau = [[None, 0.0]] * LESSON
    pupil.teach(0)
    pupil.teach(1, tau=tau)
    pupil.teach(0, stream_id="other")
    same(client.quality("seen-by-client"), pupil.get("quality"))
    same_items(client.observations("seen-by-client"), pupil.get("observations"))
    assert [item.sequence for item in client.observations("seen-by-client", "arm", rejected=True)] == [1]
    same(client.observation("seen-by-client", "arm", 1), pupil.get("observations/arm/1"))
    seen = client.observation("seen-by-client", "arm", 1, rows=True)
    assert seen.observed is not None
    assert seen.observed.tau == tau
    same(client.learning("seen-by-client"), pupil.get("learning"))
    with school.service.database.transaction() as session:
        raise_alarm(session, "seen-by-client", "novelty", "beyond", {})
    same_items(client.alarms("seen-by-client"), pupil.get("alarms"))


def test_what_is_decided(school, client):
    pupil = school.enrol("led-by-client")
    options = client.set_learning("led-by-client", contact_threshold=8.0).options
    assert (options.contact_threshold, options.on_change) == (8.0, "learn")  # which was set before
    pupil.teach(0, 1)
    pupil.teach(2, tau=[[50.0, 50.0]] * LESSON)
    assert client.replay("led-by-client", "arm", 2, ["contact"]).codes == {"contact": LESSON}
    assert client.unlearn("led-by-client", "arm", 1).rows == LESSON
    assert client.rollback("led-by-client", revision=1).undone == 2
    for refused in (
        lambda: client.rollback("led-by-client", version=1),
        lambda: client.decide("led-by-client", "adapt", replay=True),
    ):
        with pytest.raises(ApiError) as caught:
            refused()
        assert (caught.value.status, caught.value.code) == (409, "conflict")


@pytest.fixture(scope="module")
def pupil(school):
    pupil = school.enrol("travels")
    pupil.teach(0, 1, 2)
    return pupil


def close(one, other):
    for name in ("tau", "tau_std"):
        np.testing.assert_allclose(one[name], other[name], rtol=1e-9, atol=1e-12)


def test_imported_version_answers_as_the_one_that_has_learnt(school, pupil):
    archive = exported(school.client, pupil.model)
    about = json.loads(unpack(archive)["export.json"])
    assert (about["learnt"], about["revision"]) == (True, pupil.predict()["revision"])
    version = send(school.client, archive, name="arrived").json()
    assert version["lineage"]["learnt"]["revision"] == about["revision"]
    answer = answered(school.client.post("/v1/models/arrived/predict", json=QUERIES | {"version": 1}))
    assert answer["revision"] == 0
    close(answer, pupil.predict())


def test_version_as_trained_is_exported_where_asked(school, pupil):
    archive = exported(school.client, pupil.model, learnt=False)
    about = json.loads(unpack(archive)["export.json"])
    assert (about["learnt"], about["revision"]) == (False, 0)
    assert send(school.client, archive, name="untaught").status_code == 201
    answer = answered(school.client.post("/v1/models/untaught/predict", json=QUERIES | {"version": 1}))
    fresh = school.enrol("fresh").predict()
    close(answer, fresh)
    assert np.abs(np.array(fresh["tau"]) - np.array(pupil.predict()["tau"])).max() > 1e-6
