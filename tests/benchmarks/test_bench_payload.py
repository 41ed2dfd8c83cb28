"""`python -m benchmarks online --only payload,rivals,quiet`: parts against independent references."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.online import rivals
from benchmarks.online.arms import PLACES, Arm, Case
from benchmarks.online.carried import Answers, Figure, Outcome
from benchmarks.online.pickup import Options
from benchmarks.online.pickup_table import case_row, summary
from benchmarks.online.quiet import FORCES, REACH, touches
from lipcore.robots.library import pinocchio
from lipcore.robots.simulation import Payload, inverse_dynamics

ARM = Arm("double-pendulum", "clean", 0)
CASE = Case("double-pendulum", "clean", 0.3, "centred", "slow", 1)
GOOD, BAD = Answers((0.1, 0.3), (0.9, 0.95), 0.2), Answers((1.0, 3.0), (0.1, 0.2), 1.0)


def test_stream_has_its_payload_between_pick_up_and_release():
    samples = ARM.live(replace(CASE, mass=2.0))
    motion, load = (samples.q, samples.dq, samples.ddq), Payload(2.0, 0.0, PLACES["centred"])
    free = inverse_dynamics(ARM.robot, *motion)
    full = inverse_dynamics(ARM.robot, *motion, np.ones(1000), load)
    expected = np.concatenate([free[:300], full[300:700], free[700:]])
    assert np.abs(samples.tau - expected).max() < 6 * 0.05
    assert np.abs(full - free).max() > 1.0


def test_contact_torque_is_the_slope_of_the_work_of_its_force():
    samples = ARM.moving(3.0, 1.0, 1, None)
    torque = touches(ARM.robot, samples, np.array([1.0]), np.random.default_rng(3))
    assert np.flatnonzero(np.abs(torque).sum(axis=1)).tolist() == list(range(100, 120))
    rng, pin, data = np.random.default_rng(3), pinocchio(), ARM.robot.model.createData()
    link, force = int(rng.integers(1, ARM.robot.model.njoints)), rng.standard_normal(3)
    force *= rng.uniform(*FORCES) / np.linalg.norm(force)
    point = rng.uniform(-REACH, REACH, 3)

    def work(q):
        pin.forwardKinematics(ARM.robot.model, data, ARM.robot.configuration(q))
        return force @ data.oMi[link].act(point)

    q, step = samples.q[105], 1e-6
    slope = [(work(q + step * unit) - work(q - step * unit)) / (2 * step) for unit in np.eye(2)]
    np.testing.assert_allclose(torque[105], slope, atol=1e-6)


def test_least_squares_around_the_urdf_learns_the_payload():
    unseen, live = ARM.unseen(CASE, True), ARM.live(CASE)
    parts = (live.rows(slice(300, 700)), live.rows(slice(300)))
    answers, nothing = (rivals._least_squares(ARM.robot, part, unseen) for part in parts)
    assert answers.mean < 0.01 < nothing.mean
    assert answers.lowest > 0.85


def test_missed_payloads_appear_in_rows_and_summary():
    seen = Outcome(CASE, BAD, GOOD, 0.1, 0.2, masses={0.1: Figure(0.3, 0.01), 0.5: Figure(0.4, 0.01)}, first=GOOD)
    seen.answers = dict.fromkeys((0.1, 0.5, 1.0, 3.0), GOOD)
    never = Outcome(CASE, BAD, GOOD, answers=dict(seen.answers), first=GOOD)
    row = case_row(seen)
    assert row[1:5] == ("0.1/0.2", "0.30±0.02", "0.40±0.02✗", "–")
    assert case_row(never)[1] == "never/never"
    assert row[7] == "2.0e+00 (1.0e+00) 10%"
    (summed,) = summary([seen, never])
    assert summed[:4] == ("clean, slow", "2", "inf | inf", "50%")
    assert "1/2" in summed
    with pytest.raises(ValueError, match="'wet' in --kinds"):
        Options(("payload",), kinds=("wet",))
