"""What pages lead to and mention is there: links, pictures, generated pages, commands."""

import re
import runpy
import shlex
from pathlib import Path

import pytest
import typer

from service.cli.main import app
from tests.docs.blocks import ROOT, all_pages, blocks, pages, prose

LINK = re.compile(r"\]\(([^)\s]+)\)")
WIDEST, MOST_WORDS = 120, 15_000
"""Characters of a line of prose, tables and code aside, and words of all pages written by hand, as `wc -w` counts."""
BOXES = re.compile(r"^#+ +(.*?)\s*$", re.MULTILINE)


def anchor(heading: str) -> str:
    """What GitHub links a heading by."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


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


def test_the_page_of_archives_is_up_to_date():
    made = runpy.run_path(str(ROOT / "docs/archives.py"))
    assert made["TARGET"].read_text("utf-8") == made["document"](), "run: python docs/archives.py"


def test_the_page_of_the_stream_protocol_is_up_to_date():
    made = runpy.run_path(str(ROOT / "docs/stream.py"))
    assert made["TARGET"].read_text("utf-8") == made["document"](), "run: python docs/stream.py"


@pytest.mark.parametrize("page", [*pages(), ROOT / "CONTRIBUTING.md"], ids=lambda page: page.stem)
def test_lines_of_prose_fit_a_screen(page):
    for line in prose(page).splitlines():
        assert len(line) <= WIDEST or line.startswith(("|", "    ")), f"{page.name}: {line}"


def test_pages_stay_short():
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) < 120
    written = [page for page in pages() if page.name != "errors.md"]
    words = sum(len(page.read_text("utf-8").split()) for page in written)
    assert words <= MOST_WORDS, f"{words} words: say each thing once"


SETTING = re.compile(r"[A-Z_]+=\S*")


def commands(page) -> list[str]:
    """Every command line of ours on a page: in its text, and in blocks of shell whether they are run or not."""
    mentioned = re.findall(r"`((?:[A-Z_]+=\S* )?(?:\.venv/bin/)?lipserve [^`]+)`", prose(page))
    typed = "\n".join(block.text for block in blocks(page) if block.language in ("sh", "bash"))
    lines = typed.replace("\\\n", " ").splitlines()
    return [*mentioned, *(line.strip() for line in lines if re.match(r"\s*(\.venv/bin/)?lipserve ", line))]


def parse(line: str) -> None:
    """Raise where a command line names a command or an option that there is not."""
    words = [word for word in shlex.split(line, comments=True) if word != "…"]
    while SETTING.fullmatch(words[0]):
        words.pop(0)
    words.pop(0)
    command = typer.main.get_command(app)
    while True:
        context = command.context_class(command, info_name=command.name)
        if not hasattr(command, "resolve_command") or not words:
            break
        if words[0].startswith("-"):
            break
        _, command, words = command.resolve_command(context, words)
    command.make_parser(context).parse_args(list(words))


@pytest.mark.parametrize("page", all_pages(), ids=lambda page: page.stem)
def test_commands_on_a_page_are_those_that_there_are(page):
    for line in commands(page):
        try:
            parse(line)
        except Exception as error:
            pytest.fail(f"{page.name}: {line!r}: {error!r}")


@pytest.mark.parametrize("line", ["lipserve trian x.csv", "lipserve data ad x", "lipserve predict x --qq 1"])
def test_commands_that_there_are_not_are_noticed(line):
    with pytest.raises(Exception, match=r"(?i)no such"):
        parse(line)
