"""Keys: how they are stored, found and revoked."""

import asyncio
import time
from datetime import UTC, datetime, timedelta
from unittest.mock import AsyncMock, Mock

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import delete, update

from service.api.access import keys
from service.api.access.keys import Keyring
from service.api.access.scopes import ADMIN
from service.app import create_app
from service.foundation.errors import UnauthorizedError
from service.foundation.settings import Settings
from service.storage.database import ApiKeyRow
from tests.service.api.access.conftest import REFRESH_S, bearer
from tests.service.api.oip.requests import error_message
from tests.service.data import arrays, error, eventually, npz, stream


@pytest.fixture
def arm(keys_database):
    """A key with the scope predict: its row, and the key."""
    return keys.create(keys_database, "arm", ["predict"], None)


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
        answer = keyed_service.get(wrong)
        assert "Unknown API key" in error(answer, 401, "unauthorized")["message"]
        assert 'error="invalid_token"' in answer.headers["www-authenticate"]
        assert wrong[:40] == "lip_" or wrong[:40] not in answer.text + caplog.text
    assert keyed_service.api.get("/v1/models", headers={"Authorization": b"Bearer \xff\xfe"}).status_code == 401


def test_errors_below_v2_have_its_shape(keyed_service):
    error_message(keyed_service.api.get("/v2"), 401)
    error_message(keyed_service.get(keyed_service.secrets["train"], "/v2"), 403)


def test_last_use_of_a_key_is_stored(keyed_service):
    key, secret = keyed_service.make("read")
    assert keyed_service.get(secret).status_code == 200
    used = eventually(lambda: {row.id: row.used_at for row in keys.list_keys(keyed_service.database)}[key])
    assert abs(time.time() - datetime.fromisoformat(used).timestamp()) < 60


@pytest.mark.anyio
async def test_last_use_is_stored_at_most_once_a_minute(keys_database, monkeypatch):
    (often, secret), (never, _) = (keys.create(keys_database, name, ["read"], None) for name in ("often", "never"))
    stored, clock = [], [1e9]
    write = keys.note_used

    def note(database, seen):
        stored.append(dict(seen))
        write(database, seen)

    monkeypatch.setattr(keys, "note_used", note)
    monkeypatch.setattr(keys, "time", lambda: clock[0])
    keyring = Keyring(REFRESH_S, 10)
    refreshing = AsyncMock(side_effect=keyring._refresh)
    monkeypatch.setattr(keyring, "_refresh", refreshing)
    async with keyring.watching(keys_database):
        key = keyring.find(secret.encode())
        keyring.use(key)
        await wait_until(lambda: stored)
        for _ in range(5):  # within the minute
            clock[0] += 10.0
            keyring.use(key)
            before = refreshing.await_count
            await wait_until(lambda at=before: refreshing.await_count >= at + 2)
        assert stored == [{often.id: 1e9}]
        clock[0] += 20.0
        keyring.use(key)
        await wait_until(lambda: len(stored) == 2)
        clock[0] += 5.0
        keyring.use(key)
    # the last use is written at the end
    assert stored == [{often.id: 1e9}, {often.id: 1e9 + 70}, {often.id: 1e9 + 75}]
    used = {row.id: row.used_at for row in keys.list_keys(keys_database)}
    assert used == {often.id: "2001-09-09T01:47:55.000+00:00", never.id: None}


@pytest.mark.slow
def test_rate_limit_of_a_key_applies_to_it_alone(home, keys_database, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(keys, "monotonic", lambda: clock[0])
    row, slow = keys.create(keys_database, "slow", ["read"], None, max_requests_per_s=0.2)
    _, free = keys.create(keys_database, "free", ["read"], None)
    _, fast = keys.create(keys_database, "fast", ["read"], None, max_requests_per_s=1e3)
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


@pytest.fixture
async def keyring(keys_database, anyio_backend):
    """A keyring that watches the database."""
    made = Keyring(REFRESH_S, 10)
    async with made.watching(keys_database):
        yield made


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


@pytest.mark.anyio
async def test_key_expires(keys_database, keyring, monkeypatch):
    row, secret = keys.create(keys_database, "guest", ["read"], datetime.now(UTC) + timedelta(days=1))
    await wait_until(lambda: admits(keyring, secret))
    ended = []
    with keyring.lasting(keyring.find(secret.encode()), lambda: ended.append(1)):
        monkeypatch.setattr(keys, "time", lambda: time.time() + 86_390)
        assert admits(keyring, secret)
        assert not ended
        monkeypatch.setattr(keys, "time", lambda: time.time() + 86_410)
        with pytest.raises(UnauthorizedError, match=f"API key {row.id} has expired"):
            keyring.use(keyring.find(secret.encode()))
        await wait_until(lambda: ended)


@pytest.mark.anyio
@pytest.mark.parametrize("how", [update(ApiKeyRow).values(revoked_at="2026-01-01"), delete(ApiKeyRow)])
async def test_request_ends_with_its_own_key_only(keys_database, arm, keyring, caplog, how):
    row, secret = arm
    _, other = keys.create(keys_database, "other", ["predict"], None)
    await wait_until(lambda: admits(keyring, other))
    ended, key = [], keyring.find(secret.encode())
    with (
        keyring.lasting(key, Mock(side_effect=OSError("cannot"))),  # its end keeps no other request open
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
    assert "could not be closed" in caplog.text


@pytest.mark.anyio
async def test_changed_scopes_apply_to_an_existing_key(keys_database, arm, keyring):
    row, secret = arm
    key = keyring.find(secret.encode())
    with keys_database.transaction() as session:
        session.execute(update(ApiKeyRow).where(ApiKeyRow.id == row.id).values(scopes=["read"]))
    await wait_until(lambda: key.allows("read"))
    assert not key.allows("predict")
    assert keyring.find(secret.encode()) is key


@pytest.mark.anyio
async def test_known_keys_work_while_the_database_fails(keys_database, arm, keyring, monkeypatch, caplog):
    row, secret = arm
    failing = Mock(side_effect=OSError("the disk is gone"))
    monkeypatch.setattr(keys_database, "session", failing)
    await wait_until(lambda: failing.call_count > 3)
    assert admits(keyring, secret)
    assert caplog.text.count("API keys cannot be read") == 1
    keys.revoke(keys_database, row.id)
    monkeypatch.undo()
    await wait_until(lambda: not admits(keyring, secret))


@pytest.mark.anyio
async def test_service_without_a_valid_key_explains_how_to_make_one(keys_database, caplog):
    async with Keyring(REFRESH_S, 10).watching(keys_database):
        assert "create one with `lipserve keys create`" in caplog.text
