"""Serves the dashboard: one page at `/`, its files below `/dashboard`, and Plotly's JavaScript."""

from __future__ import annotations

from pathlib import Path

from fastapi import FastAPI
from starlette.datastructures import MutableHeaders
from starlette.responses import FileResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.dashboard import plotly

STATIC = Path(__file__).with_name("static")
FILES = "/dashboard"
POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Nothing comes from other hosts and no script stands in a page; Plotly writes styles of its own."""
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-cache",  # asked for again and answered 304: after an update nobody sees old pages
}


def install(app: FastAPI) -> None:
    """Add the dashboard to an application. It needs no key: its pages ask for one where the API does."""
    app.add_api_route("/", page, include_in_schema=False)
    plotly.install(app, HEADERS)
    app.mount(FILES, StaticPages(STATIC))


async def page() -> Response:
    """The one page, which shows all others."""
    return FileResponse(STATIC / "index.html", headers=HEADERS)


class StaticPages:
    """Files of one folder with the headers of the dashboard."""

    def __init__(self, folder: Path) -> None:
        self._files: ASGIApp = StaticFiles(directory=folder)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a file, 304 where the browser has it; raise HTTPException where there is none."""

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        await self._files(scope, receive, with_headers)
