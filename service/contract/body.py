"""The base of request bodies."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class RequestBody(BaseModel):
    """A request body, or a part of one: unknown fields and values of another type are rejected."""

    model_config = ConfigDict(extra="forbid", strict=True, arbitrary_types_allowed=True)
