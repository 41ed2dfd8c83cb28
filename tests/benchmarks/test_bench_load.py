"""`python -m benchmarks load`: what it counts, against services and writes that go wrong on purpose."""

from __future__ import annotations

import time
from collections import Counter

import numpy as np
import pytest
from rich.console import Console

from benchmarks.online.sending import Ack
from benchmarks.soak import accounting, connections, running, table
from benchmarks.soak.accounting import Account
from benchmarks.soak.clients import Mix, share
from benchmarks.soak.connections import TAUGHT, Connection, Log, stream_of
from benchmarks.soak.memory import growth
from benchmarks.soak.running import Options, Results
from benchmarks.timing import Timing


def test_growth_leaves_out_the_start():
    assert growth([100.0] * 5 + [200.0] * 15) == 0
    assert growth([500.0] * 5 + [200.0] * 10 + [220.0] * 5) == pytest.approx(0.1)
    assert growth([1.0] * 7) is None


@pytest.mark.parametrize("connections_", [4, 5, 16, 64, 100])
def test_a_mix_has_every_kind(connections_):
    mix = Mix.of(connections_)
    assert mix.total == connections_
    assert min(mix.predict, mix.stream, mix.observe, mix.upload) >= 1
    assert Mix.of(64) == Mix()


def test_too_few_connections_are_refused():
    with pytest.raises(ValueError, match="connections is 3, expected at least 4"):
        Mix.of(3)


def test_shares_differ_by_one_at_most():
    assert share(8, 2) == [4, 4]
    assert share(9, 2) == [5, 4]


class Failing(Connection):
    """Goes wrong every third time."""

    kind = "failing"
    closed = False

    def work(self, turn):
        if turn % 3 == 2:
            raise ConnectionResetError("gone")

    def close(self):
        self.closed = True


def test_all_that_goes_wrong_is_counted():
    connection = Failing(0)
    connection.run(time.monotonic() + 0.05, 0.0)
    wrong, right = sum(connection.log.errors.values()), len(connection.log.times)
    assert set(connection.log.errors) == {"ConnectionResetError: gone"}
    assert wrong == (wrong + right) // 3 > 0
    assert connection.closed


def test_a_torque_that_is_not_the_expected_one_is_an_error():
    right = np.array([10.0, -1.0])
    connections._check_torque(right * (1 + 1e-12), right)
    for wrong in (right + np.array([1e-7, 0.0]), right * np.nan):
        with pytest.raises(connections.WrongAnswerError, match="differs"):
            connections._check_torque(wrong, right)


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


def test_writes_that_are_there_as_acknowledged_are_fine(counted):
    said = {"sha256": "a", "rows": 300}
    uploads = Log("upload", stored={"ds_1": said, "ds_2": said}, deleted={"ds_1"})
    teaching = Log("observe", acks={0: ack(0), 1: ack(1)})
    account = counted([uploads, teaching], [dataset("ds_2")], [batch(0), batch(1)])
    assert (account.batches, account.rows, account.datasets, account.deleted) == (2, 50, 2, 1)
    assert (account.lost, account.changed, account.surplus) == (0, 0, 0)


def test_every_write_that_is_not_as_acknowledged_is_found(counted):
    said = {"sha256": "a", "rows": 300}
    uploads = Log("upload", stored={"ds_1": said, "ds_2": said, "ds_3": said}, deleted={"ds_3"})
    teaching = Log("observe", acks={0: ack(0), 1: ack(1), 2: ack(2)})
    listed = [dataset("ds_2", sha256="b"), dataset("ds_3"), dataset("ds_9")]
    account = counted([uploads, teaching], listed, [batch(0), batch(0), batch(1, accepted=24)])
    assert account.lost == 2, "ds_1 and batch 2"
    assert account.changed == 2, "ds_2 and batch 1"
    assert account.surplus == 3, "ds_3 was deleted, ds_9 never sent, batch 0 is there twice"


def test_an_upload_without_an_answer_may_be_there(counted):
    assert counted([Log("upload", unsure=1)], [dataset("ds_1")]).surplus == 0
    assert counted([Log("upload", unsure=1)]).lost == 0


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


def test_promises_of_a_run_without_fault_are_kept():
    assert all(each.met is not False for each in table.targets(_results()))


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
    assert sum(each.met is False for each in table.targets(_results(**wrong))) == 1


def test_tables_say_what_went_wrong():
    found = _results()
    found.errors["predict"]["TimeoutError: too long"] = 3
    console = Console(width=140, record=True, quiet=False, file=open("/dev/null", "w"))  # noqa: SIM115
    for grid in table.grids(found):
        console.print(grid.rich())
    said = console.export_text()
    assert "TimeoutError: too long" in said
    assert "batches acknowledged" in said


@pytest.mark.slow
def test_a_run_measures_everything():
    fit = {"hyperparameter_samples": 40, "posterior_samples": 100, "max_iterations": 30, "starts": 1}
    found = running.run(Options(8, 12.0, robot="double-pendulum", fit=fit), Console(quiet=True))
    assert set(found.timings) == set(running.KINDS)
    assert found.failed == 0
    assert found.before.batches > 10
    assert found.before.datasets > 5
    assert [each.name for each in table.targets(found) if each.met is False and "memory" not in each.name] == []
