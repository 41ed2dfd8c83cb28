"""Learnt arms of simulated robots: accuracy, coverage, latency, and success of the geometry search.

    learnt_arm.py rows [SEEDS]                accuracy and coverage of Panda, UR10, xArm7, Z1, TIAGo's arm
    learnt_arm.py search [FIRST LAST SEEDS]   random arms: evidence minus that at the true geometry
    learnt_arm.py answer                      latency of the shipped model and of Pinocchio's RNEA
    learnt_arm.py transfer FIRST LAST [ROBOT...]  10 s of a second unit, with and without a sibling's posterior

Training motions are those of the paper's experiment (50 sinusoids); tests have twice the bandwidth (100). Training
seeds are 5001, 5002, …; test seeds are 100 higher. Published figures are of arms 1 to 20 of `search` and of `rows`,
with five training seeds; constants were tuned on arms above 1000. `transfer` has the motions of `dirty_arms.py`, with
published seeds 0 to 2 and tuning seeds 50 and 51. The search does not use the geometries of installed URDFs.
"""

import sys
import time
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

import lipcore
from benchmarks.arms import another_unit, random_arm
from benchmarks.studies.dirty_arms import CASES, RATE, recorded, recording, unseen
from lipcore import FitOptions
from lipcore.arm import learning
from lipcore.arm.posing import make_problem
from lipcore.data.metrics import evaluate
from lipcore.data.motion import motion_arrays
from lipcore.data.samples import Samples
from lipcore.kernels.geometry import Geometry
from lipcore.posterior.selection import spread_out
from lipcore.robots.dirt import JOINT_SPREAD, Dirt
from lipcore.robots.library import Robot, load_robot, pinocchio
from lipcore.robots.simulation import Simulation, inverse_dynamics, simulate, usual_torque
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
"""Viscous (N·m·s/rad) and Coulomb friction (N·m), and noise (N·m), of random arms."""
MASS_SHARE = 0.1
"""Max relative difference of masses between two units."""
LONG_S, SHORT_S = 60.0, 10.0
MAX_DEFICIT_NATS = 1.0
"""Max deficit of evidence, against the true geometry, of a successful search."""


def true_geometry(robot: Robot) -> Geometry:
    """Return the geometry of a simulated robot."""
    places = tuple(robot.model.jointPlacements)[1:]
    return Geometry(
        robot.joint_types,
        np.array([place.rotation for place in places]),
        np.array([place.translation for place in places]),
        np.tile([0.0, 0.0, 1.0], (robot.n_joints, 1)),
        np.array(robot.model.gravity.linear),
    )


def best_known(robot: Robot, samples: Samples, options: FitOptions) -> float:
    """Return the evidence from the true geometry on the rows that a training uses, nats."""
    rows = spread_out(samples.motion(), options.posterior_samples)
    order = np.arange(robot.n_joints)
    problem = make_problem(samples.rows(rows), robot.joint_types, order, True, every=samples)
    sigma = np.full(robot.n_joints, NOISE)
    return problem.descend(true_geometry(robot), sigma, learning.OPTIONS.polish_steps).value


def rows(seeds: int) -> None:
    """Print median nMSE and mean coverage of each joint over training seeds, and the lowest coverage."""
    for name, speed, motion, count in ROWS:
        robot, errors, covers, seconds = load_robot(name), [], [], []
        for seed in range(5001, 5001 + seeds):
            training = simulate(robot, Simulation(count, n_sinusoids=50, speed=speed, motion=motion), seed)
            began = time.perf_counter()
            found = lipcore.train(training, robot.joint_types, "rigid-body", FitOptions(device="cpu"))
            seconds.append(time.perf_counter() - began)
            unseen = simulate(robot, Simulation(500, n_sinusoids=100, speed=speed, motion=motion), seed + 100)
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
    """Print the deficit of evidence against the true geometry for each random arm."""
    options, wins, total, covers = FitOptions(device="cpu"), 0, 0, []
    for number in range(first, last + 1):
        robot = random_arm(number, prismatic=1 if number % 5 == 0 else None)
        for seed in range(5001, 5001 + seeds):
            stream = Simulation(
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
            wins, total = wins + (behind < MAX_DEFICIT_NATS), total + 1
            print(
                f"arm {number}, {robot.n_joints} joints, seed {seed}: {behind:+.1f} nats in {seconds:.1f} s, best in "
                f"{found.fit['search_times_best']} of {found.fit['search_starts'] + found.fit['search_hops']}, next "
                f"{found.fit.get('search_next_nats', np.nan):.0f} nats, coverage {100 * cover.min():.0f}"
                f"-{100 * cover.max():.0f} %",
                flush=True,
            )
    print(f"best geometry found in {wins} of {total}; lowest coverage of a joint {100 * np.min(covers):.0f} %")


def units(robot: Robot, seed: int, dirty: bool) -> list[tuple[Robot, Simulation]]:
    """Return two units of a robot and their streams of LONG_S.

    Friction differs between the units, and masses by up to MASS_SHARE. Clean units have viscous friction and white
    noise.
    """
    out = []
    for number, unit in enumerate((robot, another_unit(robot, MASS_SHARE, seed))):
        dirt = Dirt(seed=2 * seed + number)
        stream, spread = (
            recording(LONG_S, dirt),
            np.random.default_rng(dirt.seed).uniform(-JOINT_SPREAD, JOINT_SPREAD, unit.n_joints),
        )
        if not dirty:
            viscous = usual_torque(robot) * dirt.viscous * (1 + spread)
            stream = replace(stream, dirt=None, noise=NOISE, viscous=tuple(viscous))
        out.append((unit, stream))
    return out


def without_noise(stream: Simulation) -> Simulation:
    """Return the stream without noise."""
    return replace(stream, noise=0.0, dirt=None if stream.dirt is None else replace(stream.dirt, noise=0.0))


def transfer(first: int, last: int, names: list[str]) -> None:
    """Print nMSE and coverage for each arm, simulator, test motion and training.

    nMSE is the mean over joints and seeds. The ratios are those to 60 s without a base, with measured torque and with
    torque without noise. Coverage is the mean over seeds; `lowest` is that of one joint and seed.
    """
    print(
        "| arm | simulator | unseen motion | trained on | nMSE | ratio | noise-free | coverage by joint, % | lowest |"
    )
    print("|" + " --- |" * 9)
    for name in names:
        robot, types = load_robot(name), load_robot(name).joint_types
        for dirty in (False, True):
            figures: dict[tuple[str, str], list[np.ndarray]] = {}
            for seed in range(first, last + 1):
                (old, of_old), (new, of_new) = units(robot, seed, dirty)
                short = replace(of_new, n_samples=round(SHORT_S * RATE))
                base = lipcore.train(recorded(old, of_old, 100 + seed), types, "rigid-body")
                few, many = (recorded(new, stream, 300 + seed) for stream in (short, of_new))
                models = {
                    "60 s": lipcore.train(many, types, "rigid-body"),
                    "10 s": lipcore.train(few, types, "rigid-body"),
                    "10 s and a base": lipcore.train(few, types, "rigid-body", base=base),
                    "the base alone": base,
                }
                for case, (way, model) in product(CASES, models.items()):
                    held, quiet = (unseen(new, each, case, seed) for each in (of_new, without_noise(of_new)))
                    found = model.predict(held.q, held.dq, held.ddq).interval
                    figures = evaluate(held.tau, *found)
                    cell = figures.nmse, evaluate(quiet.tau, *found).nmse, figures.coverage
                    figures.setdefault((case, way), []).append(np.array(cell))
            for (case, way), cells in figures.items():
                cover = np.array(cells)[:, 2]
                nmse, long = (np.array(each)[:, :2].mean(axis=(0, 2)) for each in (cells, figures[case, "60 s"]))
                ratios = " | ".join(f"{each:.2f}" for each in nmse / long)
                joints = " ".join(f"{100 * each:.0f}" for each in cover.mean(0))
                shown = f"{nmse[0]:.1e} | {ratios} | {joints} | {100 * cover.min():.0f}"
                print(f"| {name} | {'dirty' if dirty else 'clean'} | {case} | {way} | {shown} |", flush=True)


def answer() -> None:
    """Print the median time of an answer in process and of Pinocchio's RNEA, µs."""
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
    """Run the command of the first argument."""
    threadpool_limits(1)
    fit.known_geometries = auto.known_geometries = lambda types, gravity: ()  # type: ignore[assignment]
    what, numbers = sys.argv[1], [int(each) for each in sys.argv[2:] if each.isdigit()]
    with threadpool_limits(1):
        if what == "answer":
            answer()
        elif what == "rows":
            rows(*(numbers or [5]))
        elif what == "transfer":
            transfer(*numbers, [each for each in sys.argv[2:] if not each.isdigit()] or ["panda", "ur10"])
        else:
            search(*(numbers or [1, 20, 5]))


if __name__ == "__main__":
    main()
