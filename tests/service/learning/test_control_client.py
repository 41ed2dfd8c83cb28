"""The client's learning methods match their routes; exports include or leave out what was learnt."""

import json

import numpy as np
import pytest

from lipserve import ApiError, Client
from service.journal.alarms import raise_alarm
from tests.service.learning.learning_models import BATCH_ROWS, QUERIES, LearningModel
from tests.service.models.archives.packing import exported, import_archive, unpack


@pytest.fixture
def client(learning_service):
    made = Client()
    made.close()
    made._http = learning_service.client  # no socket needed
    return made


@pytest.mark.slow
def test_client_reads_what_the_routes_return(learning_service, client):
    name, tau = "seen-by-client", [[None, 0.0]] * BATCH_ROWS
    learning_model = learning_service.create_model(name)
    learning_model.send_batches(0)
    learning_model.send_batches(1, tau=tau)
    learning_model.send_batches(0, stream_id="other")
    with learning_service.service.database.transaction() as session:
        raise_alarm(session, name, "novelty", "beyond", {})
    for path, answer in (
        ("quality", client.quality(name)),
        ("observations/arm/1", client.observation(name, "arm", 1)),
        ("learning", client.learning(name)),
    ):
        assert answer.as_dict() == learning_model.get(path), path
    for path, answers in (("observations", client.observations(name)), ("alarms", client.alarms(name))):
        assert [each.as_dict() for each in answers] == learning_model.get(path)["items"], path
    assert [item.sequence for item in client.observations(name, "arm", rejected=True)] == [1]
    seen = client.observation(name, "arm", 1, rows=True)
    assert seen.observed is not None
    assert seen.observed.tau == tau


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


def copy_model(learning_model, name, **options):
    """Export a model and import it; return what the export says of itself, the version, and its prediction."""
    archive = exported(learning_model.client, learning_model.name, **options)
    answer = import_archive(learning_model.client, archive, name=name)
    assert answer.status_code == 201
    prediction = LearningModel(learning_model.client, name).predict(QUERIES | {"version": 1})
    return json.loads(unpack(archive)["export.json"]), answer.json(), prediction


def assert_close(one, other):
    for name in ("tau", "tau_std"):
        np.testing.assert_allclose(one[name], other[name], rtol=1e-9, atol=1e-12)


def test_imported_version_predicts_like_the_learnt_one(learning_model):
    about, version, prediction = copy_model(learning_model, "arrived")
    assert (about["learnt"], about["revision"]) == (True, learning_model.predict()["revision"])
    assert version["lineage"]["learnt"]["revision"] == about["revision"]
    assert prediction["revision"] == 0
    assert_close(prediction, learning_model.predict())


def test_export_can_leave_out_what_was_learnt(learning_service, learning_model):
    about, _, prediction = copy_model(learning_model, "untaught", learnt=False)
    assert (about["learnt"], about["revision"]) == (False, 0)
    fresh = learning_service.create_model("fresh").predict()
    assert_close(prediction, fresh)
    assert np.abs(np.subtract(fresh["tau"], learning_model.predict()["tau"])).max() > 1e-6
