"""Accuracy after training on motions planned by `lipserve excite`, compared with random sinusoids.

    python benchmarks/studies/excitation.py [SEEDS…]      # 2 to 5 minutes a seed

Each seed has three recordings of a simulated Panda with equal length, rate, noise and range of the joints: the paper's
random sinusoids, the same at ten times the frequencies, and a motion planned without data, like `lipserve excite
--robot panda --seconds 50 --rate 10 --noise 0.01`. Each trains a model with default options. Tests are the paper's sums
of 100 sinusoids, the same at ten times the frequencies, and moves from pose to pose. nMSE is against the torque without
noise; std is the root mean square of `tau_std`, N·m. Figures are geometric means over joints and trajectories; the last
lines of each test compare them seed by seed.
"""

import sys
import time

import numpy as np
from threadpoolctl import threadpool_limits

import lipcore
from lipcore.excitation import Belief, Limits, PlanOptions, plan
from lipcore.profiles import profile
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import FAST_SPEED, Simulation, inverse_dynamics, sinusoids

SEEDS = range(101, 106)
TESTS = range(9001, 9005)
SECONDS, RATE, NOISE = 50.0, 10.0, 0.01
RANGE, SCALE = 0.95, 0.9  # the defaults of `lipserve excite`
STRIDE = 5
PAUSE = 0.2
T = np.arange(round(SECONDS * RATE)) / RATE
Motion = tuple[np.ndarray, np.ndarray, np.ndarray]
ARMS = ("random", "random, fast", "planned")


def random(robot: Robot, speed: float, count: int, seed: int) -> Motion:
    """Return the paper's sinusoids over the whole range, without acceleration limits."""
    stream = Simulation(len(T), RATE, count, "full", speed)
    return sinusoids(robot, stream, T, np.random.default_rng(seed))


def moves(limits: Limits, seed: int) -> Motion:
    """Return minimum-jerk moves between random poses, at half to full speed, with short pauses."""
    rng, n = np.random.default_rng(seed), limits.n_joints
    q, dq, ddq = (np.zeros((len(T), n)) for _ in range(3))
    begin, pose = 0.0, rng.uniform(limits.lower, limits.upper)
    while begin <= T[-1]:
        step = rng.uniform(limits.lower, limits.upper) - pose
        fastest = max(
            (1.875 * np.abs(step) / limits.speed).max(), np.sqrt(5.7736 * np.abs(step) / limits.acceleration).max()
        )
        took = fastest * rng.uniform(1, 2)
        rows = (begin <= T) & (begin + took + PAUSE > T)
        s = np.clip((T[rows] - begin) / took, 0, 1)[:, None]
        q[rows] = pose + step * (10 * s**3 - 15 * s**4 + 6 * s**5)
        dq[rows] = step * (30 * s**2 - 60 * s**3 + 30 * s**4) / took
        ddq[rows] = step * (60 * s - 180 * s**2 + 120 * s**3) / took**2
        begin, pose = begin + took + PAUSE, pose + step
    return q, dq, ddq


def train(robot: Robot, motion: Motion, seed: int) -> lipcore.TorqueModel:
    """Simulate the measurement of a motion and train on it with default options."""
    tau = inverse_dynamics(robot, *motion) + NOISE * np.random.default_rng([seed, 1]).standard_normal(motion[0].shape)
    samples = lipcore.Samples(robot.joint_names, T, np.zeros(len(T), dtype=np.int64), *motion, tau)
    return lipcore.train(samples, robot.joint_types, "lip-chain")


def score(robot: Robot, model: lipcore.TorqueModel, tests: list[Motion]) -> np.ndarray:
    """Return geometric means of nMSE and std, and mean coverage of the 95 % interval, (3,)."""
    nmse, std, covered = [], [], []
    for k, test in enumerate(tests):
        truth, answer = inverse_dynamics(robot, *test), model.predict(*test)
        nmse.append(np.mean((truth - answer.tau) ** 2, axis=0) / truth.var(axis=0))
        std.append(np.sqrt(np.mean(answer.tau_std**2, axis=0)))
        measured = truth + NOISE * np.random.default_rng([k, 2]).standard_normal(truth.shape)
        covered.append(np.abs(measured - answer.tau) <= 1.96 * np.hypot(answer.tau_std, answer.noise_std))
    return np.array([np.exp(np.log(nmse).mean()), np.exp(np.log(std).mean()), np.mean(covered)])


def main(seeds: list[int]) -> None:
    """Train and test for each seed; print figures and ratios planned / random."""
    threadpool_limits(1)
    robot, limits = load_robot("panda"), Limits.of_profile(profile("panda")).within(RANGE, SCALE)
    tests = {
        "sinusoids": [random(robot, 1.0, 100, seed) for seed in TESTS],
        "fast sinusoids": [random(robot, FAST_SPEED, 100, seed) for seed in TESTS],
        "moves": [moves(limits, seed) for seed in TESTS],
    }
    tests = {name: [tuple(part[::STRIDE] for part in test) for test in some] for name, some in tests.items()}
    found = {arm: {name: [] for name in tests} for arm in ARMS}
    for seed in seeds:
        began = time.monotonic()
        belief = Belief.prior(robot, limits, NOISE, seed=seed)
        made = plan(belief, limits, PlanOptions(SECONDS, RATE, budget_s=3600, seed=seed), robot)
        planned = tuple(part[: len(T)] for part in made.table()[1:])
        print(f"seed {seed}: planned in {time.monotonic() - began:.0f} s, {made.iterations} iterations")
        motions = (random(robot, 1.0, 50, seed), random(robot, FAST_SPEED, 50, seed), planned)
        for arm, motion in zip(ARMS, motions, strict=True):
            began, model = time.monotonic(), train(robot, motion, seed)
            took = time.monotonic() - began
            figures = {name: score(robot, model, some) for name, some in tests.items()}
            for name, value in figures.items():
                found[arm][name].append(value)
            shown = "; ".join(f"{name} {v[0]:.2e} / {v[1]:.3f} / {v[2]:.1%}" for name, v in figures.items())
            print(f"  {arm:13} nMSE / std / coverage: {shown} (trained in {took:.0f} s)", flush=True)
    for name in tests:
        print(f"tested on {name}:")
        for arm in ARMS:
            nmse, std, covered = np.array(found[arm][name]).T
            print(
                f"  {arm:13} nMSE median {np.median(nmse):.2e}  std median {np.median(std):.3f} N·m  "
                f"coverage mean {np.mean(covered):.1%}"
            )
        for arm in ARMS[:2]:
            for what, column in (("nMSE", 0), ("std", 1)):
                pairs = np.array(found["planned"][name])[:, column] / np.array(found[arm][name])[:, column]
                print(
                    f"  {what} planned / {arm}: {' '.join(f'{ratio:.2g}' for ratio in pairs)}; geometric mean "
                    f"{np.exp(np.log(pairs).mean()):.2g}, better in {(pairs < 1).sum()} of {len(pairs)}"
                )


if __name__ == "__main__":
    main([int(each) for each in sys.argv[1:]] or list(SEEDS))
