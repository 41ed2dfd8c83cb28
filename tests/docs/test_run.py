"""Every block that a reader can type is typed, or says why not; what it prints is compared."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from tests.choosing import few
from tests.docs.blocks import REASONS, ROOT, RUN, Block, blocks, pages
from tests.docs.session import Reader, Session, compare
from tests.service.server import Server


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_every_block_is_run_or_says_why_not(page):
    for block in blocks(page):
        known = block.language in RUN if block.reason is None else block.reason in REASONS
        assert known, f"{block.place} is {block.language or 'of no language'}: run it or say why not, {REASONS}"
    for before, block in zip([None, *blocks(page)], blocks(page), strict=False):
        if block.language == "json" and block.reason is None:  # output follows the command that prints it
            assert before is not None, block.place
            assert (before.reason, before.language == "json") == (None, False), block.place


@pytest.mark.parametrize(
    ("printed", "written"),
    [
        ({"a": 1.2375}, '{"a": 1.235}'),
        ([1.0, 2.0], "[1.0]"),
        ({"id": "job_1"}, '{"id": "ds_…"}'),
        ({}, '{"a": null}'),
        ({"n": 3}, '{"n": 4}'),
    ],
)
def test_output_is_compared_to_the_digits_that_are_shown(printed, written):
    compare({"a": 1.23456, "id": "ds_12345", "b": 2}, '{"a": 1.235, "id": "ds_…"}', "here")
    with pytest.raises(AssertionError, match="here"):
        compare(printed, written, "here")


def chosen(page: Path, slow: bool) -> list[Block]:
    """The blocks of a page that are run, those that are slow only where asked for."""
    found = [each for each in blocks(page) if each.reason is None and each.language in RUN]
    return found if slow else [each for each in found if not each.slow]


def name(page: Path) -> str:
    """Of a page among all."""
    return page.relative_to(ROOT).with_suffix("").as_posix().replace("/", "-")


QUICK = [page for page in pages() if any(not each.serves for each in chosen(page, slow=False))]
LONGEST = ("operations", "own-robot", "scaling")  # of `make test-all`, though their blocks are quick one by one
SLOW = [page for page in pages() if len(chosen(page, slow=True)) > len(chosen(page, slow=False))]


def run(reader: Reader, page: Path, found: Sequence[Block]) -> None:
    """Run blocks of a page."""
    with Session(reader, name(page)) as session:
        for block in found:
            session.run(block)


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    """A service for the quick blocks of all pages."""
    folder = tmp_path_factory.mktemp("docs")
    with Server(folder / "home", warm=True) as server:
        yield Reader(folder, server)


@pytest.mark.parametrize("page", few(QUICK, kept=lambda page: page.stem not in LONGEST), ids=name)
def test_what_a_page_says_works(reader, page):
    run(reader, page, chosen(page, slow=False))


@pytest.mark.slow
@pytest.mark.parametrize("page", SLOW, ids=name)
def test_all_that_a_page_says_works(tmp_path, page):
    with Server(tmp_path / "home", warm=True) as server:
        run(Reader(tmp_path, server), page, chosen(page, slow=True))
