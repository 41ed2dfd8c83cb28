"""Which request or job the code that runs belongs to, for logs and for what is stored."""

from __future__ import annotations

from contextvars import ContextVar

request_id: ContextVar[str | None] = ContextVar("request_id", default=None)
"""Id of the request that is answered, None outside of one."""
job_id: ContextVar[str | None] = ContextVar("job_id", default=None)
"""Id of the job that is worked on, None outside of one."""
