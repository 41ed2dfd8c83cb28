"""The recipe that prepares a recording, and the error if it cannot."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args

from lipcore.data.signals import CUTOFF

Form = Literal["acausal", "causal"]
"""acausal: without delay, from samples before and after, for recordings; causal: as a live stream can, with a delay."""
Filtering = Literal["derived", "always", "never"]
"""When signals are low-passed: if velocity or acceleration is derived (as in the paper), always, or never."""


class PreparationError(ValueError):
    """A recording cannot be prepared as requested: `field` is `value`, but `expected` was expected."""

    def __init__(self, field: str, value: object, expected: str) -> None:
        super().__init__(f"{field} is {value}, expected {expected}")
        self.field, self.value, self.expected = field, value, expected


@dataclass(frozen=True)
class Recipe:
    """Settings of the preparation. The defaults are the paper's: 4 Hz without delay, acausal differentiation.

    Raise ValueError if a value is impossible.
    """

    cutoff_hz: float = CUTOFF
    """Cut-off of the low-pass."""
    filtering: Filtering = "derived"
    """When the low-pass is used."""
    form: Form = "acausal"
    rate_hz: float | None = None
    """Rate of the returned samples; None for the rate of the recording."""
    trim_s: float | None = None
    """Time cut off at both ends of every part; None cuts one period of the cut-off, which the filter distorts."""
    gap_steps: float = 1.5
    """A time step longer than this many usual steps splits a recording. If signals are low-passed, it must also be
    longer than 0.3 periods of the cut-off."""
    jitter: float = 0.25
    """Max deviation of a step from the usual one, as a share of it, on an even clock. An uneven clock is resampled."""

    def __post_init__(self) -> None:
        for name, choices in (("filtering", get_args(Filtering)), ("form", get_args(Form))):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} is {getattr(self, name)!r}, expected one of {', '.join(choices)}")
        for name, least in (("cutoff_hz", 0.0), ("rate_hz", 0.0), ("gap_steps", 1.0), ("jitter", 0.0)):
            value = getattr(self, name)
            if value is not None and not least < value < float("inf"):
                raise ValueError(f"{name} is {value!r}, expected a number above {least:g}")
        if self.trim_s is not None and not 0 <= self.trim_s < float("inf"):
            raise ValueError(f"trim_s is {self.trim_s!r}, expected at least 0 s")

    def to_json(self) -> dict[str, Any]:
        """Return the settings by name."""
        return asdict(self)

    @staticmethod
    def from_json(choices: dict[str, Any]) -> Recipe:
        """Return the recipe with these settings; raise ValueError for an unknown name."""
        known = [each.name for each in fields(Recipe)]
        if unknown := sorted(set(choices) - set(known)):
            raise ValueError(f"unknown setting {unknown[0]!r} of the recipe. Settings: {', '.join(known)}")
        return Recipe(**choices)
