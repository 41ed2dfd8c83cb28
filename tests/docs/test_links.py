"""Links, pictures and generated pages of the documentation are there and up to date."""

import re
import runpy
from pathlib import Path

import pytest

from service.guide.routes import anchor
from tests.docs.blocks import ROOT, all_pages, pages, prose

LINK = re.compile(r"\]\(([^)\s]+)\)")
WIDEST, MOST_WORDS = 120, 15_000
"""Characters of a line of prose, tables and code aside, and words of all pages written by hand, as `wc -w` counts."""
BOXES = re.compile(r"^#+ +(.*?)\s*$", re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """What the headings of a page are linked by."""
    return {
        anchor(re.sub(r"\[(.*?)\]\(.*?\)", r"\1", heading).replace("`", "")) for heading in BOXES.findall(prose(page))
    }


@pytest.mark.parametrize("page", all_pages(), ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    for link in LINK.findall(prose(page)):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, fragment = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.is_relative_to(ROOT), f"{page.name}: {link}"
        assert target.exists(), f"{page.name}: {link}"
        if fragment:
            assert fragment in anchors(target), f"{page.name}: {link}"


def test_the_api_reference_is_up_to_date():
    made = runpy.run_path(str(ROOT / "docs/api.py"))
    assert made["TARGET"].read_text("utf-8") == made["document"](), "run: python docs/api.py"


def test_the_readme_stays_short():
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 180


@pytest.mark.parametrize("page", [*pages(), ROOT / "CONTRIBUTING.md"], ids=lambda page: page.stem)
def test_lines_of_prose_fit_a_screen(page):
    for line in prose(page).splitlines():
        assert len(line) <= WIDEST or line.startswith(("|", "    ")), f"{page.name}: {line}"


def test_all_pages_together_stay_short():
    written = [page for page in pages() if page.name != "errors.md"]
    words = sum(len(page.read_text("utf-8").split()) for page in written)
    assert words <= MOST_WORDS, f"{words} words: say each thing once"
