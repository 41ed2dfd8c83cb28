"""Audit log. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Any, Literal

from lipserve.records import Record


class AuditEntry(Record, frozen=True, kw_only=True):
    """One change of a model.

    key: Id of the API key; null without keys and for changes by the service
    key_name: Name of the API key
    what: Origin of the change: method and route of the request, `job` and its id, or `service`
    request_id: Id of the request, as in the service's log; for a job, of the request that queued it
    version: Changed version; null if the change concerns the whole model
    alias: Alias that was moved; `serving` is the default version
    before: Value before the change: a version, a revision or options; null if there was none
    after: Value after the change; null if there is none
    """

    id: int
    at: str
    key: str | None
    key_name: str | None
    what: str
    request_id: str | None
    model: str
    change: Literal[
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
    version: int | None
    alias: str | None
    before: Any
    after: Any
