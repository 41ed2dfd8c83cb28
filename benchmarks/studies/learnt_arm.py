"""The learnt arm on simulated robots: accuracy, coverage, and how often the search finds the best geometry.

    learnt_arm.py rows [SEEDS]                accuracy and coverage of Panda, UR10, xArm7, Z1, TIAGo's arm
    learnt_arm.py search [FIRST LAST SEEDS]   random arms: evidence against that of the true geometry
    learnt_arm.py answer                      one query of the shipped model, beside Pinocchio's RNEA

Training motions are those of the paper's experiment (50 sinusoids), tests have twice the bandwidth (100). Training
seeds are 5001, 5002, …; test seeds a hundred more. What is reported are arms 1 to 20 of `search` and `rows`, with five
training seeds each; nothing was tuned on them, but on arms above 1000.
The geometries of installed URDFs are not looked at (`known=()`), so that nothing but torque is used.
"""

import sys
import time
from pathlib import Path

import numpy as np
import torch
from threadpoolctl import threadpool_limits

import lipcore
from lipcore import FitOptions
from lipcore.arm.learning import POLISHING
from lipcore.arm.posing import make_problem
from lipcore.data.metrics import evaluate
from lipcore.data.motion import motion_arrays
from lipcore.data.samples import Samples
from lipcore.kernels.geometry import Geometry
from lipcore.posterior.selection import spread_out
from lipcore.robots.library import Robot, load_robot, pinocchio, random_arm
from lipcore.robots.simulation import Stream, inverse_dynamics, simulate
from lipcore.training import auto, fit

ROWS = (
    ("panda", 1.0, "middle", 500),
    ("panda", 10.0, "middle", 500),
    ("panda", 10.0, "middle", 60),
    ("panda", 1.0, "full", 500),
    ("ur10", 10.0, "middle", 500),
    ("xarm7", 10.0, "middle", 500),
    ("z1", 10.0, "middle", 500),
    ("tiago", 10.0, "middle", 500),
)
FRICTION, NOISE = 0.3, 0.05
"""N·m·s/rad and N·m; N·m: of random arms."""
FOUND = 1.0
"""nats, by which the evidence found may be worse than that at the true geometry."""


def true_geometry(robot: Robot) -> Geometry:
    """Geometry of a simulated robot."""
    places = tuple(robot.model.jointPlacements)[1:]
    return Geometry(
        robot.joint_types,
        np.array([place.rotation for place in places]),
        np.array([place.translation for place in places]),
        np.tile([0.0, 0.0, 1.0], (robot.n_joints, 1)),
        np.array(robot.model.gravity.linear),
    )


def best_known(robot: Robot, samples: Samples, options: FitOptions) -> float:
    """Evidence that the true geometry leads to, nats, on the rows that a training looks at."""
    rows = spread_out(samples.motion(), options.posterior_samples).numpy()
    problem, _ = make_problem(samples.rows(rows), robot.joint_types, options, True, None, samples)
    sigma = np.full(robot.n_joints, NOISE)
    return problem.descend(true_geometry(robot), sigma, POLISHING).value


def rows(seeds: int) -> None:
    """Print nMSE and coverage of each joint, medians over training seeds, and the lowest coverage of a trajectory."""
    for name, speed, motion, count in ROWS:
        robot, errors, covers, seconds = load_robot(name), [], [], []
        for seed in range(5001, 5001 + seeds):
            training = simulate(robot, Stream(count, n_sinusoids=50, speed=speed, motion=motion), seed)
            began = time.perf_counter()
            found = lipcore.train(training, robot.joint_types, "rigid-body", FitOptions(device="cpu"))
            seconds.append(time.perf_counter() - began)
            unseen = simulate(robot, Stream(500, n_sinusoids=100, speed=speed, motion=motion), seed + 100)
            true = inverse_dynamics(robot, unseen.q, unseen.dq, unseen.ddq)
            answer = found.predict(unseen.q, unseen.dq, unseen.ddq)
            figures = evaluate(unseen.tau, *answer.interval)
            errors.append(((answer.tau - true) ** 2).mean(0) / true.var(0))
            covers.append(figures.coverage)
        nmse = " ".join(f"{value:.1e}" for value in np.median(errors, axis=0))
        mean = " ".join(f"{100 * value:.0f}" for value in np.mean(covers, axis=0))
        print(f"| {name}, {motion}, speed {speed:g}, {count} | {nmse} | {mean} ({100 * np.min(covers):.0f}) |", end=" ")
        print(f"{np.median(seconds):.1f} s, at most {np.max(seconds):.1f} |", flush=True)


def search(first: int, last: int, seeds: int) -> None:
    """Print, for each random arm, how much worse the evidence found is than that of the true geometry."""
    options, wins, total, covers = FitOptions(device="cpu"), 0, 0, []
    for number in range(first, last + 1):
        robot = random_arm(number, prismatic=1 if number % 5 == 0 else None)
        for seed in range(5001, 5001 + seeds):
            stream = Stream(
                500, n_sinusoids=50, speed=10.0, motion="full", noise=NOISE, viscous=FRICTION, coulomb=FRICTION
            )
            training = simulate(robot, stream, seed)
            began = time.perf_counter()
            found = lipcore.train(training, robot.joint_types, "rigid-body", options)
            seconds, best = time.perf_counter() - began, best_known(robot, training, options)
            behind = float(found.fit["search_objective"]) - best
            unseen = simulate(robot, stream, seed + 100)
            answer = found.predict(unseen.q, unseen.dq, unseen.ddq)
            cover = evaluate(unseen.tau, *answer.interval).coverage
            covers.append(cover.min())
            wins, total = wins + (behind < FOUND), total + 1
            print(
                f"arm {number}, {robot.n_joints} joints, seed {seed}: {behind:+.1f} nats in {seconds:.1f} s, best in "
                f"{found.fit['search_times_best']} of {found.fit['search_starts'] + found.fit['search_hops']}, next "
                f"{found.fit.get('search_next_nats', np.nan):.0f} nats, coverage {100 * cover.min():.0f}"
                f"-{100 * cover.max():.0f} %",
                flush=True,
            )
    print(f"best geometry found in {wins} of {total}; lowest coverage of a joint {100 * np.min(covers):.0f} %")


def answer() -> None:
    """Print the median time of an answer in process, µs, and that of Pinocchio's RNEA."""
    robot, shipped = load_robot("panda"), lipcore.load(Path(__file__).parents[2] / "models/panda-sim")
    q, dq, ddq = (part[0] for part in motion_arrays(*np.random.default_rng(0).uniform(-1, 1, (3, 7))))
    motion, data = np.ascontiguousarray(np.stack([q, dq, ddq])), robot.model.createData()
    shipped.warm_up()
    for name, ask in (
        ("with tau_std", lambda: shipped.answer(motion)),
        ("mean alone", lambda: shipped.answer(motion, std=False)),
        ("Pinocchio's RNEA", lambda: pinocchio().rnea(robot.model, data, q, dq, ddq)),
    ):
        times = []
        for _ in range(5000):
            began = time.perf_counter_ns()
            ask()
            times.append(time.perf_counter_ns() - began)
        print(f"{name}: {np.median(times) / 1e3:.1f} µs")


def main() -> None:
    """Run what is asked for."""
    torch.set_num_threads(1)
    fit.known_geometries = auto.known_geometries = lambda types, gravity: ()  # type: ignore[assignment]
    what, numbers = sys.argv[1], [int(each) for each in sys.argv[2:]]
    with threadpool_limits(1):
        if what == "answer":
            answer()
        elif what == "rows":
            rows(*(numbers or [5]))
        else:
            search(*(numbers or [1, 20, 5]))


if __name__ == "__main__":
    main()
