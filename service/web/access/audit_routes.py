"""`GET /v1/audit`: who changed what of which model."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query
from pydantic import AwareDatetime, BaseModel, Field

from service.foundation.errors import InvalidRequestError
from service.storage import audit
from service.storage.audit import Change
from service.storage.database import AuditRow
from service.web.dependencies import PageQuery, StorageDep
from service.web.errors import responses
from service.web.route import Route

router = APIRouter(prefix="/v1", tags=["audit"], responses=responses(InvalidRequestError), route_class=Route)


class AuditEntry(BaseModel):
    """One change of a model."""

    id: int
    at: str
    key: str | None = Field(description="API key of who did it; null where keys are not needed, and of the service")
    key_name: str | None = Field(description="Its name")
    what: str = Field(
        description="Method and route of the request, `job` and its id, or `service` for what that does by itself",
        examples=["PUT /v1/models/{model}/aliases/{alias}"],
    )
    request_id: str | None = Field(description="Of that request, as in the log; of a job the one that queued it")
    model: str
    change: Change
    version: int | None = Field(description="The version that it is about, null where it is about the model")
    alias: str | None = Field(description="The alias that was moved; `serving` is what answers by default")
    before: Any = Field(description="What was: a version, a revision, options; null where nothing was")
    after: Any = Field(description="What is from then on; null where nothing is")


class AuditPage(BaseModel):
    """One page of the audit log."""

    items: list[AuditEntry]
    next_cursor: str | None = Field(description="Names the page after this one; null on the last")


@router.get("/audit", summary="List what changed models, newest first")
def list_audit(
    storage: StorageDep,
    page: PageQuery,
    model: Annotated[str | None, Query(max_length=64, description="Only changes of this model")] = None,
    key: Annotated[str | None, Query(max_length=40, description="Only by the API key of this id")] = None,
    change: Annotated[Change | None, Query(description="Only changes of this kind")] = None,
    since: Annotated[AwareDatetime | None, Query(description="Only from this moment on, ISO 8601 with a zone")] = None,
    until: Annotated[AwareDatetime | None, Query(description="Only before this moment")] = None,
) -> AuditPage:
    """Who changed what of which model, when and by what. A line is written with the change and never altered; it is
    kept for `LIPSERVE_AUDIT_RETENTION_S`. What is learnt from observations is in their own log."""
    rows, following = audit.page(storage.database, page, model, key, change, since, until)
    return AuditPage(items=[_show(row) for row in rows], next_cursor=following)


def _show(row: AuditRow) -> AuditEntry:
    names = [name for name in AuditEntry.model_fields if name != "id"]
    return AuditEntry(id=row.seq, **{name: getattr(row, name) for name in names})
