"""Hides packages, as if they were not installed."""

import importlib.abc
import sys


class Hide(importlib.abc.MetaPathFinder):
    """Asked before all others. hidden: names of modules."""

    def __init__(self, hidden: set[str]) -> None:
        self.hidden = hidden

    def find_spec(self, name: str, path: object, target: object = None) -> None:
        """Say that a hidden module is not there; nothing of others."""
        if any(name == each or name.startswith(f"{each}.") for each in self.hidden):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def hide(*hidden: str) -> None:
    """Hide modules from now on."""
    sys.meta_path.insert(0, Hide(set(hidden)))
