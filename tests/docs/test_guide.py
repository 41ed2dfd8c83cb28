"""The guide builds without warnings, and its pages load nothing from other hosts."""

import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urljoin

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.api.guide import routes
from service.api.openapi import policy
from tests.docs.blocks import ROOT

pytestmark = pytest.mark.slow  # needs MkDocs


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site of the documentation."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def guide(site: Path) -> Iterator[TestClient]:
    """The guide without the rest of the service."""
    app = FastAPI(redirect_slashes=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(routes, "SITE", site)
        routes.install(app)
    with TestClient(app, follow_redirects=False) as client:
        yield client


class LoadedAddresses(HTMLParser):
    """Addresses that a page loads, and its number of headings."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.addresses: set[str] = set()
        self.headings = 0
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect the attributes that make a browser load something."""
        given = dict(attrs)
        self.headings += tag == "h1"
        names = {"link": ["href"], "a": []}.get(tag, ["src", "srcset", "data", "poster"])
        if given.get("rel") not in ("canonical", "prev", "next"):
            self.addresses.update(value for name in names if (value := given.get(name)))


def hashes(policy: str) -> set[str]:
    """Return the hashes of the scripts that a policy allows."""
    return set(re.findall(r"'sha256-(.*?)'", policy))


def test_pages_load_only_own_files_and_allowed_scripts(site, guide):
    pages = list(site.rglob("index.html"))
    assert len(pages) == len([*(ROOT / "docs").rglob("*.md")])
    for page in pages:
        address = f"/guide/{page.parent.relative_to(site).as_posix()}/".replace("/./", "/")
        answer = guide.get(address)
        loaded = LoadedAddresses(answer.text)
        assert loaded.headings == 1, address
        assert len(loaded.addresses) >= 4
        for each in loaded.addresses:
            assert guide.get(urljoin(address, each)).status_code == 200, f"{address}: {each}"
        allowed = answer.headers["content-security-policy"]
        assert len(hashes(policy(answer.content))) == 3
        assert hashes(policy(answer.content)) <= hashes(allowed), address
        assert "script-src 'self' 'sha256-" in allowed
    for sheet in site.rglob("*.css"):
        assert re.findall(r"url\(\"?https?:|@import", sheet.read_text("utf-8")) == []


def test_addresses_of_other_hosts_are_found():
    page = '<script src="https://a/b.js"></script><a href="https://c"></a><link rel="stylesheet" href="//d/e.css">'
    assert LoadedAddresses(page).addresses == {"https://a/b.js", "//d/e.css"}


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("", "/"),
        ("/first-model", "/first-model/"),
        ("/reference/api", "/reference/api/"),
        ("/stream-protocol", "/reference/stream-protocol/"),
        ("/reproduction", "/reproduction/results/"),
        ("/real", "/reproduction/real/"),
        ("/files/demo.png", "/demo.png"),
        ("/files/screenshots--live.webp", "/screenshots/live.webp"),
    ],
)
def test_old_addresses_redirect_on_same_host(guide, old, new):
    answer = guide.get(f"/guide{old}", headers={"host": "evil.example"})
    assert (answer.status_code, answer.headers["location"]) == (307, f"/guide{new}")
    assert guide.get(f"/guide{new}").status_code == 200


def test_moved_pages_exist(guide):
    for new in routes.MOVED.values():
        assert guide.get(f"/guide/{new}/").status_code == 200


@pytest.mark.parametrize("name", ["nothing", "pages.py", "..%2froutes.py", "%2e%2e%2froutes.py", "a/"])
def test_missing_page_links_to_the_guide(guide, name):
    answer = guide.get(f"/guide/{name}")
    assert answer.status_code == 404
    assert 'href="/guide/first-model/"' in answer.text
    assert hashes(policy(answer.content)) <= hashes(answer.headers["content-security-policy"])


def test_pictures_have_media_types_and_etags(guide):
    picture = guide.get("/guide/screenshots/live.webp")
    assert picture.headers["content-type"] == "image/webp"
    assert guide.get("/guide/architecture.svg").headers["content-type"] == "image/svg+xml"
    assert (picture.headers["cache-control"], picture.headers["x-content-type-options"]) == ("no-cache", "nosniff")
    again = guide.get("/guide/screenshots/live.webp", headers={"if-none-match": picture.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert guide.head("/guide/screenshots/live.webp").headers["content-length"] == str(len(picture.content))


def test_animation_can_be_hidden_and_respects_reduced_motion(guide):
    frame = re.search(r"<details open><summary>.*?</picture></details>", guide.get("/guide/").text, re.DOTALL)
    assert frame is not None
    assert '<source srcset="screenshots/live.png" media="(prefers-reduced-motion: reduce)">' in frame[0]
    assert 'src="screenshots/live.webp"' in frame[0]
    moving = [page for page in (ROOT / "docs").rglob("*.md") if re.search(r"\]\(\S+\.webp\)", page.read_text("utf-8"))]
    assert moving == []


def test_site_is_built_where_service_reads_it():
    config = pytest.importorskip("mkdocs.config", reason="MkDocs is missing: pip install mkdocs-material")
    assert Path(config.load_config(str(ROOT / "mkdocs.yml")).site_dir) == routes.SITE
