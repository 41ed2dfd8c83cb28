"""Uploads that are refused: the answer, and that nothing of them stays."""

from __future__ import annotations

from typing import Any

from tests.service.data import error, post, service_of


def nothing_stays(api: Any) -> None:
    """Check that no data set is listed and no file of one lies in the home."""
    files = service_of(api).files
    assert api.get("/v1/datasets").json() == {"items": [], "next_cursor": None}
    assert list(files.uploads.iterdir()) == []
    assert list(files.datasets.iterdir()) == []


def refused(api: Any, body: Any, media_type: str, status: int = 422, code: str = "invalid_data") -> dict[str, Any]:
    """Upload what has to be refused, check that nothing of it stays; return the error."""
    said = error(post(api, body, media_type), status, code)
    nothing_stays(api)
    return said
