"""The dashboard's files as the service sends them; what they do is tested in a browser (tests/browser)."""

import re

import pytest

from service.dashboard.routes import STATIC

FILES = sorted(path.relative_to(STATIC).as_posix() for path in STATIC.rglob("*") if path.is_file())
KINDS = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml", ".html": "text/html"}


@pytest.mark.parametrize("file", FILES)
def test_every_file_is_served_as_what_it_is_and_once(api, file):
    answer = api.get(f"/dashboard/{file}")
    assert answer.status_code == 200
    assert answer.content == (STATIC / file).read_bytes()
    assert answer.headers["content-type"].partition(";")[0] == KINDS[(STATIC / file).suffix]
    again = api.get(f"/dashboard/{file}", headers={"if-none-match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_no_file_names_another_host():
    for file in FILES:
        result = set(re.findall(r"(?:https?:)?//[a-z0-9.-]+\.[a-z]{2,}", (STATIC / file).read_text()))
        assert result <= {"http://www.w3.org"}, file


def test_what_a_module_imports_is_exported_there_and_used():
    """What a linter would find, and a browser only when it opens the page."""
    taken = re.compile(r"""import\s*\{([^}]*)\}\s*from\s*["']([^"']+)["']""")
    given = re.compile(r"export\s+(?:async\s+)?(?:function\*?|const|let|class)\s+(\w+)")
    for file in FILES:
        if not file.endswith(".js"):
            continue
        text = (STATIC / file).read_text()
        for names, other in taken.findall(text):
            exported = set(given.findall(((STATIC / file).parent / other).read_text()))
            for each in filter(None, (name.strip() for name in names.split(","))):
                name, _, alias = each.partition(" as ")
                assert name in exported, (file, other, name)
                assert len(re.findall(rf"\b{alias or name}\b", text)) > 1, (file, name, "is not used")


def test_nothing_from_the_service_is_parsed_as_html():
    for file in FILES:
        if file.endswith(".js"):
            assert not re.search(
                r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function",
                (STATIC / file).read_text(),
            ), file


@pytest.mark.parametrize("path", ["/", "/dashboard/app.js", "/dashboard/plotly/plotly.min.js"])
def test_pages_may_load_nothing_from_elsewhere_and_are_shown_in_no_frame(api, path):
    headers = api.get(path).headers
    policy = dict(part.strip().split(" ", 1) for part in headers["content-security-policy"].split(";"))
    assert policy["default-src"] == "'self'"
    assert "script-src" not in policy
    assert policy["frame-ancestors"] == "'none'"
    assert headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize(
    "path", ["/dashboard/", "/dashboard/pages", "/dashboard/..%2froutes.py", "/dashboard/plotly/../../__init__.py"]
)
def test_nothing_else_is_served(api, path):
    answer = api.get(path)
    assert answer.status_code == 404
    assert answer.json()["error"]["code"] == "not_found"
