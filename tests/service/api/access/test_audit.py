"""The audit log: every change of a model adds a line with who, what, from and to; lines never change."""

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
from tests.service.api.access.conftest import bearer
from tests.service.data import QUICK, ended, error, eventually, queue, service_of, stream, upload
from tests.service.learning.learning_models import observation_batch
from tests.service.models.archives.packing import TAR, exported
from tests.service.models.versions import publish

POST, PUT, DELETE = "POST", "PUT", "DELETE"
MODEL = "/v1/models/{model}"
BATCH = MODEL + "/observations/{stream_id}/{sequence}"
LEARNING = {"contact_threshold": 8.0, "auto_refresh": False, "on_change": "learn"}
OF_MODELS = (VersionRow, AliasRow, AliasMoveRow, ServingRow, DeletedModelRow)
"""Rows that define which versions exist and which one serves."""
UNLISTED = {
    (POST, "/v1/datasets"): "no change of a model",
    (DELETE, "/v1/datasets/{dataset}"): "no change of a model",
    (POST, "/v1/robots"): "no change of a model",
    (DELETE, "/v1/robots/{robot}"): "no change of a model",
    (POST, "/v1/jobs"): "the new version adds the line, with the key that queued the job",
    (POST, "/v1/jobs/check"): "a query",
    (POST, "/v1/jobs/{job}/cancel"): "a cancelled job makes no version",
    (POST, "/v1/jobs/{job}/retry"): "same as a job",
    (POST, MODEL + "/refresh"): "same as a job",
    (POST, MODEL + "/observations"): "the observation log has each batch",
    (POST, MODEL + "/predict"): "a query",
    (POST, MODEL + "/evaluate"): "a query",
    (POST, MODEL + "/trace"): "a query",
    (POST, MODEL + "/compare"): "a query",
    (POST, "/v1/echo"): "a query",
    (POST, "/v2/models/{model}/infer"): "a query",
    (POST, "/v2/models/{model}/versions/{version}/infer"): "a query",
}
"""Routes with methods of change, and why they add no line."""


@pytest.fixture(scope="module")
def audited(tmp_path_factory):
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
            body = observation_batch(number)
            if number == 3:
                body["tau"] = [[value + 1000.0 for value in each] for each in body["tau"]]
            if number == 0:
                assert api.put("/v1/models/arm/learning", json=LEARNING).status_code == 200
            assert api.post("/v1/models/arm/observations", json=body).status_code == 200
        yield api
    database.close()


def audit_lines(api, **filters):
    answer = api.get("/v1/audit", params={"limit": 100, **filters})
    assert answer.status_code == 200, answer.text
    return answer.json()["items"]


def assert_ok(answer):
    assert answer.status_code < 300, answer.text


def import_version(api):
    assert_ok(
        api.post(
            "/v1/models/import?name=other&promotion=always",
            content=exported(api, "arm", version=1, learnt=False),
            headers=TAR,
        )
    )


def remove_version(api):
    version = publish(api, "arm", candidate=True)
    assert_ok(api.delete(f"/v1/models/arm/versions/{version}"))


def set_alias(api, alias="production", version=1):
    assert_ok(api.put(f"/v1/models/arm/aliases/{alias}", json={"version": version}))


def roll_back(api):
    set_alias(api, "back", 1)
    set_alias(api, "back", 2)
    assert_ok(api.post("/v1/models/arm/aliases/back/rollback"))


def remove_alias(api):
    set_alias(api, "gone")
    assert_ok(api.delete("/v1/models/arm/aliases/gone"))


def resolve_pause(api):
    service = service_of(api)
    with service.database.transaction() as session:
        owner.pause(session, "arm", {"at": 1.0, "event": 4})
    assert_ok(api.post("/v1/models/arm/learning/change", json={"decision": "ignore"}))


CHANGING = {
    (POST, "/v1/models/import"): (import_version, "version added", None, {"estimator": "lip-chain", "job": None}),
    (DELETE, MODEL + "/versions/{version}"): (remove_version, "version deleted", 3, None),
    (PUT, MODEL + "/aliases/{alias}"): (set_alias, "alias moved", None, 1),
    (POST, MODEL + "/aliases/{alias}/rollback"): (roll_back, "alias moved", 2, 1),
    (DELETE, MODEL + "/aliases/{alias}"): (remove_alias, "alias moved", 1, None),
    (PUT, MODEL + "/learning"): (
        lambda api: assert_ok(api.put("/v1/models/arm/learning", json=LEARNING | {"auto_promote": False})),
        "learning set",
        {"auto_promote": True},
        {"auto_promote": False},
    ),
    (DELETE, BATCH): (
        lambda api: assert_ok(api.delete("/v1/models/arm/observations/arm/1")),
        "observations unlearnt",
        {"stream_id": "arm", "sequence": 1, "rows": 10},
        None,
    ),
    (POST, BATCH + "/replay"): (
        lambda api: assert_ok(api.post("/v1/models/arm/observations/arm/3/replay", json={"codes": ["contact"]})),
        "observations replayed",
        None,
        {"stream_id": "arm", "sequence": 3, "rows": {"contact": 10}},
    ),
    (POST, MODEL + "/learning/change"): (
        resolve_pause,
        "change decided",
        {"at": 1.0, "event": 4},
        {"decision": "ignore"},
    ),
    (POST, MODEL + "/rollback"): (
        lambda api: assert_ok(api.post("/v1/models/arm/rollback", json={"revision": 0})),
        "learning rolled back",
        None,
        0,
    ),
    (PUT, MODEL + "/payload"): (
        lambda api: assert_ok(api.put("/v1/models/panda-sim/payload", json={"mass": 1.0, "com": [0, 0, 0.1]})),
        "payload declared",
        None,
        {"body": {"mass": 1.0, "com": [0, 0, 0.1], "inertia": None}},
    ),
    (DELETE, MODEL + "/payload"): (
        lambda api: assert_ok(api.delete("/v1/models/panda-sim/payload")),
        "payload declared",
        None,
        {"stream_id": None, "body": None},
    ),
    (DELETE, MODEL + "/streams/{stream_id}"): (
        lambda api: assert_ok(api.delete("/v1/models/arm/streams/arm")),
        "stream deleted",
        {"stream_id": "arm"},
        None,
    ),
    (DELETE, MODEL): (lambda api: assert_ok(api.delete("/v1/models/other")), "model deleted", [1], None),
}
"""For each route of change: the request, and the change, from and to of its last line."""


def test_every_changing_route_is_audited_or_exempt(api):
    paths = api.get("/openapi.json").json()["paths"]
    changing = {(method.upper(), path) for path in paths for method in paths[path] if method not in ("get", "head")}
    assert changing == CHANGING.keys() | UNLISTED.keys()
    assert not CHANGING.keys() & UNLISTED.keys()


@pytest.mark.parametrize("route", CHANGING, ids=" ".join)
def test_change_adds_a_line(audited, route):
    act, change, before, after = CHANGING[route]
    known = audit_lines(audited)[0]["id"]
    act(audited)
    line = next(each for each in audit_lines(audited) if each["change"] == change)
    assert line["id"] > known
    assert (line["key"], line["key_name"], line["what"]) == (audited.key, "owner", " ".join(route))
    assert line["request_id"]
    assert abs(datetime.now(UTC) - datetime.fromisoformat(line["at"])) < timedelta(minutes=1)
    for expected, found in ((before, line["before"]), (after, line["after"])):
        if isinstance(expected, dict):
            assert found | expected == found
        elif expected is not None:
            assert found == expected


def watch_transactions(database, seen):
    """Record every transaction that changes which versions exist or serve, and if it adds a line. Return a function
    that stops it."""
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


def test_no_transaction_changes_versions_aliases_or_options_silently(audited):
    seen, database = [], service_of(audited).database
    end = watch_transactions(database, seen)
    try:
        import_version(audited)
        set_alias(audited, "again", 1)
        set_alias(audited, "serving", 1)
        roll_back(audited)
        remove_alias(audited)
        assert_ok(audited.put("/v1/models/arm/learning", json=LEARNING))
        assert_ok(audited.post("/v1/models/arm/rollback", json={"version": 2}))
        assert_ok(audited.delete("/v1/models/other"))
    finally:
        end()
    assert len(seen) >= 9
    assert [changed for changed, noted in seen if not noted] == []


@pytest.mark.slow
def test_version_of_a_job_names_the_key_that_queued_it(audited):
    row, secret = keys.create(service_of(audited).database, "trainer [1]", ["train", "read"], None)
    eventually(lambda: audited.get("/v1/jobs", headers=bearer(secret)).status_code == 200)
    dataset = upload(audited, stream())["id"]
    audited.headers["authorization"], kept = bearer(secret)["Authorization"], audited.headers["authorization"]
    try:
        job = ended(audited, queue(audited, "trained", dataset, options=QUICK)["id"])
        assert job["state"] == "succeeded"
    finally:
        audited.headers["authorization"] = kept
    serving, added = audit_lines(audited, model="trained")
    assert (added["key"], added["key_name"], added["what"]) == (row.id, "trainer [1]", f"job {job['id']}")
    assert (added["change"], added["after"]) == ("version added", {"estimator": "lip-chain", "job": job["id"]})
    assert (serving["change"], serving["alias"], serving["before"], serving["after"]) == (
        "alias moved",
        "serving",
        None,
        1,
    )


def test_automatic_changes_name_the_service(audited):
    line = audit_lines(audited, model="panda-sim", change="version added")[-1]
    assert (line["key"], line["key_name"], line["what"], line["version"]) == (None, None, "service", 1)


def test_rejected_request_adds_no_line(audited):
    known = audit_lines(audited)[0]["id"]
    error(audited.put("/v1/models/arm/aliases/production", json={"version": 99}), 404, "not_found")
    error(audited.delete("/v1/models/arm/versions/2"), 409, "conflict")
    error(audited.delete("/v1/models/none"), 404, "not_found")
    error(audited.post("/v1/models/import", content=b"no tar", headers=TAR), 422, "invalid_data")
    assert audit_lines(audited)[0]["id"] == known


def test_lines_are_paged_and_filtered(audited):
    every = audit_lines(audited)
    assert [line["id"] for line in every] == sorted((line["id"] for line in every), reverse=True)
    first = audited.get("/v1/audit?limit=2").json()
    second = audited.get("/v1/audit", params={"limit": 2, "cursor": first["next_cursor"]}).json()
    assert [line["id"] for line in first["items"] + second["items"]] == [line["id"] for line in every[:4]]
    assert {line["model"] for line in audit_lines(audited, model="arm")} == {"arm"}
    assert {line["change"] for line in audit_lines(audited, change="alias moved")} == {"alias moved"}
    assert {line["key"] for line in audit_lines(audited, key=audited.key)} == {audited.key}
    assert audit_lines(audited, model="nobody") == []
    moment = every[3]["at"]
    assert audit_lines(audited, since=moment, until=moment) == []
    later, earlier = audit_lines(audited, since=moment), audit_lines(audited, until=moment)
    assert [line["id"] for line in later + earlier] == [line["id"] for line in every]
    assert {line["at"] < moment for line in earlier} == {True}
    elsewhere = datetime.fromisoformat(moment).astimezone(timezone(timedelta(hours=9))).isoformat()
    assert audit_lines(audited, since=elsewhere) == later
    error(audited.get("/v1/audit?since=2026-11-24T08:00:00"), 422, "invalid_request")  # no time zone
    error(audited.get("/v1/audit?change=nothing"), 422, "invalid_request")


def test_only_admins_read_the_log_and_it_has_no_secrets(audited):
    database = service_of(audited).database
    _, reader = keys.create(database, "reader", ["read", "predict", "update", "train"], None)
    eventually(lambda: audited.get("/v1/models", headers=bearer(reader)).status_code == 200)
    assert audited.get("/v1/audit", headers=bearer(reader)).status_code == 403
    text = json.dumps(audit_lines(audited))
    assert "lip_" not in text
    assert not any(row.hash in text for row in keys.list_keys(database))


def test_lines_cannot_be_changed(audited):
    database = service_of(audited).database
    with pytest.raises(DBAPIError, match="the audit log is only added to"), database.transaction() as session:
        session.scalars(select(AuditRow)).first().key_name = "somebody else"


def test_lines_are_kept_for_the_configured_time(keys_database, home):
    with keys_database.transaction() as session:
        for model, days in (("old", 3), ("young", 1)):
            at = (datetime.now(UTC) - timedelta(days=days)).isoformat(timespec="milliseconds")
            session.add(AuditRow(at=at, what="service", model=model, change="version added"))
    settings = Settings(home=home, audit_retention_s=2 * 86400.0)
    assert (audit.clean(keys_database, settings), audit.clean(keys_database, settings)) == (1, 0)
    with keys_database.session() as session:
        assert [row.model for row in session.scalars(select(AuditRow))] == ["young"]


@pytest.mark.slow
def test_command_lists_lines(lipserve, server):
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
    assert_ok(server.client.put("/v1/models/panda-sim/aliases/audited", json={"version": 1}))
