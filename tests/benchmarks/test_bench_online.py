"""`python -m benchmarks online`: parts against independent references, and a tiny run."""

import numpy as np
import pytest
from rich.console import Console

import lipcore
from benchmarks.latency import table as bench_table
from benchmarks.online import flow, table, targets
from benchmarks.online.fourier import FourierModel
from benchmarks.online.running import Options, run
from benchmarks.online.scene import Scene, rows_of
from benchmarks.online.sending import Ack
from lipcore import TorqueModel
from lipcore.robots.simulation import Payload, inverse_dynamics
from tests.service.data import QUICK

pytestmark = pytest.mark.slow

LOAD = Payload(1.5)
PENDULUM = Scene(robot="double-pendulum", seconds=2.0, change_at=1.0, payload=0.2, viscous=0.05, coulomb=0.02)


@pytest.fixture(scope="module")
def fitted() -> TorqueModel:
    history = PENDULUM.history(8.0, 10.0)
    return lipcore.train(history, PENDULUM.arm.joint_types, "se", lipcore.FitOptions(**QUICK))


# the scene


def test_live_stream_has_payload_and_growing_friction():
    scene = Scene(seconds=2.0, change_at=1.0, rate=50.0, noise=0.0, drift=0.5, payload=1.5, viscous=0.7, coulomb=0.4)
    live = scene.live()
    bodies = [inverse_dynamics(scene.arm, live.q, live.dq, live.ddq, *load) for load in ((), (np.ones(100), LOAD))]
    factor = 1 + 0.5 * live.t[:, None] / 2.0
    friction = factor * (0.7 * live.dq + 0.4 * np.sign(live.dq))
    expected = np.where(live.t[:, None] < 1.0, *bodies) + friction
    np.testing.assert_allclose(live.tau, expected, rtol=1e-9, atol=1e-9)
    later = scene.unseen(2.0)
    loaded = inverse_dynamics(scene.arm, later.q, later.dq, later.ddq, np.ones(len(later)), LOAD)
    np.testing.assert_allclose(later.tau, loaded + 1.5 * (0.7 * later.dq + 0.4 * np.sign(later.dq)), atol=1e-8)
    with pytest.raises(ValueError, match="change_at is 3 s"):
        Scene(seconds=2.0, change_at=3.0)


# the baselines


def test_recursive_least_squares_is_weighted_ridge_regression(fitted):
    rows = rows_of(PENDULUM.live()).take(slice(None, None, 5))  # 400 rows, 5 ms apart
    tau_s, features = 0.7, 40
    start = FourierModel.start(fitted, tau_s, features, seed=3)
    learnt = start
    for part in (slice(0, 130), slice(130, 131), slice(131, 400)):
        learnt = learnt.learn(rows.take(part))
    unseen = PENDULUM.unseen(2.0)
    mean, std = learnt.predict(unseen.q, unseen.dq, unseen.ddq)
    weight = np.exp(-(rows.time[-1] - rows.time) / tau_s)
    for joint in range(2):
        phi = _features(start, joint, rows.q, rows.dq, rows.ddq)
        scale = np.sqrt(weight) / fitted.noise_std[joint]
        stacked = np.vstack([scale[:, None] * phi, np.eye(phi.shape[1])])
        target = np.concatenate([scale * rows.tau[:, joint], np.zeros(phi.shape[1])])
        weights = np.linalg.lstsq(stacked, target, rcond=None)[0]
        asked = _features(start, joint, unseen.q, unseen.dq, unseen.ddq)
        np.testing.assert_allclose(mean[:, joint], asked @ weights, rtol=1e-6, atol=1e-8)
        variance = np.einsum("ij,jk,ik->i", asked, np.linalg.inv(stacked.T @ stacked), asked)
        np.testing.assert_allclose(std[:, joint], np.sqrt(variance), rtol=1e-6)


def _features(model: FourierModel, joint: int, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    angle = np.hstack([q, dq, ddq]) @ model.frequencies[joint]
    waves = [model.scales[joint] * each(angle) / np.sqrt(angle.shape[1]) for each in (np.cos, np.sin)]
    speed = dq[:, joint]
    friction = np.stack([speed, np.tanh(speed / 0.02), np.ones_like(speed)], axis=1) * model.friction[joint]
    return np.hstack([*waves, friction])


# flow


def _ack(acked: int, revision: int, accepted: int = 100) -> Ack:
    return Ack(0, acked - 5_000_000, acked, 100, accepted, revision, False, {"contact": 100 - accepted})


def test_lag_ends_with_the_first_answer_that_has_the_batch():
    second = 1_000_000_000
    acks = [_ack(1 * second, 3), _ack(2 * second, 4), _ack(3 * second, 5, accepted=0), _ack(4 * second, 9)]
    revisions = [(0, 0), (1.5 * second, 3), (4 * second, 7), (8 * second, 8)]
    # revision 9 was never seen, batch 5 has no accepted rows, batch 4 came with revision 7
    assert flow.lags(acks, revisions) == pytest.approx([0.5, 2.0])
    assert flow.lags([_ack(2 * second, 3)], revisions) == [0.0]


def tiny(websocket: bool) -> Options:
    lengths = {"history_s": 8.0, "idle_s": 0.2, "burst_s": 0.5, "refit_every": 1.0}
    return Options(scene=PENDULUM, fit=QUICK, after=(0.5, 1.0), sizes=(200, 400), websocket=websocket, **lengths)


@pytest.mark.parametrize("websocket", [False, True])
def test_a_run_measures_everything(websocket: bool):
    results = run(tiny(websocket), Console(quiet=True))
    assert list(results.methods) == ["none", "learn", "adapt", "refit", "fourier"]
    for method in results.methods.values():
        assert list(method.found) == ["before the change", "0.5 s after", "1 s after"]
        assert np.isfinite([each.nmse for each in method.found.values()]).all()
    for found, rows in ((results.live, 2000), (results.burst, 500)):
        assert found is not None
        assert found.rows == rows
        assert found.accepted + sum(found.rejected.values()) == rows
        assert found.accepted > 0
        assert found.lag is not None
    for asked in (results.idle, results.learning):
        assert asked is not None
        assert 0 < asked.answers.p50 <= asked.answers.p99
    assert results.learning is not None
    assert results.learning.revisions[-1][1] > results.learning.revisions[0][1]  # the model learnt meanwhile
    assert all(each.value is not None for each in targets.targets(results))
    assert "nan" not in bench_table.grids_markdown(table.grids(results), results.notes)
