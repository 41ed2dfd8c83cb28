"""Tests of a model exported as C: the compiled code has the model's numbers."""

import ctypes
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from lipcore import TorqueModel, load
from lipcore.data.motion import Motion
from lipcore.export.c_writer import c_files
from lipcore.kernels.base import PairKernel
from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from tests.choosing import few, slow
from tests.lipcore.export.compiled import (
    c_array,
    compile_library,
    evaluate_library,
    needs_compiler,
)
from tests.lipcore.export.models import (
    BODY,
    MODELS,
    ORIGIN,
    PANDA,
    draw_motions,
)


def evaluate_exactly(model: TorqueModel, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return tau and tau_std by the posterior's formulas, in exact fractions."""
    posterior, query = model.posterior, Motion.from_arrays(*motion)
    basis, n = posterior.basis, model.n_joints
    features = np.concatenate([each.features(query) for each in basis.linear], axis=2)
    prior = np.concatenate([each.variances(posterior.params) for each in basis.linear])
    means = [each.prior_weights() for each in basis.linear]
    sizes = [each.regressor().size for each in basis.linear]
    centre = np.concatenate([np.zeros(size) if mean is None else mean for mean, size in zip(means, sizes, strict=True)])
    fraction = np.frompyfunc(Fraction, 1, 1)
    cross, first = fraction(features) * fraction(prior), len(basis.outputs)
    before = np.zeros(query.q.shape)
    if basis.term is not None:
        inducing = PairKernel.gram(basis.term, posterior.params, basis.inducing, query)[basis.outputs]
        inducing = inducing.reshape(first, len(query), n).transpose(1, 2, 0)
        cross = np.concatenate([fraction(inducing), cross], axis=2)
        before = PairKernel.variance(basis.term, posterior.params, query).diagonal(axis1=1, axis2=2)
    tau = (cross @ fraction(posterior.weights) + fraction(features) @ fraction(centre)).astype(float)
    squares = (cross @ fraction(posterior.root).T) ** 2
    variance = fraction(before) - squares[..., :first].sum(2) + squares[..., first:].sum(2)
    variance = variance.astype(float) * posterior.std_factor**2 + posterior.misfit.variance(query)
    if basis.residual is not None:
        tau += basis.residual.mean(query)
        variance += basis.residual.beyond(query)
    return tau, np.sqrt(np.maximum(variance, posterior.floor))


@needs_compiler
@pytest.mark.parametrize("name", few(MODELS, kept=lambda name: name in ("panda", "two arms")))
def test_compiled_numbers_match_the_model(name: str, tmp_path: Path) -> None:
    model = MODELS[name]()
    path = compile_library(c_files(model, ORIGIN), tmp_path)
    assert ctypes.CDLL(str(path)).lipserve_selftest() == 0
    for seed, beyond in ((1, 1.0), (2, 3.0)):
        motion = draw_motions(model, 1500, seed, beyond)
        tau, std = evaluate_library(path, motion)
        expected, tau_std, *_ = model.evaluator.many(*motion)
        np.testing.assert_allclose(tau, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
        np.testing.assert_allclose(std, tau_std, rtol=1e-9)
        few = 1 if model.n_joints > 3 else 30
        mean, deviation = evaluate_exactly(model, motion[:, :few])
        np.testing.assert_allclose(tau[:few], mean, rtol=1e-9, atol=1e-12 * np.abs(mean).max())
        np.testing.assert_allclose(std[:few], deviation, rtol=1e-9)


@needs_compiler
@pytest.mark.parametrize(
    "name",
    [
        "panda",
        *map(slow, ("prismatic", "alternatives", "fixed, from its tip", "energies", "local", "friction of all kinds")),
        slow("friction of all kinds, alternatives"),
    ],
)
@pytest.mark.parametrize("body", [BODY, Body(0.7, np.array([0.1, 0.2, -0.3]))], ids=["body", "point"])
def test_compiled_payload_matches_a_declared_payload(name: str, body: Body, tmp_path: Path) -> None:
    model = MODELS[name]()
    motion, carrier = draw_motions(model, 300, 1), Carrier(model)
    expected, tau_std, *_ = carrier.with_payload(carrier.known(body.parameters)).evaluator.many(*motion)
    tau, std = evaluate_library(compile_library(c_files(model, ORIGIN), tmp_path), motion, body)
    np.testing.assert_allclose(tau, expected, rtol=1e-9, atol=1e-10 * np.abs(expected).max())
    np.testing.assert_allclose(std, tau_std, rtol=1e-7)
    empty, _ = evaluate_library(tmp_path / "model.so", motion, replace(body, mass=1e-300, inertia=None))
    np.testing.assert_array_equal(empty, evaluate_library(tmp_path / "model.so", motion)[0])


@needs_compiler
def test_threads_do_not_disturb_each_other(tmp_path: Path) -> None:
    model = load(PANDA)
    path = compile_library(c_files(model, ORIGIN), tmp_path)
    motions = [draw_motions(model, 2000, seed) for seed in (1, 2)]
    alone = [evaluate_library(path, motion) for motion in motions]
    with ThreadPoolExecutor() as threads:
        together = list(threads.map(partial(evaluate_library, path), motions))
    np.testing.assert_array_equal(alone, together)


@needs_compiler
def test_interval_and_training_range(tmp_path: Path) -> None:
    model = load(PANDA)
    library = ctypes.CDLL(str(compile_library(c_files(model, ORIGIN), tmp_path)))
    motion = draw_motions(model, 2, 1)
    std, half = np.full(7, 0.02), np.zeros(7)
    library.lipserve_interval(c_array(std), c_array(half))
    expected = 1.959963984540054 * model.scale * np.sqrt(std**2 + model.noise_std**2)
    np.testing.assert_allclose(half, expected, rtol=1e-12)
    assert library.lipserve_in_range(*[c_array(part[0]) for part in motion]) == 1
    for part, name in enumerate(("q", "dq", "ddq")):
        for joint, value in ((0, model.training_range[name]["max"][0] + 1e-6), (6, np.nan)):
            far = motion[:, 0].copy()
            far[part, joint] = value
            assert library.lipserve_in_range(*[c_array(row) for row in far]) == 0
