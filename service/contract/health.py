"""What the routes of health answer."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from lipcore.extras import EXTRAS


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


class Missing(BaseModel):
    """What the service cannot do for want of an extra."""

    extra: str = Field(examples=["ingest"])
    gives: str = Field(description="What it is for, in words", examples=["use URDFs"])
    install: str = Field(
        description="What installs it, where the service runs", examples=["pip install 'lipserve[ingest]'"]
    )


class Health(BaseModel):
    """The process answers, and what it can do."""

    status: Literal["alive"] = "alive"
    version: str
    can: dict[str, bool] = Field(
        description="What is installed besides serving, teaching and training of learnt arms, by the name of its "
        "extra: " + "; ".join(f"`{name}`, to {extra.gives}" for name, extra in EXTRAS.items()),
        examples=[{"train": True, "robots": True, "ingest": False}],
    )
    missing: list[Missing] = Field(description="Of what is not installed")
    confined: dict[str, bool] = Field(
        {},
        description="What this system has to keep the process in which an upload is read from harm: limits of `memory` "
        "and `processor`; `landlock`, from files; `seccomp`, from the network and other processes",
        examples=[{"memory": True, "processor": True, "landlock": True, "seccomp": True}],
    )
