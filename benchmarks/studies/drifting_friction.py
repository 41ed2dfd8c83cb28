"""Accuracy of a learnt arm with friction that drifts for half an hour, with several options of online learning.

    python benchmarks/studies/drifting_friction.py SEED[,SEED...] [CASE[;CASE...]] [ROBOT]

A model is trained on 60 s at 100 Hz and then learns every fifth row of 30 minutes; each minute is another motion. Every
stretch of EVERY_S is predicted before it is learnt. The table has means over the seeds of the last five minutes:

- nMSE; for clean arms against the torque without noise.
- moving: nMSE of rows with a joint faster than MOVING_RAD_S; a dirty arm's error is mostly that of joints near rest.
- coverage of the model's own 95 % interval, without the factor of the service.
- moved: largest change of a mass or a length of the geometry since training, in trained standard deviations.
- opened: largest ratio of their standard deviation to that with default options.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

import lipcore
from benchmarks.studies.dirty_arms import prepared
from lipcore.data.independence import stream_weights
from lipcore.data.metrics import evaluate
from lipcore.data.samples import Array, Samples
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.drive.play import element_widths, with_deflections
from lipcore.model.parameters import weight_posterior
from lipcore.model.torque_model import TorqueModel
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.robots.dirt import Dirt
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.vocabulary import Code

RATE, KEEP, EVERY_S, MINUTES, TEST_MINUTES = 100.0, 5, 2.0, 30, 5
NOISE = 0.05
"""Noise of a clean arm, N·m; `Dirt` includes noise."""
STREAM = Simulation(round(60 * RATE), RATE, speed=5.0, noise=0.0)
MOVING_RAD_S = 0.1
VISCOUS, COULOMB = 0.5, 0.3
"""Friction of a clean arm, N·m·s/rad and N·m."""
DEFAULT = "default"
NIGHT_S = 8 * 3600.0


@dataclass(frozen=True)
class Case:
    """Conditions of a stream.

    Attributes:
        dirt: dirt of the arm; None: clean.
        falls: share by which a clean arm's friction falls linearly.
        cold: minute before which the warm arm rests for a night; None: it starts cold.
    """

    dirt: Dirt | None = None
    falls: float = 0.0
    cold: int | None = None


WARMS = Dirt(warmth=0.43, warm_s=600.0)
CASES = {
    "clean": Case(),
    "clean, falls by 30 %": Case(falls=0.3),
    "dirty": Case(Dirt(warmth=0.0)),
    "dirty, 13 % in 5 min": Case(Dirt()),
    "dirty, 30 % in 10 min": Case(WARMS),
    "dirty, the next morning": Case(WARMS, cold=20),
    "Maxwell slip, viscosity falls by a third in 10 min": Case(
        Dirt(drive="maxwell", warmth=0.0, viscous_warmth=0.5, warm_s=600.0)
    ),
}
OPTIONS: dict[str, dict[str, float]] = {
    DEFAULT: {},
    "`forgetting_s` 300": {"forgetting_s": 300.0},
    "`forgetting_s` 1800": {"forgetting_s": 1800.0},
    "`friction_walk_s` 1800": {"friction_walk_s": 1800.0},
}


@dataclass(frozen=True)
class Part:
    """A minute; samples: for the test, tau: measured torque to learn from, (N, n), N·m."""

    samples: Samples
    tau: Array


def simulated(name: str, case: Case, seed: int) -> tuple[Samples, list[Part]]:
    """Return the training recording, and the minutes of the stream."""
    robot = load_robot(name)
    rng = np.random.default_rng(seed)
    known, parts = None, []
    for minute in range(-1, MINUTES):
        stream, begin = STREAM, 60.0 * minute
        if case.dirt is None:
            factor = 1 - case.falls * max(minute, 0) / (MINUTES - 1)
            stream = replace(stream, viscous=factor * VISCOUS, coulomb=factor * COULOMB)
        else:
            since = -1 if case.cold is None else case.cold  # the minute of the cold start
            left = float(np.exp(-60.0 * (minute - since) / case.dirt.warm_s)) if minute >= since else 0.0
            excess = {"warmth": left * case.dirt.warmth, "viscous_warmth": left * case.dirt.viscous_warmth}
            stream = replace(stream, dirt=replace(case.dirt, seed=seed, **excess))
        samples = simulate(robot, stream, 1000 * seed + minute + 1)
        if minute < 0:
            known = samples if case.dirt else replace(samples, tau=_noisy(samples.tau, rng))
            known = prepared(known) if case.dirt else known.rows(slice(None, None, KEEP))
            continue
        samples = with_deflections(samples, robot.joint_types).rows(slice(None, None, KEEP))
        pause = NIGHT_S if case.cold is not None and minute >= case.cold else 0.0
        samples = replace(samples, t=samples.t + begin + pause)
        parts.append(Part(samples, samples.tau if case.dirt else _noisy(samples.tau, rng)))
    assert known is not None
    return known, parts


def _noisy(tau: Array, rng: np.random.Generator) -> Array:
    return np.asarray(tau + NOISE * rng.standard_normal(tau.shape))


def rows_of(part: Part, widths: Array) -> Rows:
    """Return all rows with their weights."""
    samples = part.samples
    codes, weights = np.full(len(samples), Code.LEARNT, np.uint8), stream_weights(samples.t)
    motion = samples.t, samples.q, samples.dq, samples.ddq
    return Rows(*motion, part.tau, codes, weights, samples.deflections, widths)


def body(model: TorqueModel) -> tuple[Array, Array]:
    """Return masses and geometry, and their standard deviations, (p,) each."""
    term = model.estimator.terms["rigid_body"]
    assert isinstance(term, ArmKernel)
    weights = weight_posterior(model.posterior, term)
    return weights.mean, weights.std


@dataclass(frozen=True)
class Found:
    """Figures of the last minutes, (n,), and mean and standard deviation of masses and geometry at the end, (p,)."""

    nmse: Array
    moving: Array
    coverage: Array
    mean: Array
    std: Array


def followed(base: TorqueModel, parts: list[Part], options: dict[str, float]) -> Found:
    """Learn a stream with these options, and test its last minutes."""
    started = OnlineModel.start(base, forgetting_s=options.get("forgetting_s"), since=0.0)
    online, model = started.with_walk(options.get("friction_walk_s")), base
    step, answers, widths = round(EVERY_S * RATE / KEEP), [], element_widths(base.joint_types)
    for minute, part in enumerate(parts):
        rows = rows_of(part, widths)
        for first in range(0, len(rows), step):
            chunk = rows.take(slice(first, first + step))
            if minute >= MINUTES - TEST_MINUTES:
                answer = model.predict(chunk.q, chunk.dq, chunk.ddq, deflections=chunk.deflections)
                answers.append([answer.tau, answer.tau_std])
            online = online.learn(chunk)
            model = online.model()
    tau, std = (np.concatenate(each) for each in zip(*answers, strict=True))
    test = Samples.concatenate([part.samples for part in parts[-TEST_MINUTES:]])
    squares, moves = (test.tau - tau) ** 2 / test.tau.var(axis=0), np.abs(test.dq) > MOVING_RAD_S
    measured = np.concatenate([part.tau for part in parts[-TEST_MINUTES:]])
    coverage = evaluate(measured, tau, std, base.noise_std).coverage
    return Found(squares.mean(axis=0), (squares * moves).sum(axis=0) / moves.sum(axis=0), coverage, *body(model))


def main() -> None:
    """Print a Markdown table with a row for each case and options."""
    threadpool_limits(1)
    seeds = [int(each) for each in sys.argv[1].split(",")]
    names = sys.argv[2].split(";") if len(sys.argv) > 2 and sys.argv[2] else list(CASES)
    robot = sys.argv[3] if len(sys.argv) > 3 else "panda"
    print("| case | options | nMSE | moving | coverage, % | lowest | moved | opened |\n|" + " --- |" * 8)
    for name in names:
        figures: dict[str, list[list[float]]] = {way: [] for way in OPTIONS}
        for seed in seeds:
            known, parts = simulated(robot, CASES[name], seed)
            base = lipcore.train(known, load_robot(robot).joint_types, "rigid-body")
            trained, trained_std = body(base)
            every = {way: followed(base, parts, options) for way, options in OPTIONS.items()}
            for way, found in every.items():
                moved, opened = np.abs(found.mean - trained) / trained_std, found.std / every[DEFAULT].std
                errors = [found.nmse.mean(), found.moving.mean()]
                figures[way].append([*errors, found.coverage.mean(), found.coverage.min(), moved.max(), opened.max()])
        for way, rows in figures.items():
            nmse, moving, coverage, lowest, moved, opened = np.mean(rows, axis=0)
            shown = f"{nmse:.2e} | {moving:.2e} | {100 * coverage:.1f} | {100 * lowest:.0f}"
            print(f"| {name} | {way} | {shown} | {moved:.1f} | {opened:.2f} |", flush=True)


if __name__ == "__main__":
    main()
