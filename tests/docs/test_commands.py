"""Commands that the documentation only mentions are those that there are."""

import re
import shlex

import pytest
import typer

from service.cli.main import app
from tests.docs.blocks import all_pages, blocks, prose

SETTING = re.compile(r"[A-Z_]+=\S*")


def commands(page) -> list[str]:
    """Every command line of ours on a page: in its text, and in blocks of shell whether they are run or not."""
    said = re.findall(r"`((?:[A-Z_]+=\S* )?(?:\.venv/bin/)?lipserve [^`]+)`", prose(page))
    typed = "\n".join(block.text for block in blocks(page) if block.language in ("sh", "bash"))
    lines = typed.replace("\\\n", " ").splitlines()
    return [*said, *(line.strip() for line in lines if re.match(r"\s*(\.venv/bin/)?lipserve ", line))]


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
