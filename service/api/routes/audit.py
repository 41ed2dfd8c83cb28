"""Route of the audit log."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import AwareDatetime

from service.api.access.scopes import ADMIN, needs
from service.api.dependencies import PageQuery, StorageDep
from service.api.errors import responses
from service.api.route import Route
from service.contract.audit import AuditEntry, AuditPage, Change
from service.foundation.errors import InvalidRequestError
from service.storage import audit
from service.storage.database import AuditRow

router = APIRouter(prefix="/v1", tags=["audit"], responses=responses(InvalidRequestError), route_class=Route)


@router.get("/audit", summary="List changes of models, newest first")
@needs(ADMIN)
def list_audit(
    storage: StorageDep,
    page: PageQuery,
    model: Annotated[str | None, Query(max_length=64, description="Only changes to this model")] = None,
    key: Annotated[
        str | None, Query(max_length=40, description="Only changes made with the API key of this id")
    ] = None,
    change: Annotated[Change | None, Query(description="Only changes of this kind")] = None,
    since: Annotated[
        AwareDatetime | None, Query(description="Only changes at or after this time: ISO 8601 with a time zone")
    ] = None,
    until: Annotated[
        AwareDatetime | None, Query(description="Only changes before this time: ISO 8601 with a time zone")
    ] = None,
) -> AuditPage:
    """Return one page of the audit log: who changed which model, what changed, and when.

    An entry is stored together with its change and never altered. It is kept for `LIPSERVE_AUDIT_RETENTION_S`.
    Learning from observations is not listed here: see `GET /v1/models/{model}/observations`.
    """
    rows, following = audit.page(storage.database, page, model, key, change, since, until)
    return AuditPage(items=[_show(row) for row in rows], next_cursor=following)


def _show(row: AuditRow) -> AuditEntry:
    names = [name for name in AuditEntry.model_fields if name != "id"]
    return AuditEntry(id=row.seq, **{name: getattr(row, name) for name in names})
