"""The guide shows every page of the documentation, its links lead on, and nothing else of the disk is served."""

import re
from collections.abc import Iterator

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.api.guide import routes
from tests.docs.blocks import ROOT


@pytest.fixture(scope="module")
def guide() -> Iterator[TestClient]:
    """The guide alone: it needs nothing of a service."""
    app = FastAPI()
    routes.install(app)
    with TestClient(app) as client:
        yield client


def test_every_page_of_the_documentation_is_in_the_guide():
    there = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert there == {page.file for page in routes.pages().values()}
    assert len(routes.pages()) == len(there)


@pytest.mark.parametrize("page", routes.pages().values(), ids=lambda page: page.file)
def test_a_page_has_a_title_and_links_that_lead_on(guide, page):
    answer = guide.get(page.address)
    assert answer.status_code == 200
    assert answer.text.count("<h1") == 1
    assert f'href="{page.address}" aria-current="page"' in answer.text
    assert "default-src 'self'" in answer.headers["content-security-policy"]
    for link in set(re.findall(r'(?:href|src)="(/guide[^"]*)"', answer.text)):
        path, _, fragment = link.partition("#")
        found = guide.get(path)
        assert found.status_code == 200, f"{page.file}: {link}"
        assert not fragment or f'id="{fragment}"' in found.text, f"{page.file}: {link}"
    for link in re.findall(r'(?:href|src)="([^"]*)"', answer.text):
        assert re.match(r"/|#|https?://", link), f"{page.file}: {link}"


def test_a_page_that_there_is_not_is_said_so_and_marks_of_the_tests_are_not_shown(guide):
    assert "not run" not in guide.get("/guide/operations").text
    answer = guide.get("/guide/nothing")
    assert answer.status_code == 404
    assert "There is no such page" in answer.text
    assert 'href="/guide"' in answer.text


@pytest.mark.parametrize(
    "name", ["pages.py", "../pages.py", "..%2fpages.py", "%2e%2e%2fpages.py", "demo.png%00", "/etc/passwd", ""]
)
def test_pictures_and_the_style_sheet_are_served_and_no_other_file(guide, name):
    assert guide.get("/guide/files/demo.png").headers["content-type"] == "image/png"
    assert guide.get("/guide/files/screenshots--live.webp").headers["content-type"] == "image/webp"
    assert guide.get("/guide/files/guide.css").headers["content-type"].startswith("text/css")
    assert guide.get(f"/guide/files/{name}").status_code == 404


def test_a_picture_that_moves_can_be_hidden_and_stands_still_for_who_wants_that(guide):
    shown = guide.get("/guide").text
    frame = re.search(r"<details open><summary>.*?</summary><picture>(.*?)</picture></details>", shown)
    assert frame is not None
    assert '<source srcset="/guide/files/screenshots--live.png" media="(prefers-reduced-motion: reduce)">' in frame[1]
    assert 'src="/guide/files/screenshots--live.webp"' in frame[1]
    assert "<p><details" not in shown
    assert "<details" not in guide.get("/guide/own-robot").text  # its pictures do not move


def test_html_in_markdown_is_text(monkeypatch, tmp_path):
    attack = "# T\n\n<script>alert(1)</script> [x](javascript:alert(1)) ![y](data:text/html,x)\n"
    (tmp_path / "README.md").write_text(attack)
    monkeypatch.setattr(routes, "folder", lambda: tmp_path)
    for name in ("pages", "images", "content"):  # without what they remember of the real pages
        monkeypatch.setattr(routes, name, getattr(routes, name).__wrapped__)
    html = routes.content("")
    assert [part for part in ("<script", 'href="javascript', 'src="data:text/html') if part in html] == []


@pytest.mark.parametrize("href", ["../service/settings.py", "../../etc/passwd"])
def test_links_to_what_is_no_page_lead_nowhere(href):
    assert routes.target(href, "numbers.md") is None
