"""The options of a fit."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal, get_args

from lipcore.vocabulary import DIFFERENTIATED, GEOMETRY_MODES, PRIORS, Place, Prior

Standing = Literal["auto", "all", "chosen"]
GeometryOption = Literal["auto", "learn", "calibrate", "fixed"]


MOST_SECONDS = 3600.0
"""s; longer no search for a geometry may take."""


@dataclass(frozen=True)
class FitOptions:
    """How to fit.

    hyperparameter_samples: samples that hyperparameters are fitted on; posterior_samples: samples the posterior is
    conditioned on, where there are more the most spread-out ones; starts: points that the search for hyperparameters is
    tried from, the best of which is followed; tied: links share kernel shapes (see LipKernel);
    device: "cpu", "cuda" (`se`, `gip` and `lse` alone), or "auto": a GPU for these, if there is one;
    prior: of the masses of rigid bodies, those of the "urdf" or "zero";
    geometry: of rigid bodies, "learn", "calibrate" (around the URDF), "fixed" (as the URDF has it), or "auto":
    calibrated where there is a robot, else learnt; search_seconds: time limit of the search for a geometry;
    compact_tolerance: largest deviation of the compact posterior from the exact one, in standard deviations;
    max_inducing_outputs: where that would take more, the compact posterior deviates more, and answers stay fast;
    statistics: what the posterior of the chosen basis stands on in the end: the samples `chosen` before, or `all`, each
    counted for the time that it stands for (`data.independence`); `auto`: all where together they count as more
    than posterior_samples independent ones, which was measured to answer better (benchmarks/studies/all_rows.py).
    """

    hyperparameter_samples: int = 150
    posterior_samples: int = 500
    max_iterations: int = 150
    starts: int = 3
    tied: bool = True
    device: str = "auto"
    prior: Prior = "urdf"
    compact_tolerance: float = 0.01
    max_inducing_outputs: int = 1500
    statistics: Standing = "auto"
    geometry: GeometryOption = "auto"
    search_seconds: float = 30.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("hyperparameter_samples", 10, 2000),
            ("posterior_samples", 10, 5000),
            ("max_iterations", 1, 10000),
            ("starts", 1, 100),
            ("max_inducing_outputs", 1, 20000),
        ):
            value = getattr(self, name)
            if type(value) is not int or not low <= value <= high:
                raise ValueError(f"{name} is {value!r}, expected a whole number from {low} to {high}")
        if type(self.tied) is not bool:
            raise ValueError(f"tied is {self.tied!r}, expected true or false")
        if self.statistics not in get_args(Standing):
            raise ValueError(f"statistics is {self.statistics!r}, expected one of {', '.join(get_args(Standing))}")
        if self.device not in ("auto", "cpu", "cuda"):
            raise ValueError(f"device is {self.device!r}, expected auto, cpu or cuda")
        for name, most in (("compact_tolerance", 1.0), ("search_seconds", MOST_SECONDS)):
            number = getattr(self, name)
            if type(number) not in (int, float) or not 0 < number <= most:
                raise ValueError(f"{name} is {number!r}, expected a number above 0, at most {most:g}")
        if self.geometry not in ("auto", *GEOMETRY_MODES):
            raise ValueError(f"geometry is {self.geometry!r}, expected auto, {', '.join(GEOMETRY_MODES)}")
        if self.prior not in PRIORS:
            raise ValueError(f"prior is {self.prior!r}, expected one of {', '.join(PRIORS)}")

    def check_device(self, estimator: str) -> None:
        """Raise ValueError if `device` is "cuda" and the estimator gains nothing from a GPU."""
        if self.device == "cuda" and estimator not in DIFFERENTIATED:
            raise ValueError(
                f"device is 'cuda', but the compiled code of {estimator!r} is faster on the CPU: leave `device` out. "
                f"Only {', '.join(DIFFERENTIATED)} use a GPU."
            )

    def place(self, estimator: str) -> Place:
        """Return the device to fit an estimator on; raise ValueError as `check_device`, or if "cuda" finds no GPU."""
        self.check_device(estimator)
        if self.device == "cpu" or estimator not in DIFFERENTIATED:
            return "cpu"
        if _cuda():
            return "cuda"
        if self.device == "cuda":
            raise ValueError("device is 'cuda', but torch sees no CUDA device")
        return "cpu"


def _cuda() -> bool:
    """Whether torch can compute on a GPU. It is imported only where there is a driver: it takes seconds."""
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    if find_spec("torch") is None:
        return False
    import torch  # noqa: PLC0415 - see above

    return torch.cuda.is_available()
