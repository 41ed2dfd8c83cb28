"""Tests of a payload on a trained arm: parameters, prediction and estimation from rows."""

import numpy as np
import pytest

from lipcore import load, train
from lipcore.data.motion import Motion
from lipcore.estimators.options import FitOptions
from lipcore.model.body import Body
from lipcore.model.payload import Carrier, LinearisedCarrier, PayloadPosterior
from lipcore.online.payload.bodies import ANY_PAYLOAD, body, eta_of
from lipcore.online.payload.draws import draw_arms
from lipcore.online.payload.estimate import estimate_from_prior
from lipcore.online.payload.payload import estimate, refine
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from lipcore.robots.urdf import RigidBody
from tests import ROOT
from tests.lipcore.arm_oracles import as_rows
from tests.lipcore.model.test_declared_payload import declare_payload
from tests.lipcore.stepping import run_to_end

PAYLOAD = Payload(1.5, 0.0, (0.03, 0.02, 0.1))


@pytest.fixture(scope="module")
def carrier():
    """Return the shipped Panda, learnt from torque alone."""
    return Carrier(load(ROOT / "models" / "panda-sim"))


@pytest.fixture(scope="module")
def recordings():
    """Return ten seconds of a Panda with 1.5 kg off its last axis, and another motion without noise."""
    robot = load_robot("panda")
    seen = simulate(robot, Simulation(1000, 100.0, speed=5.0, noise=0.05, payload=PAYLOAD), 7)
    other = simulate(robot, Simulation(3000, 100.0, speed=5.0, noise=0.0, payload=PAYLOAD, n_sinusoids=100), 11)
    return seen, other.rows(slice(None, None, 10))


def refine_payload(*given, **more):
    return run_to_end(refine(*given, **more))


def nmse_and_coverage(model, samples):
    """Return the mean nMSE of the joints, and the coverage of the worst joint."""
    answer = model.predict(samples.q, samples.dq, samples.ddq)
    error = samples.tau - answer.tau
    inside = np.abs(error) < 1.96 * np.sqrt(answer.tau_std**2 + answer.noise_std**2)
    return ((error**2).mean(0) / samples.tau.var(0)).mean(), inside.mean(0).min()


def test_every_eta_is_a_possible_body():
    rng = np.random.default_rng(1)
    for _ in range(20):
        eta = rng.normal(size=10) * [1, 0.2, 0.2, 0.2, 0.5, 0.5, 0.5, 0.05, 0.05, 0.05] - [0, 0, 0, 0, 3, 3, 3, 0, 0, 0]
        parameters, slope = body(eta)
        differences = [(body(eta + step)[0] - body(eta - step)[0]) / 2e-6 for step in 1e-6 * np.eye(10)]
        np.testing.assert_allclose(slope, np.array(differences).T, rtol=1e-5, atol=1e-8)
        np.testing.assert_allclose(body(eta_of(Body.of(parameters)))[0], parameters, rtol=1e-2, atol=1e-5)


def test_model_without_payload_predicts_as_before(carrier, recordings):
    _, other = recordings
    models = carrier.model, carrier.with_payload(carrier.known(np.zeros(10)))
    before, after = (each.predict(other.q, other.dq, other.ddq) for each in models)
    np.testing.assert_allclose(after.tau, before.tau, atol=1e-6)
    np.testing.assert_allclose(after.tau_std, before.tau_std, rtol=1e-3)


def test_prediction_is_linear_around_the_payload(carrier, recordings):
    _, other = recordings
    spread = np.diag(np.random.default_rng(2).uniform(1e-4, 1e-2, 10))
    load = carrier.known(body(eta_of(Body(1.5, np.array([0.03, 0.02, 0.1]))))[0], spread)
    features, base = LinearisedCarrier(carrier, load).rows(other.motion())
    variance = np.einsum("knj,kl,lnj->nj", features, load.covariance, features)
    variance += carrier.model.posterior.misfit.variance(other.motion())
    answer = carrier.with_payload(load).predict(other.q, other.dq, other.ddq)
    np.testing.assert_allclose(answer.tau, base + np.einsum("knj,k->nj", features, load.mean), atol=1e-6)
    np.testing.assert_allclose(answer.tau_std, np.sqrt(variance), rtol=1e-3)


@pytest.mark.parametrize(("found_by", "widest"), [(estimate, 0.3), (refine_payload, 0.1)])
@pytest.mark.parametrize(("count", "max_ratio"), [(10, 0.1), (100, 0.01)])
def test_payload_is_estimated_within_a_second(carrier, recordings, found_by, widest, count, max_ratio):
    seen, other = recordings
    unaware, _ = nmse_and_coverage(carrier.model, other)
    found = found_by(carrier, as_rows(seen, 0.0).take(slice(0, count)))
    mass, std = found.mass
    assert abs(mass - 1.5) < 3 * std < widest
    nmse, inside = nmse_and_coverage(carrier.with_payload(found.load), other)
    assert nmse < max_ratio * unaware
    assert inside > 0.85
    assert found.gain > 1e4


@pytest.fixture(scope="module")
def open_arm():
    """Return a UR10 learnt from torque alone, whose geometry is largely undetermined."""
    robot = load_robot("ur10")
    samples = simulate(robot, Simulation(speed=5.0, noise=0.05, motion="full"), 53)
    return samples, Carrier(train(samples, robot.joint_types, "rigid-body"))


@pytest.mark.slow
def test_remembered_training_matches_its_samples_at_other_geometries(open_arm):
    samples, carrier = open_arm
    memory, model, arm = carrier.memory, carrier.model, carrier.term.arm
    weight = model.posterior.statistics.samples / len(samples)
    virtual = Motion.from_arrays(*memory.motions.swapaxes(0, 1))

    def energies(w, geometry):
        load = PayloadPosterior(np.append(w, np.zeros(10)), np.zeros((0, 0)), np.ones(10), geometry)
        here, there = (
            base + np.einsum("knj,k->nj", features, load.mean)
            for features, base in (LinearisedCarrier(carrier, load).rows(each) for each in (samples.motion(), virtual))
        )
        residual = memory.residual(w, there)
        sample_energy = weight * ((samples.tau - here) ** 2 / model.posterior.noise_variance).sum() + w @ w
        return np.array([0.5 * sample_energy, 0.5 * residual @ residual])

    before = arm.geometry.moved(carrier.step)
    least, rng = energies(carrier.mean, before), np.random.default_rng(0)
    linear, exact, off = [], [], []
    for scale in np.repeat([0.3, 1.0, 2.0], 4):
        w = carrier.mean + memory.root @ (scale * rng.standard_normal(len(carrier.mean)))
        moved = before.moved((w - carrier.mean)[carrier.steps] * carrier.root[carrier.steps])
        w[carrier.steps] = (arm.geometry.towards(moved) - arm.expected) / carrier.root[carrier.steps]
        sample_energy, remembered = energies(w, moved) - least
        # of either sign: where the geometry is undetermined, the linear posterior's mean is not the optimum
        off.append(abs(remembered - sample_energy) / max(abs(sample_energy), 60.0))
        linear.append(0.5 * (np.linalg.solve(memory.root, w - carrier.mean) ** 2).sum())
        exact.append(sample_energy)
    # a distant draw may lie where torque is less linear than a memory of few motions represents
    assert np.median(off) < 0.02
    assert np.sort(off)[-3] < 0.05
    assert np.median(exact) > 5 * np.median(linear)


@pytest.mark.slow
def test_draws_start_in_each_direction_of_last_axis(open_arm):
    def axes(geometry):
        turns, _ = geometry.placements(np.zeros(geometry.n_joints))
        return (turns @ geometry.axis[..., None])[..., 0]

    _, wrist = open_arm
    begun = np.array([axes(each.place.geometry) for each in run_to_end(draw_arms(wrist))])
    others, tips = axes(wrist.term.arm.geometry.moved(wrist.step))[:-1], begun[:, -1]
    np.testing.assert_allclose(begun[:, :-1], np.broadcast_to(others, begun[:, :-1].shape), atol=1e-9)
    np.testing.assert_allclose(np.sort((tips @ tips.T).ravel()), [-1] * 6 + [0] * 24 + [1] * 6, atol=1e-9)


@pytest.mark.slow
def test_payload_determines_an_open_geometry(open_arm):
    _, carrier = open_arm
    robot, found = load_robot("ur10"), None
    carried = Payload(1.0, 0.0, (0.05, 0.03, 0.08))
    rows = as_rows(simulate(robot, Simulation(300, 100.0, speed=5.0, noise=0.05, payload=carried), 54), 0.0)
    other = simulate(robot, Simulation(300, 10.0, speed=5.0, noise=0.0, payload=carried, n_sinusoids=100), 55)
    for count in (10, 20, 30, 40, 50, 70, 90, 120, 150, 190, 240, 300):
        found = refine_payload(carrier, rows.take(slice(0, count, max(1, count // 100))), start=found)
    mass, std = found.mass
    assert abs(mass - 1.0) < 4 * std < 0.1
    turned = np.abs(carrier.term.arm.geometry.towards(found.load.geometry)[carrier.term.arm.geometry.turns])
    assert turned.max() > 0.1  # beyond the linear range
    answer = carrier.with_payload(found.load).predict(other.q, other.dq, other.ddq)
    assert ((answer.tau - other.tau) ** 2).mean(0).sum() < 3e-3 * other.tau.var(0).sum()
    assert nmse_and_coverage(carrier.with_payload(found.load), other)[1] > 0.85


def test_estimation_does_not_change_the_carrier(carrier, recordings):
    seen, _ = recordings
    mean, covariance = carrier.mean.copy(), carrier.covariance.copy()
    estimate(carrier, as_rows(seen, 0.0).take(slice(0, 50)))
    np.testing.assert_array_equal(carrier.mean, mean)
    np.testing.assert_array_equal(carrier.covariance, covariance)


def test_free_arm_gives_evidence_against_a_payload(carrier):
    free = simulate(load_robot("panda"), Simulation(100, 100.0, speed=5.0, noise=0.05), 8)
    assert estimate(carrier, as_rows(free, 0.0)).gain < 0


def test_declared_payload_matches_pinocchio():
    robot, payload = load_robot("panda"), Payload(2.0, 0.0, (0.02, -0.03, 0.11))
    still = simulate(robot, Simulation(300, 10.0, speed=10.0, noise=0.01), 1)
    bodies = RigidBody.from_profile("panda", robot.joint_names, robot.joint_types)
    model = train(still, robot.joint_types, "rigid-body", FitOptions(geometry="fixed"), robot=bodies)
    expected = simulate(robot, Simulation(100, 10.0, speed=5.0, noise=0.0, payload=payload), 2)
    heavier = declare_payload(model, Body(payload.mass, np.array(payload.offset)))
    answer = heavier.predict(expected.q, expected.dq, expected.ddq)
    assert ((answer.tau - expected.tau) ** 2).mean() < 1e-4 * expected.tau.var()


def test_estimate_without_rows_is_the_prior(carrier):
    found = estimate_from_prior(carrier, ANY_PAYLOAD)
    np.testing.assert_allclose(found.load.payload, body(ANY_PAYLOAD.centre)[0])
    assert found.mass[1] == pytest.approx(1.2 * found.mass[0])
