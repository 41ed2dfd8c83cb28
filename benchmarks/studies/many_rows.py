"""Error, coverage, time and memory of default trainings with few and with many rows, through the service.

    many_rows.py panda ROWS...               the first rows of a recording of a simulated Panda with `Dirt` at 20 Hz
    many_rows.py shards COUNT                COUNT recordings of 44 000 rows of the same Panda
    many_rows.py sarcos FILE ROWS [SEED...]  random splits of SARCOS' test file, compared with kernel ridge regression
    many_rows.py repeat [FRICTION_WALK_S]    the same Panda learns from an hour of a motion that repeats every 10 s

The test of the Panda is other motion of the same kind. Errors are the squared error over the variance of the test
torque. Coverage is that of the 95 % interval. Memory is the peak of one process.
"""

import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist

from benchmarks.real.product import Bed, forecast_of, open_bed
from benchmarks.real.rivals import Forecast
from benchmarks.studies.dirty_arms import recorded, recording
from lipcore.data.metrics import LEVEL, quantile
from lipcore.data.samples import Array, Samples
from lipcore.robots.dirt import Dirt
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import PERIOD_S

SECONDS = 2200.0
"""Duration of a recording of the simulated arm."""
TEST_ROWS = 1200
"""Rows of each of the three parts of another recording that are the test."""
FIRST_S, HOUR_S, NOISE_S = 60.0, 3600.0, 60.0
"""Durations of the first recording, of the repeated motion, and of a recording to measure the noise with."""
REFRESHED = 5, 20
"""Minutes after which the model is refreshed."""
RIDGES = tuple(10.0**power for power in range(-6, 2))
STARTS, FACTORS = (0.05, 0.1, 0.2, 0.4), (0.5, 0.7, 1.4, 2.0)
"""Scales of kernel ridge regression: the first, equal ones, and changes of one."""


def errors(samples: Samples, mean: Array) -> tuple[str, str]:
    """Return the mean error, and that of each joint."""
    each = np.mean((samples.tau - mean) ** 2, axis=0) / samples.tau.var(axis=0)
    return f"{each.mean():.4f}", " ".join(f"{value:.4f}" for value in each)


def panda(seed: int) -> Samples:
    """Return a recording of the simulated arm at 20 Hz."""
    return recorded(load_robot("panda"), recording(SECONDS, Dirt(seed=0)), seed)


def panda_test() -> Samples:
    """Return three parts of another recording."""
    other = panda(200)
    begins = range(0, len(other), len(other) // 3)
    return Samples.concatenate([other.rows(slice(first, first + TEST_ROWS)) for first in begins][:3])


def sarcos(path: Path, rows: int, seed: int) -> tuple[Samples, Samples]:
    """Return random rows for training, and all others. Rows without times are a second apart in the service, too."""
    with np.load(path) as file:
        order = np.random.default_rng(seed).permutation(len(file["q"]))
        arrays = {name: file[name][order].astype(np.float64) for name in ("q", "dq", "ddq", "tau")}
    names = tuple(f"joint{joint + 1}" for joint in range(arrays["q"].shape[1]))
    every = Samples(names, np.arange(len(order), dtype=np.float64), np.zeros(len(order), np.int64), **arrays)
    return every.rows(slice(rows)), every.rows(slice(rows, None))


def predict_ridge(train: Samples, test: Samples) -> Array:
    """Predict by kernel ridge regression, k(x, x') = exp(−½ Σ_d w_d² (x_d − x'_d)²), x = (q, dq, ddq) standardised.

    The last quarter of the training samples chooses the ridge and three scales w, of q, dq and ddq.
    """
    known, asked = (np.concatenate([each.q, each.dq, each.ddq], axis=1) for each in (train, test))
    middle, spread, centre, scale = known.mean(0), known.std(0), train.tau.mean(0), train.tau.std(0)
    known, asked, targets = (known - middle) / spread, (asked - middle) / spread, (train.tau - centre) / scale
    early = 3 * len(known) // 4

    def fitted(scales: Array, count: int, at: Array) -> list[Array]:
        wide = np.repeat(scales, train.n_joints)
        x = known[:count] * wide
        values, vectors = np.linalg.eigh(np.exp(-0.5 * cdist(x, x, "sqeuclidean")))
        features, turned = np.exp(-0.5 * cdist(at * wide, x, "sqeuclidean")) @ vectors, vectors.T @ targets[:count]
        return [features @ (turned / (np.maximum(values, 0.0) + each)[:, None]) for each in RIDGES]

    def error(scales: Array) -> tuple[float, int]:
        found = [float(np.mean(np.square(each - targets[early:]))) for each in fitted(scales, early, known[early:])]
        return min(found), int(np.argmin(found))

    best, chosen = min((error(np.full(3, start)), start) for start in STARTS)
    scales = np.full(3, chosen)
    for group in 2 * [0, 1, 2]:
        for factor in FACTORS:
            other = scales.copy()
            other[group] *= factor
            if (found := error(other)) < best:
                best, scales = found, other
    return centre + scale * fitted(scales, len(known), asked)[best[1]]


def train(bed: Bed, name: str, parts: list[Samples], test: Samples, types: tuple[str, ...]) -> str:
    """Train on data sets; return a table row with the errors on the test, and the cost."""
    trained = bed.train(name, [bed.upload(f"{name}-{number}", part) for number, part in enumerate(parts)], types, None)
    rows = sum(len(part) for part in parts)
    answer = bed.predict(trained, test)
    inside = np.abs(test.tau - answer.mean) <= quantile(LEVEL) * answer.std
    found = [*errors(test, answer.mean), f"{100 * inside.mean():.1f}", trained.estimator]
    return f"| {rows} | {' | '.join(found)} | {trained.seconds:.0f} | {trained.peak_mb} |"


def repeat(bed: Bed, friction_walk_s: float | None) -> None:
    """Print errors over the noise of the torque, for each minute; rows are predicted before they are learnt.

    The arm starts cold: its friction falls by 13 % in some minutes. The model was trained on FIRST_S of other motion,
    and is refreshed after some minutes, while the stream waits.
    """
    robot, dirt = load_robot("panda"), Dirt(seed=0)
    silent = replace(dirt, noise=0.0)
    noisy, clean = (recorded(robot, recording(NOISE_S, each), 100) for each in (dirt, silent))
    noise = (noisy.tau - clean.tau).std(axis=0)
    first = recorded(robot, recording(FIRST_S, dirt), 100)
    hour = recorded(robot, replace(recording(HOUR_S + 2 * PERIOD_S, dirt), course="periodic", speed=1.0), 300)
    hour = replace(hour, t=hour.t - PERIOD_S)  # the low-pass is wrong at both ends
    hour = hour.rows((hour.t > -1e-9) & (hour.t < HOUR_S - 1e-9))
    bed.train("repeat", [bed.upload("repeat", first)], robot.joint_types, None)
    bed.client.set_learning("repeat", auto_refresh=False, friction_walk_s=friction_walk_s)
    print("| minute | version | error / noise | joint by joint | fast | coverage, % |\n|" + " --- |" * 6)
    for minute, cycles in enumerate(by_minute(hour), start=1):
        answers = []
        for number, cycle in cycles:
            past = hour.rows(slice(max(0, (number - 1) * len(cycle)), number * len(cycle)))
            answers.append((cycle.tau, ask(bed, past, cycle), ask_fast(bed, past, cycle)))
            learn(bed, number, cycle)
        measured, mean, std, fast = (
            np.concatenate(parts)
            for parts in zip(*((tau, rich.mean, rich.std, fast) for tau, rich, fast in answers), strict=True)
        )
        whole, quick = (np.sqrt(np.mean(np.square(measured - each), axis=0)) / noise for each in (mean, fast))
        inside = 100 * np.mean(np.abs(measured - mean) <= quantile(LEVEL) * std)
        joints = " ".join(f"{value:.2f}" for value in whole)
        version = bed.client.model("repeat").serving_version
        row = minute, version, f"{whole.mean():.2f}", joints, f"{quick.mean():.2f}", f"{inside:.1f}"
        print(f"| {' | '.join(map(str, row))} |", flush=True)
        if minute in REFRESHED:
            bed.client.wait(bed.client.refresh("repeat"))


def by_minute(samples: Samples) -> Iterator[list[tuple[int, Samples]]]:
    """Yield the numbered cycles of each minute."""
    ends = np.arange(1, round(HOUR_S / PERIOD_S) + 1) * PERIOD_S
    rows = np.searchsorted(samples.t, np.concatenate([[0.0], ends]) - 1e-9)
    each = [(number, samples.rows(slice(*rows[number : number + 2]))) for number in range(len(ends))]
    step = round(60.0 / PERIOD_S)
    yield from (each[start : start + step] for start in range(0, len(each), step))


def ask(bed: Bed, past: Samples, rows: Samples) -> Forecast:
    """Predict rows after others, by the serving version."""
    history = (past.t, past.q, past.dq) if len(past) else None
    return forecast_of(bed.client.predict("repeat", rows.q, rows.dq, rows.ddq, t=rows.t, history=history))


def ask_fast(bed: Bed, past: Samples, rows: Samples) -> Array:
    """Predict rows after others by a stream, which answers faster."""
    every = Samples.concatenate([past, rows]) if len(past) else rows
    with bed.client.stream("repeat") as stream:
        answers = [stream.predict(*motion) for motion in zip(every.q, every.dq, every.ddq, strict=True)]
    return np.array([answer.tau for answer in answers[len(past) :]])


def learn(bed: Bed, number: int, rows: Samples) -> None:
    """Send rows to learn from and wait until answers contain them."""
    sent = bed.client.observe("repeat", "cell", number, rows.q, rows.dq, rows.tau, rows.ddq, t=rows.t)
    if sent.accepted < len(rows):
        print(f"  {sent.rejected}", file=sys.stderr)
    motion = rows.q[0], rows.dq[0], rows.ddq[0]
    while bed.client.predict("repeat", *motion).revision < sent.revision:
        time.sleep(0.02)


def main() -> None:
    """Print a Markdown table."""
    what, *arguments = sys.argv[1:]
    if what == "repeat":
        with open_bed(1) as bed:
            return repeat(bed, float(arguments[0]) if arguments else None)
    print("| rows | error | joint by joint | coverage, % | estimator | job, s | memory, MB |\n|" + " --- |" * 7)
    with open_bed(1) as bed:
        if what == "sarcos":
            path, size, *seeds = arguments
            for seed in seeds or range(5):
                known, test = sarcos(Path(path), int(size), int(seed))
                print(train(bed, f"sarcos-{seed}", [known], test, ("revolute",) * known.n_joints))
                error, joints = errors(test, predict_ridge(known, test))
                print(f"| {size} | {error} | {joints} | | kernel ridge, seed {seed} | | |", flush=True)
            return
        test, types = panda_test(), load_robot("panda").joint_types
        if what == "shards":
            parts = [panda(5000 + number) for number in range(int(arguments[0]))]
            print(train(bed, "shards", parts, test, types))
            return
        every = panda(100)
        for count in arguments:
            print(train(bed, f"rows-{count}", [every.rows(slice(int(count)))], test, types), flush=True)


if __name__ == "__main__":
    main()
