"""Every setting of the service: environment variables with the prefix `LIPSERVE_`."""

from __future__ import annotations

from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

CHECKOUT_MODELS = Path(__file__).resolve().parents[2] / "models"
PACKAGED_MODELS = Path(__file__).resolve().parents[1] / "shipped"
CONNECTIONS = 20
"""Most connections to PostgreSQL of one process, unless set."""

MiB = 1024 * 1024
Count = Annotated[int, Field(ge=1)]


def _octal(mode: object) -> object:
    if not isinstance(mode, str):
        return mode
    try:
        return int(mode, 8)
    except ValueError:
        raise ValueError("expected an octal number such as 660") from None


FileMode = Annotated[int, BeforeValidator(_octal)]


def shipped_models() -> Path:
    """Folder of the models that come with LIPServe, in a checkout or in an installed package."""
    return CHECKOUT_MODELS if (CHECKOUT_MODELS / "panda-sim").is_dir() else PACKAGED_MODELS


def _default_home() -> Path:
    return CHECKOUT_MODELS if CHECKOUT_MODELS.is_dir() else Path.home() / ".local/share/lipserve"


class Settings(BaseSettings):
    """Validated settings; a wrong value stops the start with its name and what was expected."""

    model_config = SettingsConfigDict(env_prefix="LIPSERVE_", extra="ignore", frozen=True, hide_input_in_errors=True)

    home: Path = Field(default_factory=_default_home, description="Folder of the database and all files.")
    host: str = Field("127.0.0.1", description="Address to listen on; anything but loopback asks for API keys.")
    port: int = Field(8000, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    uds: Path | None = Field(None, description="Unix-domain socket to listen on too, for clients on the same host.")
    uds_mode: FileMode = Field(
        0o660, ge=0, le=0o777, description="File mode of that socket, octal: whoever may write to it may ask."
    )
    grpc_port: int | None = Field(
        None,
        ge=0,
        le=65535,
        description="Port of the same address to listen on for gRPC, too; 0 takes a free one. Needs `lipserve[grpc]`.",
    )
    log_level: str = Field("info", pattern="^(critical|error|warning|info|debug)$")
    log_format: Literal["console", "json"] = Field(
        "console", description="Form of the log's lines: for people, or JSON, one object a line."
    )
    log_slow_s: float = Field(
        0.25, gt=0, description="Seconds from which on a query or batch of a control loop is logged."
    )
    log_refusals_per_s: Count = Field(
        10, description="Most lines a second about refused requests of one route and code; the others are counted."
    )
    stream_deadline_s: float = Field(
        0.002, gt=0, description="Seconds after which a stream's answer is late, where its frame names none."
    )
    max_metric_models: Count = Field(
        200, description="Most models that metrics of requests and streams tell apart; the others are taken together."
    )
    opentelemetry: bool = Field(
        False, description="Send a trace of every request to where OTEL_EXPORTER_OTLP_ENDPOINT says."
    )

    max_upload_bytes: Count = Field(256 * MiB, description="Largest upload of a data set.")
    max_unpacked_bytes: Count = Field(1024 * MiB, description="Largest data set once unpacked.")
    parser_memory_bytes: Count = Field(
        1024 * MiB,
        description="Memory that reading one upload may take, beside its programs; not limited on macOS.",
    )
    parser_cpu_s: Count = Field(300, description="Processor time in s that reading one upload may take.")
    parser_s: float = Field(600.0, gt=0, description="Longest that reading one upload may take, s.")
    max_bag_part_bytes: Count = Field(64 * MiB, description="Largest chunk or message of a bag, once unpacked.")
    max_columns: Count = Field(2000, description="Most columns of a recording's file, lists taken apart.")
    max_zip_members: Count = Field(20_000, description="Most files in an archive of recordings.")
    max_json_bytes: Count = Field(32 * MiB, description="Largest JSON document; one object a line may be longer.")
    max_json_line_bytes: Count = Field(1 * MiB, description="Longest line of JSON, one object a line.")
    max_urdf_bytes: Count = Field(2 * MiB, description="Largest upload of a URDF.")
    max_archive_bytes: Count = Field(128 * MiB, description="Largest archive of a version that is imported.")
    max_archive_torques: Count = Field(
        10_000,
        description="Most torques, samples times joints, that an imported version may stand on: reading it takes "
        "memory that grows with the square, 10000 of them 0.8 GB.",
    )
    max_request_bytes: Count = Field(2 * MiB, description="Largest body with motions: of predictions and observations.")
    max_joints: Count = Field(32, description="Most joints of a robot.")
    min_samples: int = Field(30, ge=10, description="Fewest samples of a data set.")
    max_samples: Count = Field(1_000_000, description="Most samples of a data set.")
    max_report_rows: Count = Field(
        2000, description="Most rows of a data set that figures on several joints together are taken over."
    )
    max_position: float = Field(
        12.6,
        ge=0.1,
        le=1e4,
        description="Largest |q| in rad or m that is taken for SI units: two turns. Beyond it: degrees?",
    )
    max_batch: Count = Field(1000, description="Most queries in one prediction request.")
    max_component_batch: Count = Field(100, description="Most queries in one prediction request with components.")
    max_streams: Count = Field(32, description="Most WebSocket connections at a time; more are answered 429.")
    max_stream_frame_bytes: int = Field(64 * 1024, ge=1024, description="Largest frame that a stream reads.")
    stream_idle_s: float = Field(3600.0, gt=0, description="Seconds without a frame after which a stream is closed.")
    stream_write_s: float = Field(10.0, gt=0, description="Longest wait in s for a client to read an answer.")
    max_evaluation_samples: Count = Field(5000, description="Most samples of one evaluation; more are thinned evenly.")
    max_trace_points: Count = Field(2000, description="Most rows of one trace of a model along a data set.")
    max_page: Count = Field(100, description="Most items of one page of a list.")
    max_job_datasets: Count = Field(100, description="Most data sets of one training job.")
    max_hyperparameter_samples: Count = Field(500, description="Most samples that hyperparameters are fitted on.")
    max_posterior_samples: Count = Field(1000, description="Most samples a posterior is conditioned on.")
    max_inducing_outputs: Count = Field(4000, description="Most inducing outputs that a training job may ask for.")
    max_queued_jobs: Count = Field(100, description="Most jobs that may wait; more are answered 429.")
    max_loaded_models: Count = Field(4, description="Model versions kept in memory.")

    max_connections: Count = Field(
        512,
        description="Most connections at a time, streams included. Beyond it those that ask nothing are closed, and "
        "where all ask something, new ones are refused; /health is still answered.",
    )
    max_connections_per_client: Count = Field(
        128,
        description="The same of one address, or network of IPv6; trusted proxies and local sockets have as many as "
        "there may be.",
    )
    max_requests: Count = Field(
        256,
        description="Most requests that are answered at a time, and four times as many as may wait for the bodies of "
        "one client; more are answered 429.",
    )
    max_requests_per_s: float | None = Field(
        None,
        gt=0,
        description="Most requests per s of one key that has no rate of its own, or address without keys; not "
        "limited by default.",
    )
    max_request_burst: Count = Field(1000, description="Requests that a client may send at once where that is limited.")
    header_s: float = Field(10.0, gt=0, description="Longest time in s that a request's line and headers may take.")
    max_header_bytes: int = Field(64 * 1024, ge=4096, description="Largest line and headers of a request.")
    body_s: float = Field(20.0, gt=0, description="Longest wait in s for a body, beside what its size allows.")
    body_bytes_per_s: Count = Field(1000, description="Slowest body: for so many bytes it may take one second more.")
    answer_s: float = Field(30.0, gt=0, description="Longest wait in s for a client to read any of its answer.")
    keep_alive_s: Count = Field(5, description="Seconds after which a connection without a request is closed.")
    max_home_bytes: Count | None = Field(None, description="Quota of the home; not limited by default.")
    min_free_bytes: int = Field(64 * MiB, ge=0, description="Space that stays free on the disk of the home.")
    stop_notice_s: float = Field(
        0.0, ge=0, description="Seconds for which a service told to stop still answers, but says that it is not ready."
    )
    drain_s: Count = Field(5, description="Longest wait in s for answers in progress when the service stops.")

    max_aliases: Count = Field(100, description="Most aliases of one model, `serving` aside.")
    max_alias_moves: Count = Field(20, description="Last moves of an alias that an answer lists.")

    audit_retention_s: float = Field(
        365 * 86400.0, gt=0, description="Age up to which the audit log of what changed models is kept, s."
    )

    max_observation_rows: Count = Field(5000, description="Most samples of one observation batch.")
    max_observation_streams: Count = Field(
        1000, description="Most sources of observations of a model; a new one takes the place of the longest silent."
    )
    stream_retention_s: float = Field(
        30 * 86400.0, gt=0, description="Silence in s after which a stream without a payload is deleted."
    )
    stream_flush_rows: Count = Field(100, description="Frames of a stream that are logged together, at most.")
    stream_flush_s: float = Field(0.1, gt=0, description="Longest wait in s of a frame to learn from for others.")
    max_velocity: float = Field(50.0, ge=0.01, le=1e4, description="Largest |dq| in rad/s or m/s that is learnt from.")
    max_acceleration: float = Field(
        2000.0, ge=0.1, le=1e6, description="Largest |ddq| in rad/s² or m/s² that is learnt from."
    )
    max_time_gap_s: float = Field(
        1.0, ge=1e-3, le=3600, description="Step of time within a batch that is taken for a jump, s."
    )
    stationary_speed: float = Field(
        1e-3, ge=0, le=1, description="Speed of all joints, rad/s or m/s, below which a sample tells of stiction only."
    )
    contact_patience_s: float = Field(
        2.0,
        ge=0.1,
        le=600,
        description="How long torques may be far off before it is no contact but a change of the robot.",
    )
    observation_retention_bytes: Count = Field(1024 * MiB, description="Size of a model's log of observations.")
    observation_retention_s: float = Field(30 * 86400.0, gt=0, description="Age up to which they are kept, s.")
    snapshot_every_s: float = Field(30.0, gt=0, description="Seconds between two snapshots of a version's state.")
    max_snapshots: int = Field(20, ge=2, description="Snapshots kept of a version: how far a rollback reaches.")
    publish_every_s: float = Field(0.5, gt=0, description="Shortest time between two revisions of a version, s.")
    max_learning_models: Count = Field(4, description="Versions whose statistics the learner process keeps in memory.")
    learner_niceness: int = Field(
        0,
        ge=0,
        le=19,
        description="Niceness of the learner process. With 10, answers on a busy machine contained rows 16 s late.",
    )
    learner_heartbeat_s: float = Field(
        45.0,
        ge=1,
        description="Time in s in which a learner process neither ends a step nor computes, after which it is "
        "replaced.",
    )
    learner_step_s: float = Field(
        900.0, ge=1, description="Longest that one step of the learner process may take, s; then it is replaced."
    )
    learner_lag_s: float = Field(
        30.0, gt=0, description="Time in s for which observations may wait to be learnt before readiness warns of it."
    )
    quality_windows_s: tuple[float, ...] = Field(
        (60.0, 600.0, 3600.0), min_length=1, description="Windows of the prequential quality, s."
    )
    novelty_share: float = Field(
        0.2, gt=0, le=1, description="Share of samples beyond the basis at which a version is refreshed."
    )
    novelty_rows: Count = Field(2000, description="Samples that share is taken over.")
    linearisation_error: float = Field(
        0.5,
        ge=0.01,
        le=10,
        description="Error of a learnt arm's linearisation at which it is refreshed; 1: as large as stated.",
    )
    refresh_pause_s: float = Field(600.0, ge=0, description="Shortest time between two automatic refreshes, s.")
    max_refreshed_versions: Count = Field(
        10, description="Versions of a model kept of those that automatic refreshes made and nothing needs."
    )
    max_refresh_samples: Count = Field(200_000, description="Most logged samples that a refresh learns from.")
    promotion: Literal["ask", "always"] = Field(
        "ask",
        description="Whether a version that was trained answers by itself: `ask`, if it does well on what was held "
        "out, else it waits under the alias `candidate`; `always`, in any case. A job may say otherwise.",
    )
    promotion_rows: Count = Field(2000, description="Samples on which a refreshed version must be better.")
    promotion_patience_s: float = Field(3600.0, gt=0, description="Time after which one that is not is dismissed, s.")

    database_url: str | None = Field(
        None,
        pattern="^postgresql://",
        repr=False,
        description="PostgreSQL server that several services share, postgresql://user:password@host/name; SQLite below "
        "the home where not set. Needs LIPSERVE_FILES_URL.",
    )
    database_connections: Count = Field(CONNECTIONS, description="Most connections to PostgreSQL of one process.")
    files_url: str | None = Field(
        None,
        pattern="^(s3|file)://",
        description="Where data sets, versions and snapshots lie that several services share: s3://bucket/prefix (with "
        "the usual AWS_ variables), or file:///folder for one that all hosts mount; the home where not set. Needs "
        "LIPSERVE_DATABASE_URL.",
    )
    files_cache_bytes: Count = Field(4096 * MiB, description="Size of the copies of shared files kept below the home.")
    cluster: str | None = Field(
        None,
        pattern="^(tcp|tls)://",
        description="Scheduler of the Dask cluster that jobs run on, tcp://host:8786; processes of this host where not "
        "set. Needs LIPSERVE_DATABASE_URL.",
    )
    replica_beat_s: float = Field(1.0, gt=0, description="Seconds between two signs of life of a service to others.")
    replica_lost_s: float = Field(
        10.0, gt=0, description="Seconds without one after which others take over the jobs of a service."
    )
    min_revision_wait_s: float = Field(
        2.0, ge=0, description="Longest wait in s of a query for the revision that it asks for at least; then a 503."
    )
    statistics_workers: Count = Field(
        1, description="Processes that a training job sums up statistics in, where there is no cluster."
    )

    database_timeout_s: float = Field(
        10.0, gt=0, description="Longest wait in s of a request for another writer of the database; then it gets a 503."
    )

    training_workers: Count = Field(1, description="Training processes.")
    training_threads: Count = Field(1, description="Threads of each training process.")
    training_niceness: int = Field(10, ge=0, le=19, description="Niceness of training processes.")
    training_policy: Literal["other", "idle"] = Field(
        "other",
        description="Scheduling policy of training processes, on Linux. `idle` helps where serving and training share "
        "one CPU, but stands still while anything else on the machine computes.",
    )
    training_cpus: Count | None = Field(
        None, description="CPUs that training processes may use, on Linux: all but one where not set."
    )
    max_job_attempts: Count = Field(3, description="Times a job is started before an interruption fails it.")
    job_cancel_grace_s: float = Field(
        1.0, gt=0, le=1.5, description="Time in s that a training process has to obey a cancel; then it is killed."
    )
    job_heartbeat_s: float = Field(
        60.0,
        ge=5,
        description="Time in s without a sign of life after which a training process is killed; it gives none once it "
        "has not got on for as long.",
    )
    job_start_s: float = Field(
        120.0, gt=0, description="Time in s that a training process may take to start; then it is killed."
    )
    max_job_s: float = Field(86400.0, gt=0, description="Longest that one attempt at a job may run, s; then it fails.")
    max_live_followers: Count = Field(20, description="Most readers that follow models live; more are answered 429.")
    live_rows_per_s: Count = Field(
        50, description="Rows a second that those who follow a model are shown; all are counted."
    )
    max_job_followers: Count = Field(100, description="Most streams of jobs' events at a time; more are answered 429.")
    serving_threads: Count = Field(1, description="Threads of one prediction.")
    max_concurrent_predictions: Count = Field(2, description="Predictions computed at the same time.")

    keys: Literal["auto", "on"] = Field(
        "auto",
        description="Whether requests need API keys: `auto`, unless the service listens on loopback only, or `on`, "
        "always, as it should be behind a reverse proxy.",
    )
    keys_refresh_s: float = Field(
        1.0, gt=0, le=3600, description="Seconds after which a running service knows of keys that are made or revoked."
    )
    trusted_proxies: str = Field(
        "127.0.0.1",
        description="Reverse proxies whose X-Forwarded-For names the client: addresses or networks, with commas.",
    )

    @model_validator(mode="after")
    def _shared_together(self) -> Self:
        if (self.database_url is None) != (self.files_url is None):
            raise ValueError("database_url and files_url: expected both, for services that share them, or none of them")
        if self.cluster is not None and self.database_url is None:
            raise ValueError("cluster: expected database_url and files_url too, which its workers share")
        return self

    @model_validator(mode="after")
    def _ports_apart(self) -> Self:
        if self.grpc_port and self.grpc_port == self.port:
            raise ValueError(f"grpc_port is {self.grpc_port}, expected another port than that of HTTP")
        return self

    @property
    def keys_needed(self) -> bool:
        """Whether requests need API keys."""
        return self.keys == "on" or not is_loopback(self.host)


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach `host`."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
