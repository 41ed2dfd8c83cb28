"""Tests of tracking a stream's payload: detection, removal, declaration, quiet streams and contacts."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from lipcore import load
from lipcore.kernels.drive.terms import SIGN_WIDTH
from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from lipcore.online.learner import OnlineModel
from lipcore.online.payload.held import TrackedPayload
from lipcore.online.payload.holding import PayloadTracker
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from tests import ROOT
from tests.lipcore.arm_oracles import as_rows
from tests.lipcore.stepping import run_to_end

RATE, UP_S, DOWN_S = 100.0, 20.0, 22.0


@pytest.fixture(scope="module")
def carrier():
    return Carrier(load(ROOT / "models" / "panda-sim"))


@cache
def simulate_panda(seed, mass, noise):
    """Return samples of a Panda that carries a mass off its last axis."""
    payload = Payload(mass, 0.0, (0.02, 0.02, 0.08)) if mass else None
    return simulate(load_robot("panda"), Simulation(2400, RATE, speed=5.0, noise=noise, payload=payload), seed)


def simulate_stream(seed, mass=0.0, noise=0.05, first=19.0, last=23.0):
    """Return rows of a Panda that carries a mass from UP_S to DOWN_S."""
    free, full = (simulate_panda(seed, each, noise) for each in (0.0, mass))
    carried = ((free.t >= UP_S) & (free.t < DOWN_S))[:, None]
    return between(as_rows(replace(free, tau=np.where(carried, full.tau, free.tau)), 0.0), first, last)


def between(rows, first, last=np.inf):
    return rows.take((rows.time >= first) & (rows.time < last))


def track_payload(carrier, rows, block=10, tracker=None):
    """Return time and tracker after each block."""
    tracker, out = tracker or PayloadTracker(7), []
    for first in range(0, len(rows), block):
        part = rows.take(slice(first, first + block))
        tracker = tracker.step(carrier, part)
        out.append((part.time[-1], tracker))
    return out


def last_tracker(*args, **kwargs):
    return track_payload(*args, **kwargs)[-1][1]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "mass"), [(300, 0.5), (301, 3.0)])
def test_payload_and_its_removal_are_noticed_quickly(carrier, seed, mass):
    trackers = track_payload(carrier, simulate_stream(seed, mass))
    held = {round(at, 2): tracker.held is not None for at, tracker in trackers}
    assert not any(value for at, value in held.items() if at < UP_S)
    assert all(value for at, value in held.items() if UP_S + 0.05 < at < DOWN_S)
    assert not any(value for at, value in held.items() if at > DOWN_S + 0.05)
    before_down = next(tracker for at, tracker in reversed(trackers) if at < DOWN_S)
    found, std = before_down.held.estimate.mass
    assert abs(found - mass) < 4 * std + 0.01 * mass
    assert before_down.since == pytest.approx(UP_S)
    assert before_down.state == "payload"
    assert sum(before_down.probabilities.values()) == pytest.approx(1.0)


def test_quiet_stream_has_no_payload(carrier):
    trackers = track_payload(carrier, simulate_stream(302, first=0.0))
    assert {tracker.state for _, tracker in trackers} == {"none"}
    assert all(tracker.held is None for _, tracker in trackers)


def test_payload_from_before_the_stream_is_noticed(carrier):
    trackers = track_payload(carrier, simulate_stream(303, 1.0, first=20.5))
    assert next(at for at, tracker in trackers if tracker.held is not None) < 20.5 + 0.7


def test_rows_before_a_payload_are_free_of_it(carrier):
    """The pick-up is within a cell."""
    held = last_tracker(carrier, simulate_stream(306, 2.0, first=19.02, last=20.5)).held
    assert held.before.time.max() < UP_S


@pytest.mark.parametrize(("first", "kept"), [(19.6, True), (20.1, False)])
def test_rows_before_a_payload_are_left_out_if_they_contradict_it(carrier, first, kept):
    rows = simulate_stream(307, 2.0)
    tracked = TrackedPayload.of_rows(carrier, between(rows, 20.5, 20.9), between(rows, first, first + 0.4))
    assert bool(len(tracked.before)) == kept
    mass, std = tracked.estimate.mass
    assert abs(mass - 2.0) < 2 * std


def test_push_on_one_joint_is_a_contact(carrier):
    rows = simulate_stream(304)
    pushed = (rows.time >= UP_S) & (rows.time < UP_S + 0.2)
    push = np.outer(pushed, [6.0, *[0.0] * 6])  # about a vertical axis, on which weight does nothing
    trackers = track_payload(carrier, replace(rows, tau=rows.tau + push))
    assert all(tracker.held is None for _, tracker in trackers)
    assert "contact" in {tracker.state for _, tracker in trackers}


def test_friction_that_grows_with_the_payload_has_not_changed(carrier):
    """The arm's friction is a tenth of the payload's torque larger, which its training does not know."""
    free, full = (simulate_panda(301, mass, 0.05) for mass in (0.0, 1.5))
    weight = full.tau - free.tau
    rubbing = 0.1 * np.abs(weight) * np.tanh(free.dq / SIGN_WIDTH)
    tau = free.tau + (free.t >= 14.0)[:, None] * (weight + rubbing)
    trackers = track_payload(carrier, between(as_rows(replace(free, tau=tau), 0.0), 13.0, 20.0))
    assert {tracker.state for at, tracker in trackers if at > 15.0} == {"payload"}
    mass, std = trackers[-1][1].held.estimate.mass
    assert abs(mass - 1.5) < 1.96 * std


@pytest.mark.slow
def test_small_payload_must_last_unlike_a_push(carrier):
    carried, free = simulate_stream(305, 0.1), simulate_stream(305)
    held = {round(at, 2): tracker.held for at, tracker in track_payload(carrier, carried)}
    taken = min(at for at, each in held.items() if each is not None)
    assert UP_S + 0.2 < taken < UP_S + 0.45
    mass, std = next(each for at, each in reversed(held.items()) if at < DOWN_S).estimate.mass
    assert abs(mass - 0.1) < 4 * std
    for begin in (20.0, 20.8, 21.5):  # the weight of the same mass, for 0.2 s each
        during = ((carried.time >= begin) & (carried.time < begin + 0.2))[:, None]
        pushed = replace(free, tau=np.where(during, carried.tau, free.tau))
        assert all(tracker.held is None for _, tracker in track_payload(carrier, pushed))


@pytest.mark.slow
def test_batch_size_does_not_change_detection(carrier):
    rows = simulate_stream(300, 1.0, last=21.0)
    masses = [last_tracker(carrier, rows, block).held.estimate.mass[0] for block in (3, 10, 77, len(rows))]
    np.testing.assert_allclose(masses, 1.0, atol=0.02)


def test_repeated_rows_and_gaps_are_skipped(carrier):
    rows = simulate_stream(300, 1.0, last=21.0)
    tracker = PayloadTracker(7).step(carrier, rows)
    assert tracker.step(carrier, rows).held.count == tracker.held.count
    later = rows.take(slice(50, 60))
    assert len(tracker.step(carrier, replace(later, time=later.time + 100.0)).cells) <= 2


def test_declared_payload_is_used_until_rows_overrule_it(carrier):
    right = PayloadTracker(7).declare(carrier, Body(1.0, np.array([0.0, 0.04, 0.08])), UP_S)
    assert right.held.declared
    np.testing.assert_allclose(right.load.payload[:1], 1.0)
    wrong = PayloadTracker(7).declare(carrier, Body(3.0, np.array([0.0, 0.0, 0.1])), UP_S)
    wrong = last_tracker(carrier, simulate_stream(305, 1.0, first=UP_S, last=21.9), tracker=wrong)
    assert wrong.held.estimate.mass[0] == pytest.approx(1.0, abs=0.05)
    assert not wrong.held.declared
    assert wrong.put_down(30.0).load is None


def test_payload_is_restored_from_its_report(carrier):
    tracker = last_tracker(carrier, simulate_stream(300, 1.0, last=21.0))
    again = PayloadTracker.from_json(tracker.to_json(), 7, carrier)
    assert (again.state, again.since, again.held.count) == (tracker.state, tracker.since, tracker.held.count)
    np.testing.assert_allclose(again.load.payload, tracker.load.payload)
    np.testing.assert_allclose(again.held.estimate.covariance, tracker.held.estimate.covariance)
    for restore in (PayloadTracker.from_json, PayloadTracker.from_other_version):
        nothing = restore(PayloadTracker(7).put_down(3.0).to_json(), 7, carrier)
        assert (nothing.held, nothing.since) == (None, 3.0)


def test_another_revision_keeps_the_payload(carrier):
    tracker, online = last_tracker(carrier, simulate_stream(300, 1.0, last=21.0)), OnlineModel.start(carrier.model)
    other = Carrier(online.learn(simulate_stream(306, first=0.0, last=2.0)).model())
    few = simulate_stream(300, 1.0, first=21.0, last=21.03)
    found = tracker.step(other, few).held.estimate
    assert found is not tracker.held.estimate
    assert found.mass[0] == pytest.approx(tracker.held.estimate.mass[0], abs=0.01)
    # a revision that has learnt nothing new gives the same estimate
    kept = tracker.step(Carrier(online.model()), few)
    floor = Carrier(online.model(np.full(7, 0.1)))
    assert kept.step(floor, simulate_stream(300, 1.0, first=21.03, last=21.04)).held.estimate is kept.held.estimate


@pytest.mark.parametrize("seed", range(4))
def test_payload_is_noticed_despite_uneven_rows(carrier, seed):
    rng, rows = np.random.default_rng(seed), simulate_stream(300, 1.5, noise=0.01, last=20.6)
    late = np.where(rng.random(len(rows)) < 0.3, rng.exponential(0.005, len(rows)), 0.0)
    time = np.maximum.accumulate(rows.time + late) + 1e-5 * np.arange(len(rows))
    rows = replace(rows, time=time).take(slice(seed, None))
    found = next(at for at, tracker in track_payload(carrier, rows, block=3) if tracker.held is not None)
    assert UP_S < found < UP_S + 0.25


def refine_payload(tracker):
    return run_to_end(tracker.refinement())


@pytest.mark.slow
def test_refined_estimate_stays_until_the_next_refinement(carrier):
    rows = simulate_stream(300, 1.0, last=21.9)
    first = last_tracker(carrier, between(rows, 0.0, UP_S + 0.2))
    found = refine_payload(first)
    later = between(rows, UP_S + 0.2, UP_S + 0.25)
    second = first.step(carrier, later).refined(found)
    assert second.held.estimate is found.estimate
    assert second.held.count == first.held.count + len(later)
    explored = second.refined(refine_payload(second))  # draws that rows have ruled out start again
    assert explored.refinement() is None
    last = explored.step(carrier, between(rows, UP_S + 0.25))
    assert last.held.estimate is not explored.held.estimate  # estimated again meanwhile
    assert last.held.estimate.draws is explored.held.estimate.draws
    late = last.refined(found).held.estimate  # from many fewer rows
    assert late.load is last.held.estimate.load
    assert late.draws is found.estimate.draws
    assert refine_payload(last).estimate.mass[0] == pytest.approx(1.0, abs=0.02)
    assert last.put_down(30.0)._relinearise(carrier).refined(found).held is None
    other = last.declare(carrier, Body(1.0, np.array([0.0, 0.04, 0.08])), UP_S)._relinearise(carrier)
    assert other.refined(found).held is other.held
    assert other.refinement() is None  # no rows were seen with it


def test_outline_continues_like_the_tracker(carrier):
    rows = simulate_stream(300, 1.0, last=21.9)
    tracker = last_tracker(carrier, between(rows, 0.0, UP_S + 0.5))
    outline = tracker.outline()
    assert len(outline.held.rows) == 0
    for start in (tracker, outline):
        mass, std = last_tracker(carrier, between(rows, UP_S + 0.5), tracker=start).held.estimate.mass
        assert abs(mass - 1.0) < 4 * std + 0.005
        assert std < 0.03


def test_payload_carries_over_to_another_version(carrier):
    rows = simulate_stream(300, 1.5, last=21.9)
    noticed = last_tracker(carrier, between(rows, 0.0, UP_S + 0.5))
    tracker = PayloadTracker.from_other_version(noticed.to_json(), 7, carrier)
    assert (tracker.state, tracker.since, tracker.held.declared) == ("payload", noticed.since, False)
    mass, std = tracker.held.estimate.mass
    assert mass == pytest.approx(1.5, abs=0.02)
    assert 0.03 < std < 0.1
    later = between(rows, UP_S + 0.5)
    vague, exact = (
        carrier.with_payload(each.load).predict(later.q, later.dq, later.ddq) for each in (tracker, noticed)
    )
    assert (vague.tau_std.max(0) > 5 * exact.tau_std.max(0)).any()
    assert (np.abs(vague.tau - later.tau) < 1.96 * np.sqrt(vague.tau_std**2 + vague.noise_std**2)).mean() > 0.9
    assert last_tracker(carrier, later, tracker=tracker).held.estimate.mass[1] < 0.03


@pytest.mark.slow
def test_state_changes_at_most_once_a_second(carrier):
    """Knocks of 0.15 s hit another joint every 0.4 s, and no payload explains them."""
    rows = simulate_stream(6, first=2.0, last=12.0)
    knock, tau = (rows.time / 0.4).astype(int), rows.tau.copy()
    hit = rows.time % 0.4 < 0.15
    tau[hit, knock[hit] % 7] += np.where(knock[hit] % 2, 20.0, -20.0)
    trackers = [tracker for _, tracker in track_payload(carrier, replace(rows, tau=tau))]
    changes = [0.1 * place for place, (one, other) in enumerate(pairwise(trackers), 1) if one.state != other.state]
    assert "contact" in {tracker.state for tracker in trackers}
    assert trackers[-1].held is None
    assert min(np.diff(changes), default=1.0) >= 0.99
