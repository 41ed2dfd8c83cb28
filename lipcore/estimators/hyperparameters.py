"""Fit of hyperparameters by penalised marginal likelihood on a subset of the samples."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Motion, spaced_rows
from lipcore.data.samples import Array, Samples
from lipcore.estimators import noise
from lipcore.estimators.options import FitOptions
from lipcore.kernels.base import Params, TorqueKernel
from lipcore.posterior.exact import negative_log_evidence
from lipcore.posterior.linalg import NotPositiveDefiniteError
from lipcore.posterior.selection import spread_out
from lipcore.vocabulary import Device

PRIOR_STD = {"noise.log_std": noise.OPTIONS.prior_std, "logits": 4.0, "log": 3.0}
"""Standard deviations of the Gaussian priors on hyperparameters around their starting values. They are weak, except for
the noise, which few data cannot distinguish from misfit. 3 on a logarithm admits a factor of 20 either way within one
standard deviation."""
START_SPREAD = 0.3
"""Distance of other starts from the kernel's own, in standard deviations of the prior."""


class FitCancelledError(RuntimeError):
    """The caller cancelled the fit."""


@dataclass(frozen=True)
class FitProgress:
    """Progress of a fit."""

    stage: str
    """`geometry`, `hyperparameters` or `posterior`."""
    iteration: int
    """Number of the iteration, at most `max_iterations`."""
    max_iterations: int
    objective: float
    """Penalised −log evidence, nats."""
    fraction: float
    """Completed share of the work, 0 to 1."""
    elapsed: float
    """Time since the start, s."""
    estimator: str | None = None
    """Estimator in training, if `auto` trains several."""


@dataclass(frozen=True)
class FitReport:
    """Result and effort of a fit."""

    objective: float
    """Penalised −log evidence at the end, nats."""
    iterations: int
    """Iterations of the search from the chosen start."""
    evaluations: int
    """Evaluations of that search and of the screening of starts."""
    rejected_steps: int
    """Line-search points at which the covariance could not be factored."""
    converged: bool
    """Whether the search converged."""
    start: int
    """Number of the chosen start; 0 is the kernel's own."""
    samples_given: int
    """Number of samples."""
    samples_hyperparameters: int
    """Samples used by the fit of hyperparameters."""
    samples_posterior: int
    """Samples used by the posterior."""
    seconds: float
    """Wall time of the fit of hyperparameters."""
    device: str
    """Device of the fit."""


Progress = Callable[[FitProgress], None]
Cancelled = Callable[[], bool]


@dataclass(frozen=True)
class Fit:
    """Fitted hyperparameters, and the rows of the data that the posterior is conditioned on."""

    params: dict[str, Array]
    rows: NDArray[np.int64]
    report: FitReport


def fit(
    kernel: TorqueKernel,
    samples: Samples,
    options: FitOptions,
    on_progress: Progress | None = None,
    cancelled: Cancelled | None = None,
    stretches: Samples | None = None,
    begin: Params | None = None,
    device: Device = "cpu",
) -> Fit:
    """Fit hyperparameters to samples.

    on_progress: called after every iteration; cancelled: called at every evaluation; stretches: contiguous samples to
    estimate the white noise, if `samples` are thinned; begin: hyperparameters that replace the kernel's own start;
    device: to compute on, see `FitOptions.place`. Raise FitCancelledError when `cancelled` returns true. Raise
    NotPositiveDefiniteError if no hyperparameters give a covariance that can be factored.
    """
    motion, tau = samples.motion(), samples.tau
    floor = np.log(noise.floor(samples))
    start = kernel.initial(motion, tau)
    start["noise.log_std"] = np.log(noise.start(samples, stretches))
    start |= begin or {}
    stop = cancelled or (lambda: False)
    rows = spread_out(motion, options.hyperparameter_samples)
    search = _Search(kernel, start, floor, motion[rows], tau[rows], stop, device)

    began, iteration = time.monotonic(), 0

    def report_progress(stage: str, objective: float) -> None:
        if on_progress is not None:
            done, most, elapsed = iteration, options.max_iterations, time.monotonic() - began
            fraction = 0.95 * (1.0 if stage == "posterior" else iteration / most)
            on_progress(FitProgress(stage, done, most, objective, fraction, elapsed))

    def callback(intermediate_result: Any) -> None:
        nonlocal iteration
        iteration += 1
        report_progress("hyperparameters", float(intermediate_result.fun))

    few = spread_out(motion, min(60, options.hyperparameter_samples))
    screening = _Search(kernel, start, floor, motion[few], tau[few], stop, device)
    chosen, origin = _best_start(screening, options.starts)
    result = search.run(origin, options.max_iterations, callback)
    seconds = time.monotonic() - began
    report_progress("posterior", float(result.fun))

    used = spread_out(motion, options.posterior_samples)
    # evenly chosen among those of the posterior: spread-out samples are not representative
    even = used[spaced_rows(len(used), noise.OPTIONS.samples)]
    params = search.unpack(result.x)
    params = noise.refine(kernel, params, motion[even], tau[even], start["noise.log_std"], floor)
    report = FitReport(
        objective=float(result.fun),
        iterations=int(result.nit),
        evaluations=search.evaluations + screening.evaluations,
        rejected_steps=search.rejected,
        converged=bool(result.success),
        start=chosen,
        samples_given=len(samples),
        samples_hyperparameters=len(rows),
        samples_posterior=len(used),
        seconds=seconds,
        device=device,
    )
    return Fit(params, used, report)


def _best_start(screening: _Search, starts: int) -> tuple[int, Array]:
    """Return the number of the start with the best evidence of few samples after few steps, and where it ended.

    The first start is the kernel's own, the others are drawn from the prior. A poor optimum mostly shows early, and few
    samples cost little. This finds it before the long search.
    """
    rng = np.random.default_rng(0)
    centre, width = screening.pack(screening.start), screening.pack(screening.width_tensors())
    best, chosen, origin = np.inf, 0, centre
    for number in range(starts):
        begin = centre if number == 0 else centre + START_SPREAD * width * rng.standard_normal(len(centre))
        screening.best = np.inf
        try:
            result = screening.run(begin, 15)
        except NotPositiveDefiniteError:
            if number == 0 and starts == 1:
                raise
            continue
        if result.fun < best:
            best, chosen, origin = float(result.fun), number, result.x
    return chosen, origin


class _Search:
    """Penalised negative log evidence as a function of one flat vector, for scipy."""

    def __init__(
        self,
        kernel: TorqueKernel,
        start: Params,
        floor: Array,
        motion: Motion,
        tau: Array,
        cancelled: Cancelled,
        device: Device,
    ) -> None:
        self.kernel, self.start, self.floor, self.motion, self.tau = kernel, start, floor, motion, tau
        self.widths = {name: prior_std(name) for name in start} | kernel.prior_std()
        self.cancelled, self.device = cancelled, device
        self.evaluations = self.rejected = 0
        self.best = np.inf

    def __call__(self, flat: Array) -> tuple[float, Array]:
        if self.cancelled():
            raise FitCancelledError("the fit was cancelled")
        self.evaluations += 1
        params = self.unpack(flat)
        try:
            # a line search may step so far that exponentials overflow: that covariance is not finite, and is rejected
            with np.errstate(over="ignore", invalid="ignore"):
                evidence = negative_log_evidence(self.kernel, params, self.motion, self.tau, self.device)
        except NotPositiveDefiniteError:
            if not np.isfinite(self.best):
                raise  # not even the starting point has a valid covariance
            self.rejected += 1
            return self.best + 1e4, np.zeros_like(flat)
        value, gradient = evidence.value, evidence.gradient
        for name, centre in self.start.items():
            width = self.widths[name]
            deviation = (params[name] - centre) / width
            value += float(0.5 * np.square(deviation).sum())
            gradient[name] = gradient[name] + deviation / width
        self.best = min(self.best, value)
        return value, self.pack(gradient)

    def run(self, begin: Array, iterations: int, callback: Callable[..., None] | None = None) -> Any:
        """Minimise by L-BFGS-B from `begin` and return scipy's result. The noise stays above its floor."""
        from scipy.optimize import minimize  # noqa: PLC0415 - serving does without it

        free = {name: np.full_like(value, -np.inf) for name, value in self.start.items()}
        lower = self.pack({**free, "noise.log_std": self.floor})
        return minimize(
            self,
            np.maximum(begin, lower),
            jac=True,
            method="L-BFGS-B",
            callback=callback,
            bounds=[(low, np.inf) for low in lower.tolist()],
            options={"maxiter": iterations, "maxcor": 30, "ftol": 1e-7},
        )

    def width_tensors(self) -> dict[str, Array]:
        """Return the prior standard deviation of every hyperparameter."""
        return {name: np.full_like(value, self.widths[name]) for name, value in self.start.items()}

    def pack(self, params: Params) -> Array:
        return np.concatenate([params[name].ravel() for name in self.start])

    def unpack(self, flat: Array) -> dict[str, Array]:
        params, at = {}, 0
        for name, like in self.start.items():
            part = flat[at : at + like.size].copy()
            params[name] = part.reshape(like.shape)
            at += like.size
        return params


def prior_std(name: str) -> float:
    """Return the standard deviation of the prior on hyperparameter `name` around its starting value."""
    if name in PRIOR_STD:
        return PRIOR_STD[name]
    return PRIOR_STD["logits" if name.endswith("logits") else "log"]
