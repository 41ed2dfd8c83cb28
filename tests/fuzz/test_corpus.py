"""Reads every file of the corpus again: seeds, files that reach other code, and former findings."""

from pathlib import Path

import pytest

from tests.fuzz.targets import TARGETS, run

CORPUS = Path(__file__).parent / "corpus"
MAX_BYTES = 300_000


@pytest.mark.parametrize("target", TARGETS)
def test_readers_accept_or_reject_every_file(target):
    files = sorted((CORPUS / target).iterdir())
    taken = [run(target, file.read_bytes()) for file in files]
    assert len(files) > 0
    assert any(taken), "no file of the corpus can be read"


def test_corpus_stays_small():
    assert sum(file.stat().st_size for file in CORPUS.rglob("*")) <= MAX_BYTES
