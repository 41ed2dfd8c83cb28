"""Power cuts at many points of a recording, and what is wrong with the homes that they leave."""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random

from tests.service.power import disk
from tests.service.power.checking import Ledger, check
from tests.service.power.disk import Disk, Model
from tests.service.power.recording import Kind, Recording


@dataclass(frozen=True)
class Cut:
    """One power cut. kind: what was asked for then; after: so many records; model: rule by which things are left;
    choice: of what is; failures: choice of what syncs have kept that failed."""

    kind: str
    after: int
    model: Model
    choice: int
    failures: int = 0


def places(recording: Recording) -> dict[str, list[int]]:
    """Numbers of records after which a cut is of interest, by what was asked for then; half of them come right after an
    answer, whose promise nothing later has helped to keep."""
    ledger, found = Ledger(), defaultdict[str, list[int]](list)
    for place, record in enumerate(recording.records(), start=1):
        if record.kind == Kind.MARK:
            ledger.take(record.mark)
            if kind := ledger.kinds.get(record.mark["number"]):
                found[kind].append(place)
        for kind in ledger.kind:
            found[kind].append(place)
    return found


def choose(recording: Recording, model: Model, count: int, seed: int) -> list[Cut]:
    """`count` cuts or a few more, as many of each kind, in the order of the recording."""
    random, by_kind = Random(seed), places(recording)
    each = -(-count // len(by_kind))
    cuts = [
        Cut(kind, random.choice(of_kind), model, random.randrange(1 << 30), seed)
        for kind, of_kind in sorted(by_kind.items())
        for _ in range(each)
    ]
    return sorted(cuts, key=lambda cut: cut.after)


def left(recording: Recording, cuts: Sequence[Cut], folder: Path) -> Iterator[tuple[Cut, Ledger, Path]]:
    """What is left after each of the cuts, which are of one model and choice of failures, and in order: the home, which
    is there until the next one."""
    made = Disk(recording, cuts[0].model, Random(cuts[0].failures))
    ledger = Ledger()
    at, records = 0, recording.records()
    for cut in cuts:
        while at < cut.after:
            record = next(records)
            at += 1
            if record.kind == Kind.MARK:
                ledger.take(record.mark)
            else:
                made.do(record)
        disk.write(made.cut(Random(cut.choice)), folder)
        try:
            yield cut, ledger, folder / recording.home.relative_to(recording.root)
        finally:
            shutil.rmtree(folder)


def wrong(recording: Recording, cuts: Sequence[Cut], folder: Path) -> list[str]:
    """What is wrong with the homes that are left after these cuts."""
    found = []
    for cut, ledger, home in left(recording, cuts, folder):
        try:
            found += [f"{cut}: {each}" for each in check(home, ledger)]
        except Exception as error:  # the others are looked at all the same
            found.append(f"{cut}: {type(error).__name__}: {error}")
    return found
