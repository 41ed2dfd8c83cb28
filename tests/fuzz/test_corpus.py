"""Each file that fuzzing has kept is read again: it began with them, they reach code that others do not, or one was a
finding once."""

from pathlib import Path

import pytest

from tests.fuzz.targets import TARGETS, run

CORPUS = Path(__file__).parent / "corpus"
MOST_BYTES = 300_000


@pytest.mark.parametrize("target", TARGETS)
def test_readers_take_what_they_can_and_refuse_the_rest(target):
    files = sorted((CORPUS / target).iterdir())
    taken = [run(target, file.read_bytes()) for file in files]
    assert len(files) > 0
    assert any(taken), "nothing of a reader's corpus can be read"


def test_the_corpus_stays_small():
    assert sum(file.stat().st_size for file in CORPUS.rglob("*")) <= MOST_BYTES
