"""What every model that learns online must keep to, whatever its estimator: in the spirit of river's `checks`.

A check takes a trained model and a stream of the same robot, and fails with an assertion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from lipcore.data.samples import Samples
from lipcore.model.torque_model import TorqueModel
from lipcore.online import transfer
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.online.transfer import Revision
from lipcore.posterior.statistics import collect, merge
from lipcore.vocabulary import CODES

Check = Callable[[TorqueModel, Rows], None]
EXACT = 1e-8
"""Relative to the largest number compared."""


def as_rows(samples: Samples, began: float = 1000.0) -> Rows:
    """All samples as rows to learn."""
    code = np.zeros(len(samples), np.uint8)
    return Rows(began + samples.t, samples.q, samples.dq, samples.ddq, samples.tau, code)


def same_answers(one: TorqueModel, other: TorqueModel, rows: Rows, tolerance: float = EXACT) -> None:
    """Assert equal means and standard deviations."""
    a, b = (model.predict(rows.q, rows.dq, rows.ddq) for model in (one, other))
    np.testing.assert_allclose(a.tau, b.tau, rtol=0, atol=tolerance * np.abs(b.tau).max())
    # variances, whose differences of large numbers are what rounding reaches
    np.testing.assert_allclose(a.tau_std**2, b.tau_std**2, rtol=1e-6, atol=tolerance * (b.tau_std**2).max())


def check_nothing_learnt_is_the_version(model: TorqueModel, rows: Rows) -> None:
    same_answers(OnlineModel.start(model).model(), model, rows)


def check_parts_and_order_do_not_matter(model: TorqueModel, rows: Rows) -> None:
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


def check_forgetting_knows_no_order_either(model: TorqueModel, rows: Rows) -> None:
    began = float(rows.time.min())
    start = OnlineModel.start(model, forgetting_s=5.0, since=began)
    backwards = start
    for part in np.array_split(np.arange(len(rows))[::-1], 4):
        backwards = backwards.learn(rows.take(part))
    same_answers(backwards.model(), start.learn(rows).model(), rows)
    assert start.learn(rows).samples < 0.9 * len(rows)


def check_unlearning_is_the_inverse(model: TorqueModel, rows: Rows) -> None:
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


def check_streams_merge(model: TorqueModel, rows: Rows) -> None:
    """Two robots' sums, merged, are those of all their rows."""
    posterior = model.posterior
    motion = rows.motion()
    residual = rows.tau - posterior.kernel.mean(motion).numpy()
    told = [
        collect(posterior.basis, posterior.noise_variance, motion[part], torch.from_numpy(residual[part]))
        for part in (slice(0, 50), slice(50, None), slice(None))
    ]
    merged = merge(told[0], told[1])
    scale = float(told[2].a.abs().max())
    np.testing.assert_allclose(merged.a.numpy(), told[2].a.numpy(), rtol=0, atol=EXACT * scale)


def check_prediction_changes_nothing(model: TorqueModel, rows: Rows) -> None:
    online = OnlineModel.start(model).learn(rows)
    before = transfer.dump(online)
    answering = online.model()
    first = answering.predict(rows.q, rows.dq, rows.ddq)
    second = answering.predict(rows.q, rows.dq, rows.ddq)
    assert transfer.dump(online) == before
    assert np.array_equal(first.tau, second.tau)
    assert np.array_equal(first.tau_std, second.tau_std)
    same_answers(online.model(), answering, rows)


def check_learning_leaves_what_it_started_from_alone(model: TorqueModel, rows: Rows) -> None:
    start = OnlineModel.start(model)
    before = transfer.dump(start)
    start.learn(rows)
    start.learn(rows.take(slice(0, 5))).change(float(rows.time[10])).learn(rows)
    assert transfer.dump(start) == before


def check_memory_is_constant(model: TorqueModel, rows: Rows) -> None:
    online = OnlineModel.start(model)
    sizes = set()
    for _ in range(3):
        online = online.learn(rows)
        sizes.add(len(transfer.dump(online)))
    assert len(sizes) == 1
    assert online.samples == 3 * len(rows)


def check_state_survives_bytes(model: TorqueModel, rows: Rows) -> None:
    online = OnlineModel.start(model, 30.0).learn(rows.take(slice(0, 60))).change(float(rows.time[60]))
    online = online.learn(rows.take(slice(60, None)))
    read = transfer.load(model, transfer.dump(online))
    assert transfer.dump(read) == transfer.dump(online)
    same_answers(read.model(), online.model(), rows)
    late = rows.take(slice(0, 5))
    same_answers(read.learn(late).model(), online.learn(late).model(), rows)


def check_revision_answers_alike(model: TorqueModel, rows: Rows) -> None:
    floor = np.linspace(0.001, 0.002, model.n_joints)
    learnt = OnlineModel.start(model).learn(rows).model(floor)
    revised = Revision.of(learnt).apply(model)
    same_answers(revised, learnt, rows, 0.0)
    assert (revised.predict(rows.q, rows.dq, rows.ddq).tau_std >= np.sqrt(floor) * (1 - 1e-12)).all()


def check_only_rows_to_learn_teach(model: TorqueModel, rows: Rows) -> None:
    code = np.zeros(len(rows), np.uint8)
    code[::2] = CODES.index("contact")
    spoilt = replace(rows, code=code, tau=np.where(code[:, None] > 0, rows.tau + 1e3, rows.tau))
    online = OnlineModel.start(model).learn(spoilt)
    assert online.samples == len(rows) // 2
    same_answers(online.model(), OnlineModel.start(model).learn(rows.take(slice(1, None, 2))).model(), rows)


def check_certainty_grows_where_it_learns(model: TorqueModel, rows: Rows) -> None:
    before = model.predict(rows.q, rows.dq, rows.ddq).tau_std
    after = OnlineModel.start(model).learn(rows).model().predict(rows.q, rows.dq, rows.ddq).tau_std
    assert (after <= before * (1 + 1e-6) + 1e-9).all()
    assert after.mean() < before.mean()


def check_change_keeps_the_mean_and_opens_the_rest(model: TorqueModel, rows: Rows) -> None:
    known = OnlineModel.start(model).learn(rows)
    changed = known.change(float(rows.time.max()) + 1.0)
    a, b = (each.model().predict(rows.q, rows.dq, rows.ddq) for each in (known, changed))
    np.testing.assert_allclose(b.tau, a.tau, rtol=0, atol=1e-7 * np.abs(a.tau).max())
    assert (b.tau_std >= a.tau_std).all()
    assert b.tau_std.mean() > 2 * a.tau_std.mean()
    assert changed.samples == 0


CHECKS: tuple[Check, ...] = tuple(value for name, value in sorted(globals().items()) if name.startswith("check_"))
