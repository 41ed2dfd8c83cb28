"""`python -m benchmarks load` and `scale`: what they count and conclude, where things go wrong on purpose."""

from collections import Counter

import numpy as np
import pytest
from rich.console import Console

from benchmarks.online.sending import Ack
from benchmarks.scale import passes
from benchmarks.scale import running as scaling
from benchmarks.soak import accounting, running, table
from benchmarks.soak.accounting import Account
from benchmarks.soak.clients import Mix
from benchmarks.soak.connections import TAUGHT, Log, stream_of
from benchmarks.soak.running import Options, Results
from benchmarks.timing import Timing


def ack(sequence, accepted=25):
    return Ack(sequence, 0, 1, 25, accepted, sequence + 1, False, {})


@pytest.fixture
def counted(monkeypatch):
    """Counts logs against lists that the test gives."""

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


def test_every_write_that_is_not_as_acknowledged_is_found(counted):
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
    assert account.surplus == 3, "ds_3 was deleted, ds_9 never sent, batch 0 is there twice"


def _results(**changes):
    found = Results(
        {"processor": "two cores"},
        {"model": "small"},
        Mix(1, 1, 1, 1),
        10.0,
        timings={"predict": Timing.of(np.full(100, 1_000_000))},
        errors={kind: Counter() for kind in running.KINDS},
        service=[400.0] * 40,
        children=[300.0] * 40,
        before=Account(batches=3, rows=75),
        after=Account(batches=3, rows=75),
    )
    for name, value in changes.items():
        setattr(found, name, value)
    return found


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
def test_every_fault_breaks_a_promise(wrong):
    assert all(each.met is not False for each in table.targets(_results()))
    assert sum(each.met is False for each in table.targets(_results(**wrong))) == 1


@pytest.mark.slow
def test_a_run_measures_everything():
    fit = {"hyperparameter_samples": 40, "posterior_samples": 100, "max_iterations": 30, "starts": 1}
    found = running.run(Options(8, 12.0, robot="double-pendulum", fit=fit), Console(quiet=True))
    assert set(found.timings) == set(running.KINDS)
    assert found.failed == 0
    assert found.before.batches > 10
    assert found.before.datasets > 5
    assert [each.name for each in table.targets(found) if each.met is False and "memory" not in each.name] == []


def test_a_ratio_is_that_of_pairs():
    seconds = {passes.POOL: {1: [10.0, 20.0, 10.0], 2: [5.0, 10.0, 8.0]}}
    part = passes._part(1000, seconds, 42.0, 1)
    ratio, linear, sums = part.targets
    assert ratio.value == pytest.approx(2.0)
    assert ratio.met
    assert linear.value == pytest.approx(42.0 / 5 / 8.0)
    assert sums.met
    assert passes._part(1000, seconds, 42.0, 2).targets[-1].met is False


@pytest.mark.slow
def test_all_that_scale_starts_is_measured():
    results = scaling.run(scaling.Options(**scaling.QUICK), Console(quiet=True))
    assert [part.name for part in results.parts] == list(scaling.PARTS)
    judged = {each.name: each for each in results.targets()}
    for name in ("different sums", "trials in which their answers differ", "acknowledged and lost", "done twice"):
        assert judged[name].met, name
    assert judged["faults without recovery"].met
