"""The options of a fit."""

from __future__ import annotations

import ctypes
import re
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal, get_args

from lipcore.vocabulary import GEOMETRY_MODES, PRIORS, TORCH_ESTIMATORS, Device, Prior

Standing = Literal["auto", "all", "chosen"]
GeometryOption = Literal["auto", "learn", "calibrate", "fixed"]


MAX_SEARCH_SECONDS = 3600.0
"""Max time limit of the search for a geometry, s."""


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit."""

    hyperparameter_samples: int = 150
    """Samples that hyperparameters are fitted on."""
    posterior_samples: int = 500
    """Samples that the posterior is conditioned on. If there are more, the most spread-out ones are used."""
    max_iterations: int = 150
    """Max iterations of the search for hyperparameters."""
    starts: int = 3
    """Starting points of the search for hyperparameters. The best one is continued."""
    tied: bool = True
    """Whether links share kernel shapes (see LipKernel)."""
    device: str = "auto"
    """Device: "cpu", "cuda" (`se`, `gip` and `lse` alone), or "auto": a GPU for these, if there is one."""
    prior: Prior = "urdf"
    """Prior masses of rigid bodies: those of the "urdf", or "zero"."""
    compact_tolerance: float = 0.01
    """Max deviation of the compact posterior from the exact one, in standard deviations."""
    max_inducing_outputs: int = 1500
    """Max size of the compact posterior. If the tolerance needs more, the deviation is larger and predictions stay
    fast."""
    statistics: Standing = "auto"
    """Samples of the final posterior: those `chosen` before, or `all`, each weighted by the time that it represents
    (`data.independence`). `auto` uses all if their effective samples exceed posterior_samples, which was measured to
    predict better (benchmarks/studies/all_rows.py)."""
    geometry: GeometryOption = "auto"
    """Geometry of rigid bodies: "learn", "calibrate" (around the URDF), "fixed" (that of the URDF), or "auto":
    calibrated if there is a robot, else learnt."""
    arms: str = ""
    """Numbers of joints of the arms on one base, such as "7,7", arm after arm in the order of the data. Empty: the arms
    of the robot, or one."""
    search_seconds: float = 30.0
    """Max processor time of the search for a geometry, s. The search lasts longer on a busy machine."""

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
        for name, most in (("compact_tolerance", 1.0), ("search_seconds", MAX_SEARCH_SECONDS)):
            number = getattr(self, name)
            if type(number) not in (int, float) or not 0 < number <= most:
                raise ValueError(f"{name} is {number!r}, expected a number above 0, at most {most:g}")
        if self.geometry not in ("auto", *GEOMETRY_MODES):
            raise ValueError(f"geometry is {self.geometry!r}, expected one of auto, {', '.join(GEOMETRY_MODES)}")
        if not re.fullmatch(r"([1-9]\d{0,2}(,[1-9]\d{0,2}){1,99})?", self.arms):
            raise ValueError(
                f"arms is {self.arms!r}, expected the number of joints of each of several arms, such as 7,7"
            )
        if self.prior not in PRIORS:
            raise ValueError(f"prior is {self.prior!r}, expected one of {', '.join(PRIORS)}")

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of joints of the arms, empty if they are those of the robot, or one."""
        return tuple(map(int, self.arms.split(","))) if self.arms else ()

    def check_device(self, estimator: str) -> None:
        """Raise ValueError if `device` is "cuda" and the estimator does not benefit from a GPU."""
        if self.device == "cuda" and estimator not in TORCH_ESTIMATORS:
            raise ValueError(
                f"device is 'cuda', but the compiled code of {estimator!r} is faster on the CPU: leave `device` out. "
                f"Only {', '.join(TORCH_ESTIMATORS)} use a GPU."
            )

    def place(self, estimator: str) -> Device:
        """Return the device for the fit of an estimator.

        Raise ValueError like `check_device`, or if "cuda" finds no GPU.
        """
        self.check_device(estimator)
        if self.device == "cpu" or estimator not in TORCH_ESTIMATORS:
            return "cpu"
        if _cuda():
            return "cuda"
        if self.device == "cuda":
            raise ValueError("device is 'cuda', but torch sees no CUDA device")
        return "cpu"


def _cuda() -> bool:
    """Return whether torch can compute on a GPU.

    torch is imported only if there is a driver, because its import takes seconds.
    """
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    if find_spec("torch") is None:
        return False
    import torch  # noqa: PLC0415 - see above

    return torch.cuda.is_available()
