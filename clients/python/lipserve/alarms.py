"""Events of alarms that the service posts to a webhook, with the check of their signature."""

from __future__ import annotations

import hashlib
import hmac
import json
import re
import time
from dataclasses import dataclass
from typing import Any

SIGNATURE = "LIPServe-Signature"
"""Header of the signature."""
_SIGNATURE = re.compile(r"t=(\d{1,15}),v1=([0-9a-f]{64})")


class SignatureError(ValueError):
    """The signature is not that of the body, or too old."""


@dataclass(frozen=True)
class AlarmEvent:
    """An alarm that was raised or cleared."""

    id: str
    """Id of the event. An event may arrive twice: ignore known ids."""
    type: str
    """`alarm.raised` or `alarm.cleared`."""
    model: str
    kind: str
    at: str
    """Time, ISO 8601 in UTC."""
    message: str
    evidence: dict[str, Any]


def read_alarm_event(
    body: bytes, signature: str, secret: str, max_age_s: float = 300.0, now: float | None = None
) -> AlarmEvent:
    """Check the signature of a posted event and return the event.

    Args:
        body: Body of the request, unchanged.
        signature: Header `LIPServe-Signature`: `t=T,v1=HEX` with HEX = HMAC-SHA256(secret, "T." + body).
        secret: Value of LIPSERVE_ALARM_WEBHOOK_SECRET.
        max_age_s: Max difference between T and now, s. It stops an attacker from sending an old event again.
        now: Unix time, s; None: the clock.

    Returns:
        The event.

    Raises:
        SignatureError: The signature is wrong or too old. Answer 400 and ignore the body.

    Example:
        >>> body = b'{"id": "evt_1", "type": "alarm.raised", "model": "arm", "kind": "change", "evidence": {}'
        >>> body += b', "at": "2026-01-01T00:00:00Z", "message": "The torque of joint1 no longer fits the model."}'
        >>> digest = hmac.new(b"0123456789abcdef", b"1767225600." + body, "sha256").hexdigest()
        >>> read_alarm_event(body, f"t=1767225600,v1={digest}", "0123456789abcdef", now=1767225600.0).kind
        'change'
    """
    match = _SIGNATURE.fullmatch(signature)
    if match is None:
        raise SignatureError(f"{SIGNATURE} is {signature[:100]!r}, expected t=SECONDS,v1=HEX")
    at, given = match.groups()
    expected = hmac.new(secret.encode(), at.encode() + b"." + body, hashlib.sha256).hexdigest()
    if not hmac.compare_digest(given, expected):
        raise SignatureError("The signature does not match: the secret differs, or the body was changed.")
    age = abs((time.time() if now is None else now) - int(at))
    if age > max_age_s:
        raise SignatureError(f"The event was sent {age:.0f} s ago, expected at most {max_age_s:g} s.")
    event = json.loads(body)
    return AlarmEvent(**{name: event[name] for name in AlarmEvent.__dataclass_fields__})
