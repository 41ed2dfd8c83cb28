"""Training and learning processes that take a moment to start: forked from one that has imported what they need."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from multiprocessing.context import ForkServerContext, ForkServerProcess
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

PRELOADED = ["service.training.worker", "service.learning.learner.worker", "tests.service.warm"]
STARTERS = ("service.training.slots", "service.learning.learner.process")
"""Modules that start processes of the service."""


class _Process(ForkServerProcess):
    """A process with the environment of who starts it, as a spawned one has."""

    def __init__(
        self,
        group: None = None,
        target: Callable[..., object] | None = None,
        name: str | None = None,
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(group, _enter, name, (dict(os.environ), target, args, kwargs or {}), **options)


class _Context(ForkServerContext):
    Process = _Process


def _enter(
    environment: dict[str, str], target: Callable[..., object], args: tuple[Any, ...], kwargs: dict[str, Any]
) -> None:
    os.environ.clear()
    os.environ.update(environment)
    target(*args, **kwargs)


@contextmanager
def warm_processes() -> Iterator[None]:
    """Let services of this process fork theirs; those of `tests.service.server` spawn them, as always."""
    context = _Context()
    context.set_forkserver_preload(PRELOADED)
    with ExitStack() as stack:
        for module in STARTERS:
            stack.enter_context(patch(f"{module}.multiprocessing", SimpleNamespace(get_context=lambda _: context)))
        yield
