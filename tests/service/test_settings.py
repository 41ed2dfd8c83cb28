"""Settings: environment variables, checked, with what is wrong named."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from service.foundation.settings import CHECKOUT_MODELS, Settings, is_loopback


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
        ("uds", "/run/lipserve.sock", Path("/run/lipserve.sock")),
        ("uds_mode", "600", 0o600),
    ],
)
def test_environment_variables_are_read(monkeypatch, name, text, value):
    assert getattr(Settings(), name) != value
    monkeypatch.setenv(f"LIPSERVE_{name.upper()}", text)
    assert getattr(Settings(), name) == value


def test_each_protocol_has_a_port_of_its_own():
    assert (Settings().grpc_port, Settings(port=0, grpc_port=0).grpc_port) == (None, 0)
    with pytest.raises(ValidationError, match="grpc_port is 8000, expected another port than that of HTTP"):
        Settings(grpc_port=8000)


def test_defaults_are_safe():
    settings = Settings()
    assert (settings.host, settings.keys, settings.keys_needed) == ("127.0.0.1", "auto", False)
    assert settings.home == CHECKOUT_MODELS


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost", "0.0.0.0"])
def test_keys_can_be_asked_for_on_every_host(monkeypatch, host):
    monkeypatch.setenv("LIPSERVE_KEYS", "on")
    assert Settings(host=host).keys_needed is True


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("localhost.example.org", False),
        ("127.0.0.1.example.org", False),
        ("", False),
    ],
)
def test_hosts_beyond_loopback_need_keys(host, loopback):
    assert is_loopback(host) is loopback
    assert Settings(host=host).keys_needed is not loopback


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("port", "70000"),
        ("log_level", "loud"),
        ("min_samples", "9"),
        ("training_niceness", "20"),
        ("keys", "off"),
        ("uds_mode", "rw-rw----"),
        ("uds_mode", "1777"),
        ("max_velocity", "1e308"),
        ("max_acceleration", "5e-324"),
        ("max_position", "0"),
        ("max_time_gap_s", "inf"),
        ("stationary_speed", "2"),
        ("contact_patience_s", "nan"),
        ("linearisation_error", "1e9"),
    ],
)
def test_wrong_values_are_named(monkeypatch, name, text):
    monkeypatch.setenv(f"LIPSERVE_{name.upper()}", text)
    with pytest.raises(ValidationError) as caught:
        Settings()
    assert [item["loc"] for item in caught.value.errors()] == [(name,)]


def test_every_setting_is_described():
    plain = {name for name, field in Settings.model_fields.items() if not field.description}
    assert plain <= {"log_level"}
