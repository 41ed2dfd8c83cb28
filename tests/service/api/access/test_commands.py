"""`lipserve keys` on a home with or without a running service, and the key that clients send."""

import json
from datetime import UTC, datetime, timedelta

import pytest

from lipserve.address import headers_of
from service.api.access import keys
from service.api.access.keys import digest_of
from service.foundation.settings import Settings
from service.storage.database import Database
from tests.service.data import error, eventually, service_of


@pytest.fixture(autouse=True)
def _own_home(monkeypatch, home):
    monkeypatch.setenv("LIPSERVE_HOME", str(home))


@pytest.fixture
def create(lipserve):
    """Run `lipserve keys create`; return its exit code, output and error output."""
    return lambda name, scope, *options: lipserve("keys", "create", "--name", name, "--scope", scope, *options)


@pytest.fixture
def create_json(create):
    """Create a key; return its description."""
    return lambda name, scope, *options: json.loads(create(name, scope, *options, "--json")[1])


def test_create_prints_only_the_key_and_makes_the_home(create, create_json, home):
    assert not home.exists()
    code, out, err = create("arm 1", "predict,update", "--scope", "read")
    assert code == 0
    database = Database.of(Settings(home=home))
    [row] = keys.list_keys(database)
    database.close()
    assert digest_of(out.removesuffix("\n").encode()).hex() == row.hash
    assert (row.name, row.scopes, row.expires_at) == ("arm 1", ["predict", "update", "read"], None)
    assert row.id in err
    assert "created: scope predict, update, read, no expiry" in err
    assert "lip_" not in err
    made = create_json("guest", "read", "--days", "1.5")
    left = datetime.fromisoformat(made["expires_at"]) - datetime.now(UTC)
    assert timedelta(days=1.49) < left < timedelta(days=1.51)
    assert (made["key"].startswith("lip_"), made["state"]) == (True, "valid")


def test_key_of_a_file_is_stored_once_and_not_printed(create, keys_database, tmp_path):
    file = tmp_path / "admin"
    secret = "lip_" + "0123456789abcdef" * 4
    file.write_text(secret + "\n")
    for _ in range(2):
        code, out, err = create("admin", "admin", "--file", file)
        assert (code, out) == (0, "")
        assert "created: scope admin" in err
    [row] = keys.list_keys(keys_database)
    assert row.hash == digest_of(secret.encode()).hex()
    keys.revoke(keys_database, row.id)
    assert create("again", "read", "--file", file)[0] == 0
    [row] = keys.list_keys(keys_database)
    assert (row.name, row.revoked_at is None) == ("admin", False)
    for wrong in ("lip_short", "x" * 64, secret + " x", ""):
        file.write_text(wrong)
        code, _, err = create("admin", "admin", "--file", file)
        assert code == 1
        assert "a key must be lip_ followed by 43 to 200" in err
        assert not wrong or wrong not in err
    assert create("a", "admin", "--file", tmp_path / "none")[0] == 1


def test_list_does_not_print_the_keys(lipserve, create_json, keys_database):
    made = [keys.create(keys_database, name, ["read"], None) for name in ("one", "two [bold]", "three")]
    keys.revoke(keys_database, made[0][0].id)
    keys.note_used(keys_database, {made[1][0].id: 1_800_000_000.0})
    with keys_database.transaction() as session:
        session.merge(made[2][0]).expires_at = "2026-01-01T00:00:00+00:00"
    assert create_json("loop", "predict", "--rate", "250")["max_requests_per_s"] == 250.0
    text = lipserve("keys", "list", "--json")[1]
    listed = json.loads(text)
    assert [item["state"] for item in listed] == ["revoked", "valid", "expired", "valid"]
    assert [item["max_requests_per_s"] for item in listed] == [None, None, None, 250.0]
    assert listed[1]["used_at"] == "2027-01-15T08:00:00.000+00:00"
    code, table, _ = lipserve("keys", "list")
    assert code == 0
    assert all(each in table for each in ("two [bold]", " 250 ", "2027-01-15 08:00"))
    assert not any(secret in text + table or row.hash in text + table for row, secret in made)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("x", "write"), "scope is 'write', expected one of read, predict, update, train, admin"),
        (("x", ""), "scope is ''"),
        (("", "read"), "name is"),
        (("x" * 201, "read"), "name is"),
        (("\x1b[31m\u202e", "read"), "expected 1 to 200 printable characters"),
        (("x", "read", "--rate", "0"), "rate is 0, expected 0.001 to 1e+06 requests per s"),
        (("x", "read", "--rate", "nan"), "rate is nan, expected"),
        (("x", "read", "--days", "0"), "--days must be more than 0 and at most"),
        (("x", "read", "--days", "nan"), ", got nan"),
        (("x", "read", "--days", "1e300"), ", got 1e+300"),
    ],
)
def test_invalid_keys_are_rejected(create, keys_database, arguments, message):
    code, out, err = create(*arguments)
    assert (code, out) == (1, "")
    assert message in err
    assert "\x1b[31m[31m" not in err
    assert keys.list_keys(keys_database) == []


def test_keys_of_a_running_service(lipserve, create_json, keyed_service, monkeypatch):
    monkeypatch.setenv("LIPSERVE_HOME", str(service_of(keyed_service.api).settings.home))
    made = create_json("arm", "read")
    eventually(lambda: keyed_service.get(made["key"]).status_code == 200)
    code, out, _ = lipserve("keys", "revoke", made["id"], "--json")
    assert code == 0
    refused = eventually(lambda: (seen := keyed_service.get(made["key"])).status_code == 401 and seen)
    assert f"API key {made['id']} was revoked" in error(refused, 401, "unauthorized")["message"]
    again = lipserve("keys", "revoke", made["id"], "--json")[1]
    assert json.loads(again)["revoked_at"] == json.loads(out)["revoked_at"] is not None
    assert "there is no key 'key_nobody'" in lipserve("keys", "revoke", "key_nobody")[2]


def test_clients_read_the_key_from_the_environment(monkeypatch):
    monkeypatch.delenv("LIPSERVE_API_KEY", raising=False)
    assert headers_of(None) == {}
    monkeypatch.setenv("LIPSERVE_API_KEY", "lip_abc\n")
    assert headers_of(None) == {"Authorization": "Bearer lip_abc"}
    assert headers_of("lip_def") == {"Authorization": "Bearer lip_def"}
    assert headers_of("") == {}


@pytest.mark.parametrize("key", ["lip_a b", "lip_a\r\nX: y", "lip_ä", "lip_\x00"])
def test_invalid_key_is_not_repeated(key):
    with pytest.raises(ValueError, match="characters that are not allowed in an API key") as caught:
        headers_of(key)
    assert "lip_a" not in str(caught.value)
