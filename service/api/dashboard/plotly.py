"""Plotly's JavaScript, as it is sent: compressed, and at an address that changes when it does, so that browsers ask for
it once. What the pages need of it comes with the wheel (hatch_build.py), or all of it from the Python package."""

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
"""Bundles by what they draw: plots with two axes, and scenes in 3-D."""
PREFIX = "/dashboard/plotly"


class Script:
    """A file of JavaScript. Its text is read, and compressed, when it is first asked for."""

    def __init__(self, path: Path) -> None:
        self.path, self._lock = path, threading.Lock()

    @cached_property
    def digest(self) -> str:
        """What its address goes by: of its content."""
        return hashlib.sha256(self.path.read_bytes()).hexdigest()[:16]

    @property
    def packed(self) -> bytes:
        """The file, compressed by gzip: once, whoever asks at the same time."""
        with self._lock:
            return self._packed

    @cached_property
    def _packed(self) -> bytes:
        return gzip.compress(self.path.read_bytes(), mtime=0)


def scripts(bundles: Path = BUNDLES) -> dict[str, Script]:
    """The script of each bundle: of the folder, or else of the Python package; none where there is neither."""
    bundled = {name: next(iter(sorted(bundles.glob(f"plotly-{name}-*.min.js"))), None) for name in NAMES}
    if None not in bundled.values():
        return {name: Script(path) for name, path in bundled.items() if path is not None}
    spec = find_spec("plotly")  # not imported, which takes a second
    if spec is None or spec.origin is None:
        return {}
    return dict.fromkeys(NAMES, Script(Path(spec.origin).with_name("package_data") / "plotly.min.js"))


def install(app: FastAPI, headers: dict[str, str], found: dict[str, Script] | None = None) -> None:
    """Add the scripts to an application: `cartesian.js` and `gl3d.js` lead to where they are now.

    headers: of all answers but for caching; found: the scripts, those that are installed where None.
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
