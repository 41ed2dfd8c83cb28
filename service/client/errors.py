"""What goes wrong between a client and the service."""

from __future__ import annotations

import json
from typing import Any


class ServiceUnreachableError(ConnectionError):
    """No service answers at the address, or the connection to it was lost."""


class ApiError(RuntimeError):
    """The service refused a request.

    status: of HTTP; code, message, detail: as the service says; retry_after: seconds after which it may be tried again,
    where the service says so.
    """

    def __init__(
        self, status: int, code: str, message: str, detail: list[dict[str, Any]], retry_after: float | None = None
    ) -> None:
        super().__init__(message)
        self.status, self.code, self.message, self.detail, self.retry_after = status, code, message, detail, retry_after


def refused(status: int, body: bytes, retry_after: float | None = None) -> ApiError:
    """The error that an answer tells."""
    try:
        error = json.loads(body)["error"]
        if isinstance(error, str):  # below /v2
            return ApiError(status, "http_error", error, [], retry_after)
        return ApiError(status, error["code"], error["message"], error["detail"], retry_after)
    except (ValueError, KeyError, TypeError):
        return ApiError(status, "http_error", body[:500].decode(errors="replace"), [], retry_after)
