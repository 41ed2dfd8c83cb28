"""Hides packages, as if they were not installed. Python imports this at its start, from PYTHONPATH.

LIPSERVE_TEST_HIDDEN: their modules, separated by commas. Spawned processes inherit it.
"""

import importlib.abc
import os
import sys

HIDDEN = {each for each in os.environ.get("LIPSERVE_TEST_HIDDEN", "").split(",") if each}


class Hide(importlib.abc.MetaPathFinder):
    """Asked before all others."""

    def find_spec(self, name: str, path: object, target: object = None) -> None:
        """Say that a hidden module is not there; nothing of others."""
        if any(name == each or name.startswith(f"{each}.") for each in HIDDEN):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, Hide())
