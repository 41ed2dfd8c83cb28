"""Every block of the documentation runs or has a reason not to, and its output is compared."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.choosing import few
from tests.docs.blocks import ALLOWED_REASONS, ROOT, RUN_LANGUAGES, Block, blocks, pages
from tests.docs.session import BlockRunner, Session, check_output
from tests.service.server import Server


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_every_block_is_run_or_has_a_reason(page):
    for block in blocks(page):
        known = block.language in RUN_LANGUAGES if block.reason is None else block.reason in ALLOWED_REASONS
        assert known, f"{block.place} is {block.language or 'of no language'}: run it or say why not, {ALLOWED_REASONS}"
    for before, block in zip([None, *blocks(page)], blocks(page), strict=False):
        if block.language == "json" and block.reason is None:  # output must follow the command that prints it
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
def test_output_is_compared_to_the_shown_digits(printed, written):
    check_output({"a": 1.23456, "id": "ds_12345", "b": 2}, '{"a": 1.235, "id": "ds_…"}', "here")
    with pytest.raises(AssertionError, match="here"):
        check_output(printed, written, "here")


def select_blocks(page: Path, slow: bool) -> list[Block]:
    """Return the blocks of a page to run; slow ones only on request."""
    found = [each for each in blocks(page) if each.reason is None and each.language in RUN_LANGUAGES]
    return found if slow else [each for each in found if not each.slow]


def page_id(page: Path) -> str:
    """Return a unique id of a page."""
    return page.relative_to(ROOT).with_suffix("").as_posix().replace("/", "-")


QUICK_PAGES = [page for page in pages() if any(not each.serves for each in select_blocks(page, slow=False))]
SLOW_PAGES = [page for page in pages() if len(select_blocks(page, slow=True)) > len(select_blocks(page, slow=False))]


def run_blocks(runner: BlockRunner, page: Path, slow: bool) -> None:
    """Run blocks of a page."""
    with Session(runner, page_id(page)) as session:
        for block in select_blocks(page, slow):
            session.run(block)


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BlockRunner]:
    """Runs the quick blocks of all pages on one service."""
    folder = tmp_path_factory.mktemp("docs")
    with Server(folder / "home", warm=True) as server:
        yield BlockRunner(folder, server)


@pytest.mark.parametrize("page", few(QUICK_PAGES, kept=lambda page: page.stem == "README"), ids=page_id)
def test_quick_blocks_of_page_run(runner, page):
    run_blocks(runner, page, slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("page", SLOW_PAGES, ids=page_id)
def test_all_blocks_of_page_run(tmp_path, page):
    # tests run in parallel: a training with the usual low priority would hardly run
    with Server(tmp_path / "home", LIPSERVE_TRAINING_NICENESS="0", LIPSERVE_LEARNER_NICENESS="0") as server:
        run_blocks(BlockRunner(tmp_path, server), page, slow=True)
