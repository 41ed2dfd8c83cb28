"""Health as the API tells it."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field


class Live(BaseModel):
    """The process answers."""

    status: Literal["alive"] = "alive"


class Part(BaseModel):
    """One part of the service."""

    name: str = Field(examples=["database"])
    state: Literal["ok", "warning"] = Field(description="warning: some clients may notice something")
    message: str = Field(examples=["can be read and written"])


class Ready(BaseModel):
    """The service can do what it is for."""

    status: Literal["ready"] = "ready"
    version: str
    checks: list[Part]
