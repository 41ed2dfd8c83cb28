"""Aliases as the API shows them."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from service.models.schema import AliasName, VersionNumber


class AliasRequest(BaseModel):
    """Where an alias shall point: to a version, or to where another alias points now."""

    model_config = ConfigDict(
        extra="forbid", strict=True, json_schema_extra={"examples": [{"version": 2}, {"alias": "candidate"}]}
    )

    version: VersionNumber | None = Field(None, description="A version of the model")
    alias: AliasName | None = Field(None, description="Another alias of the model, instead of a number")


class AliasMove(BaseModel):
    """One move of an alias."""

    version: int | None = Field(description="Where to; null where the alias was removed")
    before: int | None = Field(description="Where from; null where the alias was new")
    at: str
    rollback: bool = Field(description="Whether it took back an earlier move")


class Alias(BaseModel):
    """A name of a version, which can be moved to another one."""

    alias: str
    version: int
    changed_at: str
    previous: int | None = Field(description="Where a rollback would lead; null where there is nothing to go back to")
    history: list[AliasMove] = Field(description="The last moves, newest first")


class AliasList(BaseModel):
    """Every alias of a model, `serving` first; all are on one page."""

    items: list[Alias]
    next_cursor: None = None
