"""Writes docs/errors.md: `python docs/errors.py`. A test fails if the page differs."""

from __future__ import annotations

from pathlib import Path

from service.api.openapi import error_table
from service.app import create_app

HEAD = """# Error codes

Every answer with a status of 400 or above is `{"error": {"code", "message", "detail"}}`. Programs use the stable code,
people read the message. Each item of `detail` has a `field`, its `value` and the `expected` value. Below `/v2` the Open
Inference Protocol defines the format, `{"error": message}`, and 422 becomes 400.

| status of the answer | action of the client |
|---|---|
| 408, 429, 503 | wait (for the time in `Retry-After`, if present), then repeat the request |
| 507 | free disk space or quota, then repeat the request |
| 501 | install the extra on the service's machine; `detail` has the command |
| 500 | read the service's log; `damaged_data` and `unreadable_version` name the damaged object |
| all others | change the request |

If no answer arrives, the request may have been executed. Repeat it safely if it is not a POST, or if it is `predict`,
`evaluate`, `compare`, `trace` or an observation batch. Uploads, jobs and retries of jobs are safe to repeat with the
header `Idempotency-Key`, a text chosen by the client: the service executes them once, and returns the same result each
time. Another request with the same key is a conflict. The Python client does all of this automatically.

"""


def document() -> str:
    """Return the page."""
    create_app()  # imports all modules that define errors
    return HEAD + error_table()


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(document())
