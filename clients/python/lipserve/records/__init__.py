"""Read-only records of the API. `python clients/python/records.py` writes these modules from the service's schemas."""

from __future__ import annotations

from typing import Any

import msgspec


class Record(msgspec.Struct, frozen=True):
    """Base of records. Fields that a later release adds are ignored."""

    def as_dict(self) -> dict[str, Any]:
        """Return the record as in the API."""
        document: dict[str, Any] = msgspec.to_builtins(self)
        return document
