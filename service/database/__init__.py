"""The database: tables, sessions, and migrations of what earlier releases stored."""

from service.database.engine import BUSY_TIMEOUT_MS, Database
from service.database.tables import (
    AlarmRow,
    AliasMoveRow,
    AliasRow,
    ApiKeyRow,
    Base,
    DatasetRow,
    EventRow,
    JobRow,
    LearnerRow,
    LearningRow,
    ModelRow,
    RobotRow,
    ServingRow,
    SnapshotRow,
    StreamRow,
    VersionRow,
    now,
)

__all__ = [
    "BUSY_TIMEOUT_MS",
    "AlarmRow",
    "AliasMoveRow",
    "AliasRow",
    "ApiKeyRow",
    "Base",
    "Database",
    "DatasetRow",
    "EventRow",
    "JobRow",
    "LearnerRow",
    "LearningRow",
    "ModelRow",
    "RobotRow",
    "ServingRow",
    "SnapshotRow",
    "StreamRow",
    "VersionRow",
    "now",
]
