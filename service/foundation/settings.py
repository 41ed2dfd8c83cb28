"""All settings of the service: environment variables with the prefix `LIPSERVE_`.

A setting is a value that an operator has a reason to change. All other limits are constants beside their code.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self, get_args

from pydantic import BeforeValidator, Field, SecretStr, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

CHECKOUT_MODELS = Path(__file__).resolve().parents[2] / "models"
CONNECTIONS = 20
"""Max connections of one process to PostgreSQL by default."""

PREFIX = "LIPSERVE_"
MiB = 1024 * 1024
OCTAL = "octal"


@dataclass(frozen=True)
class Unit:
    """The unit of a setting, for people."""

    name: str


Count = Annotated[int, Field(ge=1)]
Bytes = Annotated[int, Field(ge=1), Unit("bytes")]
Seconds = Annotated[float, Field(gt=0), Unit("s")]
Delay = Annotated[float, Field(ge=0), Unit("s")]
Rate = Annotated[float, Field(gt=0), Unit("1/s")]
Niceness = Annotated[int, Field(ge=0, le=19)]


def _octal(mode: object) -> object:
    if not isinstance(mode, str):
        return mode
    try:
        return int(mode, 8)
    except ValueError:
        raise ValueError("expected an octal number such as 660") from None


FileMode = Annotated[int, BeforeValidator(_octal), Unit(OCTAL)]


def shipped_models() -> Path:
    """Return the folder of the models that come with LIPServe, in a checkout or in an installed package."""
    packaged = Path(__file__).resolve().parents[1] / "shipped"
    return CHECKOUT_MODELS if (CHECKOUT_MODELS / "panda-sim").is_dir() else packaged


def _default_home() -> Path:
    return CHECKOUT_MODELS if CHECKOUT_MODELS.is_dir() else Path.home() / ".local/share/lipserve"


class Settings(BaseSettings):
    """Validated settings; a wrong value stops the start with its name and the expected value."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, extra="forbid", frozen=True, hide_input_in_errors=True)

    home: Path = Field(
        default_factory=_default_home,
        description="Folder of the database and all files. By default `models` of a checkout, else "
        "~/.local/share/lipserve.",
    )
    host: str = Field("127.0.0.1", description="Address to listen on. Any address but loopback requires API keys.")
    port: int = Field(8000, ge=0, le=65535, description="Port to listen on. 0 picks a free one.")
    uds: Path | None = Field(None, description="Path of a Unix-domain socket for clients on the same host.")
    uds_mode: FileMode = Field(0o660, ge=0, le=0o777, description="File mode of the socket: who may connect.")
    grpc_port: int | None = Field(
        None, ge=0, le=65535, description="Port to listen on for gRPC. 0 picks a free one. Needs `lipserve[grpc]`."
    )
    database_url: str | None = Field(
        None,
        pattern="^postgresql://",
        repr=False,
        description="PostgreSQL server that several services share: postgresql://user:password@host/name. If not set, "
        "SQLite in the home. Needs LIPSERVE_FILES_URL.",
    )
    database_connections: Count = Field(CONNECTIONS, description="Max connections of one process to PostgreSQL.")
    files_url: str | None = Field(
        None,
        pattern="^(s3|file)://",
        description="Store of the files that several services share: s3://bucket/prefix (with the usual AWS_ "
        "variables), or file:///folder that all hosts mount. If not set, the home. Needs LIPSERVE_DATABASE_URL.",
    )
    files_cache_bytes: Bytes = Field(4096 * MiB, description="Size of the cache of shared files in the home.")
    cluster: str | None = Field(
        None,
        pattern="^(tcp|tls)://",
        description="Scheduler of the Dask cluster that runs jobs: tcp://host:8786. If not set, jobs run on this host. "
        "Needs LIPSERVE_DATABASE_URL.",
    )
    replica_lost_s: Seconds = Field(
        10.0, description="Time without a heartbeat after which other services take over the jobs of a service."
    )

    keys: Literal["auto", "on"] = Field(
        "auto",
        description="Whether requests need API keys. `auto`: they do unless the service listens on loopback only. "
        "`on`: they always do. Set `on` behind a reverse proxy.",
    )
    trusted_proxies: str = Field(
        "127.0.0.1",
        description="Addresses or networks of reverse proxies, separated by commas. Their X-Forwarded-For names the "
        "client.",
    )
    promotion: Literal["ask", "always"] = Field(
        "ask",
        description="When a trained version starts serving. `ask`: at once if it does well on held-out data, else it "
        "becomes a candidate (alias `candidate`). `always`: at once. A job may choose otherwise.",
    )

    log_level: Literal["critical", "error", "warning", "info", "debug"] = Field(
        "info", description="Lowest level that is logged."
    )
    log_format: Literal["console", "json"] = Field(
        "console", description="Format of the log: `console` for people, `json` with one object a line."
    )
    log_slow_s: Seconds = Field(
        0.25, description="Min duration of a query of a control loop for which it is logged as slow."
    )
    data_plane: bool = Field(
        True,
        description="Answer control loops in a process of their own, which other requests cannot delay. Linux only.",
    )
    opentelemetry: bool = Field(
        False,
        description="Send a trace of each request to OTEL_EXPORTER_OTLP_ENDPOINT. Needs `lipserve[opentelemetry]`.",
    )

    alarm_webhook: str | None = Field(
        None,
        pattern="^https?://",
        repr=False,
        description="URL to which each alarm raised or cleared is posted as JSON, with retries for a day. The service "
        "connects to any address given here. Needs LIPSERVE_ALARM_WEBHOOK_SECRET.",
    )
    alarm_webhook_secret: SecretStr | None = Field(
        None,
        min_length=16,
        description="Secret of at least 16 characters. Each request to LIPSERVE_ALARM_WEBHOOK is signed with it. The "
        "client's `read_alarm_event` checks the signature.",
    )

    max_upload_bytes: Bytes = Field(256 * MiB, description="Max size of an uploaded recording.")
    max_unpacked_bytes: Bytes = Field(1024 * MiB, description="Max size of a recording after unpacking.")
    parser_memory_bytes: Bytes = Field(
        1024 * MiB, description="Max memory for the data of one upload while it is read. Not limited on macOS."
    )
    parser_s: Seconds = Field(
        600.0, description="Max time for reading one upload. Half as much processor time is allowed."
    )
    max_samples: Count = Field(1_000_000, description="Max samples of a data set.")
    max_joints: Count = Field(32, description="Max joints of a robot.")
    max_position: Annotated[float, Unit("rad or m")] = Field(
        12.6,
        ge=0.1,
        le=1e4,
        description="Max |q|: two turns. Larger values are rejected, as they are probably degrees.",
    )
    max_velocity: Annotated[float, Unit("rad/s or m/s")] = Field(
        50.0,
        ge=0.01,
        le=1e4,
        description="Max |dq| of rows that are learnt.",
    )
    max_acceleration: Annotated[float, Unit("rad/s² or m/s²")] = Field(
        2000.0,
        ge=0.1,
        le=1e6,
        description="Max |ddq| of rows that are learnt.",
    )
    max_request_bytes: Bytes = Field(2 * MiB, description="Max size of the body of a prediction or an observation.")

    max_streams: Count = Field(32, description="Max WebSocket connections. More are answered 429.")
    stream_deadline_s: Seconds = Field(
        0.002, description="Time after which a stream's answer counts as late, unless its frame has a deadline."
    )
    stream_idle_s: Seconds = Field(3600.0, description="Time without a frame after which a stream is closed.")
    stream_flush_rows: Count = Field(100, description="Max frames of a stream that are logged together.")
    stream_flush_s: Seconds = Field(0.1, description="Max time that a frame waits to be logged with others.")
    min_revision_wait_s: Delay = Field(
        2.0, description="Max time that a query waits for the revision it requires. Then it is answered 503."
    )
    max_connections: Count = Field(
        512,
        description="Max connections, streams included. Beyond it, idle connections are closed; if none is idle, new "
        "ones are refused. /health is still answered.",
    )
    max_connections_per_client: Count = Field(
        128,
        description="Max connections of one IPv4 address or IPv6 network. Trusted proxies and local sockets have no "
        "limit of their own.",
    )
    max_requests_per_s: Rate | None = Field(
        None,
        description="Max request rate of an API key that has no own rate; of an address if there are no keys. If not "
        "set, there is no limit.",
    )
    max_request_burst: Count = Field(1000, description="Max requests that a client with a limited rate sends at once.")
    keep_alive_s: Annotated[int, Unit("s")] = Field(
        5,
        ge=1,
        description="Time without a request after which a connection is closed. A proxy in front must wait less.",
    )
    stop_notice_s: Delay = Field(
        0.0,
        description="Time for which a stopping service still answers. It already reports that it is not ready.",
    )

    max_home_bytes: Bytes | None = Field(None, description="Quota of the home. If not set, not limited.")
    min_free_bytes: Annotated[int, Field(ge=0), Unit("bytes")] = Field(
        64 * MiB, description="Space that stays free on the disk of the home."
    )
    audit_retention_s: Seconds = Field(
        365 * 86400.0,
        description="Age up to which the audit log, alarms, ended jobs and moves of aliases are kept. The jobs of "
        "existing versions and the last 20 moves of an alias stay.",
    )
    observation_retention_bytes: Bytes = Field(
        1024 * MiB, description="Size up to which the observations of a model are kept."
    )
    observation_retention_s: Seconds = Field(
        30 * 86400.0,
        description="Age up to which observations are kept. A stream without a payload that is silent for as long is "
        "deleted.",
    )
    max_snapshots: int = Field(20, ge=2, description="Max snapshots of a version. More let a rollback reach further.")
    publish_every_s: Seconds = Field(
        0.5, description="Min time between two revisions of a version. A snapshot is stored every 60 times as long."
    )

    max_loaded_models: Count = Field(
        4, description="Max versions in memory, in the service and in the learner process each."
    )
    max_concurrent_predictions: Count = Field(2, description="Max predictions that are computed at the same time.")
    learner_niceness: Niceness = Field(
        0,
        description="Niceness of the learner process. With 10, rows reached the answers 16 s late on a busy machine.",
    )
    training_workers: Count = Field(1, description="Training processes.")
    statistics_workers: Count = Field(
        1, description="Processes in which a training job computes statistics, if there is no cluster."
    )
    training_threads: Count = Field(1, description="Threads of each training process.")
    training_niceness: Niceness = Field(10, description="Niceness of training processes.")
    training_policy: Literal["other", "idle"] = Field(
        "other",
        description="Scheduling policy of training processes on Linux. `idle` helps if serving and training share one "
        "CPU, but training waits while anything else computes.",
    )
    training_cpus: Count | None = Field(
        None, description="CPUs for training processes on Linux. If not set, all but one."
    )
    max_job_s: Seconds = Field(86400.0, description="Max duration of one attempt at a job. Then the job fails.")

    @model_validator(mode="after")
    def _shared_together(self) -> Self:
        if (self.database_url is None) != (self.files_url is None):
            raise ValueError("database_url and files_url must be set together, for services that share them")
        if self.cluster is not None and self.database_url is None:
            raise ValueError("cluster needs database_url and files_url, which its workers share")
        return self

    @model_validator(mode="after")
    def _webhook_signed(self) -> Self:
        if self.alarm_webhook is not None and self.alarm_webhook_secret is None:
            raise ValueError("alarm_webhook needs alarm_webhook_secret, with which its requests are signed")
        return self

    @model_validator(mode="after")
    def _ports_apart(self) -> Self:
        if self.grpc_port and self.grpc_port == self.port:
            raise ValueError(f"grpc_port is {self.grpc_port}, expected a port other than that of HTTP")
        return self

    @property
    def keys_needed(self) -> bool:
        """Return whether requests need API keys."""
        return self.keys == "on" or not is_loopback(self.host)


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach `host`."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Setting(NamedTuple):
    """A setting for people. Value and default are written as in the environment, without secrets; empty if not set."""

    variable: str
    value: str
    default: str
    unit: str
    meaning: str


def describe(settings: Settings) -> list[Setting]:
    """Return all settings in the order of their declaration."""
    found = []
    for name, field in Settings.model_fields.items():
        marks = [*field.metadata, *(mark for part in get_args(field.annotation) for mark in get_args(part)[1:])]
        unit = next((each.name for each in marks if isinstance(each, Unit)), "")
        default = None if field.default_factory is not None else field.default
        texts = (_text(getattr(settings, name), unit), _text(default, unit))
        found.append(Setting(f"{PREFIX}{name.upper()}", *texts, unit, field.description or ""))
    return found


def _text(value: Any, unit: str) -> str:
    """Return a value as the environment has it, without the password of a URL."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if unit == OCTAL:
        return f"{value:o}"
    text = f"{value:.15g}" if isinstance(value, float) else str(value)
    return re.sub(r"(password=)[^&]*", r"\1***", re.sub(r"(://[^:/@]*:).*@", r"\1***@", text))
