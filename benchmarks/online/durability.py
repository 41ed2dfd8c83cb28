"""`python -m benchmarks durability`: kills of the service and of its learner."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rich.console import Console

import lipcore
from benchmarks.latency.table import Grid, targets_grid
from benchmarks.latency.targets import Target
from benchmarks.online.bed import install, train
from benchmarks.online.trials import BATCHES, LATE_SHARE, MODEL, ROWS, TWICE_SHARE, Tally, Trials, Victim
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from service.contract.observations import LearningOptions

ROBOT, RATE, SPEED = "double-pendulum", 100.0, 5.0
FIT = {"hyperparameter_samples": 40, "posterior_samples": 100, "max_iterations": 30, "starts": 1}
LEARNING = LearningOptions(on_change="learn", contact_threshold=100.0, auto_refresh=False, auto_promote=False)
"""All rows are learnt, so that the benchmark can compute the expected model."""
VICTIMS: tuple[Victim, ...] = ("service", "learner")
MAX_DIFFERENCE = 1e-8
NOTE = (
    f"A trial sends {BATCHES} batches of {ROWS} rows, {LATE_SHARE:.0%} of them after a later one and {TWICE_SHARE:.0%} "
    "twice. The service, or its learner only, gets SIGKILL at a random moment. Then all batches are sent again, and "
    "torques are compared with those of a model in this process that learnt all rows so far at once."
)


def open_trials(home: Path, trials: int, seed: int, batches: int = BATCHES) -> Trials:
    """Train a model of a double pendulum; prepare a home that serves it, and samples for `trials` trials."""
    robot = load_robot(ROBOT)
    history = simulate(robot, Simulation(100, 10.0, speed=SPEED), 10 * seed + 1)
    model, _ = train(history, robot.joint_types, FIT)
    lipcore.save(model, home / "model")
    install(home / "home", home / "model", {MODEL: LEARNING}, robot.n_joints)
    # a payload and friction to be learnt
    more = Simulation(trials * batches * ROWS, RATE, speed=SPEED, viscous=0.05, payload=Payload(0.2))
    samples = simulate(robot, more, 10 * seed + 2)
    queries = simulate(robot, replace(more, n_samples=50, rate=1.0), 10 * seed + 3)
    return Trials(home / "home", lipcore.load(home / "model"), samples, queries, seed)


def run(home: Path, trials: int, seed: int, console: Console) -> Tally:
    """Kill the service and its learner in turn, `trials` times in all; raise BenchError if it does not recover."""
    with open_trials(home, trials, seed) as prepared:
        tally = prepared.tally
        for number in range(trials):
            prepared.trial(VICTIMS[number % len(VICTIMS)])
            console.print(
                f"{number + 1} of {trials}: {tally.lost} lost, {tally.twice} twice, difference {tally.largest:.1e}",
                highlight=False,
            )
        prepared.measure_one_batch()
    return tally


def targets(tally: Tally) -> list[Target]:
    """Return all targets."""
    return [
        Target("acknowledged batches lost", tally.lost, "", "≤", 0),
        Target("batches learnt twice", tally.twice, "", "≤", 0),
        Target("largest difference from learning at once", tally.largest, "relative", "≤", MAX_DIFFERENCE),
        Target("for comparison: smallest difference by one batch more", tally.one_batch, "relative"),
    ]


def grids(tally: Tally) -> list[Grid]:
    """Return all tables."""
    rows = [
        ("kills of the service", str(tally.kills["service"])),
        ("kills of the learner alone", str(tally.kills["learner"])),
        ("batches", f"{tally.batches:,}"),
        ("batches without an answer at a kill", str(tally.unanswered)),
        ("batches sent twice on purpose", str(tally.repeated)),
        ("batches sent after a later one", str(tally.late)),
        ("rows not learnt", str(tally.refused)),
    ]
    table_of_targets = targets_grid(targets(tally), "")
    return [Grid("trials", ("", ""), rows), table_of_targets]
