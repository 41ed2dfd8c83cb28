"""Power cuts at many points of a recording, and the problems of the homes that they leave."""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random

from tests.system.power import disk
from tests.system.power.checking import Ledger, find_problems
from tests.system.power.disk import Disk, Model
from tests.system.power.recording import Kind, Recording


@dataclass(frozen=True)
class Cut:
    """A power cut. kind: of the request under way; after: number of records before it; model: rule of the file system;
    choice: seed of what the disk keeps; failures: seed of what failed syncs keep."""

    kind: str
    after: int
    model: Model
    choice: int
    failures: int = 0


def cut_points(recording: Recording) -> dict[str, list[int]]:
    """Return the record counts at which to cut the power, by kind of request. Half of them follow a response at once,
    when no later sync can have helped."""
    ledger, found = Ledger(), defaultdict[str, list[int]](list)
    for position, record in enumerate(recording.records(), start=1):
        if record.kind == Kind.MARK:
            ledger.read_mark(record.mark)
            if kind := ledger.kinds.get(record.mark["number"]):
                found[kind].append(position)
        for kind in ledger.pending_kinds:
            found[kind].append(position)
    return found


def choose_cuts(recording: Recording, model: Model, count: int, seed: int) -> list[Cut]:
    """Choose at least `count` cuts, equally many of each kind, in the order of the recording."""
    random, by_kind = Random(seed), cut_points(recording)
    each = -(-count // len(by_kind))
    cuts = [
        Cut(kind, random.choice(of_kind), model, random.randrange(1 << 30), seed)
        for kind, of_kind in sorted(by_kind.items())
        for _ in range(each)
    ]
    return sorted(cuts, key=lambda cut: cut.after)


def homes_after(recording: Recording, cuts: Sequence[Cut], folder: Path) -> Iterator[tuple[Cut, Ledger, Path]]:
    """Yield the home that each cut leaves; it is deleted before the next one. The cuts must be sorted, and share
    model and failures."""
    simulated_disk = Disk(recording, cuts[0].model, Random(cuts[0].failures))
    ledger = Ledger()
    at, records = 0, recording.records()
    for cut in cuts:
        while at < cut.after:
            record = next(records)
            at += 1
            if record.kind == Kind.MARK:
                ledger.read_mark(record.mark)
            else:
                simulated_disk.apply(record)
        disk.write(simulated_disk.cut(Random(cut.choice)), folder)
        try:
            yield cut, ledger, folder / recording.home.relative_to(recording.root)
        finally:
            shutil.rmtree(folder)


def find_all_problems(recording: Recording, cuts: Sequence[Cut], folder: Path) -> list[str]:
    """Return the problems of the homes that these cuts leave."""
    found = []
    for cut, ledger, home in homes_after(recording, cuts, folder):
        try:
            found += [f"{cut}: {each}" for each in find_problems(home, ledger)]
        except Exception as error:  # check the other homes too
            found.append(f"{cut}: {type(error).__name__}: {error}")
    return found
