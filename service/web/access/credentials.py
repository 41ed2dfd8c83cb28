"""Where a request carries its API key: in the header `Authorization`, from browsers in a WebSocket's subprotocol."""

from __future__ import annotations

import os
from collections.abc import Iterable

from starlette.types import Scope

VARIABLE = "LIPSERVE_KEY"
"""Environment variable that clients take the key from."""

SUBPROTOCOL = "lipserve"
KEY_SUBPROTOCOL = "lipserve.key."
"""Browsers can give a WebSocket no header: `new WebSocket(url, ["lipserve", "lipserve.key." + key])`."""


def secret_of(scope: Scope) -> bytes | None:
    """Return the key that a request carries, None where it carries none."""
    for name, value in scope["headers"]:
        if name == b"authorization":
            given: bytes = value
            if given[:7] == b"Bearer " or given[:7].lower() == b"bearer ":
                return given[7:].strip()
            return None
    for offered in scope.get("subprotocols", ()):
        if offered.startswith(KEY_SUBPROTOCOL):
            return str(offered).removeprefix(KEY_SUBPROTOCOL).encode("latin-1", "replace")
    return None


def subprotocol_of(offered: Iterable[str]) -> str | None:
    """Return the subprotocol to agree on, of those that a client offers: browsers insist on one of theirs."""
    offered = list(offered)
    if SUBPROTOCOL in offered:
        return SUBPROTOCOL
    return next((each for each in offered if each.startswith(KEY_SUBPROTOCOL)), None)


def headers_of(key: str | None) -> dict[str, str]:
    """Headers of a client's requests with its key, where None the one of the environment, or none at all.

    Raise ValueError, which does not repeat it, where it cannot be a key.
    """
    given = (os.environ.get(VARIABLE, "") if key is None else key).strip()
    if not given.isascii() or not given.isprintable() or " " in given:
        raise ValueError(f"key (or {VARIABLE}) holds other characters than keys do, expected lip_…")
    return {"Authorization": f"Bearer {given}"} if given else {}
