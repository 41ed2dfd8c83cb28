"""States and choices as the API names them."""

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

PromotionOption = Literal["ask", "always"]
"""When a version answers by itself: if it does well on what was held out, or in any case."""
Outcome = Literal["first_better", "second_better", "no_difference", "cannot_tell"]
"""Of a comparison of two versions."""
