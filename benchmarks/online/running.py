"""The benchmark of learning from start to end: options in, results out."""

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
from benchmarks.online.cost import CHUNK, TIMED, update_costs
from benchmarks.online.fleet import merged_difference
from benchmarks.online.fourier import FEATURES
from benchmarks.online.promises import ADAPTING, LEARNING
from benchmarks.online.quality import Method, Moment
from benchmarks.online.results import Results
from benchmarks.online.scene import Scene, rows_of
from benchmarks.online.sending import BATCH_ROWS
from lipcore.data.samples import Array, Samples
from lipcore.model.torque_model import TorqueModel
from service.contract.observations import LearningOptions

PARTS = ("flow", "cost", "quality", "fleet")
"""What can be measured, by name."""
LIVE, BURST = "live", "burst"
"""Models that are taught under load; each part teaches copies of its own."""
FIT: Mapping[str, Any] = {"posterior_samples": 500, "max_inducing_outputs": 500}
"""Of the model and of its refits. An estimator with inducing outputs has so few of them that a core learns 1000 samples
a second with some to spare."""
ROBOTS, FLEET_SAMPLES = 10, 300


@dataclass(frozen=True)
class Options:
    """How much is measured.

    estimator, fit: of all models, the learnt arm by default, which `auto` takes for an arm; history_s, history_rate: of
    the motion that the model is trained on, s and Hz; idle_s: length of the loop before anything is learnt, burst_s: of
    the stream that is sent as fast as it is acknowledged; after: seconds after the change at which predictions are
    judged; sizes: samples seen at which an update is timed; refit_every, refit_window: s; websocket: the live stream
    comes in frames; only: parts, all where empty.
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
            raise ValueError(f"--only has {unknown[0]!r}, expected names out of {', '.join(PARTS)}")
        scene = self.scene
        for at in (scene.seconds, *(moment.at for moment in self.moments)):
            batches = at * scene.rate / BATCH_ROWS
            if at > scene.seconds or abs(batches - round(batches)) > 1e-6:
                period = BATCH_ROWS / scene.rate
                raise ValueError(f"{at:g} s of the stream is no multiple of {period:g} s up to {scene.seconds:g} s")

    @property
    def moments(self) -> list[Moment]:
        """When predictions are judged."""
        change = self.scene.change_at
        return [Moment("before the change", change), *(Moment(f"{s:g} s after", change + s) for s in self.after)]

    def wanted(self, part: str) -> bool:
        """Whether a part is measured."""
        return not self.only or part in self.only


def run(options: Options, console: Console) -> Results:
    """Measure everything that the options ask for; raise BenchError where a step fails."""
    machine, scene = facts.machine(), options.scene
    with ExitStack() as stack:
        home = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lipserve-bench-")))
        history = scene.history(options.history_s, options.history_rate)
        console.print(f"training on {len(history)} samples of {scene.robot}", highlight=False)
        base, seconds = train(history, scene.arm.joint_types, options.fit, options.estimator)
        manifest = lipcore.save(base, home / "model")
        said = f"trained here in {seconds:.0f} s on {options.history_s:g} s at {options.history_rate:g} Hz"
        results = Results(machine, facts.model(manifest, f"{said}, speed {scene.speed:g}"), joints=base.joint_names)
        samples = scene.live()
        if options.wanted("flow") or options.wanted("quality"):
            install(home / "home", home / "model", _models(options), base.n_joints)
            bed = stack.enter_context(serving(home / "home"))
            if options.wanted("flow"):
                _flow(bed, samples, options, results, console)
            if options.wanted("quality"):
                _served(bed, samples, options, results, console)
        machine["threads of this process"] = stack.enter_context(facts.one_thread())
        if options.wanted("quality"):
            _baselines(base, history, samples, options, results, console)
        if options.wanted("cost"):
            console.print(f"cost of an update after {', '.join(map(str, options.sizes))} samples", highlight=False)
            rows = rows_of(scene.more((options.sizes[-1] + TIMED * CHUNK) / scene.rate))
            results.costs = update_costs(base, rows, options.sizes, options.forgetting_s)
        if options.wanted("fleet"):
            console.print(f"merging what {ROBOTS} robots have learnt", highlight=False)
            parts, results.robots = scene.fleet(ROBOTS, FLEET_SAMPLES, options.history_rate), ROBOTS
            results.merged = merged_difference(base, parts, scene.unseen(0.0).motion())
    return results


def _models(options: Options) -> dict[str, LearningOptions]:
    """Copies of the model by name. Nothing is trained beside the measurements."""
    learning = LearningOptions(on_change="learn", auto_refresh=False, auto_promote=False)
    adapting = learning.model_copy(update={"forgetting_s": options.forgetting_s, "on_change": "adapt"})
    opened = adapting.model_copy(update={"payloads": False})
    return {LIVE: adapting, BURST: adapting, LEARNING: learning, ADAPTING: opened}


def _flow(bed: Bed, samples: Samples, options: Options, results: Results, console: Console) -> None:
    motions = _motions(options.scene.unseen(0.0))
    console.print(f"asking at 500 Hz for {options.idle_s:g} s, idle", highlight=False)
    results.idle = flow.idle(bed, LIVE, motions, options.idle_s)
    console.print(f"the same while {options.scene.seconds:g} s are learnt in real time", highlight=False)
    results.learning, results.live = flow.live(bed, LIVE, samples, motions, options.websocket)
    console.print(f"the same while {options.burst_s:g} s are learnt as fast as they are acknowledged", highlight=False)
    results.pushed, results.burst = flow.burst(bed, BURST, options.scene.more(options.burst_s), motions)
    for name, found in (("in real time", results.live), ("as fast as acknowledged", results.burst)):
        kept_out = ", ".join(f"{count} {code}" for code, count in found.rejected.items()) or "none"
        results.notes.append(f"{name}: the learner had {found.learner:.0%} of one core; rows kept out: {kept_out}")
    how = "in frames over a WebSocket, one a row" if options.websocket else f"in batches of {BATCH_ROWS} rows over HTTP"
    results.notes.append(
        f"the live stream comes {how}, what is pushed in batches of {flow.PUSHED_ROWS}; the payload of "
        f"{options.scene.payload:g} kg comes at {options.scene.change_at:g} s of the live stream, and rows are kept "
        "out as contacts until it is taken for a change; the learner process starts with the first batch of all, and "
        "what it has to catch up with then counts"
    )


def _served(bed: Bed, samples: Samples, options: Options, results: Results, console: Console) -> None:
    results.moments = [moment.name for moment in options.moments]
    labels = {
        LEARNING: "LIPServe, learns on",
        ADAPTING: "LIPServe, adapts",
    }
    for key, label in labels.items():
        console.print(f"{label}: {options.scene.seconds:g} s in real time", highlight=False)
        results.methods[key] = quality.served(bed, key, label, options.scene, samples, options.moments)


def _baselines(
    base: TorqueModel, history: Samples, samples: Samples, options: Options, results: Results, console: Console
) -> None:
    scene, moments = options.scene, options.moments
    console.print("the other ways to learn, in this process", highlight=False)
    untaught = quality.untaught(base, scene, moments)
    refitted = quality.refitted(
        scene, samples, moments, options.estimator, options.fit, options.refit_every, options.refit_window
    )
    fitted = lipcore.train(history, scene.arm.joint_types, "se", lipcore.FitOptions(**options.fit))
    fourier = quality.fourier(scene, history, samples, moments, fitted, options.forgetting_s)
    ordered: list[Method] = [untaught, *results.methods.values(), refitted, fourier]
    results.methods = {method.key: method for method in ordered}
    results.notes += [
        "quality: both served models learn the same stream, one after the other, in real time; what learns on forgets "
        f"nothing, what adapts forgets in {options.forgetting_s:g} s and begins anew at a detected change, from what "
        "it knew; coverage is of torque measured with noise, nMSE against torque without",
        f"the refit is told when the change was, is trained on up to {quality.REFIT_ROWS} rows of the last "
        f"{options.refit_window:g} s or since the change, and stands ready at once: the seconds its trainings took are "
        "not waited for",
        f"sparse spectrum GP: {FEATURES} random Fourier features a joint and the friction features of all estimators, "
        f"hyperparameters fitted by `se`, recursive least squares that forgets in {options.forgetting_s:g} s; it is "
        "taught the samples first that the model is trained on",
    ]


def _motions(samples: Samples) -> Array:
    """Queries (Q, 3, n)."""
    return np.ascontiguousarray(np.stack([samples.q, samples.dq, samples.ddq], axis=1))
