"""Where a service is, and the key that it is asked with: as a program says, else as its environment does."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

DEFAULT_URL = "http://127.0.0.1:8000"
"""Where a service listens by default."""
URL_VARIABLE = "LIPSERVE_URL"
"""Environment variable that clients take the address from."""
KEY_VARIABLE = "LIPSERVE_API_KEY"
"""Environment variable that clients take the key from."""
UNIX = "unix://"
NO_HOST = "http://localhost"
"""What HTTP says the host is where a socket leads to the service."""


def url_of(url: str | None) -> str:
    """The address of a service, where None or empty that of the environment, else of one on this machine."""
    return url or os.environ.get(URL_VARIABLE, "").strip() or DEFAULT_URL


def headers_of(key: str | None) -> dict[str, str]:
    """Headers of a client's requests with its key, where None the one of the environment, or none at all.

    Raise ValueError, which does not repeat it, where it cannot be a key.
    """
    given = (os.environ.get(KEY_VARIABLE, "") if key is None else key).strip()
    if not given.isascii() or not given.isprintable() or " " in given:
        raise ValueError(f"key (or {KEY_VARIABLE}) holds other characters than keys do, expected lip_…")
    return {"Authorization": f"Bearer {given}"} if given else {}


@dataclass(frozen=True)
class Address:
    """Where a service is. base: of its routes; unix: path of its Unix-domain socket, None where a host is named."""

    base: str
    unix: Path | None

    @classmethod
    def of(cls, url: str) -> Address:
        """Read http://host:port or unix:///path; raise ValueError."""
        if not url.startswith(UNIX):
            return cls(url, None)
        path = url.removeprefix(UNIX)
        if not path.startswith("/"):
            raise ValueError(f"url is {url!r}, expected unix:// and an absolute path, as unix:///run/lipserve.sock")
        return cls(NO_HOST, Path(path))
