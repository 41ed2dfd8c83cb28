"""Alarms are kept with their evidence and listed newest first, for each model."""

from __future__ import annotations

from service.learning import owner
from service.web.rows import Page
from tests.service.learning.batches import MODEL, OTHER, opened


def test_alarms_are_listed_newest_first_for_each_model(home):
    database = opened(home)
    with database.transaction() as session:
        for count, kind in enumerate(("change", "novelty", "refresh")):
            owner.raise_alarm(session, MODEL, kind, f"said {count}", {"joints": [count], "share": 0.5})
        owner.raise_alarm(session, OTHER, "promotion", "of another", {})

    def listed(after):
        with database.session() as session:
            rows, cursor = owner.alarms(session, MODEL, Page(after=after, limit=2))
        return [(row.kind, row.message, row.evidence["joints"]) for row in rows], cursor

    first, cursor = listed(None)
    assert first == [("refresh", "said 2", [2]), ("novelty", "said 1", [1])]
    assert listed(int(cursor)) == ([("change", "said 0", [0])], None)
    database.close()


def test_an_alarm_goes_where_its_transaction_fails(home):
    database = opened(home)
    try:
        with database.transaction() as session:
            assert owner.raise_alarm(session, MODEL, "change", "not so", {}).seq
            raise InterruptedError
    except InterruptedError:
        pass
    with database.session() as session:
        assert owner.alarms(session, MODEL, Page(after=None, limit=10)) == ([], None)
    database.close()
