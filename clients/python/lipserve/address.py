"""Address and API key of a service, from arguments or from the environment."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

DEFAULT_URL = "http://127.0.0.1:8000"
"""Default address of a service."""
URL_VARIABLE = "LIPSERVE_URL"
"""Environment variable with the address."""
KEY_VARIABLE = "LIPSERVE_API_KEY"
"""Environment variable with the API key."""
UNIX = "unix://"
NO_HOST = "http://localhost"
"""Host in HTTP requests over a Unix-domain socket."""


def url_of(url: str | None) -> str:
    """Return the given address, else that of the environment, else the default."""
    return url or os.environ.get(URL_VARIABLE, "").strip() or DEFAULT_URL


def headers_of(key: str | None) -> dict[str, str]:
    """Return the authorization header for the given key, else for that of the environment, else no header.

    Raise ValueError for an invalid key; the message does not contain the key.
    """
    given = (os.environ.get(KEY_VARIABLE, "") if key is None else key).strip()
    if not given.isascii() or not given.isprintable() or " " in given:
        raise ValueError(f"key (or {KEY_VARIABLE}) has characters that are not allowed in an API key, expected lip_…")
    return {"Authorization": f"Bearer {given}"} if given else {}


@dataclass(frozen=True)
class Address:
    """Address of a service. base: URL of its routes; unix: path of its Unix-domain socket, None for host and port."""

    base: str
    unix: Path | None

    @classmethod
    def of(cls, url: str) -> Address:
        """Parse http://host:port or unix:///path; raise ValueError for a relative path."""
        if not url.startswith(UNIX):
            return cls(url, None)
        path = url.removeprefix(UNIX)
        if not path.startswith("/"):
            raise ValueError(f"url is {url!r}, expected unix:// and an absolute path, e.g. unix:///run/lipserve.sock")
        return cls(NO_HOST, Path(path))
