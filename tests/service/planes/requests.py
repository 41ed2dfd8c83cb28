"""Requests of both planes, and an application that shows what it has read."""

import hashlib
import json

HOST = b"Host: localhost\r\n"
QUERY = b"POST /v1/models/arm/predict HTTP/1.1\r\n" + HOST + b"Content-Length: 3\r\n\r\nabc"
ECHO = b"POST /v1/echo HTTP/1.1\r\n" + HOST + b"Content-Length: %d\r\n\r\n%b"
PAGE = b"GET /v1/models HTTP/1.1\r\n" + HOST + b"\r\n"
STREAM = b"GET /v1/models/arm/stream?std=1 HTTP/1.1\r\n" + HOST + b"Upgrade: websocket\r\nConnection: Upgrade\r\n\r\n"


def echo(body: bytes) -> bytes:
    """Return a query of the data plane."""
    return ECHO % (len(body), body)


class Digest:
    """Answers a request with what it has read: method, path and a digest of the body. /early: without the body."""

    def __init__(self):
        self.begun = 0

    async def __call__(self, scope, receive, send):
        self.begun += 1
        body = b""
        while scope["path"] != "/early":
            message = await receive()
            body += message.get("body", b"")
            if not message.get("more_body"):
                break
        content = json.dumps([scope["method"], scope["path"], len(body), hashlib.sha256(body).hexdigest()]).encode()
        length = [(b"content-length", b"%d" % len(content))]
        await send({"type": "http.response.start", "status": 200, "headers": length})
        await send({"type": "http.response.body", "body": content})
