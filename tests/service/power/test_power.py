"""Power cuts: what clients were told is there afterwards, nothing is half, and the service goes on.

LIPSERVE_POWER_CUTS: how many cuts the longest test looks at by either rule, the others at fewer; LIPSERVE_POWER_SEED:
which. `pytest -s` tells how many of each kind there were.
"""

import os
import sys
from collections import Counter
from pathlib import Path
from random import Random

import pytest

from tests.service.data import stream, upload
from tests.service.power import disk, homes, story, trials
from tests.service.power.checking import Ledger
from tests.service.power.disk import MODELS, Disk
from tests.service.power.recording import Kind, Recording, needs_compiler
from tests.service.power.story import ANY, Story
from tests.service.server import Server

pytestmark = [needs_compiler, pytest.mark.own_files("what a disk of its own keeps")]
CUTS = int(os.environ.get("LIPSERVE_POWER_CUTS", "500"))
SEED = int(os.environ.get("LIPSERVE_POWER_SEED", "1"))


def check(recording: Recording, folder: Path, count: int, seed: int = SEED) -> None:
    """Look at so many cuts by either rule; tell how many of each kind there were."""
    for model in MODELS:
        cuts = trials.choose(recording, model, count, seed)
        found = trials.wrong(recording, cuts, folder / "left")
        kinds = dict(Counter(cut.kind for cut in cuts))
        sys.stdout.write(f"{model}, seed {seed}: {kinds}, {len(found)} wrong\n")
        assert found == []


def goes_on(home: Path, log: Path, ledger: Ledger) -> None:
    """A service starts on what is left, stores more, and ends; all of it is there."""
    name = "recording-late"
    with Server(home, log=log) as server:
        ledger.told[f"dataset/{name}"] = upload(server.client, stream(samples=60, seed=999), name=name)["sha256"]
        for model, version in {"version/panda-sim/1": ANY, "alias/panda-sim/serving": 1}.items():
            ledger.told.setdefault(model, version)  # if that start was the first one
        server.client.close()
        server.terminate()
    assert trials.check(home, ledger) == []
    del ledger.told[f"dataset/{name}"]


def check_complete(recording: Recording) -> None:
    """Whoever does again what was recorded has the very same files: nothing has escaped."""
    made = Disk(recording, "strict", Random(0))
    for record in recording.records():
        if record.kind != Kind.MARK:
            made.do(record)
    seen, there = made.seen(), disk.read(recording.root)
    assert seen.keys() == there.keys()
    assert [path for path in seen if seen[path] != there[path] and not path.endswith(disk.MAPPED)] == []


def test_some_of_each_kind(tmp_path):
    recording = Recording(tmp_path / "recorded")
    with Story(recording, homes.furnished(recording)) as told:
        told.start()
        story.shorter(told, 0)
        told.store()
        told.stop()
    check_complete(recording)
    check(recording, tmp_path, 20)


@pytest.mark.slow
def test_the_life_of_a_home_from_its_first_start_on(tmp_path):
    recording = Recording(tmp_path / "recorded")
    with Story(recording) as told:
        story.life(told, 3)
    check_complete(recording)
    check(recording, tmp_path, CUTS)
    for model in MODELS:
        for _, ledger, home in trials.left(recording, trials.choose(recording, model, 5, SEED), tmp_path / "left"):
            goes_on(home, tmp_path / "log", ledger)


@pytest.mark.slow
def test_a_home_of_an_earlier_release_is_migrated(tmp_path):
    recording = Recording(tmp_path / "recorded")
    with Story(recording, homes.earlier(recording, tmp_path), shipped=False) as told:
        story.upgrade(told)
    check_complete(recording)
    check(recording, tmp_path, CUTS // 2)


@pytest.mark.slow
def test_syncs_that_fail_are_no_promises(tmp_path):
    """What could not be synced is refused; what is promised later does not stand on it."""
    recording = Recording(tmp_path / "recorded")
    with Story(recording, homes.furnished(recording), SNAPSHOT_EVERY_S="3600") as told:
        told.start()
        story.failing(told, told.upload(299))
    check_complete(recording)
    for seed in range(SEED, SEED + 5):
        check(recording, tmp_path, CUTS // 10, seed)
