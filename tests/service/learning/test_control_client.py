"""The client's learning methods match their routes; exports include or leave out what was learnt."""

import json

import numpy as np
import pytest

from lipserve import ApiError, Client
from service.journal.alarms import raise_alarm
from tests.service.learning.learning_models import BATCH_ROWS, QUERIES, read_json
from tests.service.models.archives.packing import exported, import_archive, unpack


@pytest.fixture
def client(learning_service):
    made = Client()
    made.close()
    made._http = learning_service.client  # no socket needed
    return made


def assert_same(answer, body):
    assert answer.as_dict() == body


def assert_same_items(answers, body):
    assert [each.as_dict() for each in answers] == body["items"]


@pytest.mark.slow
def test_client_reads_what_the_routes_return(learning_service, client):
    learning_model = learning_service.create_model("seen-by-client")
    tau = [[None, 0.0]] * BATCH_ROWS
    learning_model.send_batches(0)
    learning_model.send_batches(1, tau=tau)
    learning_model.send_batches(0, stream_id="other")
    assert_same(client.quality("seen-by-client"), learning_model.get("quality"))
    assert_same_items(client.observations("seen-by-client"), learning_model.get("observations"))
    assert [item.sequence for item in client.observations("seen-by-client", "arm", rejected=True)] == [1]
    assert_same(client.observation("seen-by-client", "arm", 1), learning_model.get("observations/arm/1"))
    seen = client.observation("seen-by-client", "arm", 1, rows=True)
    assert seen.observed is not None
    assert seen.observed.tau == tau
    assert_same(client.learning("seen-by-client"), learning_model.get("learning"))
    with learning_service.service.database.transaction() as session:
        raise_alarm(session, "seen-by-client", "novelty", "beyond", {})
    assert_same_items(client.alarms("seen-by-client"), learning_model.get("alarms"))


def test_client_changes_what_the_routes_change(learning_service, client):
    learning_model = learning_service.create_model("led-by-client")
    options = client.set_learning("led-by-client", contact_threshold=8.0).options
    assert (options.contact_threshold, options.on_change) == (8.0, "learn")  # set before; not reset to its default
    learning_model.send_batches(0, 1)
    learning_model.send_batches(2, tau=[[50.0, 50.0]] * BATCH_ROWS)
    assert client.replay("led-by-client", "arm", 2, ["contact"]).codes == {"contact": BATCH_ROWS}
    assert client.unlearn("led-by-client", "arm", 1).rows == BATCH_ROWS
    assert client.rollback("led-by-client", revision=1).undone == 2
    for refused in (
        lambda: client.rollback("led-by-client", version=1),
        lambda: client.decide("led-by-client", "adapt", replay=True),
    ):
        with pytest.raises(ApiError) as caught:
            refused()
        assert (caught.value.status, caught.value.code) == (409, "conflict")


@pytest.fixture(scope="module")
def learning_model(learning_service):
    learning_model = learning_service.create_model("travels")
    learning_model.send_batches(0, 1, 2)
    return learning_model


def assert_close(one, other):
    for name in ("tau", "tau_std"):
        np.testing.assert_allclose(one[name], other[name], rtol=1e-9, atol=1e-12)


def test_imported_version_predicts_like_the_learnt_one(learning_service, learning_model):
    archive = exported(learning_service.client, learning_model.name)
    about = json.loads(unpack(archive)["export.json"])
    assert (about["learnt"], about["revision"]) == (True, learning_model.predict()["revision"])
    version = import_archive(learning_service.client, archive, name="arrived").json()
    assert version["lineage"]["learnt"]["revision"] == about["revision"]
    answer = read_json(learning_service.client.post("/v1/models/arrived/predict", json=QUERIES | {"version": 1}))
    assert answer["revision"] == 0
    assert_close(answer, learning_model.predict())


def test_export_can_leave_out_what_was_learnt(learning_service, learning_model):
    archive = exported(learning_service.client, learning_model.name, learnt=False)
    about = json.loads(unpack(archive)["export.json"])
    assert (about["learnt"], about["revision"]) == (False, 0)
    assert import_archive(learning_service.client, archive, name="untaught").status_code == 201
    answer = read_json(learning_service.client.post("/v1/models/untaught/predict", json=QUERIES | {"version": 1}))
    fresh = learning_service.create_model("fresh").predict()
    assert_close(answer, fresh)
    assert np.abs(np.array(fresh["tau"]) - np.array(learning_model.predict()["tau"])).max() > 1e-6
