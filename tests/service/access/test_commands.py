"""`lipserve keys`: on the home, whether a service runs on it or not."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta

import pytest

from service import cli
from service.client import Client
from service.client.sending import headers_of
from service.foundation.settings import Settings
from service.storage.database import Database
from service.web.access import keys
from service.web.access.keys import digest_of
from tests.service.access.conftest import bearer
from tests.service.data import eventually


@pytest.fixture
def lipserve(monkeypatch, capsys, home):
    """Run `lipserve` on an empty home; return its exit code, output and error output."""
    monkeypatch.setenv("LIPSERVE_HOME", str(home))

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["lipserve", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        said = capsys.readouterr()
        return ended.value.code or 0, said.out, said.err

    return run


def test_a_key_is_all_that_create_prints(lipserve, keys_database):
    code, said, more = lipserve("keys", "create", "--name", "arm 1", "--scope", "predict,update", "--scope", "read")
    assert code == 0
    [row] = keys.stored(keys_database)
    assert said.endswith("\n")
    assert digest_of(said.strip().encode()).hex() == row.hash
    assert (row.name, row.scopes, row.expires_at) == ("arm 1", ["predict", "update", "read"], None)
    assert row.id in more
    assert "predict, update, read until it is revoked" in more
    assert "lip_" not in more


def test_keys_can_expire(lipserve, keys_database):
    _, said, _ = lipserve("keys", "create", "--name", "guest", "--scope", "read", "--days", "1.5", "--json")
    made = json.loads(said)
    left = datetime.fromisoformat(made["expires_at"]) - datetime.now(UTC)
    assert timedelta(days=1.49) < left < timedelta(days=1.51)
    assert made["key"].startswith("lip_")
    assert made["state"] == "valid"


def test_keys_are_listed_without_the_keys(lipserve, keys_database):
    secrets = [keys.create(keys_database, name, ["read"], None) for name in ("one", "two [bold]", "three")]
    keys.revoke(keys_database, secrets[0][0].id)
    keys.note_used(keys_database, {secrets[1][0].id: 1_800_000_000.0})
    with keys_database.transaction() as session:
        session.merge(secrets[2][0]).expires_at = "2026-01-01T00:00:00+00:00"
    _, said, _ = lipserve("keys", "list", "--json")
    listed = json.loads(said)
    assert [item["state"] for item in listed] == ["revoked", "valid", "expired"]
    assert listed[1]["used_at"] == "2027-01-15T08:00:00.000+00:00"
    code, table, _ = lipserve("keys", "list")
    assert code == 0
    assert "two [bold]" in table
    for row, secret in secrets:
        assert secret not in said + table
        assert row.hash not in said + table


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("create", "--name", "x", "--scope", "write"), "scope is 'write', expected one of read, predict"),
        (("create", "--name", "\x1b[31m", "--scope", "read"), "expected 1 to 200 printable characters"),
        (
            ("create", "--name", "x", "--scope", "read", "--days", "0"),
            "days is 0, expected more than 0 and at",
        ),
        (("create", "--name", "x", "--scope", "read", "--days", "nan"), "days is nan, expected more than 0"),
        (("create", "--name", "x", "--scope", "read", "--days", "1e300"), "days is 1e+300, expected"),
        (("revoke", "key_nobody"), "key is 'key_nobody', expected the id of a key"),
    ],
)
def test_what_is_wrong_is_said(lipserve, keys_database, arguments, said):
    code, out, error = lipserve("keys", *arguments)
    assert (code, out) == (1, "")
    assert said in error
    assert "\x1b[31m[31m" not in error
    assert keys.stored(keys_database) == []


def test_revoking_twice_keeps_the_first_time(lipserve, keys_database):
    row, _ = keys.create(keys_database, "arm", ["read"], None)
    times = [json.loads(lipserve("keys", "revoke", row.id, "--json")[1])["revoked_at"] for _ in range(2)]
    assert times[0] == times[1] is not None


def test_keys_of_a_running_service(lipserve, guarded, monkeypatch):
    home = guarded.api.app.state.storage.settings.home
    monkeypatch.setenv("LIPSERVE_HOME", str(home))
    made = json.loads(lipserve("keys", "create", "--name", "arm", "--scope", "read", "--json")[1])

    def status():
        return guarded.api.get("/v1/models", headers=bearer(made["key"])).status_code

    eventually(lambda: status() == 200)
    assert lipserve("keys", "revoke", made["id"])[0] == 0
    eventually(lambda: status() == 401)


def test_clients_take_the_key_of_the_environment(monkeypatch):
    monkeypatch.delenv("LIPSERVE_KEY", raising=False)
    assert headers_of(None) == {}
    monkeypatch.setenv("LIPSERVE_KEY", "lip_abc\n")
    assert headers_of(None) == {"Authorization": "Bearer lip_abc"}
    assert headers_of("lip_def") == {"Authorization": "Bearer lip_def"}
    assert headers_of("") == {}
    with Client("http://127.0.0.1:1") as client:
        assert client._http.headers["authorization"] == "Bearer lip_abc"
    with Client("http://127.0.0.1:1", key="lip_def") as client:
        assert client._http.headers["authorization"] == "Bearer lip_def"


@pytest.mark.parametrize("key", ["lip_a b", "lip_a\r\nX: y", "lip_ä", "lip_\x00"])
def test_what_cannot_be_a_key_is_not_repeated(key):
    with pytest.raises(ValueError, match="holds other characters than keys do") as caught:
        headers_of(key)
    assert "lip_a" not in str(caught.value)


def test_a_home_is_made_for_its_first_key(lipserve, home):
    assert not home.exists()
    assert lipserve("keys", "create", "--name", "admin", "--scope", "admin")[0] == 0
    database = Database.of(Settings(home=home))
    assert [row.name for row in keys.stored(database)] == ["admin"]
    database.close()
