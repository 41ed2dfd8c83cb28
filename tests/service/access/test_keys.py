"""Keys: how they are stored, found and ended."""

import asyncio
import time
from datetime import UTC, datetime, timedelta

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import delete, update

from service.api.access import keys
from service.api.access import keys as keyring_module
from service.api.access.keys import Keyring
from service.api.access.scopes import ADMIN
from service.app import create_app
from service.foundation.errors import UnauthorizedError
from service.foundation.settings import Settings
from service.storage.database import ApiKeyRow, Database
from tests.service.access.conftest import REFRESH_S, bearer
from tests.service.data import arrays, error, eventually, npz, stream


@pytest.mark.own_files("reads the file of the database")
def test_a_key_is_long_random_and_not_stored(keys_database, home):
    made = [keys.create(keys_database, "arm", ["predict"], None) for _ in range(20)]
    secrets = [secret for _, secret in made]
    assert len(set(secrets)) == 20
    assert all(secret.startswith("lip_") and len(secret) == 4 + 43 for secret in secrets)
    keys_database.close()
    stored = b"".join(path.read_bytes() for path in home.glob("lipserve.sqlite3*"))
    for row, secret in made:
        assert row.id.encode() in stored
        assert secret.encode() not in stored
        assert secret.removeprefix("lip_").encode() not in stored


def test_a_key_needs_a_scope(keys_database):
    with pytest.raises(ValueError, match="scopes are missing"):
        keys.create(keys_database, "arm", [], None)


def test_a_key_comes_as_a_bearer_token(guarded):
    key = guarded.secrets[ADMIN]
    wrong = ["", "Bearer", "Basic bGlwOnNlcnZl", key]
    others = {"X-Api-Key": key, "Cookie": f"key={key}", "Sec-WebSocket-Protocol": f"lipserve.key.{key}"}
    for headers in [*({"Authorization": each} for each in wrong), others]:
        answer = guarded.api.get(f"/v1/models?key={key}", headers=headers)
        assert "no API key was given" in error(answer, 401, "unauthorized")["message"]
        assert answer.headers["www-authenticate"] == 'Bearer realm="lipserve"'
    for scheme in ("Bearer", "bearer", "BEARER"):
        assert guarded.api.get("/v1/models", headers={"Authorization": f"{scheme} {key}"}).status_code == 200


def test_each_key_has_idempotency_keys_of_its_own(guarded):
    secrets = [guarded.make("train")[1] for _ in range(2)]
    eventually(lambda: all(guarded.api.get("/v1/jobs", headers=bearer(each)).status_code != 401 for each in secrets))

    def upload(secret, seed):
        headers = {**bearer(secret), "content-type": "application/x-npz", "Idempotency-Key": "mine"}
        return guarded.api.post("/v1/datasets", content=npz(**arrays(stream(seed=seed))), headers=headers)

    one, other = upload(secrets[0], 1), upload(secrets[1], 2)
    assert (one.status_code, other.status_code) == (201, 201)
    assert one.json()["id"] != other.json()["id"]
    assert upload(secrets[0], 1).json() == one.json()
    refusal = error(upload(secrets[1], 1), 409, "conflict")
    assert (refusal["detail"][0]["value"], one.json()["id"] in refusal["message"]) == ("mine", False)


def test_what_is_not_a_key_is_not_repeated(guarded, caplog):
    secret = guarded.secrets["read"]
    for wrong in (secret[:-1], secret + "x", secret.upper(), secret[4:], "lip_", "x" * 5000, secret[::-1]):
        answer = guarded.api.get("/v1/models", headers=bearer(wrong))
        assert "is not one of this service" in error(answer, 401, "unauthorized")["message"]
        assert 'error="invalid_token"' in answer.headers["www-authenticate"]
        assert wrong[:40] == "lip_" or wrong[:40] not in answer.text + caplog.text
    assert guarded.api.get("/v1/models", headers={"Authorization": b"Bearer \xff\xfe"}).status_code == 401


def test_errors_below_v2_have_its_shape(guarded):
    answer = guarded.api.get("/v2")
    assert (answer.status_code, list(answer.json())) == (401, ["error"])
    assert isinstance(answer.json()["error"], str)
    answer = guarded.api.get("/v2", headers=bearer(guarded.secrets["train"]))
    assert (answer.status_code, type(answer.json()["error"])) == (403, str)


def test_when_a_key_was_used_is_stored(guarded):
    key, secret = guarded.make("read")
    eventually(lambda: guarded.api.get("/v1/models", headers=bearer(secret)).status_code == 200)

    def row():
        return next(row for row in keys.stored(guarded.database) if row.id == key)

    used = datetime.fromisoformat(eventually(lambda: row().used_at)).timestamp()
    assert abs(time.time() - used) < 60


def test_when_a_key_was_used_is_stored_at_most_once_a_minute(keys_database, monkeypatch):
    made = [keys.create(keys_database, name, ["read"], None) for name in ("often", "never")]
    stored, clock = [], [1e9]
    write = keys.note_used

    def note(database, seen):
        stored.append(dict(seen))
        write(database, seen)

    monkeypatch.setattr(keyring_module, "note_used", note)
    monkeypatch.setattr(keyring_module, "time", lambda: clock[0])

    async def steps(keyring):
        key, looked = keyring.find(made[0][1].encode()), keyring._refresh
        turns = []

        async def counted(database):
            await looked(database)
            turns.append(1)

        monkeypatch.setattr(keyring, "_refresh", counted)
        keyring.use(key)
        await until(lambda: stored)
        for _ in range(5):  # within the minute
            clock[0] += 10.0
            keyring.use(key)
            before = len(turns)
            await until(lambda at=before: len(turns) >= at + 2)
        assert stored == [{key.id: 1e9}]
        clock[0] += 20.0
        keyring.use(key)
        await until(lambda: len(stored) == 2)
        clock[0] += 5.0
        keyring.use(key)

    watched(keys_database, steps)
    often = made[0][0].id
    assert stored == [{often: 1e9}, {often: 1e9 + 70}, {often: 1e9 + 75}]  # the last one at the end
    used = {row.id: row.used_at for row in keys.stored(keys_database)}
    assert used == {often: "2001-09-09T01:47:55.000+00:00", made[1][0].id: None}


def test_a_key_with_a_rate_of_its_own_is_refused_beyond_it_and_no_other_key_is(tmp_path, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(keyring_module, "monotonic", lambda: clock[0])
    home = tmp_path / "home"
    database = Database.of(Settings(home=home))
    row, slow = keys.create(database, "slow", ["read"], None, max_requests_per_s=0.2)
    _, free = keys.create(database, "free", ["read"], None)
    _, fast = keys.create(database, "fast", ["read"], None, max_requests_per_s=1e3)
    database.close()
    settings = Settings(home=home, keys="on", max_requests_per_s=0.001, max_request_burst=3)
    with TestClient(create_app(settings), "http://robot.example") as api:

        def statuses(secret, count):
            return [api.get("/v1/models", headers=bearer(secret)).status_code for _ in range(count)]

        assert statuses(slow, 3) == [200, 200, 429]  # ten seconds' worth at once
        refused = api.get("/v1/models", headers=bearer(slow))
        said = error(refused, 429, "rate_limited")["message"]
        assert said == f"the API key {row.id} asks more than 0.2 times per s, the most that it may"
        assert refused.headers["retry-after"] == "5"
        clock[0] += 5.0
        assert statuses(slow, 2) == [200, 429]
        assert statuses(fast, 3) == [200, 200, 200]  # the burst of the service, of which nothing is left
        assert statuses(fast, 1) == [429]
        clock[0] += 0.001
        assert statuses(fast, 1) == [200]  # more often than keys without a rate
        assert statuses(free, 4) == [200, 200, 200, 429]
        assert api.get("/health/live", headers=bearer(slow)).status_code == 200


def watched(database, steps):
    """Run `steps` with a keyring that watches a database."""

    async def run():
        keyring = Keyring(REFRESH_S, 10)
        async with keyring.watching(database):
            return await steps(keyring)

    return asyncio.run(run())


async def until(look):
    """Wait in the event loop until something is true."""
    async with asyncio.timeout(30):
        while not look():
            await asyncio.sleep(REFRESH_S / 4)


def admits(keyring, secret):
    try:
        keyring.use(keyring.find(secret.encode()))
    except UnauthorizedError:
        return False
    return True


def test_a_key_ends_when_it_expires(keys_database, monkeypatch):
    row, secret = keys.create(keys_database, "guest", ["read"], datetime.now(UTC) + timedelta(days=1))

    async def steps(keyring):
        ended = []
        with keyring.lasting(keyring.find(secret.encode()), lambda: ended.append(1)):
            assert admits(keyring, secret)
            monkeypatch.setattr(keyring_module, "time", lambda: time.time() + 86_390)
            assert admits(keyring, secret)
            assert not ended
            monkeypatch.setattr(keyring_module, "time", lambda: time.time() + 86_410)
            with pytest.raises(UnauthorizedError, match=f"the API key {row.id} has expired"):
                keyring.use(keyring.find(secret.encode()))
            await until(lambda: ended)

    watched(keys_database, steps)


@pytest.mark.parametrize("how", [update(ApiKeyRow).values(revoked_at="2026-01-01"), delete(ApiKeyRow)])
def test_what_lasts_ends_with_its_key_and_only_then(keys_database, caplog, how):
    row, secret = keys.create(keys_database, "arm", ["predict"], None)
    _, other = keys.create(keys_database, "other", ["predict"], None)

    def fail():
        raise OSError("cannot")

    async def steps(keyring):
        ended = []
        key = keyring.find(secret.encode())
        with (
            keyring.lasting(key, fail),  # keeps no other open
            keyring.lasting(key, lambda: ended.append(1)),
            keyring.lasting(key, lambda: ended.append(2)),
            keyring.lasting(keyring.find(other.encode()), lambda: ended.append("other")),
        ):
            with keyring.lasting(key, lambda: ended.append("over before")):
                pass
            with keys_database.transaction() as session:
                session.execute(how.where(ApiKeyRow.id == row.id))
            await until(lambda: len(ended) >= 2)
            assert set(ended) == {1, 2}
            assert not admits(keyring, secret)
            assert admits(keyring, other)

    watched(keys_database, steps)
    assert "cannot be ended" in caplog.text


def test_scopes_that_are_changed_hold_for_the_same_key(keys_database):
    row, secret = keys.create(keys_database, "arm", ["predict"], None)

    async def steps(keyring):
        key = keyring.find(secret.encode())
        with keys_database.transaction() as session:
            session.execute(update(ApiKeyRow).where(ApiKeyRow.id == row.id).values(scopes=["read"]))
        await until(lambda: key.allows("read"))
        assert not key.allows("predict")
        assert keyring.find(secret.encode()) is key

    watched(keys_database, steps)


def test_known_keys_stay_while_the_database_cannot_be_read(keys_database, monkeypatch, caplog):
    row, secret = keys.create(keys_database, "arm", ["predict"], None)
    failures = []

    def fail():
        failures.append(1)
        raise OSError("the disk is gone")

    async def steps(keyring):
        monkeypatch.setattr(keys_database, "session", fail)
        await until(lambda: len(failures) > 3)
        assert admits(keyring, secret)
        assert caplog.text.count("the keys cannot be read") == 1
        keys.revoke(keys_database, row.id)
        monkeypatch.undo()
        await until(lambda: not admits(keyring, secret))

    watched(keys_database, steps)


def test_a_service_without_a_valid_key_says_how_to_make_one(keys_database, caplog):
    watched(keys_database, lambda _: asyncio.sleep(0))
    assert "make one with `lipserve keys create`" in caplog.text
