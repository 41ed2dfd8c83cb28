"""Accuracy of several methods of learning before and after a change of the robot."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from benchmarks.clients import HttpClient
from benchmarks.online.bed import Bed, train
from benchmarks.online.flow import STREAM
from benchmarks.online.fourier import FourierModel
from benchmarks.online.scene import Scene, rows_of
from benchmarks.online.sending import BATCH_ROWS, batch_requests, stream
from lipcore.data.metrics import evaluate
from lipcore.data.samples import Array, Samples
from lipcore.model.torque_model import TorqueModel

REFIT_ROWS = 3000
"""Max rows of a refit, thinned evenly."""


@dataclass(frozen=True)
class Quality:
    """nMSE of each joint against the torque without noise, and coverage of the 95 % interval for measurements."""

    nmse: tuple[float, ...]
    coverage: tuple[float, ...]

    @property
    def mean_nmse(self) -> float:
        """Mean over joints."""
        return float(np.mean(self.nmse))

    @property
    def mean_coverage(self) -> float:
        """Mean over joints."""
        return float(np.mean(self.coverage))


@dataclass(frozen=True)
class Moment:
    """A time of the live stream, s, at which predictions are evaluated."""

    name: str
    at: float


@dataclass
class Method:
    """A method of learning, its quality by name of the moment, and the time of each refit, s."""

    key: str
    label: str
    found: dict[str, Quality] = field(default_factory=dict)
    seconds: list[float] = field(default_factory=list)


def evaluate_predictions(scene: Scene, unseen: Samples, tau: Array, std: Array, noise_std: Array) -> Quality:
    """Compare predictions, (N, n), with the torques of a test trajectory."""
    exact = evaluate(unseen.tau, tau, std, noise_std)
    noisy = evaluate(scene.measured(unseen), tau, std, noise_std)
    return Quality(tuple(exact.nmse.tolist()), tuple(noisy.coverage.tolist()))


def served(bed: Bed, model: str, label: str, scene: Scene, samples: Samples, moments: Sequence[Moment]) -> Method:
    """Stream to a served model in real time; query it at every moment, after the acknowledgement of its batch."""
    method = Method(model, label)
    unseen = {moment.name: scene.unseen(moment.at) for moment in moments}
    answers: dict[str, tuple[Array, Array, Array]] = {}

    def ask(name: str) -> None:
        answers[name] = bed.predict(model, unseen[name])[:3]

    after = {round(moment.at * scene.rate / BATCH_ROWS): partial(ask, moment.name) for moment in moments}
    requests = batch_requests(model, STREAM, samples)
    with HttpClient(bed.tcp) as client:
        stream(client, requests, BATCH_ROWS / scene.rate, after)
    method.found = {name: evaluate_predictions(scene, unseen[name], *answers[name]) for name in unseen}
    return method


def not_updated(base: TorqueModel, scene: Scene, moments: Sequence[Moment]) -> Method:
    """Evaluate the model as trained."""
    found = {moment.name: _evaluate_model(scene, base, moment.at) for moment in moments}
    return Method("none", "no update", found)


def refitted(
    scene: Scene,
    samples: Samples,
    moments: Sequence[Moment],
    estimator: str,
    fit: Mapping[str, Any],
    every: float,
    window: float,
) -> Method:
    """Evaluate a model retrained every `every` seconds, on the rows of the last `window` seconds or since the change.

    It knows the time of the change and is ready without delay. Refits that no moment uses are not computed.
    """
    method = Method("refit", f"full refit every {every:g} s")
    models: dict[float, TorqueModel] = {}
    for moment in moments:
        at = every * np.floor(moment.at / every + 1e-9)
        if at not in models:
            start = max(at - window, scene.change_at if at > scene.change_at else 0.0)
            chosen = samples.rows((samples.t >= start) & (samples.t < at))
            thinned = chosen.rows(slice(None, None, -(-len(chosen) // REFIT_ROWS)))
            models[at], seconds = train(thinned, scene.arm.joint_types, fit, estimator)
            method.seconds.append(seconds)
        method.found[moment.name] = _evaluate_model(scene, models[at], moment.at)
    return method


def fourier(
    scene: Scene,
    history: Samples,
    samples: Samples,
    moments: Sequence[Moment],
    fitted: TorqueModel,
    forgetting_s: float,
) -> Method:
    """Evaluate the sparse spectrum GP, with the history and then batch by batch; `fitted`: `se` on the history."""
    model = FourierModel.start(fitted, forgetting_s, seed=scene.seed)
    # the history is one block, not forgotten before the stream begins, like a trained version
    model = model.learn(rows_of(_at(history, float(samples.t[0]))))
    method = Method("fourier", "sparse spectrum GP")
    began = time.monotonic()
    for moment, rows in _between(samples, moments, scene.rate):
        for start in range(0, len(rows), BATCH_ROWS):
            model = model.learn(rows_of(rows.rows(slice(start, start + BATCH_ROWS))))
        unseen = scene.unseen(moment.at)
        tau, std = model.predict(unseen.q, unseen.dq, unseen.ddq)
        method.found[moment.name] = evaluate_predictions(scene, unseen, tau, std, model.noise_std)
    method.seconds.append(time.monotonic() - began)
    return method


def _evaluate_model(scene: Scene, model: TorqueModel, at: float) -> Quality:
    unseen = scene.unseen(at)
    answer = model.predict(unseen.q, unseen.dq, unseen.ddq)
    return evaluate_predictions(scene, unseen, answer.tau, answer.tau_std, answer.noise_std)


def _between(samples: Samples, moments: Sequence[Moment], rate: float) -> Iterator[tuple[Moment, Samples]]:
    """Yield each moment with the rows since the previous one."""
    before = 0
    for moment in moments:
        now = round(moment.at * rate)
        yield moment, samples.rows(slice(before, now))
        before = now


def _at(samples: Samples, time_: float) -> Samples:
    """Return the samples with one time for all."""
    return Samples(
        samples.joint_names,
        np.full(len(samples), time_),
        samples.episode,
        samples.q,
        samples.dq,
        samples.ddq,
        samples.tau,
    )
