"""Processes of the service killed at named points: what was acknowledged is there, nothing is half or twice."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from operator import attrgetter

import pytest

from tests.service.faults.points import FAULTS, FIRST_STARTS, POINTS, STARTS, TARGETS
from tests.service.faults.trial import Street, first_start_trial

ALWAYS = ("upload: file complete, no row",)
"""Points that every run of the tests looks at."""


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> Iterator[Street]:
    made = Street(tmp_path_factory.mktemp("faults"))
    yield made
    made.close()


@pytest.mark.parametrize(
    "point",
    [pytest.param(each, id=each.name, marks=[] if each.name in ALWAYS else [pytest.mark.slow]) for each in POINTS],
)
def test_what_was_acknowledged_is_there_and_nothing_is_half(street, point, record_property):
    record_property("outcome", street.trial(point))


@pytest.mark.slow
@pytest.mark.parametrize("fault", STARTS.values(), ids=STARTS)
def test_a_kill_while_the_service_starts_is_made_up_for_by_the_next_start(street, fault):
    street.start_trial(fault)


@pytest.mark.slow
@pytest.mark.parametrize("fault", FIRST_STARTS.values(), ids=FIRST_STARTS)
def test_a_kill_at_the_very_first_start_leaves_a_home_that_the_next_one_can_use(tmp_path, fault):
    first_start_trial(tmp_path, fault)


@pytest.mark.parametrize("function", sorted(TARGETS | {fault.within for fault in FAULTS if fault.within}))
def test_points_are_functions_that_there_are(function):
    module, _, path = function.partition(":")
    assert callable(attrgetter(path)(import_module(module)))


def test_every_point_has_a_name_of_its_own():
    assert len({point.name for point in POINTS}) == len(POINTS)
    assert set(ALWAYS) <= {point.name for point in POINTS}
