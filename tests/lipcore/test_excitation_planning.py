"""Planning: variance against the posterior of a model that has really seen the motion, slopes, limits, and benefit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import lipcore
from lipcore.data.motion import Motion
from lipcore.excitation import Belief, Limits, PlanOptions, plan
from lipcore.excitation.information import Information
from lipcore.excitation.motions import Shape, draw
from lipcore.excitation.searching import MARGIN, Goal, TorqueCheck, search
from lipcore.posterior.exact import ExactPosterior
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Stream, inverse_dynamics, simulate
from lipcore.robots.urdf import RigidBody

NOISE = 0.05
QUICK = lipcore.FitOptions(hyperparameter_samples=20, posterior_samples=40, max_iterations=4, starts=1, device="cpu")
SHORT = PlanOptions(8.0, 10.0, iterations=6, starts=4, budget_s=1000.0, references=20)


@pytest.fixture(scope="module")
def robot():
    return load_robot("double-pendulum")


@pytest.fixture(scope="module")
def limits(robot):
    return replace(Limits.of_robot(robot), torque=np.array([np.inf, np.inf])).within(0.5, 1.0)


@pytest.fixture(scope="module")
def prior(robot, limits):
    return Belief.prior(robot, limits, NOISE)


@pytest.fixture(scope="module")
def samples(robot):
    return simulate(robot, Stream(n_samples=40, speed=5.0, noise=NOISE), 3)


@pytest.fixture(scope="module")
def model(robot, samples):
    return lipcore.train(samples, robot.joint_types, "lip-chain", replace(QUICK, compact_tolerance=1e-6))


def both(*motions):
    return Motion(*(torch.cat([getattr(each, name) for each in motions]) for name in ("q", "dq", "ddq")))


def exact_variance(belief, seen, query, noise_variance):
    """By the exact posterior's own formulas, another code than the planner's."""
    params = {**belief.params, "noise.log_std": 0.5 * noise_variance.log()}
    posterior = ExactPosterior.fit(belief.kernel, params, seen, torch.zeros_like(seen.q), 1.0)
    return posterior.predict(query).std.square()


def test_what_is_left_of_a_prior_is_what_the_exact_posterior_has(prior, limits):
    seen, query = draw(limits, 12, 1), draw(limits, 9, 2)
    found = Information.about(prior, query).left(seen)
    before = prior.kernel.variance(prior.params, query).diagonal(dim1=1, dim2=2)
    expected = (exact_variance(prior, seen, query, prior.noise_variance) / before).log().mean(0).exp()
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_sample_that_stands_for_four_tells_what_four_equal_ones_tell(prior, limits):
    seen, information = draw(limits, 6, 3), Information.about(prior, draw(limits, 5, 4))
    np.testing.assert_allclose(information.left(seen, 4.0), information.left(both(seen, seen, seen, seen)), rtol=1e-5)


def test_what_a_model_has_learnt_is_not_credited_again(model, samples, limits):
    belief = Belief.of_model(model)
    seen, more, query = samples.motion(), draw(limits, 10, 5), draw(limits, 8, 6)
    found = Information.about(belief, query).left(more)
    before = exact_variance(belief, seen, query, belief.noise_variance)
    after = exact_variance(belief, both(seen, more), query, belief.noise_variance)
    np.testing.assert_allclose(found, (after / before).log().mean(0).exp(), rtol=2e-3)


@pytest.mark.parametrize("known", ["prior", "model"])
def test_slopes_are_those_of_the_value(known, prior, model, limits):
    belief = prior if known == "prior" else Belief.of_model(model)
    information, motion = Information.about(belief, draw(limits, 6, 7)), draw(limits, 5, 8)
    value, slope = information.slope(motion, 2.0)
    assert value == pytest.approx(float(information.left(motion, 2.0).log().mean()), rel=1e-9)
    rng, h = np.random.default_rng(9), 1e-5
    for name in ("q", "dq", "ddq"):
        direction = torch.from_numpy(rng.standard_normal(motion.q.shape))
        moved = [replace(motion, **{name: getattr(motion, name) + step * direction}) for step in (h, -h)]
        up, down = (float(information.left(each, 2.0).log().mean()) for each in moved)
        assert float((getattr(slope, name) * direction).sum()) == pytest.approx(
            (up - down) / (2 * h), rel=1e-3, abs=1e-6
        )


def test_slope_of_the_goal_with_torque_limits(robot, prior, limits):
    tight = replace(limits, torque=np.array([0.5, 0.3]))
    shape = Shape.build(tight, 6.0, 4)
    check = TorqueCheck(robot, tight)
    goal = Goal.build(shape, Information.about(prior, draw(tight, 6, 10)), check, 20)
    rng, h = np.random.default_rng(11), 1e-6
    x, direction = shape.random(rng), rng.standard_normal(shape.size)
    assert check.excess(*(part.numpy() for part in shape.motion(torch.from_numpy(x), goal.t)))[0] > 0
    value, slope = goal.slope(x)
    assert value == pytest.approx(goal.value(x), rel=1e-9)
    numeric = (goal.value(x + h * direction) - goal.value(x - h * direction)) / (2 * h)
    assert float((slope * direction).sum()) == pytest.approx(numeric, rel=1e-3)


def test_searching_leaves_less_than_where_it_began_and_equal_seeds_give_equal_motions(robot, prior, limits):
    begun, made = plan(prior, limits, replace(SHORT, iterations=0)), plan(prior, limits, SHORT)
    assert made.iterations == SHORT.iterations
    assert not made.out_of_time
    assert np.log(made.left).mean() < np.log(begun.left).mean() - 0.1
    again, other = plan(prior, limits, SHORT), plan(prior, limits, replace(SHORT, seed=1))
    np.testing.assert_array_equal(made.series.sine, again.series.sine)
    assert not np.array_equal(made.series.sine, other.series.sine)


def test_a_plan_tells_more_than_random_sinusoids_about_what_a_model_does_not_know(robot, model, limits):
    made = plan(Belief.of_model(model), limits, replace(SHORT, iterations=25, references=60))
    own = replace(robot, lower=limits.lower, upper=limits.upper, speed=limits.speed)
    fresh = Information.about(Belief.of_model(model), draw(limits, 40, 99))
    t, *motion = made.table()
    planned = fresh.left(Motion.from_arrays(*motion))
    for seed in range(3):
        for speed in (1.0, 10.0):
            stream = simulate(own, Stream(n_samples=len(t), motion="full", speed=speed), seed)
            assert float(planned.log().mean()) < float(fresh.left(stream.motion()).log().mean())


def test_the_table_keeps_all_limits_and_has_the_length_asked_for(robot, prior, limits):
    tight = replace(limits, torque=np.array([6.0, 2.0]))
    made = plan(prior, tight, SHORT, robot)
    t, q, dq, ddq = made.table()
    assert len(t) == 81
    assert t[-1] == pytest.approx(8.0)
    dense = np.linspace(0, 8.0, 20_000)
    q, dq, ddq = made.series.at(dense)
    assert (q >= tight.lower - 1e-9).all()
    assert (q <= tight.upper + 1e-9).all()
    assert (np.abs(dq) <= tight.speed * (1 + 1e-9)).all()
    assert (np.abs(ddq) <= tight.acceleration * (1 + 1e-9)).all()
    assert (np.abs(inverse_dynamics(robot, q, dq, ddq)) <= tight.torque).all()
    assert (made.used[3] <= MARGIN + 1e-9).all()


def test_too_weak_a_robot_is_said(robot, prior, limits):
    shifted = replace(limits, lower=limits.lower + 1.2, upper=limits.upper + 1.2, torque=np.array([1e-3, 1e-3]))
    with pytest.raises(ValueError, match="to hold the robot still in the middle of its range"):
        plan(prior, shifted, replace(SHORT, iterations=0), robot)


def test_rigid_bodies_and_other_priors_can_be_planned_for(robot, limits):
    bodies = RigidBody.from_profile("double-pendulum", robot.joint_names, robot.joint_types)
    for estimator, given in (("rigid-body", bodies), ("se", None)):
        belief = Belief.prior(robot, limits, NOISE, estimator, given)
        made = plan(belief, limits, replace(SHORT, iterations=2, references=8))
        assert ((made.left > 0) & (made.left < 1)).all()


def test_the_budget_ends_a_search(prior, limits):
    goal = Goal.build(Shape.build(limits, 5.0, 3), Information.about(prior, draw(limits, 5, 1)), None, 20)
    found = search(goal, 2, 50, 0, until=-np.inf)
    assert (found.iterations, found.out_of_time) == (0, True)
    assert found.x.shape == goal.shape.size


def test_references_keep_the_limits_and_reach_all_over_them(limits):
    found = draw(limits, 500, 0)
    assert len(found) == 500
    for values, bound in ((found.q - torch.from_numpy(limits.middle), limits.half), (found.dq, limits.speed)):
        share = (values.abs() / torch.from_numpy(bound)).numpy()
        assert share.max() <= 1 + 1e-9
        assert (share.max(0) > 0.9).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seconds": 0.0}, "seconds is 0.0, expected a positive number"),
        ({"rate": float("nan")}, "rate is nan"),
        ({"budget_s": -1.0}, "budget_s is -1.0"),
        ({"harmonics": 1}, "harmonics is 1, expected a whole number from 2"),
        ({"starts": 0}, "starts is 0"),
        ({"seconds": 0.01, "rate": 1.0}, "0.01 s at 1.0 Hz are 1 samples"),
    ],
)
def test_impossible_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        PlanOptions(**options)


def test_joints_have_to_be_as_many_and_noise_positive(robot, prior, limits):
    one = Limits(("a",), *(np.array([value]) for value in (-1.0, 1.0, 1.0, 1.0, np.inf)))
    with pytest.raises(ValueError, match="limits have 1 joints, the model has 2"):
        plan(prior, one, SHORT)
    with pytest.raises(ValueError, match=r"noise_std is 0\.0, expected positive numbers"):
        Belief.prior(robot, limits, 0.0)
