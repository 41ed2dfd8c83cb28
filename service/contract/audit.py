"""Lines of the audit log, as the API shows them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field

Change = Literal[
    "version added",
    "version deleted",
    "model deleted",
    "alias moved",
    "learning set",
    "observations unlearnt",
    "observations replayed",
    "learning rolled back",
    "learning held",
    "change decided",
    "candidate dismissed",
    "payload declared",
    "stream deleted",
]


class AuditEntry(BaseModel):
    """One change of a model."""

    id: int
    at: str
    key: str | None = Field(description="API key of who did it; null where keys are not needed, and of the service")
    key_name: str | None = Field(description="Its name")
    what: str = Field(
        description="Method and route of the request, `job` and its id, or `service` for what that does by itself",
        examples=["PUT /v1/models/{model}/aliases/{alias}"],
    )
    request_id: str | None = Field(description="Of that request, as in the log; of a job the one that queued it")
    model: str
    change: Change
    version: int | None = Field(description="The version that it is about, null where it is about the model")
    alias: str | None = Field(description="The alias that was moved; `serving` is what answers by default")
    before: Any = Field(description="What was: a version, a revision, options; null where nothing was")
    after: Any = Field(description="What is from then on; null where nothing is")


class AuditPage(BaseModel):
    """One page of the audit log."""

    items: list[AuditEntry]
    next_cursor: str | None = Field(description="Names the page after this one; null on the last")
