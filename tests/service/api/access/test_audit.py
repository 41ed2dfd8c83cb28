"""The audit log: every change of a model adds a line with who, what, from and to; lines never change."""

import json
from contextlib import contextmanager
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
from service.storage import database as rows
from service.storage.database import AuditRow, Database
from tests.service.api.access.conftest import bearer
from tests.service.data import error, eventually, service_of, stream, train, upload
from tests.service.learning.learning_models import observation_batch
from tests.service.models.archives.packing import TAR, exported
from tests.service.models.versions import publish

POST, PUT, PATCH, DELETE = "POST", "PUT", "PATCH", "DELETE"
MODEL = "/v1/models/{model}"
BATCH = MODEL + "/observations/{stream_id}/{sequence}"
LEARNING = {"contact_threshold": 8.0, "auto_refresh": False, "on_change": "learn"}
OF_MODELS = (rows.VersionRow, rows.AliasRow, rows.AliasMoveRow, rows.ServingRow, rows.DeletedModelRow)
"""Rows that define which versions exist and which one serves."""
QUERIES = ("/v1/jobs/check", "/v1/echo", "/v2/models/{model}/infer", "/v2/models/{model}/versions/{version}/infer")
QUERIES += tuple(f"{MODEL}/{name}" for name in ("predict", "gravity", "wrench", "evaluate", "trace", "compare"))
UPLOADS = ((POST, "/v1/datasets"), (POST, "/v1/datasets/{dataset}/read"), (POST, "/v1/robots"))
DELETIONS = ((DELETE, "/v1/datasets/{dataset}"), (DELETE, "/v1/robots/{robot}"))
UNLISTED = {
    **dict.fromkeys(UPLOADS + DELETIONS, "no change of a model"),
    **dict.fromkeys(((POST, path) for path in QUERIES), "a query"),
    (POST, "/v1/jobs"): "the new version adds the line, with the key that queued the job",
    (POST, "/v1/jobs/{job}/cancel"): "a cancelled job makes no version",
    (POST, "/v1/jobs/{job}/retry"): "same as a job",
    (POST, MODEL + "/refresh"): "same as a job",
    (POST, MODEL + "/observations"): "the observation log has each batch",
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
    assert_ok(answer)
    return answer.json()["items"]


def sender(*requests):
    """Return a function that sends requests: method, path below the models, and JSON; all must succeed."""

    def send(api):
        for method, path, *body in requests:
            assert_ok(api.request(method, f"/v1/models/{path}", json=body[0] if body else None))

    return send


def assert_ok(answer):
    assert answer.status_code < 300, answer.text


def move_request(alias, version):
    return PUT, f"arm/aliases/{alias}", {"version": version, "override": True}


def import_version(api):
    packed = exported(api, "arm", version=1, learnt=False)
    assert_ok(api.post("/v1/models/import?name=other&promotion=always", content=packed, headers=TAR))


def remove_version(api):
    sender((DELETE, f"arm/versions/{publish(api, 'arm', candidate=True)}"))(api)


def resolve_pause(api):
    with service_of(api).database.transaction() as session:
        owner.pause(session, "arm", PAUSE)
    sender((POST, "arm/learning/change", {"decision": "ignore"}))(api)


replay_contact = sender((POST, "arm/observations/arm/3/replay", {"codes": ["contact"]}))
delete_stream = sender((DELETE, "arm/streams/arm"))
roll_back = sender(move_request("back", 1), move_request("back", 2), (POST, "arm/aliases/back/rollback"))
remove_alias = sender(move_request("gone", 1), (DELETE, "arm/aliases/gone"))
PAUSE = {"at": 1.0, "event": 4}
UNLEARNT = {"stream_id": "arm", "sequence": 1, "rows": 10}
REPLAYED = {"stream_id": "arm", "sequence": 3, "rows": {"contact": 10}}
PAYLOAD, BODY = "panda-sim/payload", {"mass": 1.0, "com": [0, 0, 0.1]}
DECLARED, REMOVED = {"body": BODY | {"inertia": None}}, {"stream_id": None, "body": None}
CHANGING = {
    (POST, "/v1/models/import"): (import_version, "version added", None, {"estimator": "lip-chain", "job": None}),
    (PATCH, MODEL + "/versions/{version}"): (
        sender((PATCH, "arm/versions/1", {"tags": ["first"]})),
        "version annotated",
        {"note": None, "tags": []},
        {"note": None, "tags": ["first"]},
    ),
    (DELETE, MODEL + "/versions/{version}"): (remove_version, "version deleted", 3, None),
    (PUT, MODEL + "/aliases/{alias}"): (sender(move_request("production", 1)), "alias moved", None, 1),
    (POST, MODEL + "/aliases/{alias}/rollback"): (roll_back, "alias moved", 2, 1),
    (DELETE, MODEL + "/aliases/{alias}"): (remove_alias, "alias moved", 1, None),
    (PUT, MODEL + "/learning"): (
        sender((PUT, "arm/learning", LEARNING | {"auto_promote": False})),
        "learning set",
        {"auto_promote": True},
        {"auto_promote": False},
    ),
    (PUT, MODEL + "/thresholds"): (
        sender((PUT, "arm/thresholds", {"max_error": 0.5})),
        "thresholds set",
        None,
        {"max_error": 0.5, "min_coverage": 0.9, "max_width": 1.0},
    ),
    (DELETE, BATCH): (sender((DELETE, "arm/observations/arm/1")), "observations unlearnt", UNLEARNT, None),
    (POST, BATCH + "/replay"): (replay_contact, "observations replayed", None, REPLAYED),
    (POST, MODEL + "/learning/change"): (resolve_pause, "change decided", PAUSE, {"decision": "ignore"}),
    (POST, MODEL + "/rollback"): (sender((POST, "arm/rollback", {"revision": 0})), "learning rolled back", None, 0),
    (PUT, MODEL + "/payload"): (sender((PUT, PAYLOAD, BODY)), "payload declared", None, DECLARED),
    (DELETE, MODEL + "/payload"): (sender((DELETE, PAYLOAD)), "payload declared", None, REMOVED),
    (DELETE, MODEL + "/streams/{stream_id}"): (delete_stream, "stream deleted", {"stream_id": "arm"}, None),
    (DELETE, MODEL): (sender((DELETE, "other")), "model deleted", [1], None),
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


@contextmanager
def watched_transactions(database):
    """Record every transaction that changes which versions exist or serve, and if it adds a line."""
    sessions, seen = database._sessions, []

    def flushed(session, _):
        rows = {type(each) for each in (*session.new, *session.dirty, *session.deleted)}
        session.info.setdefault("changed", set()).update(rows)

    def committing(session):
        changed = session.info.pop("changed", set())
        if changed & {*OF_MODELS, rows.LearningRow}:
            seen.append((changed, AuditRow in changed))

    listeners = {"after_flush": flushed, "before_commit": committing}
    for name, listener in listeners.items():
        event.listen(sessions, name, listener)
    yield seen
    for name, listener in listeners.items():
        event.remove(sessions, name, listener)


def test_no_transaction_changes_versions_aliases_or_options_silently(audited):
    with watched_transactions(service_of(audited).database) as seen:
        import_version(audited)
        sender(move_request("again", 1), move_request("serving", 1))(audited)
        roll_back(audited)
        remove_alias(audited)
        sender((PUT, "arm/learning", LEARNING), (POST, "arm/rollback", {"version": 2}), (DELETE, "other"))(audited)
    assert len(seen) >= 9
    assert [changed for changed, noted in seen if not noted] == []


@pytest.mark.slow
def test_version_of_a_job_names_the_key_that_queued_it(audited, monkeypatch):
    row, secret = keys.create(service_of(audited).database, "trainer [1]", ["train", "read"], None)
    eventually(lambda: audited.get("/v1/jobs", headers=bearer(secret)).status_code == 200)
    dataset = upload(audited, stream())["id"]
    monkeypatch.setitem(audited.headers, "authorization", bearer(secret)["Authorization"])
    job = train(audited, "trained", dataset)["id"]
    monkeypatch.undo()
    serving, added = audit_lines(audited, model="trained")
    assert (added["key"], added["key_name"], added["what"]) == (row.id, "trainer [1]", f"job {job}")
    assert (added["change"], added["after"]) == ("version added", {"estimator": "lip-chain", "job": job})
    moved = {"change": "alias moved", "alias": "serving", "before": None, "after": 1}
    assert serving | moved == serving


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
    for name, value in {"model": "arm", "change": "alias moved", "key": audited.key}.items():
        assert {line[name] for line in audit_lines(audited, **{name: value})} == {value}
    assert audit_lines(audited, model="nobody") == []
    moment = every[3]["at"]
    assert audit_lines(audited, since=moment, until=moment) == []
    later, earlier = audit_lines(audited, since=moment), audit_lines(audited, until=moment)
    assert [line["id"] for line in later + earlier] == [line["id"] for line in every]
    assert {line["at"] < moment for line in earlier} == {True}
    elsewhere = datetime.fromisoformat(moment).astimezone(timezone(timedelta(hours=9))).isoformat()
    assert audit_lines(audited, since=elsewhere) == later
    for query in ("since=2026-11-24T08:00:00", "change=nothing"):  # the first has no time zone
        error(audited.get(f"/v1/audit?{query}"), 422, "invalid_request")


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
def test_command_lists_lines(run_command, server):
    assert_ok(server.client.put("/v1/models/panda-sim/aliases/audited", json={"version": 1}))
    out = run_command("audit", "--model", "panda-sim")
    assert "version added: 1" in out
    assert "alias moved: audited" in out
    moved = run_command("audit", "--model", "panda-sim", "--change", "alias moved", "--json")
    assert moved[0]["alias"] == "audited"
    assert {each["change"] for each in moved} == {"alias moved"}
    assert len(run_command("audit", "--limit", "1", "--json")) == 1
