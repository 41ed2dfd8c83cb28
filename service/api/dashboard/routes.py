"""Serves the dashboard: one page at `/`, its files below `/dashboard`, and Plotly's JavaScript."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from fastapi import FastAPI
from starlette.responses import FileResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from service.api.dashboard import plotly

STATIC = Path(__file__).with_name("static")
HEADERS = {
    # nothing is loaded from other hosts, and pages have no inline scripts; Plotly needs inline styles
    "content-security-policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-cache",  # revalidated with every use, so that no old pages are shown after an update
}


def install(app: FastAPI) -> None:
    """Add the dashboard to an application. Its files need no API key; its pages ask for one if the API needs it."""
    app.add_api_route("/", page, include_in_schema=False)
    plotly.install(app, HEADERS)
    app.mount("/dashboard/libraries", StaticPages(plotly.BUNDLES, HEADERS))
    app.mount("/dashboard", StaticPages(STATIC, HEADERS))


async def page() -> Response:
    """Return the single page of the dashboard."""
    return FileResponse(STATIC / "index.html", headers=HEADERS)


class StaticPages(StaticFiles):
    """Static files of one folder, all with the same headers."""

    def __init__(self, folder: Path, headers: Mapping[str, str], html: bool = False) -> None:
        super().__init__(directory=folder, html=html, check_dir=False)
        self._headers = headers

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return a file, or 304 if the browser has it; raise HTTPException if it does not exist."""
        response = await super().get_response(path, scope)
        response.headers.update(self._headers)
        return response
