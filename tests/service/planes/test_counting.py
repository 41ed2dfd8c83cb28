"""The data plane counts the connections of the control plane: reported, passed on since, and shed."""

import asyncio

import pytest

from service.api.server.connection_limit import ConnectionLimit
from service.foundation.settings import Settings
from service.planes.counting import AdoptedConnections, ConnectionReport, ConnectionShed, PassedConnections

A, B = "192.0.2.1", "192.0.2.2"
pytestmark = pytest.mark.anyio


class Connection:
    """An idle connection of a client."""

    def __init__(self, peer, present):
        self.peer, self.dropped = peer, False
        self._present = present
        present.add(self)

    def drop(self):
        self.dropped = True
        self._present.discard(self)


def counts(passed):
    return [passed.count(peer) for peer in (None, A, B)]


async def test_connections_since_the_last_report_are_added():
    passed = PassedConnections(lambda message: True)
    numbers = [passed.number(peer) for peer in (A, A, B, None)]
    assert counts(passed) == [4, 2, 1]
    passed.update(ConnectionReport(numbers[1], {A: 2}))
    assert counts(passed) == [4, 2, 1]
    passed.update(ConnectionReport(numbers[2], {B: 1, None: 3}))  # those of A have ended
    assert counts(passed) == [5, 0, 1]
    passed.forget(numbers[3])
    assert counts(passed) == [4, 0, 1]
    passed.clear()
    assert counts(passed) == [0, 0, 0]


async def test_report_says_what_has_changed():
    present, reports = set(), []
    adopted = AdoptedConnections(ConnectionLimit(Settings()), present, reports.append)
    adopted.report_now()
    first, _ = Connection(A, present), Connection(None, present)
    adopted.through = 2
    for _ in range(2):
        adopted.report_now()
    first.drop()
    adopted.report_now()
    assert reports == [ConnectionReport(2, {A: 1, None: 1}), ConnectionReport(2, {None: 1})]


async def test_idle_connection_of_the_other_process_makes_room():
    present, limit = set(), ConnectionLimit(Settings())
    adopted = AdoptedConnections(limit, present, lambda report: None)
    connections = [Connection(peer, present) for peer in (A, B, B)]
    for each in connections:
        limit.adopt(each)
    loop = asyncio.get_running_loop()

    def send(asked):
        loop.call_soon(lambda: passed.receive(adopted.shed(asked)))
        return True

    passed = PassedConnections(send)
    assert not await passed.shed(None)  # nothing to close
    passed.update(ConnectionReport(0, {A: 1, B: 2}))
    assert await passed.shed(B)
    assert [each.dropped for each in connections] == [False, True, False]
    limit.mark_busy(connections[0])
    assert not await passed.shed(A)
    assert await passed.shed(None)
    assert [each.dropped for each in connections] == [False, True, True]


@pytest.mark.parametrize(("ends", "room"), [(True, True), (False, False)])
async def test_control_plane_that_does_not_answer_makes_room_only_by_its_end(ends, room, monkeypatch):
    monkeypatch.setattr("service.planes.counting.MAX_SHED_S", 10.0 if ends else 0.01)
    passed = PassedConnections(lambda message: True)
    passed.update(ConnectionReport(0, {A: 1}))
    shedding = asyncio.ensure_future(passed.shed(A))
    await asyncio.sleep(0)
    if ends:
        passed.clear()
    assert await shedding is room
    passed.receive(ConnectionShed(1, done=True))  # too late: ignored
