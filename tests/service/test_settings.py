"""Settings: environment variables, checked, with what is wrong named."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from service.foundation.settings import CHECKOUT_MODELS, Settings, is_loopback, shipped_models


@pytest.fixture(autouse=True)
def clean(monkeypatch):
    """No settings from outside."""
    for name in Settings.model_fields:
        monkeypatch.delenv(f"LIPSERVE_{name.upper()}", raising=False)


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("home", "/data/lip", Path("/data/lip")),
        ("port", "9000", 9000),
        ("host", "::1", "::1"),
        ("log_level", "warning", "warning"),
        ("max_upload_bytes", "1000", 1000),
        ("max_position", "100.5", 100.5),
        ("training_niceness", "0", 0),
        ("uds", "/run/lipserve.sock", Path("/run/lipserve.sock")),
        ("uds_mode", "600", 0o600),
        ("uds_mode", "0o666", 0o666),
    ],
)
def test_environment_variables_are_read(monkeypatch, name, text, value):
    assert getattr(Settings(), name) != value
    monkeypatch.setenv(f"LIPSERVE_{name.upper()}", text)
    assert getattr(Settings(), name) == value


def test_arguments_come_before_the_environment(monkeypatch):
    monkeypatch.setenv("LIPSERVE_PORT", "9000")
    assert Settings(port=9001).port == 9001


def test_defaults_are_safe():
    settings = Settings()
    assert (settings.host, settings.keys, settings.keys_needed) == ("127.0.0.1", "auto", False)
    assert settings.home == CHECKOUT_MODELS


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", "robot.example.org", ""])
def test_other_hosts_need_keys(host):
    assert Settings(host=host).keys_needed is True


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost", "0.0.0.0"])
def test_keys_can_be_asked_for_on_every_host(monkeypatch, host):
    monkeypatch.setenv("LIPSERVE_KEYS", "on")
    assert Settings(host=host).keys_needed is True


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("127.8.9.10", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("::", False),
        ("10.0.0.1", False),
        ("localhost.example.org", False),
        ("127.0.0.1.example.org", False),
        ("", False),
    ],
)
def test_loopback(host, loopback):
    assert is_loopback(host) is loopback


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("port", "70000"),
        ("port", "-1"),
        ("port", "http"),
        ("log_level", "loud"),
        ("max_upload_bytes", "0"),
        ("max_upload_bytes", "many"),
        ("min_samples", "9"),
        ("max_position", "0"),
        ("training_niceness", "20"),
        ("training_workers", "0"),
        ("max_job_attempts", "0"),
        ("keys", "off"),
        ("keys_refresh_s", "0"),
        ("uds_mode", "rw-rw----"),
        ("uds_mode", "680"),
        ("uds_mode", "1777"),
    ],
)
def test_wrong_values_are_named(monkeypatch, name, text):
    monkeypatch.setenv(f"LIPSERVE_{name.upper()}", text)
    with pytest.raises(ValidationError) as caught:
        Settings()
    assert [item["loc"] for item in caught.value.errors()] == [(name,)]


def test_settings_do_not_change():
    with pytest.raises(ValidationError, match="frozen"):
        Settings().port = 1


def test_every_setting_is_described():
    plain = {name for name, field in Settings.model_fields.items() if not field.description}
    assert plain <= {"log_level"}


def test_the_shipped_model_is_found():
    assert (shipped_models() / "panda-sim" / "manifest.json").is_file()
