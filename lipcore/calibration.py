"""The correction that makes intervals true on trajectories never seen.

A posterior with fitted hyperparameters knows what the samples leave open, but takes the hyperparameters themselves for
certain: it is too sure of itself. The standard deviation of the function is therefore multiplied by a factor, one for
each estimator, measured on simulated arms with random masses (`docs/calibration.py`): slow and fast, 60 to 500 samples,
judged on trajectories of twice the bandwidth. It is stored with the model and touches neither mean nor noise.
"""

from __future__ import annotations

from dataclasses import dataclass

FUNCTION_STD_FACTOR = {"lip-chain": 1.1, "rigid-body+lip-chain": 1.1}


@dataclass(frozen=True)
class Calibration:
    """function_std_factor: what the standard deviation of the function is multiplied by, at least 1."""

    function_std_factor: float = 1.0

    def __post_init__(self) -> None:
        if not 1.0 <= self.function_std_factor < 100.0:
            raise ValueError(f"function_std_factor is {self.function_std_factor!r}, expected a number from 1 to 100")


NO_CALIBRATION = Calibration()


def calibrate(estimator: str) -> Calibration:
    """Return the correction measured for an estimator."""
    return Calibration(FUNCTION_STD_FACTOR.get(estimator, 1.0))
