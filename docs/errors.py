"""Writes docs/errors.md: `python docs/errors.py`. A test fails while that is not what the service documents."""

from __future__ import annotations

from pathlib import Path

from service.api.openapi import error_table
from service.app import create_app

HEAD = """# Error codes

Every answer with a status of 400 and above is `{"error": {"code", "message", "detail"}}`. The code is for programs and
stays what it is; the message is for people; each item of `detail` names a `field`, the `value` that was found there and
what was `expected`. Below `/v2` the Open Inference Protocol sets the shape, `{"error": message}`, and 422 becomes 400.

| when | what a client does |
|---|---|
| 408, 429, 503 | wait, as long as `Retry-After` says where it is given, and send the same again |
| 507 | make room, then send the same again |
| 501 | have the extra installed where the service runs; `detail` has the line |
| 500 | read the service's log; `damaged_data` and `unreadable_version` name what is damaged |
| all others | change the request |

Where no answer comes at all, the request may have been done. Whatever is no POST can be sent again, and so can
`predict`, `evaluate`, `compare`, `trace` and observations. Uploads, jobs and retries of jobs can where they carry the
header `Idempotency-Key`, a name of the client's choice: they are done once, and what they made is answered each time.
Another request under the same key is a conflict. The Python client does all of this by itself.

"""


def document() -> str:
    """The whole file."""
    create_app()  # brings in every module that defines an error
    return HEAD + error_table()


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(document())
