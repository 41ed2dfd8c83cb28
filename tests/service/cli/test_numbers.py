"""Numbers in sentences: percentages have a space; counted things are singular or plural."""

import re

import pytest

from lipserve.wording import counted, percent
from tests import ROOT
from tests.docs.blocks import pages, prose

WITHOUT_SPACE = re.compile(r"\d%(?![0-9A-Fa-f]{2})")
BARE = re.compile(r"\{[^{}\"']*:[^{}\"']*%\}")
WRITTEN = [
    path
    for folder in ("service", "clients/python/lipserve")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if path.name not in ("wording.py", "text.py")
]

SHELL = sorted((ROOT / "service/cli").glob("*.py"))
THINGS = "versions|models|data sets|batches|rows|samples|joints|jobs|snapshots|queries|iterations"
MANY = re.compile(rf"(?<! of )(?<!has )\{{(?!counted\()[^{{}}]*\}} (?:{THINGS})\b")
"""A number before a plural, which should use `counted`; `3 of 5 rows` is allowed."""


def test_percentages_have_a_space():
    assert [percent(0.953), percent(0.953, 1), percent(1.0)] == ["95 %", "95.3 %", "100 %"]


def test_singular_and_plural():
    assert [counted(1, "episode"), counted(2, "episode"), counted(0, "gap")] == ["1 episode", "2 episodes", "0 gaps"]
    assert [counted(1, "batch", "batches"), counted(1234, "batch", "batches")] == ["1 batch", "1,234 batches"]


@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: str(path.relative_to(ROOT)))
def test_messages_format_percentages_with_percent(path):
    assert BARE.findall(path.read_text("utf-8")) == []


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_pages_have_a_space_before_the_percent_sign(page):
    assert WITHOUT_SPACE.findall(re.sub(r"`[^`]*`", "", prose(page))) == []


@pytest.mark.parametrize("path", SHELL, ids=lambda path: path.stem)
def test_commands_use_counted_for_numbers_of_things(path):
    assert MANY.findall(path.read_text("utf-8")) == []
