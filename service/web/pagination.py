"""Pages of lists: {items, next_cursor}."""

from __future__ import annotations

from typing import Annotated, TypeVar

from fastapi import Depends, Query, Request
from pydantic import BaseModel
from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from service.foundation.errors import invalid_request
from service.storage.database import AlarmRow, DatasetRow, EventRow, JobRow, ModelRow, RobotRow

USUAL = 50
Row = TypeVar("Row", AlarmRow, DatasetRow, EventRow, JobRow, ModelRow, RobotRow)


class Page(BaseModel):
    """Which part of a list: items after `after`, at most `limit`, newest first where `after` is None."""

    after: int | None
    limit: int


def newest(
    session: Session, table: type[Row], page: Page, *conditions: ColumnElement[bool]
) -> tuple[list[Row], str | None]:
    """Return the rows of a page that meet all conditions, newest first, and the cursor after it, None on the last."""
    query = select(table).where(*conditions).order_by(table.seq.desc()).limit(page.limit + 1)
    if page.after is not None:
        query = query.where(table.seq < page.after)
    rows = list(session.scalars(query))
    following = str(rows[page.limit - 1].seq) if len(rows) > page.limit else None
    return rows[: page.limit], following


def _page(
    request: Request,
    limit: Annotated[int | None, Query(ge=1, description=f"Most items of this page; {USUAL} by default")] = None,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before")] = None,
) -> Page:
    most = request.app.state.storage.settings.max_page
    if limit is None:
        limit = min(USUAL, most)
    if limit > most:
        raise invalid_request("limit", limit, f"at most {most}")
    if cursor is not None and not (cursor.isascii() and cursor.isdigit() and len(cursor) < 18):
        raise invalid_request("cursor", cursor, "the next_cursor of a page")
    return Page(after=None if cursor is None else int(cursor), limit=limit)


PageQuery = Annotated[Page, Depends(_page)]
