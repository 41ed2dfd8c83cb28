"""Serves Plotly's JavaScript compressed, at an address with its hash, so that browsers can cache it forever.

The wheel contains bundles of the parts that the pages need (hatch_build.py); else the Python package's file is used.
"""

from __future__ import annotations

import gzip
import hashlib
import threading
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path

from fastapi import FastAPI, Request
from starlette.exceptions import HTTPException
from starlette.responses import RedirectResponse, Response

BUNDLES = Path(__file__).with_name("bundles")
NAMES = ("cartesian", "gl3d")
"""Names of the bundles: plots with two axes, and 3-D scenes."""
PREFIX = "/dashboard/plotly"


class Script:
    """A JavaScript file, read and compressed on first use."""

    def __init__(self, path: Path) -> None:
        self.path, self._lock = path, threading.Lock()

    @cached_property
    def digest(self) -> str:
        """Hash of the content, for its address."""
        return hashlib.sha256(self.path.read_bytes()).hexdigest()[:16]

    @property
    def packed(self) -> bytes:
        """The gzip-compressed file. Concurrent requests compress it only once."""
        with self._lock:
            return self._packed

    @cached_property
    def _packed(self) -> bytes:
        return gzip.compress(self.path.read_bytes(), mtime=0)


def scripts(bundles: Path = BUNDLES) -> dict[str, Script]:
    """Return the script of each bundle, from the folder or else the Python package; empty if there is neither."""
    bundled = {name: next(iter(sorted(bundles.glob(f"plotly-{name}-*.min.js"))), None) for name in NAMES}
    if None not in bundled.values():
        return {name: Script(path) for name, path in bundled.items() if path is not None}
    spec = find_spec("plotly")  # importing it takes a second
    if spec is None or spec.origin is None:
        return {}
    return dict.fromkeys(NAMES, Script(Path(spec.origin).with_name("package_data") / "plotly.min.js"))


def install(app: FastAPI, headers: dict[str, str], found: dict[str, Script] | None = None) -> None:
    """Add the scripts to an application. `cartesian.js` and `gl3d.js` redirect to the current addresses.

    `headers` are sent with every answer, besides those for caching; `found` defaults to the installed scripts.
    """
    known = scripts() if found is None else found

    def current(name: str) -> Response:
        return RedirectResponse(f"{PREFIX}/{_script(known, name).digest}.js", 307, headers)

    def file(digest: str, request: Request) -> Response:
        script = next((each for each in known.values() if each.digest == digest), None)
        if script is None:
            raise HTTPException(404)
        sent = headers | {"cache-control": "public, max-age=31536000, immutable", "vary": "accept-encoding"}
        if "gzip" in request.headers.get("accept-encoding", ""):
            return Response(script.packed, headers=sent | {"content-encoding": "gzip"}, media_type="text/javascript")
        return Response(script.path.read_bytes(), headers=sent, media_type="text/javascript")

    for name in NAMES:
        app.add_api_route(f"{PREFIX}/{name}.js", lambda name=name: current(name), include_in_schema=False)
    app.add_api_route(f"{PREFIX}/{{digest}}.js", file, include_in_schema=False)


def _script(known: dict[str, Script], name: str) -> Script:
    if name not in known:
        raise HTTPException(404)
    return known[name]
