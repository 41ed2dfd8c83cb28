"""Every block that a reader can type is typed. Quick ones share a service, all of a page have one of their own."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from tests.docs.blocks import ROOT, RUN, Block, blocks, pages
from tests.docs.session import Reader, Session


def chosen(page: Path, slow: bool) -> list[Block]:
    """The blocks of a page that are run, those that are slow only where asked for."""
    found = [each for each in blocks(page) if each.reason is None and each.language in RUN]
    return found if slow else [each for each in found if not each.slow]


def name(page: Path) -> str:
    """Of a page among all."""
    return page.relative_to(ROOT).with_suffix("").as_posix().replace("/", "-")


QUICK = [page for page in pages() if any(not each.serves for each in chosen(page, slow=False))]
SLOW = [page for page in pages() if len(chosen(page, slow=True)) > len(chosen(page, slow=False))]


def run(reader: Reader, page: Path, found: Sequence[Block]) -> None:
    """Run blocks of a page."""
    with Session(reader, name(page)) as session:
        for block in found:
            session.run(block)


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    """A service for the quick blocks of all pages."""
    with Reader(tmp_path_factory.mktemp("docs")) as started:
        yield started


@pytest.mark.parametrize("page", QUICK, ids=name)
def test_what_a_page_says_works(reader, page):
    run(reader, page, chosen(page, slow=False))


@pytest.mark.slow
@pytest.mark.parametrize("page", SLOW, ids=name)
def test_all_that_a_page_says_works(tmp_path, page):
    with Reader(tmp_path) as fresh:
        run(fresh, page, chosen(page, slow=True))
