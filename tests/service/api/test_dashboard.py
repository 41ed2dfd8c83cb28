"""Files of the dashboard as served; tests/system/browser tests their behaviour."""

import hashlib
import re
from pathlib import Path

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.api.dashboard import plotly
from service.api.dashboard.routes import STATIC
from service.contract.media_types import SUFFIXES
from tests.service.data import error

FILES = sorted(path.relative_to(STATIC).as_posix() for path in STATIC.rglob("*") if path.is_file())
SCRIPTS = {file: (STATIC / file).read_text() for file in FILES if file.endswith(".js")}
LIBRARIES = "/dashboard/libraries/"
KINDS = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml", ".html": "text/html"}


@pytest.mark.parametrize("file", FILES)
def test_every_file_is_served_with_its_type_and_an_etag(api, file):
    answer = api.get(f"/dashboard/{file}")
    assert answer.status_code == 200
    assert answer.content == (STATIC / file).read_bytes()
    assert answer.headers["content-type"].partition(";")[0] == KINDS[(STATIC / file).suffix]
    again = api.get(f"/dashboard/{file}", headers={"if-none-match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_files_are_read_only(api):
    answer = api.post("/dashboard/style.css")
    assert (answer.status_code, answer.headers["allow"]) == (405, "GET, HEAD")


def test_no_file_refers_to_another_host():
    for file in FILES:
        result = set(re.findall(r"(?:https?:)?//[a-z0-9.-]+\.[a-z]{2,}", (STATIC / file).read_text()))
        assert result <= {"http://www.w3.org"}, file


def test_files_of_all_formats_can_be_chosen():
    assert f'const EXTENSIONS = "{",".join(SUFFIXES)}";' in SCRIPTS["pages/data/upload.js"]


def test_imported_names_are_exported_and_used():
    """A browser would report this only when it opens the page."""
    taken = re.compile(r"""import\s*\{([^}]*)\}\s*from\s*["']([^"']+)["']""")
    given = re.compile(r"export\s+(?:async\s+)?(?:function\*?|const|let|class)\s+(\w+)")
    listed = re.compile(r"export\s*\{([^}]*)\}")
    for file, text in SCRIPTS.items():
        for names, other in taken.findall(text):
            if other.startswith(LIBRARIES):
                continue
            there = ((STATIC / file).parent / other).read_text()
            exported = {*given.findall(there), *re.findall(r"\w+", " ".join(listed.findall(there)))}
            for each in filter(None, (name.strip() for name in names.split(","))):
                name, _, alias = each.partition(" as ")
                assert name in exported, (file, other, name)
                assert len(re.findall(rf"\b{alias or name}\b", text)) > 1, (file, name, "is not used")


def test_libraries_are_those_of_the_build():
    """The build downloads them, and browsers ask for them by version."""
    built = (Path(__file__).parents[3] / "hatch_build.py").read_text()
    used = {name for text in SCRIPTS.values() for name in re.findall(rf'"{LIBRARIES}([^"]+)"', text)}
    assert used
    assert [name for name in used if f'"{name}"' not in built] == []


def test_no_module_parses_html():
    parsing = re.compile(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function")
    assert [file for file, text in SCRIPTS.items() if parsing.search(text)] == []


@pytest.mark.parametrize("path", ["", "pages", "..%2froutes.py", "plotly/0123.js", "plotly/../../__init__.py"])
def test_other_paths_are_not_served(api, path):
    error(api.get(f"/dashboard/{path}"), 404, "not_found")


@pytest.mark.parametrize("name", plotly.NAMES)
def test_plotly_is_compressed_and_cached(api, name):
    named = api.get(f"/dashboard/plotly/{name}.js", follow_redirects=False)
    assert (named.status_code, named.headers["cache-control"]) == (307, "no-cache")
    address = named.headers["location"]
    packed = api.get(address, headers={"accept-encoding": "gzip, br"})
    assert packed.headers["content-encoding"] == "gzip"
    assert int(packed.headers["content-length"]) < 0.4 * len(packed.content)
    assert "immutable" in packed.headers["cache-control"]
    assert packed.headers["vary"] == "accept-encoding"
    plain = api.get(address, headers={"accept-encoding": "identity"})
    assert "content-encoding" not in plain.headers
    assert plain.content == packed.content
    assert hashlib.sha256(plain.content).hexdigest().startswith(address.rpartition("/")[2].removesuffix(".js"))
    assert plain.content[:100].startswith(b"/**\n* plotly.js")


def test_plotly_bundles_precede_the_package_and_have_content_addresses(tmp_path):
    for name in plotly.NAMES:
        (tmp_path / f"plotly-{name}-1.0.0.min.js").write_text(f"// {name}")
    found = plotly.scripts(tmp_path)
    assert [each.path.name for each in found.values()] == [f"plotly-{name}-1.0.0.min.js" for name in plotly.NAMES]
    assert len({each.digest for each in found.values()}) == len(plotly.NAMES)


def test_missing_plotly_is_answered_404(tmp_path, monkeypatch):
    monkeypatch.setattr(plotly, "find_spec", lambda name: None)
    app = FastAPI()
    plotly.install(app, {}, plotly.scripts(tmp_path))
    assert TestClient(app).get("/dashboard/plotly/cartesian.js").status_code == 404


CARTESIAN, GL3D = {"scatter", "box", "bar", "heatmap", "histogram", "contour"}, {"scatter", "scatter3d", "mesh3d"}
"""Some trace types of each bundle: plotly.js, dist/README.md."""


def test_every_trace_type_is_in_its_bundle():
    plotting = "\n".join(text for file, text in SCRIPTS.items() if "plots.js" in text or file == "plots.js")
    used = set(re.findall(r'\btype: "(\w+)"', plotting))
    spatial = set(re.findall(r'"(\w+)"', re.search(r"SPATIAL = new Set\((.*?)\)", SCRIPTS["plots.js"])[1]))
    axes = {"line", "log", "linear", "date", "category"}
    controls = {"text", "number", "checkbox", "button", "radio", "range", "file", "submit", "password"}
    assert spatial <= GL3D - CARTESIAN
    assert used - spatial - axes - controls <= CARTESIAN
