"""Keys: how they are stored, found and revoked."""

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
from tests.service.api.access.conftest import REFRESH_S, bearer
from tests.service.data import arrays, error, eventually, npz, stream


@pytest.mark.own_files("reads the file of the database")
def test_key_is_long_and_random_and_only_its_hash_is_stored(keys_database, home):
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


def test_key_needs_a_scope(keys_database):
    with pytest.raises(ValueError, match="give at least one scope of read"):
        keys.create(keys_database, "arm", [], None)


def test_key_is_sent_as_bearer_token(keyed_service):
    key = keyed_service.secrets[ADMIN]
    wrong = ["", "Bearer", "Basic bGlwOnNlcnZl", key]
    others = {"X-Api-Key": key, "Cookie": f"key={key}", "Sec-WebSocket-Protocol": f"lipserve.key.{key}"}
    for headers in [*({"Authorization": each} for each in wrong), others]:
        answer = keyed_service.api.get(f"/v1/models?key={key}", headers=headers)
        assert "An API key is required" in error(answer, 401, "unauthorized")["message"]
        assert answer.headers["www-authenticate"] == 'Bearer realm="lipserve"'
    for scheme in ("Bearer", "bearer", "BEARER"):
        assert keyed_service.api.get("/v1/models", headers={"Authorization": f"{scheme} {key}"}).status_code == 200


def test_each_key_has_its_own_idempotency_keys(keyed_service):
    secrets = [keyed_service.make("train")[1] for _ in range(2)]
    eventually(
        lambda: all(keyed_service.api.get("/v1/jobs", headers=bearer(each)).status_code != 401 for each in secrets)
    )

    def upload(secret, seed):
        headers = {**bearer(secret), "content-type": "application/x-npz", "Idempotency-Key": "mine"}
        return keyed_service.api.post("/v1/datasets", content=npz(**arrays(stream(seed=seed))), headers=headers)

    one, other = upload(secrets[0], 1), upload(secrets[1], 2)
    assert (one.status_code, other.status_code) == (201, 201)
    assert one.json()["id"] != other.json()["id"]
    assert upload(secrets[0], 1).json() == one.json()
    refusal = error(upload(secrets[1], 1), 409, "conflict")
    assert (refusal["detail"][0]["value"], one.json()["id"] in refusal["message"]) == ("mine", False)


def test_invalid_key_is_not_repeated_in_the_answer(keyed_service, caplog):
    secret = keyed_service.secrets["read"]
    for wrong in (secret[:-1], secret + "x", secret.upper(), secret[4:], "lip_", "x" * 5000, secret[::-1]):
        answer = keyed_service.api.get("/v1/models", headers=bearer(wrong))
        assert "Unknown API key" in error(answer, 401, "unauthorized")["message"]
        assert 'error="invalid_token"' in answer.headers["www-authenticate"]
        assert wrong[:40] == "lip_" or wrong[:40] not in answer.text + caplog.text
    assert keyed_service.api.get("/v1/models", headers={"Authorization": b"Bearer \xff\xfe"}).status_code == 401


def test_errors_below_v2_have_its_shape(keyed_service):
    answer = keyed_service.api.get("/v2")
    assert (answer.status_code, list(answer.json())) == (401, ["error"])
    assert isinstance(answer.json()["error"], str)
    answer = keyed_service.api.get("/v2", headers=bearer(keyed_service.secrets["train"]))
    assert (answer.status_code, type(answer.json()["error"])) == (403, str)


def test_last_use_of_a_key_is_stored(keyed_service):
    key, secret = keyed_service.make("read")
    eventually(lambda: keyed_service.api.get("/v1/models", headers=bearer(secret)).status_code == 200)

    def row():
        return next(row for row in keys.list_keys(keyed_service.database) if row.id == key)

    used = datetime.fromisoformat(eventually(lambda: row().used_at)).timestamp()
    assert abs(time.time() - used) < 60


def test_last_use_is_stored_at_most_once_a_minute(keys_database, monkeypatch):
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
        await wait_until(lambda: stored)
        for _ in range(5):  # within the minute
            clock[0] += 10.0
            keyring.use(key)
            before = len(turns)
            await wait_until(lambda at=before: len(turns) >= at + 2)
        assert stored == [{key.id: 1e9}]
        clock[0] += 20.0
        keyring.use(key)
        await wait_until(lambda: len(stored) == 2)
        clock[0] += 5.0
        keyring.use(key)

    run_with_keyring(keys_database, steps)
    often = made[0][0].id
    assert stored == [{often: 1e9}, {often: 1e9 + 70}, {often: 1e9 + 75}]  # the last use is written at the end
    used = {row.id: row.used_at for row in keys.list_keys(keys_database)}
    assert used == {often: "2001-09-09T01:47:55.000+00:00", made[1][0].id: None}


@pytest.mark.slow
def test_rate_limit_of_a_key_applies_to_it_alone(tmp_path, monkeypatch):
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

        assert statuses(slow, 3) == [200, 200, 429]  # a burst of ten seconds
        refused = api.get("/v1/models", headers=bearer(slow))
        message = error(refused, 429, "rate_limited")["message"]
        assert message == f"Too many requests with API key {row.id}: at most 0.2 per s."
        assert refused.headers["retry-after"] == "5"
        clock[0] += 5.0
        assert statuses(slow, 2) == [200, 429]
        assert statuses(fast, 3) == [200, 200, 200]  # the burst of the service is used up
        assert statuses(fast, 1) == [429]
        clock[0] += 0.001
        assert statuses(fast, 1) == [200]  # faster than the limit of keys without a rate
        assert statuses(free, 4) == [200, 200, 200, 429]
        assert api.get("/health/live", headers=bearer(slow)).status_code == 200


def run_with_keyring(database, steps):
    """Run `steps` with a keyring that watches a database."""

    async def run():
        keyring = Keyring(REFRESH_S, 10)
        async with keyring.watching(database):
            return await steps(keyring)

    return asyncio.run(run())


async def wait_until(look):
    """Wait in the event loop until a condition is true."""
    async with asyncio.timeout(30):
        while not look():
            await asyncio.sleep(REFRESH_S / 4)


def admits(keyring, secret):
    try:
        keyring.use(keyring.find(secret.encode()))
    except UnauthorizedError:
        return False
    return True


def test_key_expires(keys_database, monkeypatch):
    row, secret = keys.create(keys_database, "guest", ["read"], datetime.now(UTC) + timedelta(days=1))

    async def steps(keyring):
        ended = []
        with keyring.lasting(keyring.find(secret.encode()), lambda: ended.append(1)):
            assert admits(keyring, secret)
            monkeypatch.setattr(keyring_module, "time", lambda: time.time() + 86_390)
            assert admits(keyring, secret)
            assert not ended
            monkeypatch.setattr(keyring_module, "time", lambda: time.time() + 86_410)
            with pytest.raises(UnauthorizedError, match=f"API key {row.id} has expired"):
                keyring.use(keyring.find(secret.encode()))
            await wait_until(lambda: ended)

    run_with_keyring(keys_database, steps)


@pytest.mark.parametrize("how", [update(ApiKeyRow).values(revoked_at="2026-01-01"), delete(ApiKeyRow)])
def test_request_ends_with_its_own_key_only(keys_database, caplog, how):
    row, secret = keys.create(keys_database, "arm", ["predict"], None)
    _, other = keys.create(keys_database, "other", ["predict"], None)

    def fail():
        raise OSError("cannot")

    async def steps(keyring):
        ended = []
        key = keyring.find(secret.encode())
        with (
            keyring.lasting(key, fail),  # its end keeps no other request open
            keyring.lasting(key, lambda: ended.append(1)),
            keyring.lasting(key, lambda: ended.append(2)),
            keyring.lasting(keyring.find(other.encode()), lambda: ended.append("other")),
        ):
            with keyring.lasting(key, lambda: ended.append("over before")):
                pass
            with keys_database.transaction() as session:
                session.execute(how.where(ApiKeyRow.id == row.id))
            await wait_until(lambda: len(ended) >= 2)
            assert set(ended) == {1, 2}
            assert not admits(keyring, secret)
            assert admits(keyring, other)

    run_with_keyring(keys_database, steps)
    assert "could not be closed" in caplog.text


def test_changed_scopes_apply_to_an_existing_key(keys_database):
    row, secret = keys.create(keys_database, "arm", ["predict"], None)

    async def steps(keyring):
        key = keyring.find(secret.encode())
        with keys_database.transaction() as session:
            session.execute(update(ApiKeyRow).where(ApiKeyRow.id == row.id).values(scopes=["read"]))
        await wait_until(lambda: key.allows("read"))
        assert not key.allows("predict")
        assert keyring.find(secret.encode()) is key

    run_with_keyring(keys_database, steps)


def test_known_keys_work_while_the_database_fails(keys_database, monkeypatch, caplog):
    row, secret = keys.create(keys_database, "arm", ["predict"], None)
    failures = []

    def fail():
        failures.append(1)
        raise OSError("the disk is gone")

    async def steps(keyring):
        monkeypatch.setattr(keys_database, "session", fail)
        await wait_until(lambda: len(failures) > 3)
        assert admits(keyring, secret)
        assert caplog.text.count("API keys cannot be read") == 1
        keys.revoke(keys_database, row.id)
        monkeypatch.undo()
        await wait_until(lambda: not admits(keyring, secret))

    run_with_keyring(keys_database, steps)


def test_service_without_a_valid_key_explains_how_to_make_one(keys_database, caplog):
    run_with_keyring(keys_database, lambda _: asyncio.sleep(0))
    assert "create one with `lipserve keys create`" in caplog.text
