"""Coverage of 95 % intervals as a function of the factor on the function's standard deviation.

Arms of example-robot-data get random masses (each link's inertia times 0.4 to 2.5). Models are trained on slow and on
fast motion with few and many samples, and tested on trajectories of twice the training's bandwidth.

    calibration.py collect OUT.npz ESTIMATOR ROBOT...    # train; store errors and standard deviations; minutes
    calibration.py report OUT.npz...                     # print coverage for each factor
"""

import sys
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

import lipcore
from lipcore.robots.library import Robot, load_robot, pinocchio
from lipcore.robots.simulation import FAST_SPEED, Simulation, simulate
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import ROBOT_ESTIMATORS

SEEDS, TESTS, SPEEDS, SIZES = (301, 302), 2, (1.0, FAST_SPEED), (60, 200, 500)
STRIDE = 5
FACTORS = (1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.75, 2.0, 2.5, 3.0)
Z95 = 1.959964


def randomised(robot: Robot, seed: int, low: float = 0.4, high: float = 2.5) -> Robot:
    """Return the arm with mass and inertia of every link scaled by a random factor from `low` to `high`."""
    pin, model = pinocchio(), robot.model.copy()
    scales = np.exp(np.random.default_rng(seed).uniform(np.log(low), np.log(high), model.njoints))
    for index in range(1, model.njoints):
        body = model.inertias[index]
        model.inertias[index] = pin.Inertia(body.mass * scales[index], body.lever, body.inertia * scales[index])
    return replace(robot, model=model)


def _bodies(name: str, robot: Robot, estimator: str) -> RigidBody | None:
    """Return the arm's geometry with the nominal masses, like a user's URDF."""
    if estimator not in ROBOT_ESTIMATORS:
        return None
    return RigidBody.from_profile(name, robot.joint_names, robot.joint_types)


def collect(path: str, estimator: str, names: list[str]) -> None:
    """Train on every arm, seed, speed and size; store residuals and uncalibrated standard deviations."""
    threadpool_limits(1)
    rows = []
    for name in names:
        for seed in SEEDS:
            robot = randomised(load_robot(name), seed)
            for speed in SPEEDS:
                stream = simulate(robot, Simulation(speed=speed), seed)
                tests = [
                    simulate(robot, Simulation(speed=speed, n_sinusoids=100), 10 * seed + k).rows(
                        slice(0, None, STRIDE)
                    )
                    for k in range(TESTS)
                ]
                for size in SIZES:
                    thinned = stream.rows(np.linspace(0, len(stream) - 1, size).round().astype(np.int64))
                    model = lipcore.train(thinned, robot.joint_types, estimator, robot=_bodies(name, robot, estimator))
                    for test in tests:
                        answer = model.predict(test.q, test.dq, test.ddq)
                        std = answer.tau_std / model.calibration.function_std_factor
                        for joint in range(robot.n_joints):
                            rows.append(
                                np.concatenate(
                                    [
                                        [names.index(name), seed, speed, size, joint, answer.noise_std[joint]],
                                        (test.tau - answer.tau)[:, joint],
                                        std[:, joint],
                                    ]
                                )
                            )
                    print(name, seed, speed, size, round(float(model.fit["seconds"]), 1), flush=True)
                    np.savez(path, rows=np.array(rows), names=names, estimator=estimator)


def report(paths: list[str]) -> None:
    """Print mean coverage for each factor: overall, by size and speed, and by arm."""
    rows, arms, estimators = [], [], set()
    for path in paths:
        with np.load(path) as file:
            rows.append(file["rows"])
            arms += [str(file["names"][int(k)]) for k in file["rows"][:, 0]]
            estimators.add(str(file["estimator"]))
    table, named = np.concatenate(rows), np.array(arms)
    speed, size, noise = table[:, 2], table[:, 3], table[:, 5:6]
    error, std = np.split(table[:, 6:], 2, axis=1)
    covered = np.array([(np.abs(error) < Z95 * np.sqrt((f * std) ** 2 + noise**2)).mean(1) for f in FACTORS])
    print(", ".join(sorted(estimators)), f"{len(table)} joint-trajectories; coverage of the 95 % interval by factor")
    print(f"{'factor':<24}" + "".join(f"{f:>7.2f}" for f in FACTORS))
    groups = {"all": np.ones(len(table), dtype=bool)}
    groups |= {f"{n:g} samples": size == n for n in SIZES} | {f"speed {v:g}": speed == v for v in SPEEDS}
    groups |= {f"{n:g} samples, speed {v:g}": (size == n) & (speed == v) for n in SIZES for v in SPEEDS}
    groups |= {name: named == name for name in dict.fromkeys(arms)}
    for title, chosen in groups.items():
        print(f"{title:<24}" + "".join(f"{value:>7.3f}" for value in covered[:, chosen].mean(1)))


if __name__ == "__main__":
    if sys.argv[1] == "collect":
        collect(sys.argv[2], sys.argv[3], sys.argv[4:])
    else:
        report(sys.argv[2:])
