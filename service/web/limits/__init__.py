"""What clients may take of the machine: sizes, times, connections, rates, disk."""

from __future__ import annotations

from service.web.limits.requests import BodyLimit

__all__ = ["BodyLimit"]
