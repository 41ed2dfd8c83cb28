"""Simulated power cuts: acknowledged writes survive, none is partial, and the service continues.

LIPSERVE_POWER_CUTS: cuts of the longest test per file system rule; LIPSERVE_POWER_SEED: seed of their choice.
`pytest -s` prints how many of each kind there were.
"""

import os
import sys
from collections import Counter
from pathlib import Path
from random import Random

import pytest

from tests.service.data import stream, upload
from tests.service.server import Server
from tests.system.power import disk, homes, scenarios, trials
from tests.system.power.checking import Ledger
from tests.system.power.disk import MODELS, Disk
from tests.system.power.recording import Kind, Recording, needs_compiler
from tests.system.power.scenarios import ANY, RecordedService

pytestmark = [needs_compiler, pytest.mark.own_files("what a disk of its own keeps")]
CUTS = int(os.environ.get("LIPSERVE_POWER_CUTS", "500"))
SEED = int(os.environ.get("LIPSERVE_POWER_SEED", "1"))


def check_cuts(recording: Recording, folder: Path, count: int, seed: int = SEED) -> None:
    """Check this many cuts under either rule; print how many of each kind there were."""
    for model in MODELS:
        cuts = trials.choose_cuts(recording, model, count, seed)
        found = trials.find_all_problems(recording, cuts, folder / "left")
        kinds = dict(Counter(cut.kind for cut in cuts))
        sys.stdout.write(f"{model}, seed {seed}: {kinds}, {len(found)} wrong\n")
        assert found == []


def check_service_continues(home: Path, log: Path, ledger: Ledger) -> None:
    """Check that a service starts on a home, stores more, and stops with everything stored."""
    name = "recording-late"
    with Server(home, log=log) as server:
        ledger.acknowledged[f"dataset/{name}"] = upload(server.client, stream(samples=60, seed=999), name=name)[
            "sha256"
        ]
        for model, version in {"version/panda-sim/1": ANY, "alias/panda-sim/serving": 1}.items():
            ledger.acknowledged.setdefault(model, version)  # if that start was the first one
        server.client.close()
        server.terminate()
    assert trials.find_problems(home, ledger) == []
    del ledger.acknowledged[f"dataset/{name}"]


def check_recording_is_complete(recording: Recording) -> None:
    """Check that replaying the recording yields the same files: no change was missed."""
    simulated_disk = Disk(recording, "strict", Random(0))
    for record in recording.records():
        if record.kind != Kind.MARK:
            simulated_disk.apply(record)
    visible, there = simulated_disk.visible(), disk.read(recording.root)
    assert visible.keys() == there.keys()
    assert [path for path in visible if visible[path] != there[path] and not path.endswith(disk.MAPPED_SUFFIX)] == []


def test_power_cuts_during_each_kind_of_request(tmp_path):
    recording = Recording(tmp_path / "recorded")
    with RecordedService(recording, homes.populated_home(recording)) as service:
        service.start()
        scenarios.run_each_kind(service, 0)
        service.wait_until_stored()
        service.stop()
    check_recording_is_complete(recording)
    check_cuts(recording, tmp_path, 5)


def test_power_cuts_over_lifetime_of_home(tmp_path):
    recording = Recording(tmp_path / "recorded")
    with RecordedService(recording) as service:
        scenarios.run_lifetime(service, 3)
    check_recording_is_complete(recording)
    check_cuts(recording, tmp_path, CUTS)
    for model in MODELS:
        for _, ledger, home in trials.homes_after(
            recording, trials.choose_cuts(recording, model, 5, SEED), tmp_path / "left"
        ):
            check_service_continues(home, tmp_path / "log", ledger)


def test_power_cuts_during_migration(tmp_path):
    recording = Recording(tmp_path / "recorded")
    with RecordedService(recording, homes.earlier_release_home(recording, tmp_path), shipped=False) as service:
        scenarios.run_upgrade(service)
    check_recording_is_complete(recording)
    check_cuts(recording, tmp_path, CUTS // 2)


def test_failed_syncs_acknowledge_nothing(tmp_path):
    """Requests whose sync failed are rejected, and later acknowledged writes do not depend on them."""
    recording = Recording(tmp_path / "recorded")
    with RecordedService(recording, homes.populated_home(recording), SNAPSHOT_EVERY_S="3600") as service:
        service.start()
        scenarios.run_failing_syncs(service, service.upload(299))
    check_recording_is_complete(recording)
    for seed in range(SEED, SEED + 5):
        check_cuts(recording, tmp_path, CUTS // 10, seed)
