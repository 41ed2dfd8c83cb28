"""Serves the guide below `/guide`.

MkDocs builds the site from the documentation at installation (hatch_build.py) and with `make docs`.
"""

from __future__ import annotations

import mimetypes
from pathlib import Path

from fastapi import FastAPI
from starlette.responses import RedirectResponse, Response
from starlette.types import Scope

from service.api.dashboard.routes import HEADERS, StaticPages
from service.api.openapi import policy

SITE = Path(__file__).with_name("site")
ADDRESS = "/guide"
FILES = "files/"
MOVED = {
    **{page: f"reference/{page}" for page in ("api", "archives", "cli", "metrics", "stream-protocol")},
    "real": "reproduction/real",
    "reproduction": "reproduction/results",
}
"""Redirects from former addresses of pages. Pictures were below `FILES`, with `--` in place of each slash."""
mimetypes.add_type("image/webp", ".webp")  # missing in Python 3.11 and 3.12


def install(app: FastAPI) -> None:
    """Add the guide to an application. It needs no API key."""
    app.add_api_route(ADDRESS, index, include_in_schema=False)
    app.mount(ADDRESS, Guide(SITE))


async def index() -> Response:
    """Redirect to the address with a slash, as the links of the page are relative."""
    return RedirectResponse(f"{ADDRESS}/")


class Guide(StaticPages):
    """A built site. The scripts in its pages are allowed by hash, and redirects contain no host."""

    def __init__(self, site: Path) -> None:
        pages = b"".join(page.read_bytes() for page in site.rglob("*.html"))
        super().__init__(site, HEADERS | {"content-security-policy": policy(pages)}, html=True)

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return a file, the page of a folder, a redirect, or the 404 page."""
        if path in MOVED:
            return RedirectResponse(f"{ADDRESS}/{MOVED[path]}/")
        if path.startswith(FILES):
            return RedirectResponse(f"{ADDRESS}/{path.removeprefix(FILES).replace('--', '/')}")
        response = await super().get_response(path, scope)
        if isinstance(response, RedirectResponse):  # Starlette's contains the client's Host header
            return RedirectResponse(f"{ADDRESS}/{path}/")
        return response
