"""Bodies that are no JSON object, of every route that takes one."""

from __future__ import annotations

from tests.service.bad_requests.bad import EVALUATE, INFER, JOBS, LEARNING, OBSERVE, PREDICT, QUERY, ROLLBACK, Bad, body

ROUTES = (
    (PREDICT, "POST"),
    (EVALUATE, "POST"),
    (OBSERVE, "POST"),
    (JOBS, "POST"),
    (LEARNING, "PUT"),
    (ROLLBACK, "POST"),
)
TEXTS = (
    b"",
    b" ",
    b"{",
    b"}",
    b"[]",
    b"null",
    b"true",
    b"0",
    b"NaN",
    b'"text"',
    b"q=0&dq=0",
    b"<query/>",
    b"{} {}",
    b"{}\x00",
    b"{'q': 0}",
    b'{"q": 0,}',
    b'{"q": 0x10}',
    b'{"q": 01}',
    b'{"q": .5}',
    b'{"q": +1}',
    b'{"q" 0}',
    b'{"q": 0 /* zero */}',
    b'{"q": "\n"}',
    b'{"q": "\xff"}',
    b"\xff\xfe{\x00}\x00",
    b'{"q": "\xed\xa0\x80"}',
    b'{"q": ' + b"9" * 5000 + b"}",
    b"[" * 100_000,
    b'{"q": ' * 20_000,
    b"[" * 300 + b"]" * 300,
)
TWICE = (
    (PREDICT, "q", b'{"q": [1], "dq": [0], "ddq": [0], "q": [0]}'),
    (PREDICT, "q", b'{"q": [1], "dq": [0], "ddq": [0], "\\u0071": [0]}'),
    (PREDICT, "version", b'{"q": [1], "dq": [0], "ddq": [0], "version": 1, "version": 2}'),
    (OBSERVE, "tau", b'{"stream_id": "a", "sequence": 0, "q": [0], "dq": [0], "ddq": [0], "tau": [0], "tau": [1]}'),
    (EVALUATE, "dataset", b'{"dataset": "a", "dataset": "b"}'),
    (JOBS, "model", b'{"model": "a", "datasets": ["b"], "model": "c"}'),
    (JOBS, "tied", b'{"model": "a", "datasets": ["b"], "options": {"tied": true, "tied": false}}'),
    (ROLLBACK, "version", b'{"version": 1, "version": 1}'),
)
DEEP = b'{"q": ' + b"[" * 400 + b"]" * 400 + b', "dq": [0], "ddq": [0]}'

BAD: list[Bad] = [
    *(body(path, text, "body", method=method) for path, method in ROUTES for text in TEXTS),
    *(body(path, text, named) for path, named, text in TWICE),
    body(PREDICT, DEEP, "q[0][0]"),
    # the protocol's own reader
    *(body(INFER, text, "the body is", status=400) for text in TEXTS if not text.startswith((b'{"q":', b"{}"))),
    *(body(INFER, text, "inputs is missing", status=400) for text in (b"{}", b"{} {}", b"{}\x00")),
    body(INFER, b'{"inputs": []} x', "the body is", status=400),
    body(INFER, b'{"inputs": [], "id": "\xff"}', "the body is", status=400),
    body(INFER, b'{"inputs": ' + b"[" * 100_000, "inputs[0] is", status=400),
    body(INFER, b'{"q": 0}', "q is given", status=400),
    # what is right in itself, but not announced as JSON
    *(
        body(path, b"{}", "content-type", 415, "unsupported_media_type", method=method, headers={"content-type": kind})
        for path, method in ROUTES
        for kind in ("text/plain", "multipart/form-data; boundary=x")
    ),
    body(PREDICT, QUERY, "content-type", 415, "unsupported_media_type", headers={"content-type": "text/json"}),
    body(PREDICT, QUERY, "content-type", 415, "unsupported_media_type", headers={"content-type": "json"}),
    body(PREDICT, QUERY, "content-type", 415, "unsupported_media_type", headers={"content-type": "application/jsonx"}),
]
