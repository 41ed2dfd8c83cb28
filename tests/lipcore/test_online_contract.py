"""What every model that learns online must keep to, whatever its estimator: in the spirit of river's `checks`."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore import FitOptions, TorqueModel, train
from lipcore.fitting.estimators import ESTIMATORS
from lipcore.online import transfer
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.online.transfer import Revision
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Stream, simulate
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import CODES, ROBOT_ESTIMATORS
from tests.choosing import few
from tests.lipcore.online_checks import as_rows, same_answers

ROBOT = "double-pendulum"
OPTIONS = FitOptions(hyperparameter_samples=40, max_iterations=25, starts=1, device="cpu", compact_tolerance=0.1)


@pytest.fixture(scope="module", params=few(ESTIMATORS, {"lip-chain", "se", "rigid-body+lip-chain"}.__contains__))
def model(request: pytest.FixtureRequest) -> TorqueModel:
    samples = simulate(load_robot(ROBOT), Stream(n_samples=80, speed=10, noise=0.02, viscous=0.1), seed=1)
    robot = None
    if request.param in ROBOT_ESTIMATORS:
        robot = RigidBody.from_profile(ROBOT, samples.joint_names, ("revolute",) * 2)
    return train(samples, ("revolute",) * 2, request.param, OPTIONS, robot=robot)


@pytest.fixture(scope="module")
def rows() -> Rows:
    """Another motion of the same robot, which is a little more viscous than it was."""
    return as_rows(simulate(load_robot(ROBOT), Stream(n_samples=120, speed=10, noise=0.02, viscous=0.12), seed=2))


def test_nothing_learnt_is_the_version(model: TorqueModel, rows: Rows) -> None:
    same_answers(OnlineModel.start(model).model(), model, rows)


def test_parts_and_order_do_not_matter(model: TorqueModel, rows: Rows) -> None:
    whole = OnlineModel.start(model).learn(rows).model()
    rng = np.random.default_rng(0)
    parts = np.array_split(rng.permutation(len(rows)), 7)
    shuffled = OnlineModel.start(model)
    for part in parts:
        shuffled = shuffled.learn(rows.take(part))
    same_answers(shuffled.model(), whole, rows)
    one_by_one = OnlineModel.start(model)
    for k in range(12):
        one_by_one = one_by_one.learn(rows.take(slice(k, k + 1)))
    same_answers(one_by_one.model(), OnlineModel.start(model).learn(rows.take(slice(0, 12))).model(), rows)


def test_forgetting_knows_no_order_either(model: TorqueModel, rows: Rows) -> None:
    began = float(rows.time.min())
    start = OnlineModel.start(model, forgetting_s=5.0, since=began)
    backwards = start
    for part in np.array_split(np.arange(len(rows))[::-1], 4):
        backwards = backwards.learn(rows.take(part))
    same_answers(backwards.model(), start.learn(rows).model(), rows)
    assert start.learn(rows).samples < 0.9 * len(rows)


def test_unlearning_is_the_inverse(model: TorqueModel, rows: Rows) -> None:
    kept, gone = rows.take(slice(0, 40)), rows.take(slice(40, None))
    for forgetting in (None, 20.0):
        start = OnlineModel.start(model, forgetting, since=float(rows.time.min()))
        without = start.learn(kept).learn(gone).unlearn(gone)
        # the clock goes on all the same: what was kept has aged as if the others had never come
        expected = start.learn(kept)
        age = 0.0 if forgetting is None else (without.reference - expected.reference) / forgetting
        assert np.isclose(without.samples, expected.samples * np.exp(-age), rtol=1e-9)
        if forgetting is None:
            same_answers(without.model(), expected.model(), rows)


def test_memory_is_constant(model: TorqueModel, rows: Rows) -> None:
    online = OnlineModel.start(model)
    sizes = set()
    for _ in range(3):
        online = online.learn(rows)
        sizes.add(len(transfer.dump(online)))
    assert len(sizes) == 1
    assert online.samples == 3 * len(rows)


def test_state_survives_bytes(model: TorqueModel, rows: Rows) -> None:
    online = OnlineModel.start(model, 30.0).learn(rows.take(slice(0, 60))).change(float(rows.time[60]))
    online = online.learn(rows.take(slice(60, None)))
    read = transfer.load(model, transfer.dump(online))
    assert transfer.dump(read) == transfer.dump(online)
    same_answers(read.model(), online.model(), rows)
    late = rows.take(slice(0, 5))
    same_answers(read.learn(late).model(), online.learn(late).model(), rows)


def test_revision_answers_alike(model: TorqueModel, rows: Rows) -> None:
    floor = np.linspace(0.001, 0.002, model.n_joints)
    learnt = OnlineModel.start(model).learn(rows).model(floor)
    revised = Revision.of(learnt).apply(model)
    same_answers(revised, learnt, rows, 0.0)
    assert (revised.predict(rows.q, rows.dq, rows.ddq).tau_std >= np.sqrt(floor) * (1 - 1e-12)).all()


def test_only_rows_to_learn_teach(model: TorqueModel, rows: Rows) -> None:
    code = np.zeros(len(rows), np.uint8)
    code[::2] = CODES.index("contact")
    spoilt = replace(rows, code=code, tau=np.where(code[:, None] > 0, rows.tau + 1e3, rows.tau))
    online = OnlineModel.start(model).learn(spoilt)
    assert online.samples == len(rows) // 2
    same_answers(online.model(), OnlineModel.start(model).learn(rows.take(slice(1, None, 2))).model(), rows)


def test_certainty_grows_where_it_learns(model: TorqueModel, rows: Rows) -> None:
    before = model.predict(rows.q, rows.dq, rows.ddq).tau_std
    after = OnlineModel.start(model).learn(rows).model().predict(rows.q, rows.dq, rows.ddq).tau_std
    assert (after <= before * (1 + 1e-6) + 1e-9).all()
    assert after.mean() < before.mean()


def test_change_keeps_the_mean_and_opens_the_rest(model: TorqueModel, rows: Rows) -> None:
    known = OnlineModel.start(model).learn(rows)
    changed = known.change(float(rows.time.max()) + 1.0)
    a, b = (each.model().predict(rows.q, rows.dq, rows.ddq) for each in (known, changed))
    np.testing.assert_allclose(b.tau, a.tau, rtol=0, atol=1e-7 * np.abs(a.tau).max())
    assert (b.tau_std >= a.tau_std).all()
    assert b.tau_std.mean() > 2 * a.tau_std.mean()
    assert changed.samples == 0
