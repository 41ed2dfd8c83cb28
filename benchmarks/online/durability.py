"""`python -m benchmarks durability`: kills, and what they cost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rich.console import Console

import lipcore
from benchmarks.latency.table import Grid, promises
from benchmarks.latency.targets import Target
from benchmarks.online.bed import install, train
from benchmarks.online.trials import BATCHES, LATE, MODEL, ROWS, TWICE, Tally, Trials, Victim
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from service.contract.observations import LearningOptions

ROBOT, RATE, SPEED = "double-pendulum", 100.0, 5.0
FIT = {"hyperparameter_samples": 40, "posterior_samples": 100, "max_iterations": 30, "starts": 1}
LEARNING = LearningOptions(on_change="learn", contact_threshold=100.0, auto_refresh=False, auto_promote=False)
"""Every row is learnt, so that the client knows what the service must know."""
VICTIMS: tuple[Victim, ...] = ("service", "learner")
TOLERANCE = 1e-8
SAID = (
    f"a trial: {BATCHES} batches of {ROWS} rows, {LATE:.0%} of them after a later one, {TWICE:.0%} twice; SIGKILL to "
    "the service, or only to its learner, at a random moment; then all is sent again, whether acknowledged or not, "
    "and torques are compared with those of a model in this process that learnt all rows so far at once"
)


def open_trials(home: Path, trials: int, seed: int, batches: int = BATCHES) -> Trials:
    """Train a model of a double pendulum and prepare a home that serves it; samples are enough for so many trials."""
    robot = load_robot(ROBOT)
    history = simulate(robot, Simulation(100, 10.0, speed=SPEED), 10 * seed + 1)
    model, _ = train(history, robot.joint_types, FIT)
    lipcore.save(model, home / "model")
    install(home / "home", home / "model", {MODEL: LEARNING}, robot.n_joints)
    # a payload and friction, so that there is something to learn
    more = Simulation(trials * batches * ROWS, RATE, speed=SPEED, viscous=0.05, payload=Payload(0.2))
    samples = simulate(robot, more, 10 * seed + 2)
    queries = simulate(robot, replace(more, n_samples=50, rate=1.0), 10 * seed + 3)
    return Trials(home / "home", lipcore.load(home / "model"), samples, queries, seed)


def run(home: Path, trials: int, seed: int, console: Console) -> Tally:
    """Kill the service and its learner in turn, so many times in all; raise BenchError where it does not recover."""
    with open_trials(home, trials, seed) as prepared:
        tally = prepared.tally
        for number in range(trials):
            prepared.trial(VICTIMS[number % len(VICTIMS)])
            console.print(
                f"{number + 1} of {trials}: {tally.lost} lost, {tally.twice} twice, difference {tally.largest:.1e}",
                highlight=False,
            )
        prepared.weigh()
    return tally


def targets(tally: Tally) -> list[Target]:
    """What is promised, and what was seen."""
    return [
        Target("acknowledged batches lost", tally.lost, "", "≤", 0),
        Target("batches learnt twice", tally.twice, "", "≤", 0),
        Target("largest difference from learning at once", tally.largest, "relative", "≤", TOLERANCE),
        Target("the least that one batch more or less would make of it", tally.one_batch, "relative"),
    ]


def grids(tally: Tally) -> list[Grid]:
    """The tally as tables."""
    rows = [
        ("kills of the service", str(tally.kills["service"])),
        ("kills of the learner alone", str(tally.kills["learner"])),
        ("batches", f"{tally.batches:,}"),
        ("on their way at a kill", str(tally.unanswered)),
        ("sent twice on purpose", str(tally.repeated)),
        ("sent after a later one", str(tally.late)),
        ("rows that were not learnt", str(tally.refused)),
    ]
    judged = replace(promises(targets(tally)), columns=("", "promised", "measured", ""))
    return [Grid("trials", ("", ""), rows), judged]
