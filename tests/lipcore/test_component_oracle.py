"""Components and their uncertainty against a dense Gaussian posterior of energies differentiated by machine.

A compact posterior with every torque among its inducing outputs is the exact one, so both are held to the same.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from lipcore import TorqueModel
from lipcore.data.motion import Motion
from lipcore.fitting.estimators import make_estimator
from lipcore.kernels.friction import SIGN_WIDTH
from lipcore.model import dynamics
from lipcore.model.torque_model import training_range
from lipcore.posterior.basis import Basis
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.statistics import collect
from tests.lipcore.oracles import (
    Energy,
    Instant,
    chain_energies,
    energy_torque,
    instant,
    lip_energies,
    torque_terms,
)

TYPES = ("revolute", "prismatic")
N, SAMPLES, QUERIES = 2, 3, 2
JOINT_NAMES = ("a", "b")


ENERGIES = {"lip": lip_energies, "lip-chain": chain_energies}


class Case(NamedTuple):
    """A random model, the energies of its prior, the covariance of the measured torques, and queries."""

    model: TorqueModel
    motion: Motion
    tau: Tensor
    energies: list[Energy]
    gram: np.ndarray
    query: Motion


@pytest.fixture(scope="module", params=ENERGIES)
def case(request: pytest.FixtureRequest) -> Case:
    rng = np.random.default_rng(3)
    motion = Motion.from_arrays(*rng.uniform(-1.5, 1.5, (3, SAMPLES, N)))
    query = Motion.from_arrays(*rng.uniform(-1.5, 1.5, (3, QUERIES, N)))
    tau = torch.from_numpy(rng.normal(size=(SAMPLES, N)))
    like = make_estimator(request.param, TYPES).kernel.initial(motion, tau)
    params = {name: torch.from_numpy(np.asarray(rng.uniform(-1, 0.5, value.shape))) for name, value in like.items()}
    params["noise.log_std"] = torch.tensor([-1.5, -2.0], dtype=torch.float64)
    kernel, outputs = make_estimator(request.param, TYPES).kernel, torch.arange(SAMPLES * N)
    basis = Basis.build(kernel, params, motion, outputs)
    statistics = collect(basis, torch.exp(2 * params["noise.log_std"]), motion, tau)
    estimator = make_estimator(request.param, TYPES)
    posterior = CompactPosterior.restore(estimator.kernel, params, motion, outputs, statistics)
    span = training_range(motion)
    model = TorqueModel(estimator, JOINT_NAMES, TYPES, "gravity_included", {}, {}, posterior, span, {})
    energies = ENERGIES[request.param](TYPES, params)
    data = samples(motion)
    noise = np.tile(np.exp(2 * params["noise.log_std"].numpy()), SAMPLES)
    gram = torque_covariance(energies, data, data) + friction_covariance(params, data, data) + np.diag(noise)
    return Case(model, motion, tau, energies, gram, query)


def torque_covariance(energies: list[Energy], xs: Sequence[Instant], ys: Sequence[Instant]) -> np.ndarray:
    """Covariance of the torques of the energies alone: (len(xs) n, len(ys) n)."""
    blocks = [[torque_terms(energies, x, y).sum(0).numpy() for y in ys] for x in xs]
    return np.block(blocks)


def friction_covariance(params: Mapping[str, Tensor], xs: Sequence[Instant], ys: Sequence[Instant]) -> np.ndarray:
    variances = torch.exp(2 * params["friction.log_std"]).numpy()

    def features(v: Tensor) -> np.ndarray:
        return np.stack([v.numpy(), np.tanh(v.numpy() / SIGN_WIDTH), np.ones(N)], axis=1)

    return np.block([[np.diag((features(x[1]) * variances * features(y[1])).sum(1)) for y in ys] for x in xs])


def samples(motion: Motion) -> list[Instant]:
    return [instant(motion, row) for row in range(SAMPLES)]


def conditioned(case: Case, prior: np.ndarray, cross: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of quantities with prior covariance (k, k) and covariance (k, m) with the torques."""
    solved = np.linalg.solve(case.gram, cross.T)
    return solved.T @ case.tau.numpy().ravel(), np.sqrt(np.diag(prior - cross @ solved))


def assert_estimate(found: dynamics.Estimate, row: int, mean: np.ndarray, std: np.ndarray) -> None:
    np.testing.assert_allclose(found.mean[row].numpy().ravel(), mean, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(found.std[row].numpy().ravel(), std, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("row", range(QUERIES))
def test_energies(case: Case, row: int) -> None:
    names = ["kinetic_energy", "potential_energy"]
    found = dynamics.components(case.model, case.query, names)
    x = instant(case.query, row)
    origin = dynamics.reference_posture(case.model)
    reference = (origin, torch.zeros(N, dtype=torch.float64), torch.zeros(N, dtype=torch.float64))
    data = samples(case.motion)
    torques = np.array([[energy_torque(case.energies, at, y).numpy() for y in data] for at in (x, reference)])
    torques = torques.transpose(0, 2, 1, 3).reshape(2, len(case.energies), -1)  # (at, energy, m)

    def value(which: int, at: Instant, other: Instant) -> float:
        return float(case.energies[which].kernel(*at[:2], *other[:2]))

    kinetic = sum(value(which, x, x) for which in range(1, N + 1))
    expected = conditioned(case, np.array([[kinetic]]), torques[0, 1:].sum(0)[None])
    assert_estimate(found["kinetic_energy"], row, *expected)

    potential = value(0, x, x) - 2 * value(0, x, reference) + value(0, reference, reference)
    expected = conditioned(case, np.array([[potential]]), (torques[0, 0] - torques[1, 0])[None])
    assert_estimate(found["potential_energy"], row, *expected)


@pytest.mark.parametrize("row", range(QUERIES))
def test_torques_and_inertia(case: Case, row: int) -> None:
    q, v, a = instant(case.query, row)
    zero, eye = torch.zeros(N, dtype=torch.float64), torch.eye(N, dtype=torch.float64)
    stack = [(q, zero, zero), (q, v, zero), (q, zero, a), *((q, zero, eye[j]) for j in range(N))]
    prior = torque_covariance(case.energies, stack, stack)
    cross = torque_covariance(case.energies, stack, samples(case.motion))
    rest, moving, accelerating, *pushes = np.split(np.eye(len(stack) * N), len(stack))
    column = [push - rest for push in pushes]
    differences = {
        "gravity": rest,
        "coriolis": moving - rest,
        "inertial": accelerating - rest,
        "inertia_matrix": np.stack([column[j][i] for i, j in product(range(N), range(N))]),
    }
    found = dynamics.components(case.model, case.query, list(differences))
    for name, rows in differences.items():
        assert_estimate(found[name], row, *conditioned(case, rows @ prior @ rows.T, rows @ cross))


@pytest.mark.parametrize("row", range(QUERIES))
def test_friction(case: Case, row: int) -> None:
    x = instant(case.query, row)
    params = case.model.posterior.params
    prior, cross = friction_covariance(params, [x], [x]), friction_covariance(params, [x], samples(case.motion))
    friction = dynamics.components(case.model, case.query, ["friction"])["friction"]
    assert_estimate(friction, row, *conditioned(case, prior, cross))
