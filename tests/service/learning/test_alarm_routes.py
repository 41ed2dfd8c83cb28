"""Alarms are listed with their evidence."""

from __future__ import annotations

from service.learning import owner
from tests.service.data import error


def test_alarms_are_listed_newest_first(school):
    pupil = school.enrol("alarmed")
    assert pupil.get("alarms") == {"items": [], "next_cursor": None}
    with school.service.database.transaction() as session:
        for number, kind in enumerate(("change", "novelty", "refresh", "promotion")):
            owner.raise_alarm(session, "alarmed", kind, f"message {number}", {"number": number, "joints": ["joint1"]})
        owner.raise_alarm(session, "panda-sim", "change", "of another model", {})
    first = pupil.get("alarms", limit=3)
    rest = pupil.get("alarms", limit=3, cursor=first["next_cursor"])
    items = first["items"] + rest["items"]
    assert [item["kind"] for item in items] == ["promotion", "refresh", "novelty", "change"]
    assert [item["message"] for item in items] == [f"message {number}" for number in (3, 2, 1, 0)]
    assert items[0]["evidence"] == {"number": 3, "joints": ["joint1"]}
    assert [item["at"] for item in items] == sorted((item["at"] for item in items), reverse=True)
    assert len({item["id"] for item in items}) == 4
    assert rest["next_cursor"] is None


def test_wrong_pages_and_models_are_refused(school):
    pupil = school.enrol("calm")
    assert pupil.refused("GET", "alarms?limit=0", 422, "invalid_request")["detail"][0]["field"] == "limit"
    assert pupil.refused("GET", "alarms?cursor=x", 422, "invalid_request")["detail"][0]["field"] == "cursor"
    error(school.client.get("/v1/models/nobody/alarms"), 404, "not_found")
