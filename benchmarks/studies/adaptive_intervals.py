"""Comparison of methods that adapt prediction intervals online, on streams of simulated arms.

    python benchmarks/studies/adaptive_intervals.py report|tune [ARM:SEED...]

A learnt arm answers a stream of 100 Hz in batches of ten rows; each batch is answered with the scale known before it.
The stream has six parts of a minute: warming up, the training motion, a payload of 1.5 kg, three times faster, moves
with rests, slow. Each arm is simulated clean (noise 0.05 N·m) and with `Dirt`; the model is fixed, or learns online
(forgetting 60 s, a new regime 2 s after each change of the payload). Rows at rest count, too.

- Minute: lowest and highest coverage of the 95 % interval in any window of a minute, over all joints and streams.
- Payload: coverage from 0.3 to 1.3 s after the payload is attached, of the worst stream and of the worst joint.
- Width: mean scale over that of the best constant scale of the part; median and maximum over joints and parts.

Constants were tuned on the streams of `tune` only.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from threadpoolctl import threadpool_limits

import lipcore
from benchmarks.studies.dirty_arms import prepared
from lipcore.data.independence import stream_weights
from lipcore.data.samples import Array, Samples
from lipcore.online.adaptive import AdaptiveScale, scores
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.online.record import LEVEL
from lipcore.robots.dirt import Dirt
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from lipcore.vocabulary import Code

STREAMS = {"tune": ("panda:0", "ur10:1"), "report": ("kinova:10", "xarm7:10", "panda:11", "ur5:12")}
RATE, BATCH, NOISE = 100.0, 10, 0.05
MINUTE = round(60 * RATE)
TRAINED = Simulation(MINUTE, RATE, speed=5.0, noise=0.0)
UNSEEN = replace(TRAINED, n_sinusoids=100)
PARTS = {
    "warming up": UNSEEN,
    "as trained": UNSEEN,
    "payload": replace(UNSEEN, payload=Payload(1.5)),
    "faster": replace(TRAINED, speed=15.0),
    "rests": replace(TRAINED, course="rests", speed=1.0),
    "slow": replace(UNSEEN, speed=1.0),
}
LOADED_S, NOTICED_S = 120.0, 2.0
EVERY = round(0.5 * RATE)
MISS = 1 - LEVEL


def measured(robot: Robot, stream: Simulation, seed: int, dirt: Dirt | None) -> Samples:
    """Return a stream of a clean arm, or of one with `dirt`, which includes the noise."""
    return simulate(robot, replace(stream, dirt=dirt, noise=0.0 if dirt else NOISE), seed)


def played(arm: str, seed: int, dirty: bool, learning: bool) -> Array:
    """Return the scores of all rows of all parts under the current model, (N, n)."""
    robot, warm = load_robot(arm), Dirt(seed=seed, warmth=0.0) if dirty else None
    history = measured(robot, TRAINED, 1000 * seed, warm)
    history = prepared(history) if dirty else history.rows(slice(None, None, 5))
    model, parts = lipcore.train(history, robot.joint_types, "rigid-body"), []
    for number, (name, stream) in enumerate(PARTS.items()):
        cold = replace(warm, warm_s=40.0, warmth=0.5) if warm and name == "warming up" else warm
        parts.append(measured(robot, stream, 1000 * seed + 7 + number, cold))
    samples = Samples.concatenate(parts)
    time = np.arange(len(samples.q)) / RATE
    codes, weights = np.full(len(time), Code.LEARNT, np.uint8), stream_weights(time)
    rows = Rows(time, samples.q, samples.dq, samples.ddq, samples.tau, codes, weights)
    changes = {round((at + NOTICED_S) * RATE) for at in (LOADED_S, LOADED_S + 60.0)}
    online, out = OnlineModel.start(model, 60.0), []
    for first in range(0, len(rows), EVERY):
        part = rows.take(slice(first, first + EVERY))
        answer = model.predict(part.q, part.dq, part.ddq)
        out.append(scores(part.tau - answer.tau, answer.tau_std, answer.noise_std))
        if learning:
            online = online.change(float(part.time[0])) if first in changes else online
            online = online.learn(part)
            model = online.model()
    return np.concatenate(out)


class Tracker(Protocol):
    """A method that adapts a scale for each of n columns; scale: (n,)."""

    scale: Array

    def step(self, score: Array) -> None:
        """Update the scale with a batch of scores, (N, n)."""


class Unadapted:
    """The model's own interval."""

    def __init__(self, n: int) -> None:
        self.scale = np.ones(n)

    def step(self, score: Array) -> None:
        """Do nothing."""


class Adaptive:
    """The service's method."""

    def __init__(self, n: int) -> None:
        self._state, self._rows = AdaptiveScale.start(np.ones(n)), 0

    @property
    def scale(self) -> Array:
        """Factors of the state."""
        return self._state.factor

    def step(self, score: Array) -> None:
        """Update the state with the rows at their times."""
        self._state = self._state.step((self._rows + np.arange(len(score))) / RATE, score)
        self._rows += len(score)


class Aci:
    """ACI (Gibbs & Candès 2021): a quantile of recent scores; its level moves by gamma (0.05 − miss) a row.

    If the level falls below 0, the original's interval is infinite; here the scale is twice the largest score.
    """

    def __init__(self, n: int, gamma: float = 0.01, window: int = 1000) -> None:
        self.scale, self._alpha, self._gamma = np.ones(n), np.full(n, MISS), gamma
        self._recent, self._window = np.ones((1, n)), window

    def step(self, score: Array) -> None:
        """Move the level by the batch, and update the quantile."""
        self._alpha = self._alpha + self._gamma * (MISS - (score > self.scale)).sum(0)
        self._recent = np.concatenate([self._recent, score])[-self._window :]
        ranked, rows = np.sort(self._recent, axis=0), len(self._recent)
        place = np.ceil((1 - self._alpha) * rows).astype(int) - 1
        inside = ranked[np.clip(place, 0, rows - 1), np.arange(len(self._alpha))]
        self.scale = np.where(place >= rows, 2 * ranked[-1], inside)


class Faci:
    """FACI (Gibbs & Candès 2024): quantile trackers of log s with several gains, weighted by their pinball losses."""

    gains, share, span = np.array([[0.005], [0.01], [0.02], [0.05], [0.1], [0.2]]), 1 / 500, 500

    def __init__(self, n: int) -> None:
        self.scale, self._logs = np.ones(n), np.zeros((len(self.gains), n))
        self._weights, self._loss = np.full_like(self._logs, 1 / len(self.gains)), np.full(n, 0.05)

    def step(self, score: Array) -> None:
        """Move all trackers and their weights by the batch."""
        size = np.log(np.maximum(score, 1e-3))[:, None]
        loss = _pinball(size, self._logs).mean(0)
        self._loss = 0.9 * self._loss + 0.1 * (self._weights * loss**2).sum(0)
        rate = np.sqrt((np.log(len(self.gains) * self.span) + 1) / self.span / np.maximum(self._loss, 1e-6))
        weights = self._weights * np.exp(-rate * len(score) * (loss - loss.min(0)))
        self._weights = (1 - self.share) * weights / weights.sum(0) + self.share / len(self.gains)
        self._logs = self._logs + self.gains * ((size > self._logs) - MISS).sum(0)
        self.scale = np.exp((self._weights * self._logs).sum(0))


class Saocp:
    """SAOCP (Bhatnagar et al. 2023): trackers of log s by scale-free gradient descent, weighted by their gains.

    A tracker starts with every batch and lives for 8 · 2^k batches.
    """

    def __init__(self, n: int) -> None:
        self.scale, self._n, self._batches = np.ones(n), n, 0
        self._begun, self._ends, self._prior = np.zeros(0), np.zeros(0), np.zeros((0, 1))
        self._logs, self._squares, self._won, self._stake, self._weight = (np.zeros((0, n)) for _ in range(5))

    def step(self, score: Array) -> None:
        """Move all live trackers by the batch, start one, and update the weights."""
        self._batches += 1
        size = np.log(np.maximum(score, 1e-3))[:, None]
        now = np.log(self.scale)
        slope = (MISS - (size > self._logs)).mean(0)
        gain = np.clip(_pinball(size, now).mean(0) - _pinball(size, self._logs).mean(0), -1, 1)
        gain = np.where(self._weight > 0, gain, np.maximum(gain, 0))
        self._squares = self._squares + slope**2
        self._logs = self._logs - slope / np.sqrt(np.maximum(self._squares, 1e-9))
        self._won, self._stake = self._won + gain, self._stake + self._weight * gain
        age = (self._batches - self._begun)[:, None]
        self._weight = self._won / age * (1 + self._stake)
        life = 8 * (self._batches & -self._batches)
        self._begun = np.append(self._begun, self._batches)
        self._ends = np.append(self._ends, self._batches + life)
        self._prior = np.vstack([self._prior, [[1 / life**2]]])
        self._logs = np.vstack([self._logs, now])
        for name in ("_squares", "_won", "_stake", "_weight"):
            setattr(self, name, np.vstack([getattr(self, name), np.zeros(self._n)]))
        alive = self._ends > self._batches
        for name in ("_begun", "_ends", "_prior", "_logs", "_squares", "_won", "_stake", "_weight"):
            setattr(self, name, getattr(self, name)[alive])
        staked = self._prior * np.maximum(self._weight, 0)
        shares = np.where(staked.sum(0) > 0, staked, self._prior)
        self.scale = np.exp((shares / shares.sum(0) * self._logs).sum(0))


class ConformalPid:
    """Conformal PID (Angelopoulos et al. 2023) without scorecaster.

    The quantile of the score is tracked with a tenth of the largest recent score a row; the sum of errors adds a
    saturated tangent.
    """

    def __init__(self, n: int, gain: float = 0.1, window: int = 100) -> None:
        self.scale, self._level, self._sum, self._rows = np.ones(n), np.ones(n), np.zeros(n), 1
        self._recent, self._gain, self._window = np.ones((1, n)), gain, window

    def step(self, score: Array) -> None:
        """Update quantile and integral with the batch."""
        error = ((score > self.scale) - MISS).sum(0)
        self._recent = np.concatenate([self._recent, score])[-self._window :]
        largest = self._recent.max(0)
        self._level, self._sum = self._level + self._gain * largest * error, self._sum + error
        self._rows += len(score)
        angle = np.clip(self._sum * np.log(self._rows) / (5 * self._rows), -1.5, 1.5)
        self.scale = np.maximum(self._level + largest * np.tan(angle), 0.01)


METHODS: dict[str, Callable[[int], Tracker]] = {
    "not adapted": Unadapted,
    "ACI, gain 0.005, window 10 s": lambda n: Aci(n, 0.005),
    "ACI, gain 0.01, window 3 s": lambda n: Aci(n, 0.01, 300),
    "FACI": Faci,
    "SAOCP": Saocp,
    "conformal PID": ConformalPid,
    "LIPServe": Adaptive,
}


@dataclass(frozen=True)
class Figures:
    """Figures of a method on all streams; see the module's docstring."""

    min_minute: float
    max_minute: float
    stream: float
    joint: float
    width: float
    max_width: float


def evaluate_method(method: Callable[[int], Tracker], score: Array, stream: Array) -> Figures:
    """Evaluate a method on scores of C joints, (N, C), of the streams with these numbers, (C,)."""
    tracker, scale = method(score.shape[1]), np.empty_like(score)
    for first in range(0, len(score), BATCH):
        rows = slice(first, first + BATCH)
        scale[rows] = tracker.scale
        tracker.step(score[rows])
    inside = score <= scale
    sums = np.concatenate([np.zeros((1, score.shape[1])), np.cumsum(inside, axis=0)])
    minutes = (sums[MINUTE:] - sums[:-MINUTE]) / MINUTE
    loaded = inside[round((LOADED_S + 0.3) * RATE) :][: round(RATE)].mean(0)
    parts = [slice(first, first + MINUTE) for first in range(0, len(score), MINUTE)]
    width = np.array([scale[part].mean(0) / np.quantile(score[part], LEVEL, axis=0) for part in parts])
    worst = min(loaded[stream == each].mean() for each in set(stream.tolist()))
    return Figures(minutes.min(), minutes.max(), worst, loaded.min(), float(np.median(width)), width.max())


def main() -> None:
    """Simulate the streams and print a Markdown table."""
    threadpool_limits(1)
    kind, arms = sys.argv[1], sys.argv[2:] or STREAMS[sys.argv[1]]
    names = [(*arm.split(":"), dirty, learning) for arm in arms for dirty in (0, 1) for learning in (0, 1)]
    parts = [played(arm, int(seed), bool(dirty), bool(learning)) for arm, seed, dirty, learning in names]
    stream = np.repeat(np.arange(len(parts)), [part.shape[1] for part in parts])
    show(kind, np.concatenate(parts, axis=1), stream)


def show(kind: str, score: Array, stream: Array) -> None:
    """Print the figures of all methods."""
    print(f"| {kind} | minute, % | payload: stream, joint, % | width: median, largest |\n|" + " --- |" * 4)
    for name, method in METHODS.items():
        found = evaluate_method(method, score, stream)
        coverage = (
            f"{100 * found.min_minute:.1f} to {100 * found.max_minute:.1f} | "
            f"{100 * found.stream:.0f}, {100 * found.joint:.0f}"
        )
        print(f"| {name} | {coverage} | {found.width:.2f}, {found.max_width:.1f} |", flush=True)


def _pinball(size: Array, level: Array) -> Array:
    return np.asarray(np.maximum(LEVEL * (size - level), -MISS * (size - level)))


if __name__ == "__main__":
    main()
