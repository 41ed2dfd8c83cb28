"""Serves the guide at `/guide`: rendered pages, their pictures, one style sheet beside the dashboard's."""

from __future__ import annotations

from html import escape
from pathlib import Path

from fastapi import FastAPI
from starlette.responses import FileResponse, HTMLResponse, Response

from service.dashboard.routes import HEADERS
from service.guide import pages

ADDRESS, FILES = "/guide", "/guide/files"
STYLE = "guide.css"
_PAGE = """<!doctype html>
<html lang="en">
  <head>
    <meta charset="utf-8">
    <meta name="viewport" content="width=device-width, initial-scale=1">
    <meta name="color-scheme" content="light dark">
    <title>{title} · LIPServe</title>
    <link rel="icon" href="/dashboard/icon.svg" type="image/svg+xml">
    <link rel="stylesheet" href="/dashboard/style.css">
    <link rel="stylesheet" href="/guide/files/guide.css">
    <script src="/dashboard/theme.js"></script>
  </head>
  <body>
    <a class="skip" href="#main">Skip to content</a>
    <header class="bar">
      <a class="brand" href="/"><img src="/dashboard/icon.svg" alt="" width="22" height="22"> LIPServe</a>
      <nav aria-label="Pages">
        <a href="/#/">Overview</a>
        <a href="/#/data">Data</a>
        <a href="/#/jobs">Training</a>
        <a href="/#/models">Models</a>
        <a href="/#/live">Live</a>
      </nav>
      <span class="grow"></span>
      <nav aria-label="Help">
        <a href="/guide" aria-current="page">Guide</a>
        <a href="/docs">API</a>
      </nav>
    </header>
    <div class="guide">
      <nav class="contents" aria-label="Guide">
        <ul>
{contents}
        </ul>
      </nav>
      <main id="main" tabindex="-1">
{content}
      </main>
    </div>
  </body>
</html>
"""


def install(app: FastAPI) -> None:
    """Add the guide to an application. It needs no key: it is the same for everybody."""
    app.add_api_route(ADDRESS, index, include_in_schema=False)
    app.add_api_route(ADDRESS + "/{page}", page, include_in_schema=False)
    app.add_api_route(FILES + "/{name}", file, include_in_schema=False)


def index() -> Response:
    """The page that leads to all others."""
    return page("")


def page(page: str) -> Response:
    """A page, or one that says that there is none of that name."""
    known = pages.pages().get(page)
    if known is None:
        missing = (
            '<h1>There is no such page</h1>\n<p>The guide has those on its list, <a href="/guide">from here on</a>.</p>'
        )
        return _shown("Not found", missing, None, 404)
    return _shown(known.title, pages.content(page), page)


def file(name: str) -> Response:
    """A picture or the style sheet, by its name in the guide; nothing else can be named."""
    path = Path(__file__).with_name(STYLE) if name == STYLE else pages.images().get(name)
    if path is None:
        return Response(status_code=404, headers=HEADERS)
    return FileResponse(path, headers=HEADERS)


def _shown(title: str, content: str, current: str | None, status: int = 200) -> HTMLResponse:
    lines = []
    for slug, each in pages.pages().items():
        here = ' aria-current="page"' if slug == current else ""
        lines.append(f'          <li><a href="{each.address}"{here}>{escape(each.title)}</a></li>')
    text = _PAGE.format(title=escape(title), contents="\n".join(lines), content=content)
    return HTMLResponse(text, status, HEADERS)
