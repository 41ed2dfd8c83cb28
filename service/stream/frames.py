"""Binary frames of `WS /v1/models/{model}/stream`, layout 1, which `docs/control-loop.md` describes."""

from __future__ import annotations

from struct import Struct

LAYOUT = 1

REQUEST = Struct("<IHHd")
"""sequence, flags, n, deadline budget."""
ASK_STD = 1
ASK_LEARN = 2

ANSWER = Struct("<IHHIIQd")
"""sequence, flags, n, version, late answers, revision, seconds."""
HAS_STD = 1
LATE = 2
ERROR = 4
UNREAD = 8

NUMBER = "<f8"


def request_bytes(n_joints: int, learn: bool = False) -> int:
    """Length of a request of so many joints; learn: with tau."""
    return REQUEST.size + (4 if learn else 3) * 8 * n_joints
