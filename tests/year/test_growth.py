"""The checks of the year can fail: growth without a bound, lost batches and wrong counters are found."""

import sqlite3
from collections import Counter
from contextlib import closing

import pytest

from tests.year.ledger import DAY_S, AcknowledgedBatch, Ledger
from tests.year.sizes import find_growth, format_table

pytestmark = pytest.mark.journey
COLUMNS = "model, number, kind, stream_id, sequence, rows, void, received, payload"
METRICS = """# TYPE lipserve_observations_total counter
lipserve_observations_total{model="arm",outcome="learnt"} 490.0
lipserve_observations_total{model="arm",outcome="contact"} 10.0
lipserve_observations_total{model="arm",outcome="late"} 0.0
# TYPE lipserve_requests_total counter
lipserve_requests_total{method="GET",route="/health/ready",status="200"} 7.0
lipserve_requests_total{method="POST",route="/v1/models/{model}/observations",status="200"} 1.0
"""


@pytest.mark.parametrize(
    ("name", "values", "grows"),
    [
        ("rows in table alarms", range(0, 2000, 100), True),
        ("rows in table alarms", [100, 900, *([1000, 900] * 9)], False),
        ("memory of service and processes", [2**28 + 2**24 * place for place in range(20)], True),
        ("memory of service and processes", [2**28, *[2**29] * 19], False),
        ("memory of service and processes", [2**28, 2**28, 2**29, *[2**28] * 8, *[2**29] * 9], False),  # more processes
        ("rows in table deleted_models", range(0, 40, 2), False),
        ("rows in table deleted_models", range(0, 2000, 100), True),
        ("bytes of the log", range(0, 20_000_000, 1_000_000), True),
        ("bytes in table events", [0] * 11 + [2**24] * 9, True),
        ("bytes in table events", [2**22] * 19 + [2**24], False),  # by chance
    ],
)
def test_growth_is_found(name, values, grows):
    periods = [{name: float(value), "deleted models": 2.0 * k, "requests": 10.0 * k} for k, value in enumerate(values)]
    found = find_growth(periods)
    assert (len(found), all(each.startswith(name) for each in found)) == (int(grows), True)
    assert name in format_table(periods, range(1, len(periods) + 1))


def test_moves_of_aliases_may_reach_their_limit():
    name, limit = "rows in table alias_moves", 100
    models = {"rows in table aliases": 3.0, "rows in table serving": 2.0}
    for most, grows in ((limit, False), (limit + 100, True)):
        assert bool(find_growth([{name: most * part / 20, **models} for part in range(21)])) == grows


def test_wrong_counters_are_found():
    ledger = Ledger()
    ledger.life = Counter(
        {
            ("lipserve_observations_total", "arm", "learnt"): 490,
            ("lipserve_observations_total", "arm", "contact"): 10,
            ("lipserve_requests_total", "POST", "/v1/models/{model}/observations", "200"): 1,
        }
    )
    ledger.check_counters(METRICS)
    with pytest.raises(AssertionError, match="'learnt'"):
        ledger.check_counters(METRICS.replace("490", "980"))
    with pytest.raises(AssertionError, match="observations"):
        ledger.check_counters("\n".join(METRICS.splitlines()[:5]))


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("DELETE FROM events WHERE number = 9", r"\('arm', 's', 9\) of 86400 s is lost"),
        ("DELETE FROM events WHERE number = 1", None),  # older than the retention
        ("DELETE FROM events WHERE number = 2", r"\('arm', 's', 2\) of 691200 s is lost"),  # but a later one
        ("UPDATE events SET rows = 4 WHERE number = 9", r"\('arm', 's', 9\)"),
        ("UPDATE events SET void = 1 WHERE number = 9", r"\('arm', 's', 9\)"),
        ("UPDATE events SET sequence = 70 WHERE number = 9", r"\('arm', 's', 9\) of 86400 s is lost"),
        ("INSERT INTO events SELECT model, 11, kind, stream_id, 11, rows, void, received, payload FROM events "
         "WHERE number = 10", "unasked"),
    ],
)  # fmt: skip
def test_lost_batches_are_found(tmp_path, statement, message):
    ledger = Ledger()
    with closing(sqlite3.connect(tmp_path / "lipserve.sqlite3")) as database, database:
        database.execute(f"CREATE TABLE events ({COLUMNS})")
        for number in range(1, 11):
            values = ("arm", number, "batch", "s", number, 5, 0, 0.0, b"\0")
            database.execute(f"INSERT INTO events VALUES ({', '.join('?' * len(values))})", values)
            ledger.batches["arm", "s", number] = AcknowledgedBatch(5, number * DAY_S, 0.0)
        database.execute(statement)
    if message is None:
        assert ledger.check_home(tmp_path, 10 * DAY_S, 7 * DAY_S, 10**6) == 9
        return
    with pytest.raises(AssertionError, match=message):
        ledger.check_home(tmp_path, 10 * DAY_S, 7 * DAY_S, 10**6)
