"""Which requests are worth a line of the log, and what it says of them."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from time import monotonic
from typing import Any

from starlette.types import Scope

from service.web.observability.context import KEY_ID
from service.web.observability.meters import Kind

logger = logging.getLogger("service.requests")

MONITORING = frozenset({"/health/live", "/health/ready", "/v2/health/live", "/v2/health/ready", "/metrics"})
SHOWN = 200
"""Characters of an address that are logged."""


class RequestLog:
    """One line for each request, with three exceptions.

    Queries and batches of a control loop, and what monitoring asks for, are logged from `slow_s` on or where they fail:
    a line takes longer than an answer. Of equal refusals, `most_refusals` a second are logged and the others counted:
    a loop that asks wrong, or without a key, must not fill the disk. quiet: routes of control loops.
    """

    def __init__(self, quiet: Iterable[str], slow_s: float, most_refusals: int) -> None:
        self.quiet, self.slow_s, self.most_refusals = frozenset(quiet) | MONITORING, slow_s, most_refusals
        self._refusals: dict[tuple[str, int, str], _Second] = {}

    def worth(self, route: str, seconds: float) -> bool:
        """Whether a request that was not refused may be worth a line: a quick look, before more is made of it."""
        return route not in self.quiet or seconds >= self.slow_s or logger.isEnabledFor(logging.DEBUG)

    def answered(self, scope: Scope, kind: Kind, seconds: float) -> None:
        """Log a request that has been answered; of a stream, its end."""
        slow, missed = seconds >= self.slow_s and kind.status != 101, 0
        if kind.status >= 400:
            level, missed = logging.INFO if kind.status < 500 else logging.WARNING, self._missed(kind)
        else:
            level = logging.DEBUG if kind.route in self.quiet and not slow else logging.INFO
        if missed < 0 or not logger.isEnabledFor(level):
            return
        fields: dict[str, Any] = {"status": kind.status, "duration_ms": round(seconds * 1e3, 3)}
        if kind.code:
            fields["code"] = kind.code
        if slow:
            fields["slow"] = True
        if missed:
            fields["not_logged"] = missed
        what = "stream closed" if kind.status == 101 else "request"
        logger.log(level, what, extra={"fields": _of(scope, kind.route) | fields})

    def opened(self, scope: Scope, route: str) -> None:
        """Log a stream that begins."""
        if logger.isEnabledFor(logging.INFO):
            logger.info("stream opened", extra={"fields": _of(scope, route)})

    def _missed(self, kind: Kind) -> int:
        """How many equal refusals were not logged before this one; -1 where this one is not either."""
        second = int(monotonic())
        seen = self._refusals.get((kind.route, kind.status, kind.code))
        if seen is None:
            seen = self._refusals[kind.route, kind.status, kind.code] = _Second(second)
        missed = 0
        if seen.second != second:
            missed = max(seen.count - self.most_refusals, 0)
            seen.second, seen.count = second, 0
        seen.count += 1
        return missed if seen.count <= self.most_refusals else -1


def _of(scope: Scope, route: str) -> dict[str, Any]:
    """What a line says of a request: its address without the query, cut, as clients choose both."""
    found = {"route": route, "path": scope["path"][:SHOWN]}
    if "method" in scope:
        found["method"] = scope["method"][:16]
    if scope.get("client"):
        found["client"] = scope["client"][0]
    if KEY_ID in scope:
        found["key"] = scope[KEY_ID]
    return found


class _Second:
    """Refusals of one sort within one second."""

    __slots__ = ("count", "second")

    def __init__(self, second: int) -> None:
        self.second, self.count = second, 0
