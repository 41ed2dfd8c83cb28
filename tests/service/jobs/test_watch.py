"""When a training process is ended: judged from what its job's row says and from a clock, without any process."""

from __future__ import annotations

import pytest

from service.foundation.settings import Settings
from service.training import queue
from service.training.lifecycle import LINGER_S, Facts, Hand

SETTINGS = Settings(job_cancel_grace_s=1.0, job_heartbeat_s=60.0, job_start_s=120.0, max_job_s=1000.0)


def hand():
    return Hand("job_x", slot=None, future=None, since=100.0)


def facts(state="running", heartbeat="a", cancel=False):
    return Facts(state, heartbeat, cancel)


def verdict(given, clock):
    found = given.judge(SETTINGS, clock)
    return None if found is None else found.why


def test_a_process_may_take_its_time_to_start():
    given = hand()
    given.see(facts("queued", None), 150.0)
    assert verdict(given, 219.9) is None
    assert verdict(given, 220.0) == "not_started"


def test_signs_of_life_count_when_they_come_not_by_what_they_say():
    """The clocks of rows may be set, and machines sleep: only that the sign has changed matters."""
    given = hand()
    for beat in range(5):
        clock = 101.0 + 50 * beat
        given.see(facts(heartbeat=f"1970-01-01T00:00:0{beat}"), clock)
        assert verdict(given, clock + 49) is None
    given.see(facts(heartbeat="1970-01-01T00:00:04"), 340.0)
    assert verdict(given, 360.9) is None
    assert verdict(given, 361.0) == "silent"


def test_a_cancel_has_to_be_obeyed_from_when_it_was_first_seen():
    given = hand()
    given.see(facts(), 101.0)
    given.see(facts(heartbeat="b", cancel=True), 110.0)
    given.see(facts(heartbeat="c", cancel=True), 110.9)
    assert verdict(given, 110.99) is None
    assert verdict(given, 111.0) == "cancelled"


def test_a_cancel_is_within_two_seconds_for_every_setting():
    longest = max(item.le for item in Settings.model_fields["job_cancel_grace_s"].metadata if hasattr(item, "le"))
    assert longest + 2 * queue.WATCH_S < 2
    assert SETTINGS.job_cancel_grace_s <= longest


def test_a_wish_to_stop_before_the_process_has_begun_ends_nothing():
    """The row of such a job says that it is cancelled: there is nothing that the process would do."""
    given = hand()
    given.stop(101.0)
    assert verdict(given, 110.0) is None


def test_a_job_may_not_run_for_ever():
    given = hand()
    for clock in range(101, 1102, 50):
        given.see(facts(heartbeat=str(clock)), float(clock))
    assert verdict(given, 1100.9) is None
    assert verdict(given, 1101.0) == "too_long"


@pytest.mark.parametrize("state", ["succeeded", "failed", "cancelled"])
def test_a_process_that_does_not_go_on_after_its_job_is_ended(state):
    given = hand()
    given.see(facts(), 101.0)
    given.see(facts(state, cancel=True), 110.0)
    assert verdict(given, 110.0 + LINGER_S - 0.1) is None
    assert verdict(given, 110.0 + LINGER_S) == "lingering"
