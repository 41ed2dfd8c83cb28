"""Fitting: hyperparameters by penalised marginal likelihood on a subset, then the exact posterior."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from lipcore import noise
from lipcore.evidence import negative_log_evidence
from lipcore.kernels.base import Params, TorqueKernel
from lipcore.kernels.rigid_body import PRIORS
from lipcore.linalg import NotPositiveDefiniteError
from lipcore.motion import Motion
from lipcore.samples import Array, Samples
from lipcore.selection import spread_out

PRIOR_STD = {"noise.log_std": noise.PRIOR_STD, "logits": 4.0, "log": 3.0}
"""Widths of the Gaussian priors on hyperparameters around their starting values: weak, but for the noise, which a
small data set cannot tell from misfit. 3 on a logarithm admits a factor of 20 either way within one deviation."""
LINE_SEARCH_PENALTY = 1e4
TOLERANCE = 1e-7
"""The fit has converged when an iteration improves the objective by less than this share of it."""
MEMORY = 30
"""Corrections that L-BFGS keeps."""


class FitCancelledError(RuntimeError):
    """The caller asked to stop."""


@dataclass(frozen=True)
class FitOptions:
    """How to fit.

    hyperparameter_samples: samples that hyperparameters are fitted on; posterior_samples: samples the posterior is
    conditioned on, where there are more the most spread-out ones; tied: links share kernel shapes (see LipKernel);
    device: "cpu", "cuda" or "auto"; prior: of rigid bodies, "urdf" or "zero" (see RigidBodyKernel).
    """

    hyperparameter_samples: int = 150
    posterior_samples: int = 500
    max_iterations: int = 150
    tied: bool = True
    device: str = "auto"
    prior: str = "urdf"

    def __post_init__(self) -> None:
        for name, low, high in (
            ("hyperparameter_samples", 10, 2000),
            ("posterior_samples", 10, 5000),
            ("max_iterations", 1, 10000),
        ):
            value = getattr(self, name)
            if type(value) is not int or not low <= value <= high:
                raise ValueError(f"{name} is {value!r}, expected a whole number from {low} to {high}")
        if self.device not in ("auto", "cpu", "cuda"):
            raise ValueError(f"device is {self.device!r}, expected auto, cpu or cuda")
        if self.prior not in PRIORS:
            raise ValueError(f"prior is {self.prior!r}, expected one of {', '.join(PRIORS)}")

    def torch_device(self) -> torch.device:
        """The device to fit on; raise ValueError for `cuda` where there is none."""
        if self.device == "cuda" and not torch.cuda.is_available():
            raise ValueError("device is 'cuda', but no CUDA device is available")
        return torch.device("cuda" if self.device != "cpu" and torch.cuda.is_available() else "cpu")


@dataclass(frozen=True)
class FitProgress:
    """stage: `hyperparameters` or `posterior`; objective: penalised −log evidence, nats; fraction: 0..1 of the work."""

    stage: str
    iteration: int
    max_iterations: int
    objective: float
    fraction: float
    elapsed: float


@dataclass(frozen=True)
class FitReport:
    """What a fit did. objective: penalised −log evidence at the end; rejected_steps: line-search points whose
    covariance could not be factored; seconds: wall time of the hyperparameters' fit."""

    objective: float
    iterations: int
    evaluations: int
    rejected_steps: int
    converged: bool
    samples_given: int
    samples_hyperparameters: int
    samples_posterior: int
    seconds: float
    device: str


Progress = Callable[[FitProgress], None]
Cancelled = Callable[[], bool]


@dataclass(frozen=True)
class Fit:
    """Fitted hyperparameters and the rows of the data that the posterior stands on."""

    params: dict[str, Tensor]
    rows: NDArray[np.int64]
    report: FitReport


def fit(
    kernel: TorqueKernel,
    samples: Samples,
    options: FitOptions,
    on_progress: Progress | None = None,
    cancelled: Cancelled | None = None,
) -> Fit:
    """Fit hyperparameters to samples; on_progress after every iteration, `cancelled` asked at every evaluation.

    Raise FitCancelledError when `cancelled` answers true, NotPositiveDefiniteError where no hyperparameters give a
    covariance that can be factored.
    """
    device = options.torch_device()
    motion, tau = samples.motion(device), samples.torque(device)
    start = kernel.initial(motion, tau)
    floor = noise.floor(samples)
    start["noise.log_std"] = torch.from_numpy(np.log(np.maximum(noise.start(samples), floor))).to(device)
    rows = spread_out(motion, options.hyperparameter_samples)
    objective = _Objective(kernel, start, motion[rows], tau[rows], cancelled or (lambda: False))

    began, iteration = time.monotonic(), 0

    def callback(intermediate_result: Any) -> None:
        nonlocal iteration
        iteration += 1
        if on_progress is not None:
            on_progress(
                FitProgress(
                    "hyperparameters",
                    iteration,
                    options.max_iterations,
                    float(intermediate_result.fun),
                    0.95 * iteration / options.max_iterations,
                    time.monotonic() - began,
                )
            )

    result = minimize(
        objective,
        objective.pack(start),
        jac=True,
        method="L-BFGS-B",
        callback=callback,
        bounds=objective.bounds({"noise.log_std": np.log(floor)}),
        options={"maxiter": options.max_iterations, "maxcor": MEMORY, "ftol": TOLERANCE},
    )
    seconds = time.monotonic() - began
    if on_progress is not None:
        on_progress(FitProgress("posterior", iteration, options.max_iterations, float(result.fun), 0.95, seconds))
    used = spread_out(motion, options.posterior_samples)
    report = FitReport(
        objective=float(result.fun),
        iterations=int(result.nit),
        evaluations=objective.evaluations,
        rejected_steps=objective.rejected,
        converged=bool(result.success),
        samples_given=len(samples),
        samples_hyperparameters=len(rows),
        samples_posterior=len(used),
        seconds=seconds,
        device=device.type,
    )
    lowest = torch.from_numpy(np.log(floor)).to(device)
    params = objective.unpack(result.x)
    # evenly among those of the posterior: spread-out samples are the odd ones
    even = used[torch.linspace(0, len(used) - 1, min(len(used), noise.SAMPLES), device=device).round().long()]
    params = noise.refine(kernel, params, motion[even], tau[even], start["noise.log_std"], lowest)
    params = {name: value.cpu() for name, value in params.items()}
    return Fit(params, used.cpu().numpy(), report)


class _Objective:
    """Penalised negative log evidence as a function of one flat vector, for scipy."""

    def __init__(self, kernel: TorqueKernel, start: Params, motion: Motion, tau: Tensor, cancelled: Cancelled) -> None:
        self.kernel, self.start, self.motion, self.tau = kernel, start, motion, tau
        self.widths = {name: prior_std(name) for name in start} | kernel.prior_std()
        self.cancelled = cancelled
        self.evaluations = self.rejected = 0
        self.best = np.inf

    def __call__(self, flat: Array) -> tuple[float, Array]:
        if self.cancelled():
            raise FitCancelledError("the fit was cancelled")
        self.evaluations += 1
        params = self.unpack(flat)
        try:
            evidence = negative_log_evidence(self.kernel, params, self.motion, self.tau)
        except NotPositiveDefiniteError:
            if not np.isfinite(self.best):
                raise  # not even the starting point is well posed
            self.rejected += 1
            return self.best + LINE_SEARCH_PENALTY, np.zeros_like(flat)
        value, gradient = evidence.value, evidence.gradient
        for name, centre in self.start.items():
            width = self.widths[name]
            deviation = (params[name] - centre) / width
            value += float(0.5 * deviation.square().sum())
            gradient[name] = gradient[name] + deviation / width
        self.best = min(self.best, value)
        return value, self.pack(gradient)

    def bounds(self, lower: dict[str, Array]) -> list[tuple[float, float]]:
        """Bounds of the flat vector: from below where `lower` names a hyperparameter, none elsewhere."""
        limits = [lower.get(name, np.full(like.numel(), -np.inf)) for name, like in self.start.items()]
        return [(float(low), np.inf) for low in np.concatenate(limits)]

    def pack(self, params: Params) -> Array:
        return np.concatenate([params[name].detach().cpu().numpy().ravel() for name in self.start])

    def unpack(self, flat: Array) -> dict[str, Tensor]:
        params, at = {}, 0
        for name, like in self.start.items():
            part = torch.from_numpy(flat[at : at + like.numel()].copy())
            params[name] = part.reshape(like.shape).to(like.device)
            at += like.numel()
        return params


def prior_std(name: str) -> float:
    """Width of the prior on hyperparameter `name` around its starting value."""
    if name in PRIOR_STD:
        return PRIOR_STD[name]
    return PRIOR_STD["logits" if name.endswith("logits") else "log"]
