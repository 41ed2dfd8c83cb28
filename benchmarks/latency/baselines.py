"""Baselines in this process: rigid-body dynamics, the exact posterior, GPyTorch."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.timing import Ask
from benchmarks.workload import Workload
from lipcore.data.motion import Motion
from lipcore.data.samples import Array, Samples
from lipcore.posterior.exact import ExactPosterior
from lipcore.posterior.selection import spread_out
from lipcore.robots.library import Robot, pinocchio

GPYTORCH_NOTE = (
    "GPyTorch: one exact GP per joint, as a batch of n; zero mean, RBF with one lengthscale per input (q, dq, ddq: 3n "
    "inputs), float64, Cholesky, eval mode, warm caches. Hyperparameters are fixed, with lengthscales from the spread "
    "of the inputs; compare the cost, not the accuracy. Answers are mean and std of the function."
)


def gpytorch_installed() -> bool:
    """Return whether GPyTorch, of the extra `bench`, is installed."""
    return find_spec("gpytorch") is not None


def rnea(robot: Robot, queries: Array) -> Ask:
    """Return Pinocchio's recursive Newton–Euler with the simulator's own bodies."""
    pin = pinocchio()
    algorithm, model, data = pin.rnea, robot.model, robot.model.createData()
    motions = [(robot.configuration(q), dq.copy(), ddq.copy()) for q, dq, ddq in queries]

    def ask(number: int) -> object:
        return algorithm(model, data, *motions[number % len(motions)])

    return ask


def exact_posterior(workload: Workload) -> ExactPosterior:
    """Return the exact Gaussian process with the model's hyperparameters, on the samples of its posterior."""
    samples, model = workload.samples, workload.model
    assert samples is not None
    motion, tau = samples.motion(), samples.tau
    rows = spread_out(motion, int(workload.manifest["options"]["posterior_samples"]))
    factor = model.calibration.function_std_factor
    return ExactPosterior.fit(model.estimator.kernel, model.posterior.params, motion[rows], tau[rows], factor)


def deviation(workload: Workload, exact: ExactPosterior) -> tuple[float, str]:
    """Return the largest deviation of the model's answers from the exact posterior's, and a note about it."""
    q, dq, ddq = (np.ascontiguousarray(workload.queries[:, part]) for part in range(3))
    answer, expected = workload.model.predict(q, dq, ddq), exact.predict(Motion.from_arrays(q, dq, ddq))
    unit = expected.std
    mean, std = (answer.tau - expected.mean) / unit, answer.tau_std / unit - 1
    largest = float(max(np.abs(mean).max(), np.abs(std).max()))
    return largest, (
        f"On the {len(q)} queries of another trajectory, the model's mean deviates from the exact GP's by "
        f"{np.sqrt(np.mean(mean**2)):.2%} rms and {np.abs(mean).max():.2%} max of the GP's standard deviation; its "
        f"standard deviation deviates by {np.abs(std).max():.2%} max."
    )


def exact(posterior: ExactPosterior, queries: Array) -> Ask:
    """Return a function that asks the exact posterior one query with standard deviation."""
    motions = [Motion(*(part[None].copy() for part in query)) for query in queries]

    def ask(number: int) -> object:
        answer = posterior.predict(motions[number % len(motions)])
        return answer.mean, answer.std

    return ask


class GPyTorch:
    """Exact GPs of GPyTorch on the same samples; see GPYTORCH_NOTE."""

    def __init__(self, samples: Samples, noise_std: Array) -> None:
        import gpytorch  # noqa: PLC0415 - of the extra `bench`

        self._settings = gpytorch.settings
        inputs, targets = _inputs(samples.motion()), torch.from_numpy(np.ascontiguousarray(samples.tau.T))
        n = samples.n_joints
        variance = torch.from_numpy(noise_std)[:, None] ** 2
        above = gpytorch.constraints.GreaterThan(0.5 * float(variance.min()))  # some joints have less than 1e-4
        likelihood = gpytorch.likelihoods.GaussianLikelihood(
            noise_constraint=above, batch_shape=torch.Size([n])
        ).double()
        likelihood.noise = variance

        class _Model(gpytorch.models.ExactGP):  # type: ignore[misc]  # the package has no types
            def __init__(self) -> None:
                super().__init__(inputs.expand(n, *inputs.shape), targets, likelihood)
                batch = torch.Size([n])
                self.mean_module = gpytorch.means.ZeroMean(batch_shape=batch)
                base = gpytorch.kernels.RBFKernel(ard_num_dims=inputs.shape[1], batch_shape=batch)
                self.covar_module = gpytorch.kernels.ScaleKernel(base, batch_shape=batch)

            def forward(self, x: Tensor) -> Any:
                return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

        model = _Model().double()
        spread = inputs.std(0).clamp_min(1e-6) * inputs.shape[1] ** 0.5
        model.covar_module.base_kernel.lengthscale = spread.expand(n, 1, -1)
        model.covar_module.outputscale = targets.var(1)
        model.eval()
        likelihood.eval()
        self.model = model

    def ask(self, queries: Array, fast_pred_var: bool) -> Ask:
        """Return a function that asks one query with std; `fast_pred_var` caches a low-rank variance (LOVE)."""
        points = [torch.from_numpy(query.reshape(1, -1).copy()) for query in queries]
        settings, model = self._settings, self.model
        n = len(model.train_targets)

        def ask(number: int) -> object:
            with torch.no_grad(), settings.fast_pred_var(fast_pred_var):
                answer = model(points[number % len(points)].expand(n, 1, -1))
                return answer.mean, answer.stddev

        return ask


def _inputs(motion: Motion) -> Tensor:
    return torch.from_numpy(np.concatenate([motion.q, motion.dq, motion.ddq], axis=1))
