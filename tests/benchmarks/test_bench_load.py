"""`python -m benchmarks load`, `soak` and `scale`: counts and targets, with deliberate faults."""

import json
import mmap
import os
import threading
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from benchmarks.online.sending import Ack
from benchmarks.processes import PROC, PeriodicCall, written_mib
from benchmarks.scale import passes
from benchmarks.scale import running as scaling
from benchmarks.soak import accounting, hours, running, table
from benchmarks.soak.accounting import Account
from benchmarks.soak.clients import Mix
from benchmarks.soak.connections import TAUGHT, Log, stream_of
from benchmarks.soak.day import MAX_LAG_S, Clock
from benchmarks.soak.resources import Look
from benchmarks.soak.running import Options, Results
from benchmarks.timing import Timing

pytestmark = pytest.mark.slow


def ack(sequence, accepted=25):
    return Ack(sequence, 0, 1, 25, accepted, sequence + 1, False, {})


@pytest.fixture
def counted(monkeypatch):
    """Compare logs with lists that the test provides."""

    def count(logs, datasets=(), batches=()):
        lists = {"/v1/datasets": list(datasets), f"/v1/models/{TAUGHT}/observations": list(batches)}
        monkeypatch.setattr(accounting, "_pages", lambda http, path: lists[path])
        account = Account.of(logs)
        accounting.check(account, logs, type("Client", (), {"url": "http://localhost"}))
        return account

    return count


def dataset(name, sha256="a", rows=300):
    return {"id": name, "sha256": sha256, "report": {"rows": rows}}


def batch(sequence, accepted=25, number=0):
    return {"stream_id": stream_of(number), "sequence": sequence, "accepted": accepted}


def test_lost_changed_and_surplus_writes_are_counted(counted):
    kept = {"sha256": "a", "rows": 300}
    fine = Log("upload", stored={"ds_1": kept, "ds_2": kept}, deleted={"ds_1"}, unsure=1)
    teaching = Log("observe", acks={0: ack(0), 1: ack(1)})
    account = counted([fine, teaching], [dataset("ds_2"), dataset("ds_7")], [batch(0), batch(1)])
    assert (account.batches, account.rows, account.datasets, account.deleted) == (2, 50, 2, 1)
    assert (account.lost, account.changed, account.surplus) == (0, 0, 0), "one upload had no answer"

    uploads = Log("upload", stored={"ds_1": kept, "ds_2": kept, "ds_3": kept}, deleted={"ds_3"})
    teaching = Log("observe", acks={0: ack(0), 1: ack(1), 2: ack(2)})
    listed = [dataset("ds_2", sha256="b"), dataset("ds_3"), dataset("ds_9")]
    account = counted([uploads, teaching], listed, [batch(0), batch(0), batch(1, accepted=24)])
    assert account.lost == 2, "ds_1 and batch 2"
    assert account.changed == 2, "ds_2 and batch 1"
    assert account.surplus == 3, "ds_3 was deleted, ds_9 never sent, batch 0 is stored twice"


def _results(**changes):
    usual = {
        "timings": {"predict": Timing.of(np.full(100, 1_000_000))},
        "errors": {kind: Counter() for kind in running.KINDS},
        "service": [400.0] * 40,
        "children": [300.0] * 40,
        "before": Account(batches=3, rows=75),
        "after": Account(batches=3, rows=75),
    }
    return Results({"processor": "two cores"}, {"model": "small"}, Mix(1, 1, 1, 1), 10.0, **{**usual, **changes})


@pytest.mark.parametrize(
    "wrong",
    [
        {"errors": {"predict": Counter({"TimeoutError": 1})}},
        {"before": Account(lost=1)},
        {"after": Account(lost=1)},
        {"after": Account(changed=1)},
        {"after": Account(surplus=1)},
        {"after": Account(twice=1)},
        {"after": Account(difference=1e-6)},
        {"service": [400.0] * 30 + [430.0] * 10},
    ],
)
def test_every_fault_misses_one_target(wrong):
    assert all(each.met is not False for each in table.targets(_results()))
    assert sum(each.met is False for each in table.targets(_results(**wrong))) == 1


def test_a_run_measures_everything():
    fit = {"hyperparameter_samples": 40, "posterior_samples": 100, "max_iterations": 30, "starts": 1}
    found = running.run(Options(8, 12.0, robot="double-pendulum", fit=fit), Console(quiet=True))
    assert set(found.timings) == set(running.KINDS)
    assert found.failed == 0
    assert found.before.batches > 10
    assert found.before.datasets > 5
    assert [each.name for each in table.targets(found) if each.met is False and "memory" not in each.name] == []


def _looks(**rising):
    """Return a thousand looks in which the given figures rise linearly after the first tenth, by the given amount."""
    rng = np.random.default_rng(0)
    usual = {"service": 300.0, "learner": 150.0, "jobs": 200.0, "disk": 40.0}
    usual |= {"descriptors": 50.0, "threads": 22.0, "processes": 3.0}
    found = []
    for turn in range(1000):
        share = max(0.0, (turn - 100) / 900)
        warm = min(1.0, turn / 80)  # at first everything grows
        figures = {name: value * warm + rising.get(name, 0.0) * share for name, value in usual.items()}
        figures["jobs"] += 300.0 if turn % 100 < 5 else 0.0  # a training job
        figures["service"] += rng.normal(0.0, 3.0)
        found.append(Look(at=float(turn), **figures))
    return found


LEAKS = {
    "service": 25.0,
    "learner": 12.0,
    "jobs": 15.0,
    "disk": 3.0,
    "descriptors": 5.0,
    "threads": 3.0,
    "processes": 1.0,
}
"""Rise of each figure that is a leak."""


def _day(**changes):
    return replace(hours.Results({"processor": "two cores"}, 8.0, looks=_looks(), done={"keep": 8}), **changes)


@pytest.mark.parametrize(
    "wrong",
    [
        {"errors": {"move: TimeoutError": 1}},
        {"unasked": ["GET /v2"]},
        *({"looks": _looks(**{name: value})} for name, value in LEAKS.items()),
    ],
)
def test_every_leak_misses_one_target(wrong):
    assert [each.name for each in hours.targets(_day()) if not each.met] == []
    assert sum(each.met is False for each in hours.targets(_day(**wrong))) == 1


def test_a_soak_is_drawn_and_written(tmp_path):
    found = _day(errors={"move: TimeoutError": 1})
    found.write(tmp_path / "soak.json", [])
    assert json.loads((tmp_path / "soak.json").read_text())["looks"][0]["service"] == pytest.approx(0, abs=20)
    hours.draw(found, tmp_path / "soak.png")
    assert (tmp_path / "soak.png").read_bytes().startswith(b"\x89PNG")
    assert [grid.title for grid in hours.grids(found)][1].startswith("8 hours")


def test_failed_periodic_call_raises_its_error_on_exit():
    looked = threading.Event()

    def look():
        looked.set()
        raise FileNotFoundError("a folder")

    with pytest.raises(FileNotFoundError, match="a folder"), PeriodicCall(0.0, look):
        assert looked.wait(60)


@pytest.mark.skipif(not (PROC / "self" / "smaps_rollup").exists(), reason="requires Linux")
def test_written_memory_excludes_mapped_files(tmp_path):
    file = tmp_path / "library"
    file.write_bytes(bytes(64 << 20))
    before = written_mib(os.getpid())
    with file.open("rb") as opened, mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        assert sum(mapped[at] for at in range(0, len(mapped), mmap.PAGESIZE)) == 0
        assert written_mib(os.getpid()) - before < 16
        kept = np.ones(64 << 17)
        assert 48 < written_mib(os.getpid()) - before < 80
        del kept
    assert written_mib(1 << 30) is None


def test_clock_waits_for_its_followers():
    clock, seen = Clock(300), []

    def follow():
        for at in range(0, 300, 10):
            clock.follow("slow", at)
            seen.append((at, clock.now))
        clock.leave("slow")

    thread = threading.Thread(target=follow)
    thread.start()
    for _ in range(300):
        clock.tick()
    thread.join()
    assert len(seen) == 30
    assert all(at <= now <= at + MAX_LAG_S + 1 for at, now in seen)


def test_short_day_has_no_errors():
    found = hours.run(hours.Options(0.1, rate=20), Console(quiet=True))
    assert found.errors == {}
    assert found.done["batch of 40 rows"] == 180
    assert {"train", "exchange archives", "back up", "upload recordings"} <= found.done.keys()
    assert found.looks[-1].learner > 0


def test_ratio_is_the_median_of_pairs():
    seconds = {passes.POOL: {1: [10.0, 20.0, 10.0], 2: [5.0, 10.0, 8.0]}}
    part = passes._part(1000, seconds, 42.0, 1)
    ratio, linear, sums = part.targets
    assert ratio.value == pytest.approx(2.0)
    assert ratio.met
    assert linear.value == pytest.approx(42.0 / 5 / 8.0)
    assert sums.met
    assert passes._part(1000, seconds, 42.0, 2).targets[-1].met is False


def test_all_that_scale_starts_is_measured():
    results = scaling.run(scaling.Options(**scaling.QUICK), Console(quiet=True))
    assert [part.name for part in results.parts] == list(scaling.PARTS)
    judged = {each.name: each for each in results.targets()}
    for name in ("different sums", "trials with different answers", "acknowledged and lost", "done twice"):
        assert judged[name].met, name
    assert judged["faults without recovery"].met
