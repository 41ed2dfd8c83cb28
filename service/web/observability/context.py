"""Which request or job the code that runs belongs to, for logs and for what is stored."""

from __future__ import annotations

import itertools
import secrets
from collections.abc import Iterable
from contextvars import ContextVar

request_id: ContextVar[str | None] = ContextVar("request_id", default=None)
"""Id of the request that is answered, None outside of one."""
job_id: ContextVar[str | None] = ContextVar("job_id", default=None)
"""Id of the job that is worked on, None outside of one."""

REQUEST_ID = b"x-request-id"
"""Header that names a request: taken from who asks, and in every answer."""
LONGEST_ID = 64
KEY_ID = "lipserve.key_id"
"""Key of the id of the API key in the ASGI scope of a request that came with one."""

_SEPARATORS = str.maketrans("", "", "._-")
_prefix = secrets.token_hex(6)
_numbers = itertools.count(1)


def new_request_id() -> str:
    """Return an id that no other request of this or of another process has: a counter costs less than randomness."""
    return f"{_prefix}-{next(_numbers):x}"


def given_request_id(headers: Iterable[tuple[bytes, bytes]]) -> str | None:
    """The id that a request brings, None where it brings none that can be taken: letters, digits and `._-`, up to 64.

    Whatever else a header may hold would go into logs and into answers.
    """
    for name, value in headers:
        if name == REQUEST_ID:
            text = value.decode("latin-1")
            plain = text.translate(_SEPARATORS)
            return text if len(text) <= LONGEST_ID and plain.isascii() and plain.isalnum() else None
    return None
