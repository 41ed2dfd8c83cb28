"""The benchmark of learning from options to results."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

import lipcore
from benchmarks import facts
from benchmarks.online import flow, quality
from benchmarks.online.bed import Bed, install, serving, train
from benchmarks.online.cost import CHUNK, TIMED_CHUNKS, update_costs
from benchmarks.online.fleet import merged_difference
from benchmarks.online.fourier import FEATURES
from benchmarks.online.quality import Method, Moment
from benchmarks.online.results import Results
from benchmarks.online.scene import Scene, rows_of
from benchmarks.online.sending import BATCH_ROWS
from benchmarks.online.targets import ADAPTING, LEARNING
from lipcore.data.samples import Array, Samples
from lipcore.model.torque_model import TorqueModel
from service.contract.observations import LearningOptions

PARTS = ("flow", "cost", "quality", "fleet")
"""Names of all parts."""
LIVE, BURST = "live", "burst"
"""Models that learn under load."""
FIT: Mapping[str, Any] = {"posterior_samples": 500, "max_inducing_outputs": 500}
"""Fit options. With at most 500 inducing outputs, a core learns more than 1000 samples a second."""
ROBOTS, FLEET_SAMPLES = 10, 300


@dataclass(frozen=True)
class Options:
    """Scope of the benchmark.

    Attributes:
        scene: the simulated robot and its stream.
        estimator: estimator of all models.
        fit: fit options of all models.
        history_s: length of the training motion.
        history_rate: rate of the training motion, Hz.
        idle_s: length of the loop without learning.
        burst_s: length of the stream that is sent as fast as possible.
        after: seconds after the change at which predictions are evaluated.
        sizes: numbers of samples at which an update is timed.
        forgetting_s: time constant of forgetting.
        refit_every: seconds between refits.
        refit_window: max seconds of rows of a refit.
        websocket: send the live stream in frames.
        only: names of parts; empty: all.
    """

    scene: Scene = field(default_factory=Scene)
    estimator: str = "rigid-body"
    fit: Mapping[str, Any] = field(default_factory=lambda: dict(FIT))
    history_s: float = 80.0
    history_rate: float = 10.0
    idle_s: float = 20.0
    burst_s: float = 60.0
    after: tuple[float, ...] = (0.5, 5.0, 30.0)
    sizes: tuple[int, ...] = (1_000, 10_000, 100_000)
    forgetting_s: float = 30.0
    refit_every: float = 10.0
    refit_window: float = 30.0
    websocket: bool = False
    only: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if unknown := [name for name in self.only if name not in PARTS]:
            raise ValueError(f"Unknown name {unknown[0]!r} in --only. Names: {', '.join(PARTS)}.")
        scene = self.scene
        for at in (scene.seconds, *(moment.at for moment in self.moments)):
            batches = at * scene.rate / BATCH_ROWS
            if at > scene.seconds or abs(batches - round(batches)) > 1e-6:
                period = BATCH_ROWS / scene.rate
                raise ValueError(
                    f"A time of the stream must be a multiple of {period:g} s up to {scene.seconds:g} s, not {at:g} s."
                )

    @property
    def moments(self) -> list[Moment]:
        """Times at which predictions are evaluated."""
        change = self.scene.change_at
        return [Moment("before the change", change), *(Moment(f"{s:g} s after", change + s) for s in self.after)]

    def is_wanted(self, part: str) -> bool:
        """Return whether a part is measured."""
        return not self.only or part in self.only


def run(options: Options, console: Console) -> Results:
    """Run the benchmark; raise BenchError if a step fails."""
    machine, scene = facts.machine(), options.scene
    with ExitStack() as stack:
        home = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lipserve-bench-")))
        history = scene.history(options.history_s, options.history_rate)
        console.print(f"training on {len(history)} samples of {scene.robot}", highlight=False)
        base, seconds = train(history, scene.arm.joint_types, options.fit, options.estimator)
        manifest = lipcore.save(base, home / "model")
        origin = f"trained here in {seconds:.0f} s on {options.history_s:g} s at {options.history_rate:g} Hz"
        results = Results(machine, facts.model(manifest, f"{origin}, speed {scene.speed:g}"), joints=base.joint_names)
        samples = scene.live()
        if options.is_wanted("flow") or options.is_wanted("quality"):
            install(home / "home", home / "model", _models(options), base.n_joints)
            bed = stack.enter_context(serving(home / "home"))
            if options.is_wanted("flow"):
                _flow(bed, samples, options, results, console)
            if options.is_wanted("quality"):
                _served(bed, samples, options, results, console)
        machine["threads of this process"] = stack.enter_context(facts.one_thread())
        if options.is_wanted("quality"):
            _baselines(base, history, samples, options, results, console)
        if options.is_wanted("cost"):
            console.print(f"cost of an update after {', '.join(map(str, options.sizes))} samples", highlight=False)
            rows = rows_of(scene.more((options.sizes[-1] + TIMED_CHUNKS * CHUNK) / scene.rate))
            results.costs = update_costs(base, rows, options.sizes, options.forgetting_s)
        if options.is_wanted("fleet"):
            console.print(f"merging the statistics of {ROBOTS} robots", highlight=False)
            parts, results.robots = scene.fleet(ROBOTS, FLEET_SAMPLES, options.history_rate), ROBOTS
            results.merged = merged_difference(base, parts, scene.unseen(0.0).motion())
    return results


def _models(options: Options) -> dict[str, LearningOptions]:
    """Return the learning options of each copy of the model; without retraining during the measurements."""
    learning = LearningOptions(on_change="learn", auto_refresh=False, auto_promote=False)
    adapting = learning.model_copy(update={"forgetting_s": options.forgetting_s, "on_change": "adapt"})
    opened = adapting.model_copy(update={"payloads": False})
    return {LIVE: adapting, BURST: adapting, LEARNING: learning, ADAPTING: opened}


def _flow(bed: Bed, samples: Samples, options: Options, results: Results, console: Console) -> None:
    motions = _motions(options.scene.unseen(0.0))
    console.print(f"500 Hz loop for {options.idle_s:g} s, idle", highlight=False)
    results.idle = flow.idle(bed, LIVE, motions, options.idle_s)
    console.print(f"the same while {options.scene.seconds:g} s are learnt in real time", highlight=False)
    results.learning, results.live = flow.live(bed, LIVE, samples, motions, options.websocket)
    console.print(f"the same while {options.burst_s:g} s are sent as fast as possible", highlight=False)
    results.pushed, results.burst = flow.burst(bed, BURST, options.scene.more(options.burst_s), motions)
    for name, found in (("In real time", results.live), ("As fast as possible", results.burst)):
        rejected = ", ".join(f"{count} {code}" for code, count in found.rejected.items()) or "none"
        results.notes.append(f"{name}: the learner used {found.learner:.0%} of one core; rejected rows: {rejected}.")
    how = "in frames over a WebSocket, one a row" if options.websocket else f"in batches of {BATCH_ROWS} rows over HTTP"
    results.notes.append(
        f"The live stream is sent {how}, the pushed stream in batches of {flow.PUSHED_ROWS}. The payload of "
        f"{options.scene.payload:g} kg is attached at {options.scene.change_at:g} s of the live stream; until the "
        "change is detected, rows are rejected as contacts. The learner process starts with the first batch; the time "
        "of its start counts."
    )


def _served(bed: Bed, samples: Samples, options: Options, results: Results, console: Console) -> None:
    results.moments = [moment.name for moment in options.moments]
    labels = {
        LEARNING: "LIPServe, on_change=learn",
        ADAPTING: "LIPServe, on_change=adapt",
    }
    for key, label in labels.items():
        console.print(f"{label}: {options.scene.seconds:g} s in real time", highlight=False)
        results.methods[key] = quality.served(bed, key, label, options.scene, samples, options.moments)


def _baselines(
    base: TorqueModel, history: Samples, samples: Samples, options: Options, results: Results, console: Console
) -> None:
    scene, moments = options.scene, options.moments
    console.print("other methods, in this process", highlight=False)
    not_updated = quality.not_updated(base, scene, moments)
    refitted = quality.refitted(
        scene, samples, moments, options.estimator, options.fit, options.refit_every, options.refit_window
    )
    fitted = lipcore.train(history, scene.arm.joint_types, "se", lipcore.FitOptions(**options.fit))
    fourier = quality.fourier(scene, history, samples, moments, fitted, options.forgetting_s)
    ordered: list[Method] = [not_updated, *results.methods.values(), refitted, fourier]
    results.methods = {method.key: method for method in ordered}
    results.notes += [
        "Both served models learn the same stream in real time, one after the other. With on_change=learn the model "
        f"forgets nothing; with on_change=adapt it forgets with {options.forgetting_s:g} s, and starts a new regime "
        "from its present posterior at a detected change. Coverage is of torque with noise, nMSE of torque without.",
        f"The refit knows the time of the change, is trained on up to {quality.REFIT_ROWS} rows of the last "
        f"{options.refit_window:g} s or since the change, and is ready without delay.",
        f"Sparse spectrum GP: {FEATURES} random Fourier features a joint and the friction features of all estimators, "
        f"hyperparameters fitted by `se`, recursive least squares that forgets with {options.forgetting_s:g} s. It "
        "learns the training samples of the model first.",
    ]


def _motions(samples: Samples) -> Array:
    """Return queries, (Q, 3, n)."""
    return np.ascontiguousarray(np.stack([samples.q, samples.dq, samples.ddq], axis=1))
