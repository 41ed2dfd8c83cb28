"""Links, pictures, generated pages and commands of the documentation exist."""

import re
import runpy
import shlex
from pathlib import Path

import pytest
import typer

from service.cli.main import app
from tests.docs.blocks import ROOT, all_pages, blocks, pages, prose

LINK = re.compile(r"\]\(([^)\s]+)\)")
DASHBOARD = ROOT / "service/api/dashboard/static"
TERM = re.compile(r'\b(?:of|term)(?:=|: )"([\w-]+)"')
"""A word of the dashboard with the anchor of its definition: `Term`, or `term` of a card or column."""
GUIDE_LINK = re.compile(r"/guide/([\w/-]*)(?:#([\w-]+))?[\"`]")
MAX_LINE_LENGTH, MAX_WORDS = 120, 15_000
"""Characters of a line of prose, without tables and code; words of all hand-written pages, as `wc -w` counts them."""
HEADINGS = re.compile(r"^#+ +(.*?)\s*$", re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives to the headings of a page."""
    headings = (re.sub(r"\[(.*?)\]\(.*?\)", r"\1", each).replace("`", "") for each in HEADINGS.findall(prose(page)))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", all_pages(), ids=lambda page: page.stem)
def test_links_have_targets(page):
    for link in LINK.findall(prose(page)):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, fragment = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.is_relative_to(ROOT), f"{page.name}: {link}"
        assert target.exists(), f"{page.name}: {link}"
        assert not fragment or fragment in anchors(target), f"{page.name}: {link}"


def test_dashboard_links_to_definitions_and_pages_that_exist():
    texts = {path.name: path.read_text("utf-8") for path in DASHBOARD.rglob("*") if path.suffix in (".js", ".html")}
    terms = {(name, term) for name, text in texts.items() for term in TERM.findall(text)}
    defined = anchors(ROOT / "docs/glossary.md")
    assert {name for name, _ in terms} >= {"verdicts.js", "innovation.js", "lineage.js"}
    assert {(name, term) for name, term in terms if term not in defined} == set()
    links = [each for text in texts.values() for each in GUIDE_LINK.findall(text)]
    assert links
    for address, fragment in links:
        page = ROOT / "docs" / f"{address.rstrip('/') or 'README'}.md"
        assert page.exists(), address
        assert not fragment or fragment in anchors(page), f"{address}#{fragment}"


@pytest.mark.parametrize("name", ["api", "archives", "stream"])
def test_generated_page_is_up_to_date(name):
    made = runpy.run_path(str(ROOT / f"docs/{name}.py"))
    assert made["TARGET"].read_text("utf-8") == made["document"](), f"run: python docs/{name}.py"


@pytest.mark.parametrize("page", [*pages(), ROOT / "CONTRIBUTING.md"], ids=lambda page: page.stem)
def test_prose_lines_are_short(page):
    for line in prose(page).splitlines():
        assert len(line) <= MAX_LINE_LENGTH or line.startswith(("|", "    ")), f"{page.name}: {line}"


def test_pages_stay_short():
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) < 120
    written = [page for page in pages() if page.name != "errors.md"]
    words = sum(len(page.read_text("utf-8").split()) for page in written)
    assert words <= MAX_WORDS, f"{words} words: say each thing once"


SETTING = re.compile(r"[A-Z_]+=\S*")


def commands(page) -> list[str]:
    """Return every `lipserve` command line of a page, in its text and in shell blocks, run or not."""
    mentioned = re.findall(r"`((?:[A-Z_]+=\S* )?(?:\.venv/bin/)?lipserve [^`]+)`", prose(page))
    typed = "\n".join(block.text for block in blocks(page) if block.language in ("sh", "bash"))
    lines = typed.replace("\\\n", " ").splitlines()
    return [*mentioned, *(line.strip() for line in lines if re.match(r"\s*(\.venv/bin/)?lipserve ", line))]


def parse(line: str) -> None:
    """Raise if a command line contains an unknown command or option."""
    words = [word for word in shlex.split(line, comments=True) if word != "…"]
    while SETTING.fullmatch(words[0]):
        words.pop(0)
    words.pop(0)
    command = typer.main.get_command(app)
    while True:
        context = command.context_class(command, info_name=command.name)
        if not hasattr(command, "resolve_command") or not words or words[0].startswith("-"):
            break
        _, command, words = command.resolve_command(context, words)
    command.make_parser(context).parse_args(list(words))


@pytest.mark.parametrize("page", all_pages(), ids=lambda page: page.stem)
def test_commands_on_pages_exist(page):
    for line in commands(page):
        try:
            parse(line)
        except Exception as error:
            pytest.fail(f"{page.name}: {line!r}: {error!r}")


@pytest.mark.parametrize("line", ["lipserve trian x.csv", "lipserve data ad x", "lipserve predict x --qq 1"])
def test_unknown_commands_are_found(line):
    with pytest.raises(Exception, match=r"(?i)no such"):
        parse(line)
