"""Entries of the audit log."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field

Change = Literal[
    "version added",
    "version deleted",
    "version annotated",
    "version exported",
    "model deleted",
    "alias moved",
    "learning set",
    "thresholds set",
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
    key: str | None = Field(description="Id of the API key; null without keys and for changes by the service")
    key_name: str | None = Field(description="Name of the API key")
    what: str = Field(
        description="Origin of the change: method and route of the request, `job` and its id, or `service`",
        examples=["PUT /v1/models/{model}/aliases/{alias}"],
    )
    request_id: str | None = Field(
        description="Id of the request, as in the service's log; for a job, of the request that queued it"
    )
    model: str
    change: Change
    version: int | None = Field(description="Changed version; null if the change concerns the whole model")
    alias: str | None = Field(description="Alias that was moved; `serving` is the default version")
    before: Any = Field(description="Value before the change: a version, a revision or options; null if there was none")
    after: Any = Field(description="Value after the change; null if there is none")


class AuditPage(BaseModel):
    """One page of the audit log."""

    items: list[AuditEntry]
    next_cursor: str | None = Field(description="Cursor of the next page; null on the last page")
