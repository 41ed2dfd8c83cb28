"""Tests of planned motions: limits at every instant, and variance against the exact posterior."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lipcore
from lipcore.data.motion import Motion
from lipcore.excitation import Belief, Limits, PlanOptions, Series, plan
from lipcore.excitation.information import Information
from lipcore.excitation.motions import Shape, draw, overshoot
from lipcore.excitation.searching import MAX_TORQUE_SHARE, Goal, TorqueCheck, search
from lipcore.posterior.exact import ExactPosterior
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, inverse_dynamics, simulate
from lipcore.robots.urdf import RigidBody
from tests.lipcore.oracles import with_full_counts

NOISE = 0.05
QUICK_OPTIONS = lipcore.FitOptions(
    hyperparameter_samples=20, posterior_samples=40, max_iterations=4, starts=1, device="cpu"
)
SHORT_PLAN = PlanOptions(8.0, 10.0, iterations=6, starts=4, budget_s=1000.0, references=20)


@pytest.fixture(scope="module")
def robot():
    return load_robot("double-pendulum")


@pytest.fixture(scope="module")
def limits(robot):
    unknown = np.full(2, np.nan)
    known = robot.joint_names, robot.joint_types, robot.lower, robot.upper, robot.speed
    return Limits.with_defaults(*known, unknown, unknown).within(0.5, 1.0)


@pytest.fixture(scope="module")
def prior(robot, limits):
    return Belief.prior(robot, limits, NOISE)


@pytest.fixture(scope="module")
def samples(robot):
    return simulate(robot, Simulation(n_samples=40, speed=5.0, noise=NOISE), 3)


@pytest.fixture(scope="module")
def model(robot, samples):
    trained = lipcore.train(samples, robot.joint_types, "lip-chain", replace(QUICK_OPTIONS, compact_tolerance=1e-6))
    return with_full_counts(trained, samples)


def concatenate_motions(*motions):
    return Motion(*(np.concatenate([getattr(each, name) for each in motions]) for name in ("q", "dq", "ddq")))


def exact_variance(belief, seen, query, noise_variance):
    """Compute variances by the exact posterior, independently of the planner."""
    params = {**belief.params, "noise.log_std": 0.5 * np.log(noise_variance)}
    posterior = ExactPosterior.fit(belief.kernel, params, seen, np.zeros_like(seen.q), 1.0)
    return np.square(posterior.predict(query).std)


def test_remaining_variance_matches_the_exact_posterior(prior, limits):
    seen, query = draw(limits, 12, 1), draw(limits, 9, 2)
    found = Information.about(prior, query).left(seen)
    before = prior.kernel.variance(prior.params, query).diagonal(axis1=1, axis2=2)
    expected = np.exp(np.log(exact_variance(prior, seen, query, prior.noise_variance) / before).mean(0))
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    information, four = Information.about(prior, query), concatenate_motions(seen, seen, seen, seen)
    np.testing.assert_allclose(information.left(seen, 4.0), information.left(four), rtol=1e-5)


def test_learnt_samples_are_not_credited_again(model, samples, limits):
    belief = Belief.of_model(model)
    seen, more, query = samples.motion(), draw(limits, 10, 5), draw(limits, 8, 6)
    found = Information.about(belief, query).left(more)
    before = exact_variance(belief, seen, query, belief.noise_variance)
    after = exact_variance(belief, concatenate_motions(seen, more), query, belief.noise_variance)
    np.testing.assert_allclose(found, np.exp(np.log(after / before).mean(0)), rtol=2e-3)


@pytest.mark.parametrize("known", ["prior", "model", "rigid-body"])
def test_gradient_of_information_matches_finite_differences(known, robot, prior, model, limits):
    if known == "rigid-body":
        bodies = RigidBody.from_profile("double-pendulum", robot.joint_names, robot.joint_types)
        belief = Belief.prior(robot, limits, NOISE, known, bodies)
    else:
        belief = prior if known == "prior" else Belief.of_model(model)
    information, motion = Information.about(belief, draw(limits, 6, 7)), draw(limits, 5, 8)
    value, slope = information.slope(motion, 2.0)
    assert value == pytest.approx(float(np.log(information.left(motion, 2.0)).mean()), rel=1e-9)
    rng, h = np.random.default_rng(9), 1e-5
    for name in ("q", "dq", "ddq"):
        direction = rng.standard_normal(motion.q.shape)
        moved = [replace(motion, **{name: getattr(motion, name) + step * direction}) for step in (h, -h)]
        up, down = (float(np.log(information.left(each, 2.0)).mean()) for each in moved)
        found = float((getattr(slope, name) * direction).sum())
        assert found == pytest.approx((up - down) / (2 * h), rel=1e-3, abs=1e-6)


def test_gradient_of_the_goal_with_torque_limits(robot, prior, limits):
    tight = replace(limits, torque=np.array([0.5, 0.3]))
    shape = Shape.build(tight, 6.0, 4)
    check = TorqueCheck(robot, tight)
    goal = Goal.build(shape, Information.about(prior, draw(tight, 6, 10)), check, 20)
    rng, h = np.random.default_rng(11), 1e-6
    x, direction = shape.random(rng), rng.standard_normal(shape.size)
    assert check.excess(*shape.motion(x, goal.t))[0] > 0
    value, slope = goal.slope(x)
    assert value == pytest.approx(goal.value(x), rel=1e-9)
    numeric = (goal.value(x + h * direction) - goal.value(x - h * direction)) / (2 * h)
    assert float((slope * direction).sum()) == pytest.approx(numeric, rel=1e-3)


def test_search_reduces_variance_and_is_reproducible(robot, prior, limits):
    begun, made = plan(prior, limits, replace(SHORT_PLAN, iterations=0)), plan(prior, limits, SHORT_PLAN)
    assert made.iterations == SHORT_PLAN.iterations
    assert not made.out_of_time
    assert np.log(made.left).mean() < np.log(begun.left).mean() - 0.1
    again, other = plan(prior, limits, SHORT_PLAN), plan(prior, limits, replace(SHORT_PLAN, seed=1))
    np.testing.assert_array_equal(made.series.sine, again.series.sine)
    assert not np.array_equal(made.series.sine, other.series.sine)


@pytest.mark.slow
def test_plan_informs_more_than_random_sinusoids(robot, model, limits):
    made = plan(Belief.of_model(model), limits, replace(SHORT_PLAN, iterations=25, references=60))
    own = replace(robot, lower=limits.lower, upper=limits.upper, speed=limits.speed)
    fresh = Information.about(Belief.of_model(model), draw(limits, 40, 99))
    t, *motion = made.table()
    planned = fresh.left(Motion.from_arrays(*motion))
    for seed in range(3):
        for speed in (1.0, 10.0):
            stream = simulate(own, Simulation(n_samples=len(t), motion="full", speed=speed), seed)
            assert float(np.log(planned).mean()) < float(np.log(fresh.left(stream.motion())).mean())


def test_table_keeps_all_limits_and_the_requested_length(robot, prior, limits):
    tight = replace(limits, torque=np.array([6.0, 2.0]))
    made = plan(prior, tight, SHORT_PLAN, robot)
    t, q, dq, ddq = made.table()
    assert len(t) == 81
    assert t[-1] == pytest.approx(8.0)
    q, dq, ddq = made.series.at(np.linspace(0, 8.0, 20_000))
    assert (made.series.used(tight) <= 1 + 1e-9).all()
    assert (np.abs(inverse_dynamics(robot, q, dq, ddq)) <= tight.torque).all()
    assert (made.used[3] <= MAX_TORQUE_SHARE + 1e-9).all()


def test_weak_robot_is_rejected_and_budget_ends_search(robot, prior, limits):
    goal = Goal.build(Shape.build(limits, 5.0, 3), Information.about(prior, draw(limits, 5, 1)), None, 20)
    found = search(goal, 2, 50, 0, until=-np.inf)
    assert (found.iterations, found.out_of_time) == (0, True)
    shifted = replace(limits, lower=limits.lower + 1.2, upper=limits.upper + 1.2, torque=np.array([1e-3, 1e-3]))
    with pytest.raises(ValueError, match="to hold the robot still in the middle of its range"):
        plan(prior, shifted, replace(SHORT_PLAN, iterations=0), robot)


def test_joint_count_and_noise_are_checked(robot, prior, limits):
    one = Limits(("a",), *(np.array([value]) for value in (-1.0, 1.0, 1.0, 1.0, np.inf)))
    with pytest.raises(ValueError, match="limits have 1 joints, the model has 2"):
        plan(prior, one, SHORT_PLAN)
    with pytest.raises(ValueError, match=r"noise_std is 0\.0, expected positive numbers"):
        Belief.prior(robot, limits, 0.0)


ROUNDING_TOLERANCE = 1e-9


def random_limits(rng: np.random.Generator, n: int) -> Limits:
    middle, half = rng.uniform(-2, 2, n), rng.uniform(0.01, 3, n)
    speed, acceleration = 10 ** rng.uniform(-2, 1.5, n), 10 ** rng.uniform(-2, 2, n)
    names = tuple(f"j{k}" for k in range(n))
    return Limits(names, middle - half, middle + half, speed, acceleration, np.full(n, np.inf))


@st.composite
def shapes(draw: st.DrawFn) -> tuple[Shape, np.ndarray]:
    """Draw a shape with random limits, and coefficients of any size."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    limits = random_limits(rng, draw(st.integers(1, 4)))
    shape = Shape.build(limits, draw(st.floats(0.5, 100)), draw(st.integers(2, 12)))
    size = 10 ** draw(st.floats(-3, 6))
    x = size * rng.standard_normal(shape.size)
    x[rng.random(shape.size) < draw(st.floats(0, 0.9))] = 0.0
    return shape, x


@given(shapes())
def test_no_limit_is_exceeded_between_instants(problem):
    shape, x = problem
    series, limits = shape.series(x), shape.limits
    # far denser than the instants that the code checks, and between them
    t = (np.arange(20_000) + 0.37) / 20_000 * shape.seconds
    q, dq, ddq = series.at(t)
    room = ROUNDING_TOLERANCE * limits.half
    assert (q >= limits.lower - room).all()
    assert (q <= limits.upper + room).all()
    assert (np.abs(dq) <= limits.speed * (1 + ROUNDING_TOLERANCE)).all()
    assert (np.abs(ddq) <= limits.acceleration * (1 + ROUNDING_TOLERANCE)).all()
    ends, *still = series.at(np.array([0.0, shape.seconds]))  # the ends are at rest at the same position
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9 * (1 + np.abs(ends[0]).max()))
    for values, limit in zip(still, (limits.speed, limits.acceleration), strict=True):
        assert (np.abs(values) <= 1e-9 * limit).all()
    used = series.used(limits)
    assert (used <= 1 + ROUNDING_TOLERANCE).all()
    peaks = np.array([np.abs(q - limits.middle).max(0), np.abs(dq).max(0), np.abs(ddq).max(0)])
    shares = peaks / np.array([limits.half, limits.speed, limits.acceleration])
    assert (shares <= used + ROUNDING_TOLERANCE).all()
    assert (used <= 1.01 * shares + ROUNDING_TOLERANCE).all()


def test_series_derivatives_match_its_positions():
    rng = np.random.default_rng(4)
    series = Series(3.0, rng.standard_normal(2), *rng.standard_normal((2, 6, 2)))
    t, h = np.linspace(0.1, 2.9, 40), 1e-5
    _, dq, ddq = series.at(t)
    before, after = series.at(t - h), series.at(t + h)
    np.testing.assert_allclose(dq, (after[0] - before[0]) / (2 * h), atol=1e-6)
    np.testing.assert_allclose(ddq, (after[1] - before[1]) / (2 * h), atol=1e-5)
    one = Series(2.0, np.array([0.5]), np.array([[0.0], [3.0]]), np.array([[1.0], [0.0]]))
    # by hand: q = 0.5 + 3 sin(2 π t) / (2 π) − cos(π t) / π
    np.testing.assert_allclose(
        one.at(t)[0][:, 0], 0.5 + 3 * np.sin(2 * np.pi * t) / (2 * np.pi) - np.cos(np.pi * t) / np.pi, atol=1e-14
    )


def test_polynomial_reaches_the_bound_of_ehlich_and_zeller():
    # cos(K t − π K / m) has its largest magnitudes midway between m even instants
    for harmonics, instants in ((3, 12), (5, 40)):
        t = 2 * np.pi * np.arange(instants) / instants
        seen = np.abs(np.cos(harmonics * t + np.pi * harmonics / instants)).max()
        assert overshoot(harmonics, instants) * seen == pytest.approx(1.0, rel=1e-12)


def test_unknown_limits_get_defaults():
    nan = np.array([np.nan, np.nan])
    speed = np.array([2.0, np.inf])
    found = Limits.with_defaults(("a", "b"), ("revolute", "prismatic"), nan, nan, speed, nan, np.zeros(2))
    np.testing.assert_allclose(found.upper, [np.pi, 0.5])
    np.testing.assert_allclose(found.speed, [2.0, 0.2])
    np.testing.assert_allclose(found.acceleration, [8.0, 0.8])
    assert np.isinf(found.torque).all()
    share = found.within(0.5, 0.25)
    np.testing.assert_allclose(share.half, found.half / 2)
    np.testing.assert_allclose(share.acceleration, found.acceleration / 4)
    np.testing.assert_allclose(found.within(reach=0.005).half, 0.005)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda limits: PlanOptions(seconds=0.0), "seconds is 0.0, expected a positive number"),
        (lambda limits: PlanOptions(rate=float("nan")), "rate is nan"),
        (lambda limits: PlanOptions(harmonics=1), "harmonics is 1, expected a whole number from 2"),
        (lambda limits: PlanOptions(starts=0), "starts is 0"),
        (lambda limits: PlanOptions(seconds=0.01, rate=1.0), "0.01 s at 1.0 Hz are 1 samples"),
        (lambda limits: limits.within(0.0), "share of position is 0.0, expected a number above 0"),
        (lambda limits: limits.within(1.0, 1.2), "share of motion is 1.2"),
        (lambda limits: limits.within(reach=-1.0), "reach is -1.0"),
        (lambda limits: Shape.build(limits, 1.0, 1), "harmonics is 1, expected at least 2"),
        (lambda limits: Limits(("a",), *(np.ones(1) for _ in range(5))), "joint 'a' may move from 1.0 to 1.0"),
        (lambda limits: Limits(("a",), *(np.ones(2) for _ in range(5))), "lower has shape"),
        (lambda limits: Limits(("a",), -np.ones(1), np.ones(1), -np.ones(1), np.ones(1), np.ones(1)), "speed is"),
    ],
)
def test_invalid_options_and_limits_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make(random_limits(np.random.default_rng(6), 2))
