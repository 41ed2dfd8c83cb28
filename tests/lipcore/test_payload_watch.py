"""A stream's payload followed row by row: noticed, put down, declared; quiet streams and contacts are none."""

from pathlib import Path

import numpy as np
import pytest

import lipcore
from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.online.payload.holding import PayloadTracker
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from tests.lipcore.stepping import finished

SHIPPED = Path(__file__).parents[2] / "models" / "panda-sim"
RATE, UP, DOWN = 100.0, 20.0, 22.0


@pytest.fixture(scope="module")
def carrier():
    return Carrier(lipcore.load(SHIPPED))


def stream(seed, mass=0.0, noise=0.05, first=19.0, last=23.0):
    """Rows of a Panda that carries a mass from UP to DOWN, off its last axis."""
    robot, asked = load_robot("panda"), Simulation(2400, RATE, speed=5.0, noise=noise)
    free = simulate(robot, asked, seed)
    full = simulate(
        robot, Simulation(2400, RATE, speed=5.0, noise=noise, payload=Payload(mass, 0.0, (0.02, 0.02, 0.08))), seed
    )
    carried = ((free.t >= UP) & (free.t < DOWN))[:, None] if mass else np.zeros((len(free), 1), bool)
    tau = np.where(carried, full.tau, free.tau)
    rows = Rows(free.t, free.q, free.dq, free.ddq, tau, np.zeros(len(free), np.uint8))
    return rows.take((rows.time >= first) & (rows.time < last))


def followed(carrier, rows, block=10):
    """The watches after each block."""
    watch, out = PayloadTracker(7), []
    for first in range(0, len(rows), block):
        watch = watch.step(carrier, rows.take(slice(first, first + block)))
        out.append((rows.time[min(first + block, len(rows)) - 1], watch))
    return out


@pytest.mark.parametrize(("seed", "mass"), [(300, 0.5), (301, 3.0)])
def test_a_payload_is_noticed_within_a_tenth_of_a_second_and_so_is_that_it_is_gone(carrier, seed, mass):
    watches = followed(carrier, stream(seed, mass))
    held = {round(at, 2): watch.held is not None for at, watch in watches}
    assert not any(value for at, value in held.items() if at < UP)
    assert all(value for at, value in held.items() if UP + 0.05 < at < DOWN)
    assert not any(value for at, value in held.items() if at > DOWN + 0.05)
    before_down = next(watch for at, watch in reversed(watches) if at < DOWN)
    found, std = before_down.held.estimate.mass
    assert abs(found - mass) < 4 * std + 0.01 * mass
    assert before_down.since == pytest.approx(UP)
    assert before_down.state == "payload"
    assert sum(before_down.probabilities.values()) == pytest.approx(1.0)


def test_a_quiet_stream_carries_nothing(carrier):
    watches = followed(carrier, stream(302, first=0.0))
    assert {watch.state for _, watch in watches} == {"none"}
    assert all(watch.held is None for _, watch in watches)


def test_a_payload_from_before_the_first_row_is_noticed_too(carrier):
    watches = followed(carrier, stream(303, 1.0, first=20.5))
    found = next(at for at, watch in watches if watch.held is not None)
    assert found < 20.5 + 0.7


def test_a_push_on_one_joint_is_a_contact_and_no_payload(carrier):
    rows = stream(304)
    tau = rows.tau.copy()
    pushed = (rows.time >= UP) & (rows.time < UP + 0.2)
    tau[pushed, 0] += 6.0  # about a vertical axis, on which weight does nothing
    rows = Rows(rows.time, rows.q, rows.dq, rows.ddq, tau, rows.code)
    watches = followed(carrier, rows)
    assert all(watch.held is None for _, watch in watches)
    assert "contact" in {watch.state for _, watch in watches}


def test_a_small_payload_has_to_last_as_a_short_push_looks_like_one(carrier):
    held = {round(at, 2): watch.held for at, watch in followed(carrier, stream(305, 0.1))}
    taken = min(at for at, each in held.items() if each is not None)
    assert UP + 0.2 < taken < UP + 0.45
    mass, std = next(each for at, each in reversed(held.items()) if at < DOWN).estimate.mass
    assert abs(mass - 0.1) < 4 * std
    for begin in (20.0, 20.8, 21.5):  # the weight of the same mass, for a fifth of a second each
        carried, free = stream(305, 0.1), stream(305)
        during = ((carried.time >= begin) & (carried.time < begin + 0.2))[:, None]
        tau = np.where(during, carried.tau, free.tau)
        pushed = Rows(free.time, free.q, free.dq, free.ddq, tau, free.code)
        assert all(watch.held is None for _, watch in followed(carrier, pushed))


def test_batches_of_any_size_notice_the_same(carrier):
    rows = stream(300, 1.0, last=21.0)
    masses = [followed(carrier, rows, block)[-1][1].held.estimate.mass[0] for block in (3, 10, 77, len(rows))]
    np.testing.assert_allclose(masses, 1.0, atol=0.02)


def test_rows_that_came_before_and_a_gap_are_passed_over(carrier):
    rows = stream(300, 1.0, last=21.0)
    watch = PayloadTracker(7).step(carrier, rows)
    again = watch.step(carrier, rows)
    assert again.held.count == watch.held.count
    later = rows.take(slice(50, 60))
    later = Rows(later.time + 100.0, later.q, later.dq, later.ddq, later.tau, later.code)
    assert len(watch.step(carrier, later).cells) <= 2


def test_a_declared_payload_answers_at_once_and_rows_overrule_it(carrier):
    rows = stream(305, 1.0, last=21.9)
    carried = rows.take(rows.time >= UP)
    right = PayloadTracker(7).declare(carrier, Body(1.0, np.array([0.0, 0.04, 0.08])), UP)
    assert right.held.declared
    np.testing.assert_allclose(right.load.payload[:1], 1.0)
    wrong = PayloadTracker(7).declare(carrier, Body(3.0, np.array([0.0, 0.0, 0.1])), UP)
    for block in range(0, len(carried), 10):
        wrong = wrong.step(carrier, carried.take(slice(block, block + 10)))
    assert wrong.held.estimate.mass[0] == pytest.approx(1.0, abs=0.05)
    assert not wrong.held.declared
    assert wrong.put_down(30.0).load is None


def test_what_a_report_says_of_a_payload_is_taken_up_again(carrier):
    watch = followed(carrier, stream(300, 1.0, last=21.0))[-1][1]
    again = PayloadTracker.from_json(watch.to_json(), 7, carrier)
    assert (again.state, again.since, again.held.count) == (watch.state, watch.since, watch.held.count)
    np.testing.assert_allclose(again.load.payload, watch.load.payload)
    np.testing.assert_allclose(again.held.estimate.covariance, watch.held.estimate.covariance)
    nothing = PayloadTracker.from_json(PayloadTracker(7).put_down(3.0).to_json(), 7, carrier)
    assert (nothing.held, nothing.since) == (None, 3.0)


def test_another_revision_of_the_model_sees_the_same_payload(carrier):
    watch = followed(carrier, stream(300, 1.0, last=21.0))[-1][1]
    online = OnlineModel.start(carrier.model).learn(stream(306, first=0.0, last=2.0))
    other = Carrier(online.model())
    few = stream(300, 1.0, first=21.0, last=21.03)
    found = watch.step(other, few).held.estimate
    assert found is not watch.held.estimate
    assert found.mass[0] == pytest.approx(watch.held.estimate.mass[0], abs=0.01)
    # one that knows nothing more, but for past errors, has no other opinion
    same = Carrier(OnlineModel.start(carrier.model).model())
    kept = watch.step(same, few)
    floor = Carrier(OnlineModel.start(carrier.model).model(np.full(7, 0.1)))
    assert kept.step(floor, stream(300, 1.0, first=21.03, last=21.04)).held.estimate is kept.held.estimate


@pytest.mark.parametrize("seed", range(4))
def test_a_payload_is_noticed_wherever_in_a_cell_and_however_unevenly_its_rows_come(carrier, seed):
    rng, rows = np.random.default_rng(seed), stream(300, 1.5, noise=0.01, last=20.6)
    late = np.where(rng.random(len(rows)) < 0.3, rng.exponential(0.005, len(rows)), 0.0)
    time = np.maximum.accumulate(rows.time + late) + 1e-5 * np.arange(len(rows))
    rows = Rows(time, rows.q, rows.dq, rows.ddq, rows.tau, rows.code).take(slice(seed, None))
    found = next(at for at, watch in followed(carrier, rows, block=3) if watch.held is not None)
    assert UP < found < UP + 0.25


def refined(watch):
    return finished(watch.refinement())


def test_what_is_refined_stays_until_more_rows_are_refined(carrier):
    rows = stream(300, 1.0, last=21.9)
    first = followed(carrier, rows.take(rows.time < UP + 0.2))[-1][1]
    found = refined(first)
    later = rows.take((rows.time >= UP + 0.2) & (rows.time < UP + 0.25))
    second = first.step(carrier, later).refined(found)
    assert second.held.estimate is found.estimate
    assert second.held.count == first.held.count + len(later)
    explored = second.refined(refined(second))  # draws that rows have ruled out begin again
    assert explored.refinement() is None
    last = explored.step(carrier, rows.take(rows.time >= UP + 0.25))
    assert last.held.estimate is not explored.held.estimate  # it is estimated again meanwhile
    assert last.held.estimate.draws is explored.held.estimate.draws
    late = last.refined(found).held.estimate  # from many fewer rows
    assert late.load is last.held.estimate.load
    assert late.draws is found.estimate.draws
    assert refined(last).estimate.mass[0] == pytest.approx(1.0, abs=0.02)
    assert last.put_down(30.0)._relinearise(carrier).refined(found).held is None
    other = last.declare(carrier, Body(1.0, np.array([0.0, 0.04, 0.08])), UP)._relinearise(carrier)
    assert other.refined(found).held is other.held
    assert other.refinement() is None  # nothing was seen with it


def test_an_outline_goes_on_as_the_watch_does(carrier):
    rows = stream(300, 1.0, last=21.9)
    watch = followed(carrier, rows.take(rows.time < UP + 0.5))[-1][1]
    outline = watch.outline()
    assert len(outline.held.rows) == 0
    more = rows.take(rows.time >= UP + 0.5)
    for block in range(0, len(more), 10):
        part = more.take(slice(block, block + 10))
        watch, outline = watch.step(carrier, part), outline.step(carrier, part)
    for each in (watch, outline):
        mass, std = each.held.estimate.mass
        assert abs(mass - 1.0) < 4 * std + 0.005
        assert std < 0.03


def test_what_one_version_has_noticed_another_takes_for_about_there(carrier):
    rows = stream(300, 1.5, last=21.9)
    noticed = followed(carrier, rows.take(rows.time < UP + 0.5))[-1][1]
    watch = PayloadTracker.from_other_version(noticed.to_json(), 7, carrier)
    assert (watch.state, watch.since, watch.held.declared) == ("payload", noticed.since, False)
    mass, std = watch.held.estimate.mass
    assert mass == pytest.approx(1.5, abs=0.02)
    assert 0.03 < std < 0.1
    asked = rows.take(rows.time >= UP + 0.5)
    vague, exact = (carrier.with_payload(each.load).predict(asked.q, asked.dq, asked.ddq) for each in (watch, noticed))
    assert (vague.tau_std.max(0) > 5 * exact.tau_std.max(0)).any()
    assert (np.abs(vague.tau - asked.tau) < 1.96 * np.sqrt(vague.tau_std**2 + vague.noise_std**2)).mean() > 0.9
    for block in range(0, len(asked), 10):
        watch = watch.step(carrier, asked.take(slice(block, block + 10)))
    assert watch.held.estimate.mass[1] < 0.03
    nothing = PayloadTracker.from_other_version(PayloadTracker(7).put_down(3.0).to_json(), 7, carrier)
    assert (nothing.held, nothing.since) == (None, 3.0)


def test_the_state_changes_at_most_once_a_second_whatever_knocks(carrier):
    """A knock of 0.15 s on another joint every 0.4 s, none of which a payload explains."""
    rows = stream(6, first=2.0, last=12.0)
    knock, tau = (rows.time / 0.4).astype(int), rows.tau.copy()
    hit = rows.time % 0.4 < 0.15
    tau[hit, knock[hit] % 7] += np.where(knock[hit] % 2, 20.0, -20.0)
    knocked = Rows(rows.time, rows.q, rows.dq, rows.ddq, tau, rows.code)
    watch, states = PayloadTracker(7), []
    for first in range(0, len(knocked), 10):
        watch = watch.step(carrier, knocked.take(slice(first, first + 10)))
        states.append(watch.state)
    changes = [0.1 * place for place in range(1, len(states)) if states[place] != states[place - 1]]
    assert "contact" in states
    assert watch.held is None
    assert min(np.diff(changes), default=1.0) >= 0.99
