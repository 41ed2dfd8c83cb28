"""Every route that changes a model leaves a line that says who, what, from and to; the lines stay as they were."""

import json
from datetime import UTC, datetime, timedelta, timezone

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import event, select
from sqlalchemy.exc import DBAPIError

from service.api.access import keys
from service.app import create_app
from service.foundation.settings import Settings
from service.learning import owner
from service.storage import audit
from service.storage.database import (
    AliasMoveRow,
    AliasRow,
    AuditRow,
    Database,
    DeletedModelRow,
    LearningRow,
    ServingRow,
    VersionRow,
)
from tests.service.access.conftest import bearer
from tests.service.archives.packing import TAR, exported
from tests.service.data import QUICK, ended, error, eventually, queue, service_of, stream, upload
from tests.service.learning.lessons import lesson
from tests.service.models.versions import publish

POST, PUT, DELETE = "POST", "PUT", "DELETE"
MODEL = "/v1/models/{model}"
BATCH = MODEL + "/observations/{stream_id}/{sequence}"
LEARNING = {"contact_threshold": 8.0, "auto_refresh": False, "on_change": "learn"}
OF_MODELS = (VersionRow, AliasRow, AliasMoveRow, ServingRow, DeletedModelRow)
"""Rows that say which versions there are and which one answers."""
UNLISTED = {
    (POST, "/v1/datasets"): "data sets are no models",
    (DELETE, "/v1/datasets/{dataset}"): "data sets are no models",
    (POST, "/v1/robots"): "robots are no models",
    (DELETE, "/v1/robots/{robot}"): "robots are no models",
    (POST, "/v1/jobs"): "the version that a job makes has the line, with the key that queued the job",
    (POST, "/v1/jobs/check"): "asks",
    (POST, "/v1/jobs/{job}/cancel"): "a job that is cancelled makes no version",
    (POST, "/v1/jobs/{job}/retry"): "as the job",
    (POST, MODEL + "/refresh"): "as a job",
    (POST, MODEL + "/observations"): "each batch is a line of the log of observations, which tells what it taught",
    (POST, MODEL + "/predict"): "asks",
    (POST, MODEL + "/evaluate"): "asks",
    (POST, MODEL + "/trace"): "asks",
    (POST, MODEL + "/compare"): "asks",
    (POST, "/v1/echo"): "asks",
    (POST, "/v2/models/{model}/infer"): "asks",
    (POST, "/v2/models/{model}/versions/{version}/infer"): "asks",
}
"""Routes of methods that change something, and why they leave no line."""


@pytest.fixture(scope="module")
def owned(tmp_path_factory):
    """A service with a model of two versions and one that learns, and a client with a key named `owner`."""
    home = tmp_path_factory.mktemp("audited")
    database = Database.of(Settings(home=home))
    row, secret = keys.create(database, "owner", ["admin"], None)
    settings = Settings(home=home, keys="on", publish_every_s=0.02)
    with TestClient(create_app(settings), "http://robot.example", headers=bearer(secret)) as api:
        api.key = row.id
        publish(api, "arm")
        publish(api, "arm")
        for number in range(4):
            body = lesson(number)
            if number == 3:
                body["tau"] = [[value + 1000.0 for value in each] for each in body["tau"]]
            if number == 0:
                assert api.put("/v1/models/arm/learning", json=LEARNING).status_code == 200
            assert api.post("/v1/models/arm/observations", json=body).status_code == 200
        yield api
    database.close()


def lines(api, **filters):
    answer = api.get("/v1/audit", params={"limit": 100, **filters})
    assert answer.status_code == 200, answer.text
    return answer.json()["items"]


def good(answer):
    assert answer.status_code < 300, answer.text


def import_(api):
    good(
        api.post(
            "/v1/models/import?name=other&promotion=always",
            content=exported(api, "arm", version=1, learnt=False),
            headers=TAR,
        )
    )


def remove_version(api):
    version = publish(api, "arm", candidate=True)
    good(api.delete(f"/v1/models/arm/versions/{version}"))


def move(api, alias="production", version=1):
    good(api.put(f"/v1/models/arm/aliases/{alias}", json={"version": version}))


def moved_back(api):
    move(api, "back", 1)
    move(api, "back", 2)
    good(api.post("/v1/models/arm/aliases/back/rollback"))


def remove_alias(api):
    move(api, "gone")
    good(api.delete("/v1/models/arm/aliases/gone"))


def decide(api):
    service = service_of(api)
    with service.database.transaction() as session:
        owner.pause(session, "arm", {"at": 1.0, "event": 4})
    good(api.post("/v1/models/arm/learning/change", json={"decision": "ignore"}))


CHANGING = {
    (POST, "/v1/models/import"): (import_, "version added", None, {"estimator": "lip-chain", "job": None}),
    (DELETE, MODEL + "/versions/{version}"): (remove_version, "version deleted", 3, None),
    (PUT, MODEL + "/aliases/{alias}"): (move, "alias moved", None, 1),
    (POST, MODEL + "/aliases/{alias}/rollback"): (moved_back, "alias moved", 2, 1),
    (DELETE, MODEL + "/aliases/{alias}"): (remove_alias, "alias moved", 1, None),
    (PUT, MODEL + "/learning"): (
        lambda api: good(api.put("/v1/models/arm/learning", json=LEARNING | {"auto_promote": False})),
        "learning set",
        {"auto_promote": True},
        {"auto_promote": False},
    ),
    (DELETE, BATCH): (
        lambda api: good(api.delete("/v1/models/arm/observations/arm/1")),
        "observations unlearnt",
        {"stream_id": "arm", "sequence": 1, "rows": 10},
        None,
    ),
    (POST, BATCH + "/replay"): (
        lambda api: good(api.post("/v1/models/arm/observations/arm/3/replay", json={"codes": ["contact"]})),
        "observations replayed",
        None,
        {"stream_id": "arm", "sequence": 3, "rows": {"contact": 10}},
    ),
    (POST, MODEL + "/learning/change"): (decide, "change decided", {"at": 1.0, "event": 4}, {"decision": "ignore"}),
    (POST, MODEL + "/rollback"): (
        lambda api: good(api.post("/v1/models/arm/rollback", json={"revision": 0})),
        "learning rolled back",
        None,
        0,
    ),
    (PUT, MODEL + "/payload"): (
        lambda api: good(api.put("/v1/models/panda-sim/payload", json={"mass": 1.0, "com": [0, 0, 0.1]})),
        "payload declared",
        None,
        {"body": {"mass": 1.0, "com": [0, 0, 0.1], "inertia": None}},
    ),
    (DELETE, MODEL + "/payload"): (
        lambda api: good(api.delete("/v1/models/panda-sim/payload")),
        "payload declared",
        None,
        {"stream_id": None, "body": None},
    ),
    (DELETE, MODEL + "/streams/{stream_id}"): (
        lambda api: good(api.delete("/v1/models/arm/streams/arm")),
        "stream deleted",
        {"stream_id": "arm"},
        None,
    ),
    (DELETE, MODEL): (lambda api: good(api.delete("/v1/models/other")), "model deleted", [1], None),
}
"""What each changing route is asked, and what its last line says: the change, from and to."""


def test_every_route_that_may_change_something_is_audited_or_has_a_reason(api):
    paths = api.get("/openapi.json").json()["paths"]
    changing = {(method.upper(), path) for path in paths for method in paths[path] if method not in ("get", "head")}
    assert changing == CHANGING.keys() | UNLISTED.keys()
    assert not CHANGING.keys() & UNLISTED.keys()


@pytest.mark.parametrize("route", CHANGING, ids=" ".join)
def test_a_change_leaves_a_line(owned, route):
    act, change, before, after = CHANGING[route]
    known = lines(owned)[0]["id"]
    act(owned)
    line = next(each for each in lines(owned) if each["change"] == change)
    assert line["id"] > known
    assert (line["key"], line["key_name"], line["what"]) == (owned.key, "owner", " ".join(route))
    assert line["request_id"]
    assert abs(datetime.now(UTC) - datetime.fromisoformat(line["at"])) < timedelta(minutes=1)
    for expected, found in ((before, line["before"]), (after, line["after"])):
        if isinstance(expected, dict):
            assert found | expected == found
        elif expected is not None:
            assert found == expected


def check_lines(database, seen):
    """See that no transaction changes which versions there are, or answer, without a line. Return what ends that."""
    sessions = database._sessions

    def flushed(session, _):
        rows = {type(each) for each in (*session.new, *session.dirty, *session.deleted)}
        session.info.setdefault("changed", set()).update(rows)

    def committing(session):
        changed = session.info.pop("changed", set())
        if changed & {*OF_MODELS, LearningRow}:
            seen.append((changed, AuditRow in changed))

    event.listen(sessions, "after_flush", flushed)
    event.listen(sessions, "before_commit", committing)
    return lambda: (event.remove(sessions, "after_flush", flushed), event.remove(sessions, "before_commit", committing))


def test_no_transaction_changes_versions_aliases_or_options_without_a_line(owned):
    seen, database = [], service_of(owned).database
    end = check_lines(database, seen)
    try:
        import_(owned)
        move(owned, "again", 1)
        move(owned, "serving", 1)
        moved_back(owned)
        remove_alias(owned)
        good(owned.put("/v1/models/arm/learning", json=LEARNING))
        good(owned.post("/v1/models/arm/rollback", json={"version": 2}))
        good(owned.delete("/v1/models/other"))
    finally:
        end()
    assert len(seen) >= 9
    assert [changed for changed, noted in seen if not noted] == []


def test_a_version_of_a_job_names_the_key_that_queued_it(owned):
    row, secret = keys.create(service_of(owned).database, "trainer [1]", ["train", "read"], None)
    eventually(lambda: owned.get("/v1/jobs", headers=bearer(secret)).status_code == 200)
    dataset = upload(owned, stream())["id"]
    owned.headers["authorization"], kept = bearer(secret)["Authorization"], owned.headers["authorization"]
    try:
        job = ended(owned, queue(owned, "trained", dataset, options=QUICK)["id"])
        assert job["state"] == "succeeded"
    finally:
        owned.headers["authorization"] = kept
    serving, added = lines(owned, model="trained")
    assert (added["key"], added["key_name"], added["what"]) == (row.id, "trainer [1]", f"job {job['id']}")
    assert (added["change"], added["after"]) == ("version added", {"estimator": "lip-chain", "job": job["id"]})
    assert (serving["change"], serving["alias"], serving["before"], serving["after"]) == (
        "alias moved",
        "serving",
        None,
        1,
    )


def test_what_the_service_does_by_itself_says_so(owned):
    line = lines(owned, model="panda-sim", change="version added")[-1]
    assert (line["key"], line["key_name"], line["what"], line["version"]) == (None, None, "service", 1)


def test_what_is_refused_leaves_no_line(owned):
    known = lines(owned)[0]["id"]
    error(owned.put("/v1/models/arm/aliases/production", json={"version": 99}), 404, "not_found")
    error(owned.delete("/v1/models/arm/versions/2"), 409, "conflict")
    error(owned.delete("/v1/models/none"), 404, "not_found")
    error(owned.post("/v1/models/import", content=b"no tar", headers=TAR), 422, "invalid_data")
    assert lines(owned)[0]["id"] == known


def test_lines_are_found_page_by_page_and_by_model_key_and_change(owned):
    every = lines(owned)
    assert [line["id"] for line in every] == sorted((line["id"] for line in every), reverse=True)
    first = owned.get("/v1/audit?limit=2").json()
    second = owned.get("/v1/audit", params={"limit": 2, "cursor": first["next_cursor"]}).json()
    assert [line["id"] for line in first["items"] + second["items"]] == [line["id"] for line in every[:4]]
    assert {line["model"] for line in lines(owned, model="arm")} == {"arm"}
    assert {line["change"] for line in lines(owned, change="alias moved")} == {"alias moved"}
    assert {line["key"] for line in lines(owned, key=owned.key)} == {owned.key}
    assert lines(owned, model="nobody") == []
    moment = every[3]["at"]
    assert lines(owned, since=moment, until=moment) == []
    later, earlier = lines(owned, since=moment), lines(owned, until=moment)
    assert [line["id"] for line in later + earlier] == [line["id"] for line in every]
    assert {line["at"] < moment for line in earlier} == {True}
    elsewhere = datetime.fromisoformat(moment).astimezone(timezone(timedelta(hours=9))).isoformat()
    assert lines(owned, since=elsewhere) == later
    error(owned.get("/v1/audit?since=2026-11-24T08:00:00"), 422, "invalid_request")  # of which zone?
    error(owned.get("/v1/audit?change=nothing"), 422, "invalid_request")


def test_only_who_may_everything_reads_it_and_nothing_secret_is_in_it(owned):
    database = service_of(owned).database
    _, reader = keys.create(database, "reader", ["read", "predict", "update", "train"], None)
    eventually(lambda: owned.get("/v1/models", headers=bearer(reader)).status_code == 200)
    assert owned.get("/v1/audit", headers=bearer(reader)).status_code == 403
    said = json.dumps(lines(owned))
    assert "lip_" not in said
    assert not any(row.hash in said for row in keys.stored(database))


def test_a_line_cannot_be_changed(owned):
    database = service_of(owned).database
    with pytest.raises(DBAPIError, match="the audit log is only added to"), database.transaction() as session:
        session.scalars(select(AuditRow)).first().key_name = "somebody else"


def test_lines_are_kept_for_as_long_as_the_setting_says(keys_database, home):
    with keys_database.transaction() as session:
        for model, days in (("old", 3), ("young", 1)):
            at = (datetime.now(UTC) - timedelta(days=days)).isoformat(timespec="milliseconds")
            session.add(AuditRow(at=at, what="service", model=model, change="version added"))
    settings = Settings(home=home, audit_retention_s=2 * 86400.0)
    assert (audit.clean(keys_database, settings), audit.clean(keys_database, settings)) == (1, 0)
    with keys_database.session() as session:
        assert [row.model for row in session.scalars(select(AuditRow))] == ["young"]


def test_the_command_lists_it(lipserve, server):
    publish_and_move(server)
    code, out, _ = lipserve("audit", "--model", "panda-sim", "--url", server.url)
    assert code == 0
    assert "version added: 1" in out
    assert "alias moved: audited" in out
    code, out, _ = lipserve("audit", "--model", "panda-sim", "--change", "alias moved", "--json", "--url", server.url)
    moved = json.loads(out)
    assert moved[0]["alias"] == "audited"
    assert {each["change"] for each in moved} == {"alias moved"}
    assert len(json.loads(lipserve("audit", "--limit", "1", "--json", "--url", server.url)[1])) == 1


def publish_and_move(server):
    good(server.client.put("/v1/models/panda-sim/aliases/audited", json={"version": 1}))
