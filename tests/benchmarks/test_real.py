"""`python -m benchmarks real` on simulated arms: other methods, splits, cached cells and targets."""

import io
from dataclasses import replace
from functools import partial
from unittest.mock import Mock

import numpy as np
import pytest
from rich.console import Console

from benchmarks.real import figaroh_fit, mujoco_forward, mujoco_sysid, report, rivals, running
from benchmarks.real.cells import PRODUCT, Cache, Cell, Result, evaluate_forecast
from benchmarks.real.peers import count_lines
from benchmarks.real.product import open_bed
from benchmarks.real.recordings import Recording
from benchmarks.real.rivals import Forecast
from benchmarks.real.splits import GUARD_S, MAX_TEST_ROWS, SECONDS, Split, elapsed, splits
from lipcore.data.samples import Samples
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, inverse_dynamics, simulate
from lipcore.robots.urdf import RigidBody
from lipserve.asking import Reading
from service.cli.simulate import write_recording

PENDULUM = Recording("pendulum", robot="double-pendulum")


def simulated(robot="double-pendulum", seed=1, samples=300, **stream):
    return simulate(load_robot(robot), Simulation(samples, 20.0, 10, speed=5.0, **stream), seed)


def still(seconds, rate=100.0, episode=0):
    """Return samples of one joint whose position is the number of the row."""
    rows = round(seconds * rate)
    column = np.arange(rows, dtype=float)[:, None]
    return Samples(("a",), column[:, 0] / rate, np.full(rows, episode), column, column, column, column)


def nmse(forecast, samples):
    """Return nMSE against the torque without noise."""
    robot = load_robot("double-pendulum")
    true = inverse_dynamics(robot, samples.q, samples.dq, samples.ddq)
    return np.mean((forecast.mean - true) ** 2, axis=0) / true.var(axis=0)


@pytest.mark.parametrize("predict", [rivals.predict_least_squares, rivals.predict_bayesian])
def test_least_squares_finds_the_torque_of_a_simulated_robot(predict):
    train, test = simulated(noise=0.001), simulated(seed=2)
    forecast = predict(PENDULUM.body(train), train, test)
    assert nmse(forecast, test).max() < 1e-3
    assert np.all(forecast.std > 0)


def test_regressor_has_the_joint_order_of_the_samples():
    samples, robot = simulated("ur5", noise=0.0), load_robot("ur5")
    turned = [3, 0, 5, 1, 4, 2]
    names = tuple(robot.joint_names[joint] for joint in turned)
    columns = {name: getattr(samples, name)[:, turned] for name in ("q", "dq", "ddq", "tau")}
    shuffled = replace(samples, joint_names=names, **columns)
    body = RigidBody.from_profile("ur5", names, ("revolute",) * 6)
    parameters = np.concatenate([np.ravel(each.toDynamicParameters()) for each in robot.model.inertias[1:]])
    rigid = rivals.regressor(body, shuffled)[:, :, : parameters.size]
    true = inverse_dynamics(robot, samples.q, samples.dq, samples.ddq)[:, turned]
    np.testing.assert_allclose(rigid @ parameters, true, atol=1e-9)


def test_ridge_regression_beats_the_mean_if_test_and_training_are_alike():
    samples = simulated(samples=600, noise=0.001)
    train, test = samples.rows(slice(0, 600, 2)), samples.rows(slice(1, 600, 2))
    mean, ridge = rivals.predict_mean(train, test), rivals.predict_rbf(train, test)
    assert np.all(nmse(ridge, test) < 0.01 * nmse(mean, test))
    np.testing.assert_allclose(mean.mean[7], train.tau.mean(axis=0))
    assert mean.mean.shape == mean.std.shape == test.tau.shape


needs_mujoco = pytest.mark.skipif(not mujoco_sysid.is_installed(), reason="mujoco.sysid is not installed")


@needs_mujoco
@pytest.mark.parametrize("name", ["panda", "ur10", "tiago", "double-pendulum"])
def test_the_mujoco_model_has_the_torque_of_the_urdf(name):
    import mujoco

    robot, samples = load_robot(name), simulated(name, samples=20)
    model = mujoco_sysid.arm(RigidBody.from_profile(name, robot.joint_names, robot.joint_types)).compile()
    data, found = mujoco.MjData(model), []
    for data.qpos, data.qvel, data.qacc in zip(samples.q, samples.dq, samples.ddq, strict=True):
        mujoco.mj_inverse(model, data)
        found.append(data.qfrc_inverse.copy())
    true = inverse_dynamics(robot, samples.q, samples.dq, samples.ddq)
    np.testing.assert_allclose(found, true, atol=1e-3 * np.abs(true).max())


@needs_mujoco
def test_mujoco_finds_the_torque_of_a_simulated_robot():
    train, test = simulated(noise=0.001, samples=100), simulated(seed=2)
    forecast = mujoco_sysid.predict_mujoco(PENDULUM.body(train), train, test)
    assert nmse(forecast, test).max() < 1e-2
    assert forecast.intervals.parameters == 28
    assert forecast.intervals.infinite > 14  # torque determines fewer combinations than masses and inertias


@needs_mujoco
@pytest.mark.slow
def test_mujoco_finds_the_torque_from_simulated_motion(monkeypatch):
    monkeypatch.setattr(mujoco_forward, "MAX_WINDOWS", 10)
    train, test = simulated(noise=0.001), simulated(seed=2)
    forecast = mujoco_forward.predict_forward(PENDULUM.body(train), train, test)
    assert nmse(forecast, test).max() < 1e-2


@pytest.mark.skipif(not figaroh_fit.is_installed(), reason="FIGAROH is not installed")
@pytest.mark.filterwarnings("ignore:to-Python converter:RuntimeWarning")
def test_figaroh_finds_the_torque_of_a_simulated_robot():
    train, test = simulated(noise=0.001, samples=100), simulated(seed=2)
    forecast = figaroh_fit.predict_figaroh(PENDULUM.body(train), train, test)
    assert nmse(forecast, test).max() < 1e-2
    assert forecast.intervals.infinite == 0
    assert forecast.intervals.parameters < 20  # of 28


def test_splits_keep_a_guard_between_training_and_test():
    found, skipped = splits({"train": still(24.0), "other": still(3.0)})
    assert list(skipped) == ["first-30s"]
    rows = [(name, len(each.train), each.test.q[0, 0]) for name, each in found.items() if name != SECONDS]
    guard = 100 * GUARD_S
    assert rows == [
        ("first-5s", 500, 500 + guard),
        ("first-10s", 1000, 1000 + guard),
        ("last-30pct", 1680, 1680 + guard),
        ("other", 2400, 0),
    ]
    assert all(len(each.test) <= MAX_TEST_ROWS for each in found.values())
    early = splits({"train": still(9.0)})[0]["first-60pct"]  # of a short recording
    assert (len(early.train), early.test.q[0, 0], early.test.q[-1, 0]) == (540, 630, 899)


def test_single_seconds_are_held_out_with_a_guard():
    split = splits({"train": still(24.0)})[0][SECONDS]
    train, test = (each.q[:, 0] for each in (split.train, split.test))
    assert (len(test), len({*(test // 100)})) == (500, 5)
    assert np.abs(train[:, None] - test).min() >= 100 * GUARD_S
    for part in (split.train, split.test):
        steps, new = np.diff(part.q[:, 0]), np.diff(part.episode)
        assert ((steps > 1) == (new == 1)).all()
        assert (new <= 1).all()


def test_the_time_between_episodes_does_not_count():
    samples = Samples.concatenate([still(6.0), still(6.0)])
    apart = replace(samples, t=samples.t + 1000.0 * samples.episode)
    np.testing.assert_allclose(elapsed(apart), np.arange(1200) / 100)


def toy(recording="toy", split="other", knowledge="nothing", method="mean", error=0.5, **figures):
    """Return an invented result."""
    usual = {
        **{"train_s": 20.0, "train_rows": 10, "test_rows": 10, "seconds": 1.0},
        **{"nmse": [error, error], "nmse_mean": [1.0, 1.0], "coverage": [0.95, 0.95], "width": [1.0, 1.0]},
    }
    return Result(
        cell=Cell(recording=recording, split=split, knowledge=knowledge, method=method), **{**usual, **figures}
    )


def test_figures_compare_errors_and_widths_with_measurements():
    test = replace(still(1.0), tau=np.tile([1.0, -1.0], 50)[:, None])
    split = Split(replace(still(2.0), tau=np.full((200, 1), 3.0)), test)
    found = evaluate_forecast(toy().cell, split, Forecast(test.tau + 0.5, np.full((100, 1), 1.0)), 2.0)
    assert (*found.nmse, *found.nmse_mean, *found.width) == pytest.approx((0.25, 10.0, 2.0))
    assert (found.worst, found.train_s) == pytest.approx((0.025, 2.0))
    assert found.coverage == [1.0]


def test_only_results_of_the_product_belong_to_a_revision(tmp_path):
    first, second = Cache(tmp_path, "aaaa"), Cache(tmp_path, "bbbb")
    product, rival = toy(method=PRODUCT), toy(method="RBF ridge")
    first.add(product)
    first.add(rival)
    assert first.find(product.cell).revision == "aaaa"
    assert second.find(product.cell) is None
    assert second.find(rival.cell) == rival


@pytest.fixture
def options(tmp_path):
    """Return options of a run on a prepared recording, without the product."""
    (tmp_path / "prepared").mkdir()
    write_recording(tmp_path / "prepared" / "pendulum-train.npz", simulated(samples=400, noise=0.01))
    return running.Options(tmp_path, tmp_path, "aaaa", only="mean|least", recordings=(PENDULUM,))


def run(options):
    return running.run(options, Console(file=io.StringIO()))


def test_second_run_computes_nothing(options, monkeypatch):
    assert run(replace(options, compute=False)).results == []
    first = run(options)
    assert {result.cell.method for result in first.results} == {"mean", "least squares", "Bayesian least squares"}
    assert {result.cell.split for result in first.results} == {"first-5s", "first-10s", "last-30pct", SECONDS}
    monkeypatch.setattr(running, "compute_cell", lambda *_: pytest.fail("computed again"))
    assert run(options) == first


def test_run_continues_after_failed_cells(options, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setitem(running.ALONE, "mean", Mock(side_effect=ValueError("no luck")))
        broken = run(options)
    assert [*broken.failed.values()] == ["ValueError: no luck"] * 4
    assert len(broken.results) == 8
    assert len(run(options).results) == 12


def test_methods_do_not_see_the_torque_of_the_test(options, monkeypatch):
    watch = Mock(side_effect=rivals.predict_mean)
    monkeypatch.setitem(running.ALONE, "mean", watch)
    run(replace(options, only="first-5s/nothing/mean"))
    assert np.isnan(watch.call_args.args[1].tau).all()


def targets(results):
    return {each.name: (each.value, each.met) for each in report.targets(results)}


def test_targets_compare_the_product_with_the_best_other_method_of_each_split():
    found = targets(
        [
            toy("a", method=PRODUCT, error=0.3),
            toy("a", knowledge="URDF", method=PRODUCT, error=0.12),
            toy("a", method="RBF ridge", error=0.2),
            toy("a", knowledge="URDF", method="least squares", error=0.1),
            toy("b", method=PRODUCT, nmse=[0.7, 0.1], nmse_mean=[0.5, 1.5], train_s=5.0, coverage=[0.5, 1.0]),
            toy("b", method="mean", error=0.1, train_s=5.0),
        ]
    )
    assert found["no URDF, at least 10 s: largest error / best other"] == (pytest.approx(3.0), False)
    assert found["URDF, at least 10 s: largest error / best other"] == (pytest.approx(1.2), False)
    assert found["no URDF, less than 10 s: largest error / best other"] == (pytest.approx(4.0), True)
    assert found["largest error / error of the recording's mean"] == (pytest.approx(0.4), True)
    assert found["worst joint: error / error of the recording's mean"] == (pytest.approx(1.4), False)
    assert found["joints with a coverage of 85 to 100 %"] == (pytest.approx(100 * 5 / 6), False)
    assert found["median width / need"] == (1.0, True)


def test_targets_name_their_splits():
    found = targets([toy("panda-9s", "other", "URDF", PRODUCT, error=0.012)])
    assert found["panda-9s, other motion, URDF"] == (pytest.approx(0.012), True)
    assert found["panda-9s, other motion, no URDF"] == (None, None)
    assert found["kuka, other motion, no URDF"] == (None, None)


def test_page_contains_every_table():
    results = [toy("a", method=PRODUCT, error=0.3, estimator="rigid-body"), toy("a", error=1.5)]
    page = report.page(running.Outcome(results, {"a/first-30s": "9.0 s recorded"}, {}, ["mujoco.sysid"]), "aaaa")
    parts = (
        "| a, other | 20.0 | 3.0e-1 | – | – | – | 1.5 |",
        "| a, other, no URDF | 3.0e-1 3.0e-1 | 95 95 | 1.0 | 0.3 | 0.20 | 0.20 | 1 | rigid-body |",
        "| LIPServe, no URDF | 100 | 1.0 | 1.0 | 1.0 | 1 of 1 |",
        "a/first-30s (9.0 s recorded)",
        "Not installed: mujoco.sysid.",
    )
    assert [part for part in parts if part not in page] == []
    assert "NOT met" not in page


def test_peers_are_those_with_results():
    known = {"knowledge": "URDF", "split": "other"}
    results = [toy("a", method=PRODUCT, **known), toy("a", method="least squares", **known)]
    results += [toy(name, method="mujoco.sysid", intervals=(10, 7), **known) for name in "ab"]
    rows = {row[0]: row for row in report.peers(report.Summary(results)).rows}
    assert list(rows) == [PRODUCT, "mujoco.sysid"]
    assert rows["mujoco.sysid"][5] == "14 of 20"
    assert rows[PRODUCT][5] == "–"
    assert report.peers(report.Summary([toy()])).rows == []


def test_lines_of_code_exclude_documentation():
    source = '''
    def double(value):
        """Return twice a value.

        It is a number.
        """
        # a comment

        text = """of
        two lines"""
        return (
            2 * value  # another
        )
    '''
    assert count_lines(source) == 6


@pytest.mark.slow
def test_the_product_prepares_trains_and_predicts_through_its_api(tmp_path):
    raw = simulated(samples=600, noise=0.001)
    np.savez(tmp_path / "raw.npz", t=raw.t, q=raw.q, tau=raw.tau, joint_names=np.array(raw.joint_names))
    with open_bed(1) as bed:
        prepared = bed.prepare(tmp_path / "raw.npz", Reading())
        assert prepared.ddq.shape == prepared.q.shape
        split = Split(raw.rows(slice(0, 300)), raw.rows(slice(320, 600)))
        cell = toy(method=PRODUCT).cell
        found = running.compute_cell(cell, PENDULUM, split, partial(lambda bed: bed, bed))
    assert max(found.nmse) < 0.1
    assert found.estimator
    assert found.seconds > 0
