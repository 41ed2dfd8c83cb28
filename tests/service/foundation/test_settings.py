"""Settings: environment variables are checked, and errors name the wrong variable."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import ValidationError

from service.foundation.environment import REMOVED_VARIABLES, check_environment
from service.foundation.settings import CHECKOUT_MODELS, Settings, describe, is_loopback


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch):
    """Remove the settings of the environment."""
    for name in Settings.model_fields:
        monkeypatch.delenv(f"LIPSERVE_{name.upper()}", raising=False)


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("home", "/data/lip", Path("/data/lip")),
        ("port", "9000", 9000),
        ("uds", "/run/lipserve.sock", Path("/run/lipserve.sock")),
        ("uds_mode", "600", 0o600),
    ],
)
def test_environment_variables_are_read(monkeypatch, name, text, value):
    assert getattr(Settings(), name) != value
    monkeypatch.setenv(f"LIPSERVE_{name.upper()}", text)
    assert getattr(Settings(), name) == value


def test_each_protocol_has_its_own_port():
    assert (Settings().grpc_port, Settings(port=0, grpc_port=0).grpc_port) == (None, 0)
    with pytest.raises(ValidationError, match="grpc_port is 8000, expected a port other than that of HTTP"):
        Settings(grpc_port=8000)


def test_defaults_are_safe():
    settings = Settings()
    assert (settings.host, settings.keys, settings.keys_needed) == ("127.0.0.1", "auto", False)
    assert settings.home == CHECKOUT_MODELS


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        *((host, True) for host in ("127.0.0.1", "::1", "localhost")),
        *((host, False) for host in ("0.0.0.0", "localhost.example.org", "127.0.0.1.example.org", "")),
    ],
)
def test_hosts_beyond_loopback_need_keys(monkeypatch, host, loopback):
    assert is_loopback(host) is loopback
    assert Settings(host=host).keys_needed is not loopback
    monkeypatch.setenv("LIPSERVE_KEYS", "on")
    assert Settings(host=host).keys_needed is True


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("port", "70000"),
        ("log_level", "loud"),
        ("training_niceness", "20"),
        ("keys", "off"),
        ("uds_mode", "rw-rw----"),
        ("uds_mode", "1777"),
        ("max_velocity", "1e308"),
        ("max_acceleration", "5e-324"),
        ("max_position", "0"),
    ],
)
def test_wrong_values_are_named(monkeypatch, name, text):
    monkeypatch.setenv(f"LIPSERVE_{name.upper()}", text)
    with pytest.raises(ValidationError) as caught:
        Settings()
    assert [item["loc"] for item in caught.value.errors()] == [(name,)]


def test_settings_are_few_and_documented():
    found = describe(Settings())
    assert len(found) <= 63
    assert all(each.meaning.endswith(".") for each in found)
    assert {each.unit for each in found if each.variable.endswith("_S")} == {"s", "1/s"}
    assert {each.unit for each in found if each.variable.endswith("_BYTES")} == {"bytes"}


def test_setting_is_shown_without_passwords():
    url = "postgresql://me:se@cret@host/name?password=secret&sslmode=require"
    settings = Settings(uds_mode="600", keep_alive_s=9, opentelemetry=True, database_url=url, files_url="s3://here/me")
    shown = {each.variable: each.value for each in describe(settings)}
    assert shown["LIPSERVE_DATABASE_URL"] == "postgresql://me:***@host/name?password=***&sslmode=require"
    assert (shown["LIPSERVE_UDS_MODE"], shown["LIPSERVE_KEEP_ALIVE_S"]) == ("600", "9")
    assert (shown["LIPSERVE_OPENTELEMETRY"], shown["LIPSERVE_UDS"]) == ("true", "")


def test_reference_page_lists_all_settings():
    docs = CHECKOUT_MODELS.parent / "docs"
    page = runpy.run_path(str(docs / "settings.py"))["page"]
    assert (docs / "reference/settings.md").read_text() == page(), "run: python docs/settings.py"


def test_unknown_settings_are_rejected():
    with pytest.raises(ValidationError, match="max_columns"):
        Settings(max_columns=5)


@pytest.mark.parametrize(
    ("variable", "message"),
    [
        ("LIPSERVE_PROT", "Unknown setting LIPSERVE_PROT. Did you mean LIPSERVE_PORT?"),
        ("lipserve_log_levels", "Unknown setting LIPSERVE_LOG_LEVELS. Did you mean LIPSERVE_LOG_LEVEL?"),
        ("LIPSERVE_42", "Unknown setting LIPSERVE_42."),
    ],
)
def test_unknown_variable_error_suggests_the_nearest(variable, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        check_environment({variable: "1"})


def test_variables_of_clients_tests_and_kubernetes_are_known():
    services = {
        "LIPSERVE_DB_SERVICE_HOST": "10.0.0.7",
        "LIPSERVE_DB_SERVICE_PORT": "5432",
        "LIPSERVE_DB_PORT": "tcp://…",
    }
    assert check_environment({"LIPSERVE_URL": "", "LIPSERVE_API_KEY": "", "LIPSERVE_ATTACK_SEED": "", **services}) == []
    del services["LIPSERVE_DB_SERVICE_HOST"]
    with pytest.raises(ValueError, match="LIPSERVE_DB_PORT"):
        check_environment(services)


def test_variables_that_tests_read_are_known():
    files = (Path(__file__).parents[2]).rglob("*.py")
    read = {name for file in files for name in re.findall(r'environ(?:\.get\(|\[)"(LIPSERVE_\w+)"', file.read_text())}
    assert {"LIPSERVE_HISTORY_S", "LIPSERVE_ATTACK_SEED", "LIPSERVE_YEAR_SEED"} <= read
    assert check_environment(dict.fromkeys(read, "1")) == []


def test_removed_variables_are_replaced_by_settings():
    names = {name.upper() for name in Settings.model_fields}
    assert names.isdisjoint(REMOVED_VARIABLES)
    replacing = {name for text in REMOVED_VARIABLES.values() for name in re.findall("LIPSERVE_([A-Z_]+)", text)}
    assert replacing <= names


@pytest.mark.slow
def test_start_fails_on_an_unknown_variable_and_warns_once_of_a_removed_one(tmp_path):
    """Once its settings are read, the service stops, as its home is a file."""
    (home := tmp_path / "home").touch()
    command = [sys.executable, "-m", "service", "serve", "--port", "0"]
    removed = {"LIPSERVE_MAX_COLUMNS": "50", "LIPSERVE_URL": "http://127.0.0.1:1", "LIPSERVE_API_KEY": "lip_key"}
    logs = []
    for variables in ({"LIPSERVE_PROT": "9000"}, removed):
        environment = {**os.environ, "LIPSERVE_HOME": str(home), **variables}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)
        assert done.returncode == 1
        logs.append(done.stderr)
    assert logs[0] == "error: Unknown setting LIPSERVE_PROT. Did you mean LIPSERVE_PORT?\n"
    assert logs[1].count("LIPSERVE_MAX_COLUMNS was removed: the limit is now fixed at 2000 columns.") == 1
    assert "Unknown setting" not in logs[1]
    assert "home" in logs[1].splitlines()[-1]
