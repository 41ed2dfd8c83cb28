"""The documentation's Markdown as HTML: which pages there are, and how one is rendered."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fastapi import FastAPI
from starlette.responses import FileResponse, HTMLResponse, Response

from service.api.dashboard.routes import HEADERS

if TYPE_CHECKING:
    from markdown_it import MarkdownIt
    from markdown_it.token import Token

HERE = Path(__file__).resolve().parent
CHECKOUT = HERE.parents[2] / "docs"
INDEX = "README.md"
ORDER = (
    "first-model.md",
    "concepts.md",
    "own-robot.md",
    "control-loop.md",
    "safety.md",
    "numbers.md",
    "method.md",
    "architecture.md",
    "operations.md",
    "monitoring.md",
    "reverse-proxy.md",
    "scaling.md",
    "kubernetes.md",
    "sizing.md",
    "errors.md",
    "reference/api.md",
    "reference/cli.md",
    "reference/metrics.md",
    "reference/stream-protocol.md",
    "reference/archives.md",
    "reproduction/results.md",
    "reproduction/real.md",
)
"""Pages beside the index, as the guide lists them. What is not listed here is not a page."""
SLUGS = {"reproduction/results.md": "reproduction"}
"""Addresses of pages that are not called as their file is."""
KINDS = {".png": "image/png", ".svg": "image/svg+xml", ".webp": "image/webp"}
"""What pictures are, by their endings: not every machine's own list knows all. One that moves is a .webp and has a
picture of the same name that does not."""
_COMMENT = re.compile(r"^<!--.*?-->\n?", re.MULTILINE)
_SCROLLED = '<div class="scroll" role="region" aria-label="Table, may be scrolled" tabindex="0"><table>\n'
_ELSEWHERE = re.compile(r"[a-z][a-z0-9+.-]*:|//|#", re.IGNORECASE)


@dataclass(frozen=True)
class Page:
    """One page. slug: last part of its address, empty of the index; file: below the folder; title: its heading."""

    slug: str
    file: str
    title: str

    @property
    def address(self) -> str:
        """Path of the page's address."""
        return f"/guide/{self.slug}" if self.slug else "/guide"


def folder() -> Path:
    """The documentation's folder, in a checkout or in an installed package."""
    packaged = HERE / "docs"
    return packaged if packaged.is_dir() else CHECKOUT


@lru_cache(1)
def pages() -> dict[str, Page]:
    """Every page by its slug, in the guide's order, the index first."""
    pages = {}
    for file in (INDEX, *ORDER):
        if (path := folder() / file).is_file():
            slug = "" if file == INDEX else SLUGS.get(file, path.stem)
            pages[slug] = Page(slug, file, _title(path))
    return pages


@lru_cache(1)
def images() -> dict[str, Path]:
    """Every picture by the name that the guide gives it: its path with dashes, which no other file can be named by."""
    paths = sorted(path for kind in KINDS for path in folder().rglob(f"*{kind}"))
    return {_flat(path.relative_to(folder()).as_posix()): path for path in paths}


@lru_cache(64)
def content(slug: str) -> str:
    """A page's content as HTML; raise KeyError where there is no such page."""
    file = pages()[slug].file
    text = (folder() / file).read_text("utf-8")
    return str(_markdown().render(_COMMENT.sub("", text), {"file": file}))


def anchor(heading: str) -> str:
    """What a heading is linked by, the same as on GitHub."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def target(href: str, file: str) -> str | None:
    """Where a link on the page of a file leads in the guide, None where it leads to what the guide does not have."""
    if _ELSEWHERE.match(href):
        return href
    path, _, fragment = href.partition("#")
    leads_to = posixpath.normpath(posixpath.join(posixpath.dirname(file), path))
    for page in pages().values():
        if page.file == leads_to:
            return page.address + (f"#{fragment}" if fragment else "")
    name = _flat(leads_to)
    return f"/guide/files/{name}" if name in images() else None


def _flat(path: str) -> str:
    return path.replace("/", "--")


def _title(path: Path) -> str:
    first = next((line for line in path.read_text("utf-8").splitlines() if line.startswith("# ")), f"# {path.stem}")
    return first.removeprefix("# ").strip().replace("`", "")


@lru_cache(1)
def _markdown() -> MarkdownIt:
    from markdown_it import MarkdownIt  # noqa: PLC0415 - a service whose guide nobody reads does without

    made = MarkdownIt("commonmark", {"html": False}).enable("table")
    made.core.ruler.push("guide", _adapt)
    made.add_render_rule("table_open", lambda *_: _SCROLLED)
    made.add_render_rule("table_close", lambda *_: "</table></div>\n")
    made.add_render_rule("image", lambda self, *arguments: _stoppable(self.image(*arguments)))
    made.add_render_rule("fence", lambda self, *arguments: _reached(self.fence(*arguments)))
    made.add_render_rule("code_block", lambda self, *arguments: _reached(self.code_block(*arguments)))
    return made


def _reached(block: str) -> str:
    """A block of code that keys reach, as it may have to be scrolled."""
    return block.replace("<pre>", '<pre tabindex="0">', 1)


def _stoppable(picture: str) -> str:
    """A picture that moves in a frame that hides it, and at rest where motion is not wanted (WCAG 2.2, 2.2.2)."""
    moving = re.search(r'src="([^"]+)\.webp"', picture)
    if moving is None:
        return picture
    still = f'<source srcset="{moving[1]}.png" media="(prefers-reduced-motion: reduce)">'
    return f"<details open><summary>Moving picture</summary><picture>{still}{picture}</picture></details>"


def _adapt(state: Any) -> None:
    """Give headings their anchors, and links and pictures their addresses in the guide."""
    tokens: Sequence[Token] = state.tokens
    for index, token in enumerate(tokens):
        if token.type == "heading_open":
            token.attrSet("id", anchor(_text(tokens[index + 1])))
        if token.type == "inline" and token.content.startswith("![") and token.content.endswith(".webp)"):
            tokens[index - 1].hidden = tokens[index + 1].hidden = True  # no paragraph may hold its frame
        for child in token.children or ():
            _redirect(child, state.env["file"])


def _redirect(token: Token, file: str) -> None:
    name = {"link_open": "href", "image": "src"}.get(token.type)
    if name is None:
        return
    leads = target(str(token.attrs[name]), file)
    if leads is None:
        del token.attrs[name]  # an anchor without an address is shown as its text
    else:
        token.attrSet(name, leads)
        if token.type == "image":
            token.attrSet("loading", "lazy")


def _text(inline: Token) -> str:
    return "".join(child.content for child in inline.children or ())


ADDRESS, FILES = "/guide", "/guide/files"
STYLE, PAGE = HERE / "guide.css", HERE / "page.html"


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
    known = pages().get(page)
    if known is None:
        missing = (
            '<h1>There is no such page</h1>\n<p>The guide has those on its list, <a href="/guide">from here on</a>.</p>'
        )
        return _framed("Not found", missing, None, 404)
    return _framed(known.title, content(page), page)


def file(name: str) -> Response:
    """A picture or the style sheet, by its name in the guide; nothing else can be named."""
    path = STYLE if name == STYLE.name else images().get(name)
    if path is None:
        return Response(status_code=404, headers=HEADERS)
    return FileResponse(path, headers=HEADERS, media_type=KINDS.get(path.suffix, "text/css"))


def _framed(title: str, content: str, current: str | None, status: int = 200) -> HTMLResponse:
    lines = []
    for slug, each in pages().items():
        here = ' aria-current="page"' if slug == current else ""
        lines.append(f'          <li><a href="{each.address}"{here}>{escape(each.title)}</a></li>')
    text = PAGE.read_text("utf-8").format(title=escape(title), contents="\n".join(lines), content=content)
    return HTMLResponse(text, status, HEADERS)
