"""Selection of similar cases for `make test`; the others are slow. See also the marker `each_once`."""

from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

import pytest


def slow(*values: Any) -> Any:
    """Return a case for `make test-all`."""
    return pytest.param(*values, marks=pytest.mark.slow)


def few(cases: Iterable[Any], kept: Callable[[Any], object]) -> list[Any]:
    """Return cases of one value each, all slow except the kept ones."""
    return [case if kept(case) else slow(case) for case in cases]


def mark_repetitions(items: Iterable[pytest.Item]) -> None:
    """Mark combinations of tests marked `each_once` as slow, except a few that contain every parameter value once."""
    alike: dict[Any, dict[tuple[str, ...], pytest.Item]] = defaultdict(dict)
    for item in items:
        if isinstance(item, pytest.Function) and item.get_closest_marker("each_once") is not None:
            # ids of the values of each parametrisation; pytest has no public attribute for them
            alike[item.path, item.originalname][tuple(item.callspec._idlist)] = item
    for cases in alike.values():
        values = [list(dict.fromkeys(names)) for names in zip(*cases, strict=True)]
        longest = max(map(len, values))
        kept = {tuple(each[count % len(each)] for each in values) for count in range(longest)}
        for names, item in cases.items():
            if names not in kept:
                item.add_marker(pytest.mark.slow)
