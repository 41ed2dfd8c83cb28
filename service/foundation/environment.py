"""Environment variables of LIPServe: known ones, and those that this release removed."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches

from service.foundation.settings import PREFIX, Settings

OTHER_VARIABLES = frozenset(
    {
        *("URL", "API_KEY"),  # read by clients
        "PUBLISH",  # read by compose.yaml
        *("AXE", "CHROMIUM", "SCREENSHOTS", "HISTORY_S", "HISTORY_SEED", "POWER_CUTS", "POWER_SEED"),  # read by tests
        *("ATTACK_SEED", "YEAR_DAYS", "YEAR_ROBOTS", "YEAR_SEED"),
        *("FAULT_FILE", "FAULT_TARGETS", "TEST_HIDDEN"),
    }
)
"""Known variables that are no settings of the service, without the prefix."""
REMOVED_VARIABLES = {
    "ANSWER_S": "a connection is now closed if the client reads nothing of its answer for 30 s",
    "BODY_BYTES_PER_S": "the slowest body is now fixed at 1000 bytes/s",
    "BODY_S": "the wait for a body is now fixed at 20 s",
    "CONTACT_PATIENCE_S": "a contact now lasts at most 2 s",
    "DATABASE_TIMEOUT_S": "a request now waits up to 10 s for the database",
    "DRAIN_S": "running requests now have 5 s to finish when the service stops",
    "HEADER_S": "the headers of a request must now arrive within 10 s",
    "JOB_CANCEL_GRACE_S": "a training process now has 1 s to stop after a cancellation",
    "JOB_HEARTBEAT_S": "a training process is now killed after 60 s without progress",
    "JOB_START_S": "a training process now has 120 s to start",
    "KEYS_REFRESH_S": "new and revoked keys now take effect within 1 s",
    "LEARNER_HEARTBEAT_S": "the learner process is now replaced after 45 s without progress",
    "LEARNER_LAG_S": "readiness now warns of observations that wait for 30 s",
    "LEARNER_STEP_S": "a step of the learner process now takes at most 900 s",
    "LINEARISATION_ERROR": "a version is now refreshed at a linearisation error of 0.5",
    "LIVE_ROWS_PER_S": "the live view now shows 50 rows a second",
    "LOG_REFUSALS_PER_S": "at most 10 equal rejections are now logged per second",
    "MAX_ALIASES": "the limit is now fixed at 100 aliases",
    "MAX_ALIAS_MOVES": "the last 20 moves of an alias are now listed",
    "MAX_ARCHIVE_BYTES": "the limit is now fixed at 134217728 bytes",
    "MAX_ARCHIVE_TORQUES": "the limit is now fixed at 10000 torques",
    "MAX_BAG_PART_BYTES": "the limit is now fixed at 67108864 bytes",
    "MAX_BATCH": "the limit is now fixed at 1000 queries",
    "MAX_COLUMNS": "the limit is now fixed at 2000 columns",
    "MAX_COMPONENT_BATCH": "the limit is now fixed at 100 queries",
    "MAX_EVALUATION_SAMPLES": "an evaluation now uses at most 5000 samples",
    "MAX_HEADER_BYTES": "the limit is now fixed at 65536 bytes",
    "MAX_HYPERPARAMETER_SAMPLES": "the limit is now fixed at 500 samples",
    "MAX_INDUCING_OUTPUTS": "the limit is now fixed at 4000 inducing outputs",
    "MAX_JOB_ATTEMPTS": "a job is now started at most 3 times",
    "MAX_JOB_DATASETS": "the limit is now fixed at 100 data sets",
    "MAX_JOB_FOLLOWERS": "the limit is now fixed at 100 streams of events",
    "MAX_JSON_BYTES": "the limit is now fixed at 33554432 bytes",
    "MAX_JSON_LINE_BYTES": "the limit is now fixed at 1048576 bytes",
    "MAX_LEARNING_MODELS": "LIPSERVE_MAX_LOADED_MODELS now limits the learner process, too",
    "MAX_LIVE_FOLLOWERS": "the limit is now fixed at 20 readers",
    "MAX_METRIC_MODELS": "metrics now distinguish 200 models",
    "MAX_OBSERVATION_ROWS": "the limit is now fixed at 5000 rows",
    "MAX_OBSERVATION_STREAMS": "the limit is now fixed at 1000 streams",
    "MAX_PAGE": "the limit is now fixed at 100 items",
    "MAX_POSTERIOR_SAMPLES": "the limit is now fixed at 1000 samples",
    "MAX_QUEUED_JOBS": "the limit is now fixed at 100 jobs",
    "MAX_REFRESHED_VERSIONS": "10 refreshed versions of a model are now kept",
    "MAX_REFRESH_SAMPLES": "the limit is now fixed at 200000 samples",
    "MAX_REPORT_ROWS": "a report now uses at most 2000 rows",
    "MAX_REQUESTS": "the limit is now fixed at 256 requests",
    "MAX_STREAM_FRAME_BYTES": "the limit is now fixed at 65536 bytes",
    "MAX_TIME_GAP_S": "the limit is now fixed at 1 s",
    "MAX_TRACE_POINTS": "the limit is now fixed at 2000 rows",
    "MAX_URDF_BYTES": "the limit is now fixed at 2097152 bytes",
    "MAX_ZIP_MEMBERS": "the limit is now fixed at 20000 files",
    "MIN_SAMPLES": "the limit is now fixed at 30 samples",
    "NOVELTY_ROWS": "the share of novel samples is now computed over 2000 samples",
    "NOVELTY_SHARE": "a version is now refreshed at a share of 0.2 novel samples",
    "PARSER_CPU_S": "half of LIPSERVE_PARSER_S is now the limit of processor time",
    "PROMOTION_PATIENCE_S": "a refreshed version is now compared once, before its last fit",
    "PROMOTION_ROWS": "a refreshed version is now compared on the newest third of the logged rows",
    "QUALITY_WINDOWS_S": "the windows are now fixed at 60, 600 and 3600 s",
    "REFRESH_PAUSE_S": "the pause between two refreshes is now fixed at 600 s",
    "REPLICA_BEAT_S": "a service now sends ten heartbeats in LIPSERVE_REPLICA_LOST_S",
    "SERVING_THREADS": "one thread now computes a prediction",
    "SNAPSHOT_EVERY_S": "a snapshot is now stored every 60 times LIPSERVE_PUBLISH_EVERY_S",
    "STATIONARY_SPEED": "the limit is now fixed at 0.001 rad/s",
    "STREAM_RETENTION_S": "LIPSERVE_OBSERVATION_RETENTION_S now applies to streams, too",
    "STREAM_WRITE_S": "a client of a stream now has 10 s to read an answer",
}
"""The replacement of each variable that this release removed, without the prefix. The next release drops this table."""


def check_environment(environment: Mapping[str, str]) -> list[str]:
    """Return a warning for each removed variable; raise ValueError for an unknown one.

    Kubernetes sets variables for each Service of a namespace. Some may have our prefix; they are ignored.
    """
    names = {name.upper() for name in environment if name.upper().startswith(PREFIX)}
    services = [name.removesuffix("SERVICE_HOST") for name in names if name.endswith("_SERVICE_HOST")]
    foreign = tuple(service + part for service in services for part in ("SERVICE_", "PORT"))
    known = [name.upper() for name in Settings.model_fields]
    warnings = []
    for name in sorted(names):
        short = name.removeprefix(PREFIX)
        if short in REMOVED_VARIABLES:
            warnings.append(removal(short))
        elif short not in OTHER_VARIABLES and short not in known and not name.startswith(foreign):
            near = get_close_matches(short, known, 1)
            raise ValueError(f"Unknown setting {name}." + (f" Did you mean {PREFIX}{near[0]}?" if near else ""))
    return warnings


def removal(name: str) -> str:
    """Return what replaces a removed variable, as a sentence. name: without the prefix."""
    return f"{PREFIX}{name} was removed: {REMOVED_VARIABLES[name]}."
