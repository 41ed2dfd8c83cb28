"""Identities of requests that may be sent more than once and are done once."""

from __future__ import annotations

from secrets import token_hex

KEY_HEADER = "Idempotency-Key"


def new_key() -> str:
    """A key that no other request has."""
    return token_hex(16)
