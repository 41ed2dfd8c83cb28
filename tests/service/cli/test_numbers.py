"""Numbers in sentences: per cent with a space, things counted in singular and plural; one way on all pages."""

import re
from pathlib import Path

import pytest

from lipserve.wording import counted, percent
from tests.docs.blocks import pages, prose

ROOT = Path(__file__).resolve().parents[3]
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
"""A number before several things, which may be one: `counted` knows. Of `3 of 5 rows` the last is never one."""


def test_shares_are_written_with_a_space():
    assert [percent(0.953), percent(0.953, 1), percent(1.0)] == ["95 %", "95.3 %", "100 %"]


def test_one_thing_is_no_plural():
    assert [counted(1, "episode"), counted(2, "episode"), counted(0, "gap")] == ["1 episode", "2 episodes", "0 gaps"]
    assert [counted(1, "batch", "batches"), counted(1234, "batch", "batches")] == ["1 batch", "1,234 batches"]


@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_message_writes_a_share_in_another_way(path):
    assert BARE.findall(path.read_text("utf-8")) == []


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_no_page_writes_a_share_in_another_way(page):
    assert WITHOUT_SPACE.findall(re.sub(r"`[^`]*`", "", prose(page))) == []


@pytest.mark.parametrize("path", SHELL, ids=lambda path: path.stem)
def test_commands_count_in_singular_and_plural(path):
    assert MANY.findall(path.read_text("utf-8")) == []


def test_a_report_counts_what_it_tells(asked, recording):
    text = asked("data", "add", recording(74, "counted.csv"))
    assert "in 1 episode, at" in text
    assert "; 0 gaps" in text
