"""Pages of lists: {items, next_cursor}."""

from __future__ import annotations

from typing import Annotated, TypeVar

from fastapi import Depends, Query, Request
from pydantic import BaseModel

from service.errors import invalid_request

Item = TypeVar("Item")


class Page(BaseModel):
    """Which part of a list: items after `after`, at most `limit`, newest first where `after` is None."""

    after: int | None
    limit: int


def _page(
    request: Request,
    limit: Annotated[int, Query(ge=1, description="Most items of this page")] = 50,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before")] = None,
) -> Page:
    most = request.app.state.service.settings.max_page
    if limit > most:
        raise invalid_request("limit", limit, f"at most {most}")
    if cursor is not None and not (cursor.isascii() and cursor.isdigit() and len(cursor) < 18):
        raise invalid_request("cursor", cursor, "the next_cursor of a page")
    return Page(after=None if cursor is None else int(cursor), limit=limit)


PageQuery = Annotated[Page, Depends(_page)]
