"""States and choices of the API."""

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
"""State of a part of the service."""

PromotionOption = Literal["ask", "always"]
"""When a new version starts to serve: if it passes on the held-out part, or always."""
Outcome = Literal["first_better", "second_better", "no_difference", "cannot_tell"]
"""Outcome of a comparison of two versions."""
