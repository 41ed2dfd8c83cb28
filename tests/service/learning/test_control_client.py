"""The client's methods say what their routes say."""

from __future__ import annotations

import pytest

from service.client import ApiError, Client
from service.learning import owner
from tests.service.learning.lessons import LESSON


@pytest.fixture
def client(school):
    made = Client()
    made.close()
    made._http = school.client  # the same requests, without a socket
    return made


def same(answer, body):
    assert answer.model_dump(mode="json") == body


def same_items(answers, body):
    assert [each.model_dump(mode="json") for each in answers] == body["items"]


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
        owner.raise_alarm(session, "seen-by-client", "novelty", "beyond", {})
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
