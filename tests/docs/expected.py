"""Is what was printed what the page shows?"""

import json
from decimal import Decimal
from typing import Any


def compare(printed: Any, shown: str, place: str) -> None:
    """Raise AssertionError where a value that a page shows is not the one printed, to the digits that are shown."""
    _same(printed, json.loads(shown, parse_float=Decimal), place)


def _same(printed: Any, shown: Any, place: str) -> None:
    if isinstance(shown, dict):
        assert isinstance(printed, dict), place
        for name, value in shown.items():
            assert name in printed, f"{place}: {name} is not printed, but {list(printed)}"
            _same(printed[name], value, f"{place}, {name}")
    elif isinstance(shown, list):
        assert isinstance(printed, list), place
        assert len(printed) == len(shown), f"{place}: {len(printed)} printed, {len(shown)} shown"
        for index, (left, right) in enumerate(zip(printed, shown, strict=True)):
            _same(left, right, f"{place}[{index}]")
    elif isinstance(shown, Decimal):
        last_digit = Decimal(1).scaleb(int(shown.as_tuple().exponent))
        assert abs(Decimal(repr(printed)) - shown) <= last_digit, f"{place}: {printed} is shown as {shown}"
    elif isinstance(shown, str) and shown.endswith("…"):
        assert str(printed).startswith(shown.removesuffix("…")), f"{place}: {printed!r} is shown as {shown!r}"
    else:
        assert printed == shown, f"{place}: {printed!r} is shown as {shown!r}"
