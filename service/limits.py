"""The largest body of a request, announced or not."""

from __future__ import annotations

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

UPLOADS, ROBOTS = "/v1/datasets", "/v1/robots"


class BodyLimit:
    """Refuse to read more of a body than the limit.

    Not FastAPI's `max_body_size`: to a body whose length is announced, that answers in plain text.
    """

    def __init__(self, app: ASGIApp, max_upload_bytes: int, max_urdf_bytes: int, max_request_bytes: int) -> None:
        self.app, self.others = app, max_request_bytes
        self.limits = {UPLOADS: max_upload_bytes, ROBOTS: max_urdf_bytes}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on; reading too much of its body raises an answer of 413."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        path: str = scope["path"]
        limit = next((most for prefix, most in self.limits.items() if path.startswith(prefix)), self.others)
        length: bytes = next((value for name, value in scope["headers"] if name == b"content-length"), b"")
        refused = length.isdigit() and int(length) > limit
        seen = 0

        async def limited() -> Message:
            nonlocal seen
            message: Message = {} if refused else await receive()
            seen += len(message.get("body", b""))
            if refused or seen > limit:
                # FastAPI takes any other exception for a body that cannot be parsed
                raise HTTPException(413, f"the body has more than {limit} bytes, the most that is taken here")
            return message

        await self.app(scope, limited, send)
