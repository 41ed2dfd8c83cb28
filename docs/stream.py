"""Writes docs/reference/stream-protocol.md: `python docs/stream.py`. Its text is that of the frames' module,
`clients/python/lipserve/frames.py`, its examples are the test vectors of the clients. A test fails while it is not."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from struct import Struct, calcsize

from lipserve import frames

TARGET = Path(__file__).parent / "reference/stream-protocol.md"
VECTORS = Path(__file__).parents[1] / "clients/stream-vectors.txt"
HEAD = """# Stream protocol

What a controller sends and reads, byte by byte: enough to write a client in any language. `StreamClient` (Python) and
`clients/cpp` (C++) speak it. [In a control loop](../control-loop.md) says what for.

"""
CHAPTERS = {
    "One binary message": "Frames",
    "Request, ": "Request",
    "Answer, ": "Answer",
    "Every request has": "Texts",
    "External torque is": "External torque",
    "Learning. ": "Learning",
    "The query of": "The address",
    "The service reads no": "Limits and ends",
}
"""How the paragraphs of frames.py begin that a heading stands before."""
CONNECTION = """## WebSocket

RFC 6455, version 13, without extensions and subprotocols, over TCP or a Unix-domain socket (`LIPSERVE_UDS`).

```text
GET /v1/models/panda-sim/stream?stream_id=arm-1 HTTP/1.1
Host: 127.0.0.1:8000
Upgrade: websocket
Connection: Upgrade
Sec-WebSocket-Version: 13
Sec-WebSocket-Key: 16 random bytes in base64
Authorization: Bearer lip_…
```

- `Authorization` only where the service asks for keys. `Host`: a service without keys answers to `localhost` and
  addresses of loopback alone; over a Unix-domain socket say `localhost`. No `Origin`, unless you are a web page.
- The answer is `101`, and its `Sec-WebSocket-Accept` is base64(SHA-1(key + `258EAFA5-E914-47DA-95CA-C5AB0DC85B11`)).
  Any other status has a JSON error for a body, with `Content-Length`.
- A client masks each of its frames with four bytes of its choice: byte k of the payload is xored with byte k mod 4 of
  the mask. The service does not mask. It sends each message as one frame, but what stands between may cut it in parts.
- A ping is answered with a pong of the same payload; the service sends one after 20 s, and ends a connection that does
  not answer it. A close is answered with a close.

"""
CLIENT = """## What a client has to keep

- **Match answers by sequence.** An answer that comes after its asker has given up is still the next to come; it must
  not be taken for the answer to a later question.
- **Keep what is taught until it is settled**: `learnt.through` has reached its sequence, `refused` names it, or its own
  answer was an error. After a lost connection send what is left again, oldest first, under the same sequences and with
  the same bytes, before anything new is taught: a frame below one that the service has already taken is refused.
- **Begin above the last sequence** where a stream_id is used by another run. The same sequence with other numbers is
  refused as a conflict.
- **Bound what is under way.** Every request costs the service time in its turn; what is sent again after a restart
  delays the answers behind it.
- **Tell a dead connection from a slow one.** A machine that vanished sends no end: give up after some seconds without
  an answer that is due, and connect again after a wait that grows.

"""
REQUEST_FIELDS = ("sequence", "flags", "n", "deadline")
ANSWER_FIELDS = ("sequence", "flags", "n", "version", "late_answers", "revision", "seconds")
ARRAYS = {
    "request": ("q", "dq", "ddq", "tau"),
    "answer": ("tau", "tau_std", "scale", "external_tau", "external_std", "external_z", "external_statistic",
               "external_p", "payload"),
}  # fmt: skip


def document() -> str:
    """The whole file."""
    assert frames.__doc__ is not None
    return (
        HEAD + CONNECTION + "\n".join(_protocol(frames.__doc__)) + "\n" + CLIENT + "\n".join(_vectors()).rstrip() + "\n"
    )


def _protocol(text: str) -> Iterator[str]:
    """The text of frames.py, with headings; raise ValueError where a paragraph is missing that one stands before."""
    left = dict(CHAPTERS)
    for paragraph in text.strip().split("\n\n")[1:]:
        for start in [start for start in left if paragraph.startswith(start)]:
            yield f"## {left.pop(start)}\n"
        yield paragraph.removeprefix("Learning. ") + "\n"
    if left:
        raise ValueError(f"clients/python/lipserve/frames.py has no paragraph that begins with {list(left)}")


def _vectors() -> Iterator[str]:
    yield "## Test vectors\n"
    yield "From `clients/stream-vectors.txt`, which both clients are checked with. Bytes in hex, by their offsets.\n"
    for kind, name, fields in read_vectors(VECTORS.read_text("utf-8")):
        yield f"### {kind} {name}\n".replace("-", " ")
        yield "```text"
        data = bytes.fromhex(fields.pop("bytes"))
        if kind in ("request", "answer", "error"):
            yield from _annotated(kind, fields, data)
        else:
            for field, value in fields.items():
                yield from textwrap.wrap(f"{field}: {value}", 110, subsequent_indent="    ")
            yield from _dump(data)
        yield "```\n"


def read_vectors(text: str) -> Iterator[tuple[str, str, dict[str, str]]]:
    """Kind, name and fields of each vector, as they are written."""
    for block in re.split(r"\n\n+", text.strip()):
        lines = [line for line in block.splitlines() if not line.startswith("#")]
        if lines:
            kind, _, name = lines[0].partition(" ")
            yield kind, name, {key: value for key, _, value in (line.strip().partition(" ") for line in lines[1:])}


def _annotated(kind: str, fields: dict[str, str], data: bytes) -> Iterator[str]:
    """A line a field."""
    head, names = (frames.REQUEST, REQUEST_FIELDS) if kind == "request" else (frames.ANSWER, ANSWER_FIELDS)
    offset = 0
    for name, size in zip(names, _sizes(head), strict=True):
        value = fields.get(name)
        yield _line(offset, data[offset : offset + size], name if value is None else f"{name} {value}")
        offset += size
    for name in ARRAYS.get(kind, ()):
        for place, value in enumerate(fields.get(name, "").split()):
            yield _line(offset, data[offset : offset + 8], f"{name}[{place}] {value}")
            offset += 8
    if kind == "error":
        yield f"{offset:>4}  the rest, UTF-8:"
        yield from textwrap.wrap(data[offset:].decode(), 110, initial_indent="      ", subsequent_indent="      ")
    elif offset != len(data):
        raise ValueError(f"{offset} of {len(data)} bytes have a name")


def _sizes(head: Struct) -> list[int]:
    return [calcsize("<" + code) for code in head.format.lstrip("<")]


def _line(offset: int, data: bytes, meaning: str) -> str:
    return f"{offset:>4}  {data.hex():<16}  {meaning}"


def _dump(data: bytes) -> Iterator[str]:
    for offset in range(0, len(data), 32):
        yield f"{offset:>4}  {data[offset : offset + 32].hex(' ', -8)}"


if __name__ == "__main__":
    TARGET.write_text(document(), "utf-8")
