"""Responses of the health routes."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from lipcore.extras import EXTRAS


class Live(BaseModel):
    """The process is running."""

    status: Literal["alive"] = "alive"


class Part(BaseModel):
    """One part of the service."""

    name: str = Field(examples=["database"])
    state: Literal["ok", "warning"] = Field(description="`warning`: some clients may be affected")
    message: str = Field(examples=["can be read and written"])


class Ready(BaseModel):
    """The service is ready."""

    status: Literal["ready"] = "ready"
    version: str
    checks: list[Part]


class Missing(BaseModel):
    """An extra that is not installed."""

    extra: str = Field(examples=["ingest"])
    gives: str = Field(description="Purpose of the extra", examples=["use URDFs"])
    install: str = Field(
        description="Command that installs it, to be run where the service runs",
        examples=["pip install 'lipserve[ingest]'"],
    )


class Health(BaseModel):
    """The process is running, and its capabilities."""

    status: Literal["alive"] = "alive"
    version: str
    can: dict[str, bool] = Field(
        description="Installed extras by name, besides serving, online learning and training of learnt arms: "
        + "; ".join(f"`{name}`, to {extra.gives}" for name, extra in EXTRAS.items()),
        examples=[{"train": True, "robots": True, "ingest": False}],
    )
    missing: list[Missing] = Field(description="Extras that are not installed")
    confined: dict[str, bool] = Field(
        {},
        description="Available confinement of the process that reads uploads: limits of `memory` and `processor` time; "
        "`landlock` blocks files; `seccomp` blocks the network and other processes",
        examples=[{"memory": True, "processor": True, "landlock": True, "seccomp": True}],
    )
