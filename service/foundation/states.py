"""States of a job."""

from __future__ import annotations

from typing import Final, Literal

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]

QUEUED: Final = "queued"
RUNNING: Final = "running"
SUCCEEDED: Final = "succeeded"
FAILED: Final = "failed"
CANCELLED: Final = "cancelled"
ACTIVE = (QUEUED, RUNNING)

PartState = Literal["ok", "warning", "failed"]
"""Of a part of the service."""
