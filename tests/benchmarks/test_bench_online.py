"""`python -m benchmarks online`: its parts against independent references, and a tiny run from start to end."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

import lipcore
from benchmarks.command import app
from benchmarks.latency import table as bench_table
from benchmarks.online import fleet, flow, promises, quality, table
from benchmarks.online.asking import Asked
from benchmarks.online.cost import CHUNK, TIMED, Cost, update_costs
from benchmarks.online.flow import Flow
from benchmarks.online.fourier import FourierModel
from benchmarks.online.quality import Method, Moment, Quality
from benchmarks.online.results import Results
from benchmarks.online.running import Options, run
from benchmarks.online.scene import Scene, rows_of
from benchmarks.online.sending import Ack, batch_requests, stream
from benchmarks.timing import Timing
from lipcore import TorqueModel
from lipcore.robots.library import pinocchio
from tests.service.data import QUICK

PENDULUM = Scene(robot="double-pendulum", seconds=2.0, change_at=1.0, payload=0.2, viscous=0.05, coulomb=0.02)


@pytest.fixture(scope="module")
def model() -> TorqueModel:
    return _trained("lip-chain")


@pytest.fixture(scope="module")
def fitted() -> TorqueModel:
    return _trained("se")


def _trained(estimator: str) -> TorqueModel:
    history = PENDULUM.history(8.0, 10.0)
    return lipcore.train(history, PENDULUM.arm.joint_types, estimator, lipcore.FitOptions(**QUICK))


# the scene


def test_the_live_stream_is_rigid_bodies_with_a_payload_and_friction_that_grows():
    scene = Scene(seconds=2.0, change_at=1.0, rate=50.0, noise=0.0, drift=0.5, payload=1.5, viscous=0.7, coulomb=0.4)
    samples = scene.live()
    pin, robot = pinocchio(), scene.arm
    data = robot.model.createData()
    assert np.ptp(samples.q, axis=0) == pytest.approx(np.ones(7), rel=1e-6)  # ±0.5 rad, at 5 times the usual speed
    for row in (3, 49, 50, 77, 99):
        q, dq, ddq = samples.q[row], samples.dq[row], samples.ddq[row]
        expected = pin.rnea(robot.model, data, q, dq, ddq)
        if row >= 50:
            # the point mass as a force at a frame of the last link: Jᵀ m (acceleration − gravity)
            place = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.1]))
            last = robot.model.njoints - 1
            pin.computeJointJacobians(robot.model, data, q)
            pin.forwardKinematics(robot.model, data, q, dq, ddq)
            world = data.oMi[last] * place
            jacobian = pin.getJointJacobian(robot.model, data, last, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            arm = world.translation - data.oMi[last].translation
            velocity = pin.getVelocity(robot.model, data, last, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            acceleration = pin.getClassicalAcceleration(robot.model, data, last, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            spin, turning = velocity.angular, acceleration.angular
            at_mass = acceleration.linear + np.cross(turning, arm) + np.cross(spin, np.cross(spin, arm))
            force = 1.5 * (at_mass + np.array([0.0, 0.0, 9.81]))
            expected = expected + jacobian[:3].T @ force + jacobian[3:].T @ np.cross(arm, force)
        factor = 1 + 0.5 * samples.t[row] / 2.0
        expected = expected + factor * (0.7 * dq + 0.4 * np.sign(dq))
        np.testing.assert_allclose(samples.tau[row], expected, rtol=1e-9, atol=1e-9)


def test_the_unseen_trajectory_has_the_dynamics_of_its_moment_and_no_noise():
    scene = replace(PENDULUM, payload=0.5, drift=1.0)
    before, just_after, later = (scene.unseen(at) for at in (1.0, 1.0 + 1e-9, 2.0))
    np.testing.assert_array_equal(before.q, later.q)
    assert np.abs(just_after.tau - before.tau).max() > 0.1  # the payload
    friction = scene.viscous * later.dq + scene.coulomb * np.sign(later.dq)
    np.testing.assert_allclose(later.tau - just_after.tau, 0.5 * friction, atol=1e-8)  # factors 2.0 and 1.5
    noise = scene.measured(later) - later.tau
    assert noise.std() == pytest.approx(scene.noise, rel=0.1)


def test_parts_of_a_scene_are_told_apart_and_repeated_exactly():
    again, other = PENDULUM.live(), replace(PENDULUM, seed=1).live()
    np.testing.assert_array_equal(PENDULUM.live().tau, again.tau)
    assert np.abs(other.q - again.q).max() > 0.1
    history = PENDULUM.history(2.0, 1000.0)
    assert history.t[0] == pytest.approx(-2.0)
    assert history.t[-1] < 0
    assert np.abs(history.q - again.q).max() > 0.1
    assert np.abs(PENDULUM.more(2.0).q - again.q).max() > 0.1
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


def test_random_features_have_the_covariance_of_the_fitted_kernel(fitted):
    unseen = PENDULUM.unseen(0.0).rows(slice(0, 40))
    models = [FourierModel.start(fitted, None, features=4000, seed=seed) for seed in range(6)]
    params = {name: value.numpy() for name, value in fitted.posterior.params.items()}
    state = np.hstack([unseen.q, unseen.dq, unseen.ddq])
    for joint in range(2):
        drawn = [_features(model, joint, unseen.q, unseen.dq, unseen.ddq)[:, :-3] for model in models]
        scaled = state / np.exp(params["se.log_lengthscales"][joint])
        squares = ((scaled[:, None] - scaled[None]) ** 2).sum(2)
        expected = np.exp(params["se.log_scale"][joint]) * np.exp(-0.5 * squares)
        found = np.mean([phi @ phi.T for phi in drawn], axis=0)
        np.testing.assert_allclose(found, expected, atol=0.05 * expected.max())


def test_a_refit_sees_the_rows_since_the_change_and_no_more_than_its_limit(monkeypatch, model):
    seen = []

    def fake(samples, joint_types, fit):
        seen.append(samples)
        return model, 1.5

    monkeypatch.setattr(quality, "train", fake)
    scene, samples = replace(PENDULUM, seconds=12.0, change_at=6.0), PENDULUM.more(12.0)
    moments = [Moment("a", 5.0), Moment("b", 6.0), Moment("c", 6.5), Moment("d", 12.0)]
    found = quality.refitted(scene, samples, moments, {}, every=3.0, window=4.0)
    spans = [(part.t[0], part.t[-1]) for part in seen]
    assert spans == [pytest.approx((a, b), abs=0.01) for a, b in ((0.0, 3.0), (2.0, 6.0), (8.0, 12.0))]
    assert all(len(part) <= quality.REFIT_ROWS for part in seen)
    assert found.seconds == [1.5] * 3
    shorter = quality.refitted(scene, samples, [Moment("e", 9.0)], {}, every=3.0, window=30.0)
    assert seen[-1].t[0] == pytest.approx(6.0)  # since the change, though the window reaches further
    assert set(shorter.found) == {"e"}


def test_predictions_are_judged_against_torque_without_noise_and_intervals_with():
    unseen = PENDULUM.unseen(1.0)
    off = unseen.tau + 0.01
    found = quality.judge(PENDULUM, unseen, off, np.zeros_like(off), np.full(2, PENDULUM.noise))
    np.testing.assert_allclose(found.nmse, 1e-4 / unseen.tau.var(axis=0), rtol=1e-9)
    assert np.array(found.coverage) == pytest.approx(0.95, abs=0.03)


# fleet and cost


def test_merged_statistics_equal_training_on_all(monkeypatch, model):
    parts = PENDULUM.fleet(3, 50, 10.0)
    assert len({part.q[0, 0] for part in parts}) == 3
    queries = PENDULUM.unseen(0.0).motion()
    assert fleet.merged_difference(model, parts, queries) < 1e-9
    monkeypatch.setattr(fleet, "merge", lambda one, other: one)
    assert fleet.merged_difference(model, parts, queries) > 1e-4


def test_an_update_is_timed_after_each_number_of_samples(monkeypatch, model):
    rows = rows_of(PENDULUM.more(7.0))
    learnt = []
    real = lipcore.online.learner.OnlineModel.learn

    def learn(self, part):
        learnt.append((round(part.time[0] * 1000), len(part)))
        return real(self, part)

    monkeypatch.setattr("benchmarks.online.cost.OnlineModel.learn", learn)
    found = update_costs(model, rows, (200, 3000), 30.0)
    assert [cost.samples for cost in found] == [200, 3000]
    assert all(cost.learn > 0 and cost.solve > 0 for cost in found)
    starts = [start for start, _ in learnt]
    in_turn = [at for number in range(TIMED) for at in (200 + number * CHUNK, 3000 + number * CHUNK)]
    assert starts == [0, 200, 1200, 2200, *in_turn]  # every row once, in order; then both sizes side by side
    assert sum(count for _, count in learnt) == 3000 + 2 * TIMED * CHUNK
    with pytest.raises(ValueError, match="expected at least 8000"):
        update_costs(model, rows, (4000,), None)


# flow


class Service:
    """Acknowledges batches, as the service does."""

    def __init__(self) -> None:
        self.asked: list[dict] = []

    def ask(self, request: bytes) -> bytes:
        head, body = request.split(b"\r\n\r\n", 1)
        assert head.startswith(b"POST /v1/models/m/observations HTTP/1.1")
        said = json.loads(body)
        self.asked.append(said)
        answer = {"model": "m", "sequence": said["sequence"], "rows": len(said["t"]), "accepted": len(said["t"]) - 1}
        answer |= {"revision": 7 + said["sequence"], "duplicate": False, "rejected": {"contact": 1}, "state": "learnt"}
        return json.dumps(answer).encode()


def test_batches_hold_all_rows_in_order_and_are_sent_in_turn():
    samples, service, seen = PENDULUM.live().rows(slice(0, 250)), Service(), []
    requests = batch_requests("m", "bench", samples, 0.1)
    acks = stream(service, requests, 0.001, {2: lambda: seen.append(len(service.asked))})
    assert [ack.sequence for ack in acks] == [0, 1, 2]
    assert [(ack.rows, ack.accepted, ack.revision) for ack in acks] == [(100, 99, 7), (100, 99, 8), (50, 49, 9)]
    assert all(ack.acked >= ack.sent for ack in acks)
    assert seen == [2]
    assert {said["stream_id"] for said in service.asked} == {"bench"}
    np.testing.assert_allclose(_sent(service, "t"), 0.1 * samples.t)
    for name in ("q", "dq", "ddq", "tau"):
        np.testing.assert_array_equal(_sent(service, name), getattr(samples, name))


def _sent(service: Service, name: str) -> list:
    return list(chain.from_iterable(said[name] for said in service.asked))


def _ack(acked: int, revision: int, accepted: int = 100) -> Ack:
    return Ack(0, acked - 5_000_000, acked, 100, accepted, revision, False, {"contact": 100 - accepted})


def test_lag_reaches_to_the_first_answer_with_the_batch():
    second = 1_000_000_000
    acks = [_ack(1 * second, 3), _ack(2 * second, 4), _ack(3 * second, 5, accepted=0), _ack(4 * second, 9)]
    revisions = [(0, 0), (1.5 * second, 3), (4 * second, 7), (8 * second, 8)]
    # 9 was never seen; 5 teaches nothing; 4 came with revision 7
    assert flow.lags(acks, revisions) == pytest.approx([0.5, 2.0])
    assert flow.lags([_ack(2 * second, 3)], revisions) == [0.0]


# figures


def _timing(p50: float, p99: float) -> Timing:
    return Timing(1000, p50, p50, p99, 2 * p99, 3 * p99, 1e6 / p50)


def known() -> Results:
    names = ("before the change", "0.5 s after", "30 s after")

    def method(key: str, *nmse: float) -> Method:
        found = {n: Quality((v, 3 * v), (0.9, 0.8)) for n, v in zip(names, nmse, strict=True)}
        return Method(key, f"way {key}", found, [61.0] if key == "refit" else [])

    results = Results({"processor": "p"}, {"model": "m"}, joints=("j1", "j2"), moments=list(names))
    results.idle = Asked(_timing(100, 200), _timing(110, 220), _timing(50, 60), ((0, 0),))
    results.learning = Asked(_timing(150, 500), _timing(160, 550), _timing(55, 120), ((0, 0), (9, 4)))
    results.live = Flow(60_000, 58_000, {"contact": 2000}, 1000.4, 961.0, (20.0, 44.0, 60.0), (0.6, 1.2, 1.5), 0.7)
    results.burst = Flow(60_000, 60_000, {}, 4000.0, 1500.0, (20.0, 44.0, 60.0), None, 0.9)
    results.costs = [Cost(1000, 400.0, 90.0), Cost(10_000, 500.0, 91.0), Cost(100_000, 450.0, 92.0)]
    ways = (method("none", 1e-3, 0.1, 0.2), method("learn", 1e-3, 0.1, 0.04))
    ways += (method("adapt", 1e-3, 0.1, 0.0023), method("refit", 1e-3, 0.1, 0.002))
    results.methods = {each.key: each for each in ways}
    results.robots, results.merged = 10, 3e-12
    results.notes = ["a note"]
    return results


def test_promises_are_judged_by_their_figures():
    found = {each.name: each for each in promises.targets(known())}
    assert [each.value for each in found.values()] == pytest.approx([1500.0, 2.5, 25.0, 1.15, 20.0, 3e-12])
    assert [each.met for each in found.values()] == [True, True, False, True, None, True]
    results = known()
    results.methods["adapt"].found["30 s after"] = Quality((0.0025, 0.0075), (0.9, 0.8))
    results.learning = replace(known().learning, answers=_timing(150, 601))
    missed = {each.name for each in promises.targets(results) if each.met is False}
    assert missed == {
        "prediction p99 while learning / idle",
        "cost of a sample: the largest above the smallest",
        "nMSE 30 s after, adapting / full refit",
    }


def test_what_was_not_measured_is_not_claimed():
    empty = Results({}, {})
    assert all(each.value is None and each.met is None for each in promises.targets(empty))
    assert [grid.title for grid in table.grids(empty)] == ["promised and measured"]


def test_tables_hold_every_figure_and_fit_the_page(tmp_path):
    with open(os.devnull, "w") as nowhere:
        console = Console(width=300, record=True, file=nowhere)
        bench_table.show_grids(table.grids(known()), known().notes, console)
    printed = console.export_text()
    assert max(map(len, printed.splitlines())) <= bench_table.WIDTH
    written = bench_table.grids_markdown(table.grids(known()), known().notes)
    for text in ("NOT met", "2.50", "4.60e-03 (85 %)", "2.3e-03", "1,500", "0.60", "3.0e-12", "way refit", "a note"):
        assert text in printed
        assert text in written
    known().write(tmp_path / "found.json", [])
    assert (
        json.loads((tmp_path / "found.json").read_text())["methods"]["adapt"]["found"]["30 s after"]["nmse"][0]
        == 0.0023
    )


@pytest.mark.parametrize(
    ("command", "names"),
    [
        ("online", ("--seed", "--speed", "--quick", "--websocket", "--only", "--json", "--strict", "--forgetting")),
        ("durability", ("--trials", "--seed", "--json", "--strict")),
        ("latency", ("--runs", "--quick")),
    ],
)
def test_every_benchmark_explains_itself(command: str, names: tuple[str, ...]):
    said = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200", "NO_COLOR": "1"})
    assert said.exit_code == 0
    plain = re.sub(r"\x1b\[[0-9;]*m", "", said.output)
    for name in names:
        assert name in plain


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"only": ("speed",)}, "'speed'"),
        ({"after": (0.5, 31.0)}, "61 s of the stream"),
        ({"after": (0.55,)}, "no multiple of 0.1 s"),
    ],
)
def test_options_that_cannot_be_measured_are_refused(wrong, said):
    with pytest.raises(ValueError, match=said):
        Options(**wrong)


def tiny(websocket: bool = False, only: tuple[str, ...] = ()) -> Options:
    return Options(
        scene=PENDULUM,
        fit=QUICK,
        history_s=8.0,
        idle_s=0.2,
        burst_s=0.5,
        after=(0.5, 1.0),
        sizes=(200, 400),
        refit_every=1.0,
        websocket=websocket,
        only=only,
    )


@pytest.mark.slow
def test_a_run_measures_everything():
    results = run(tiny(), Console(quiet=True))
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
    assert results.learning.revisions[-1][1] > results.learning.revisions[0][1]  # it learnt while it answered
    assert all(each.value is not None for each in promises.targets(results))
    assert "nan" not in bench_table.grids_markdown(table.grids(results), results.notes)


@pytest.mark.slow
def test_the_live_stream_may_come_in_frames():
    results = run(tiny(websocket=True, only=("flow",)), Console(quiet=True))
    assert results.live is not None
    assert results.live.rows == 2000
    assert results.live.accepted + sum(results.live.rejected.values()) == 2000
    assert not results.methods
