"""Versions in memory as they answer: immutable, so that whoever holds one needs no lock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

from lipcore.model.torque_model import TorqueModel
from service.models.moves import SERVING
from service.models.registry import Serving

Key = tuple[str, int]
"""A model and the number of a version."""
Alias = tuple[str, str]
"""A model and an alias."""


@dataclass(frozen=True)
class Served:
    """One version in memory, immutable: whoever holds it answers from it whatever is learnt or dropped meanwhile.

    model: what answers; base: the version as trained; datasets: ids and hashes of the data sets it has learnt
    from; revision: online updates applied to it.
    """

    name: str
    version: int
    model: TorqueModel
    base: TorqueModel
    datasets: frozenset[str]
    revision: int = 0

    def has_learnt_from(self, dataset: str, sha256: str) -> bool:
        """Whether it was trained on a data set or part of it, or on the same samples uploaded another time."""
        return not self.datasets.isdisjoint((dataset, sha256))

    @cached_property
    def noise_std(self) -> list[float]:
        """Standard deviation of the measured torque around the function, (n,) N·m, as answers carry it."""
        found: list[float] = self.model.noise_std.tolist()
        return found


@dataclass(frozen=True)
class Learnt:
    """A version as trained and what it has learnt since: the model at a revision. behind: whether the log holds more
    than that."""

    model: TorqueModel
    revision: int
    behind: bool


class LearntStates(Protocol):
    """Knows what versions have learnt; each answer is None where that is nothing. base: the version as trained."""

    def find(self, model: str, version: int, base: TorqueModel) -> Learnt | None:
        """As much of it as takes no time."""

    def consolidated(self, model: str, version: int, base: TorqueModel) -> Learnt | None:
        """All of it, as a model that can be saved: it takes the time to learn what came since the last snapshot."""


@dataclass(frozen=True)
class Snapshot:
    """What is in memory, which version of each model answers, and where all aliases point; replaced as a whole."""

    served: Mapping[Key, Served] = field(default_factory=dict)
    serving: Mapping[str, Serving] = field(default_factory=dict)
    aliases: Mapping[Alias, int] = field(default_factory=dict)

    def pointed(self, model: str, alias: str | None) -> int | None:
        """The version that an alias points to, or that serves where it is None; None where that is not known."""
        if alias is None or alias == SERVING:
            serving = self.serving.get(model)
            return None if serving is None else serving.version
        return self.aliases.get((model, alias))

    def without(self, gone: set[Key], model: str | None) -> Snapshot:
        """The same without some versions and, where given, without a model's pointers."""
        return Snapshot(
            {key: each for key, each in self.served.items() if key not in gone},
            {name: each for name, each in self.serving.items() if name != model},
            {key: each for key, each in self.aliases.items() if key[0] != model},
        )
