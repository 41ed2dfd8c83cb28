"""Makes modules unimportable, as if their packages were not installed."""

import importlib.abc
import sys


class Hide(importlib.abc.MetaPathFinder):
    """An import finder for hidden modules."""

    def __init__(self, hidden: set[str]) -> None:
        self.hidden = hidden

    def find_spec(self, name: str, path: object, target: object = None) -> None:
        """Raise ModuleNotFoundError for a hidden module; return None for others."""
        if any(name == each or name.startswith(f"{each}.") for each in self.hidden):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def hide(*hidden: str) -> None:
    """Hide these modules."""
    sys.meta_path.insert(0, Hide(set(hidden)))
