"""What changed models. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Any, Literal

from lipserve.records import Record


class AuditEntry(Record, frozen=True, kw_only=True):
    """One change of a model.

    key: API key of who did it; null where keys are not needed, and of the service
    key_name: Its name
    what: Method and route of the request, `job` and its id, or `service` for what that does by itself
    request_id: Of that request, as in the log; of a job the one that queued it
    version: The version that it is about, null where it is about the model
    alias: The alias that was moved; `serving` is what answers by default
    before: What was: a version, a revision, options; null where nothing was
    after: What is from then on; null where nothing is
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
    version: int | None
    alias: str | None
    before: Any
    after: Any
