"""Records of the API, such as a job: what the service says of itself, read only. `python clients/python/records.py`
writes the modules here from the service's own schemas."""

from __future__ import annotations

from typing import Any

import msgspec


class Record(msgspec.Struct, frozen=True):
    """What all records can do. Fields that a later release adds are left out."""

    def as_dict(self) -> dict[str, Any]:
        """The record as the API tells it."""
        document: dict[str, Any] = msgspec.to_builtins(self)
        return document
