"""Notes and tags of versions: kept with the version, changed one at a time, removed by empty values."""

import pytest

from tests.service.data import error
from tests.service.models.versions import publish

MODEL = "noted"


@pytest.fixture(scope="module")
def annotate(api):
    publish(api, MODEL)
    publish(api, MODEL)

    def send(**body):
        answer = api.patch(f"/v1/models/{MODEL}/versions/1", json=body)
        assert answer.status_code == 200, answer.text
        return {name: answer.json()[name] for name in ("note", "tags")}

    return send


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ({"note": " new gripper\n<b>7 kg</b> "}, {"note": "new gripper\n<b>7 kg</b>", "tags": []}),
        ({"tags": ["line 2", "ros", " ros"]}, {"note": None, "tags": ["line 2", "ros"]}),
        ({"note": "a" * 500, "tags": ["Ä" * 40] + [str(k) for k in range(9)]}, None),
        ({}, {"note": None, "tags": []}),
    ],
)
def test_version_and_model_show_note_and_tags(api, annotate, body, expected):
    annotate(note=None, tags=None)
    expected = body if expected is None else expected
    assert annotate(**body) == expected
    first, second = api.get(f"/v1/models/{MODEL}").json()["versions"]
    assert {name: first[name] for name in ("note", "tags")} == expected
    assert (second["note"], second["tags"]) == (None, [])


@pytest.mark.parametrize("nothing", [{"note": None}, {"note": ""}, {"note": "  "}, {"tags": None}, {"tags": []}])
def test_empty_values_remove_one_field_and_keep_the_other(annotate, nothing):
    full = {"note": "spare", "tags": ["line 2"]}
    assert annotate(**full) == full
    (name,) = nothing
    assert annotate(**nothing) == full | {name: [] if name == "tags" else None}


def test_repeated_request_adds_no_line_to_the_audit_log(api, annotate):
    def lines():
        return api.get("/v1/audit", params={"model": MODEL}).json()["items"]

    annotate(note="once", tags=["a"])
    before = lines()
    annotate(note="once", tags=["a"])
    assert lines() == before
    assert (before[0]["change"], before[0]["version"], before[0]["after"]) == (
        "version annotated",
        1,
        {"note": "once", "tags": ["a"]},
    )


def test_only_existing_versions_are_annotated(api, annotate):
    error(api.patch(f"/v1/models/{MODEL}/versions/3", json={"note": "a"}), 404, "not_found")
    error(api.patch("/v1/models/nobody/versions/1", json={"note": "a"}), 404, "not_found")
