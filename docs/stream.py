"""Writes docs/reference/stream-protocol.md: `python docs/stream.py`. A test fails if the page differs.

The text is the docstring of `clients/python/lipserve/frames.py`; the examples are the test vectors of the clients.
"""

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

The bytes that a controller sends and receives, in sufficient detail for a client in any language. `StreamClient`
(Python) and `clients/cpp` (C++) implement it. For its use, see [in a control loop](../control-loop.md).

"""
CHAPTERS = {
    "Each frame is one": "Frames",
    "Request, ": "Request",
    "Answer, ": "Answer",
    "Every request gets": "Texts",
    "Deadlines. ": "Deadlines",
    "Fallback. ": "Fallback",
    "Parts. ": "Gravity, mass matrix and Coriolis torque",
    "External torque is": "External torque",
    "Learning. ": "Learning",
    "Query parameters of": "The address",
    "Flow control. ": "Limits and ends",
}
"""Starts of paragraphs of frames.py, and the headings before them."""
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

- Send `Authorization` only if the service requires keys. `Host`: a service without keys accepts only `localhost` and
  loopback addresses; use `localhost` over a Unix-domain socket. Only web pages send `Origin`.
- The answer is `101` with the `Sec-WebSocket-Accept` base64(SHA-1(key + `258EAFA5-E914-47DA-95CA-C5AB0DC85B11`)). With
  any other status, the body is a JSON error with `Content-Length`.
- A client masks each of its frames with four bytes of its choice: byte k of the payload is xored with byte k mod 4 of
  the mask. The service does not mask. It sends each message as one frame, but a proxy may split it.
- Answer a ping with a pong of the same payload, and a close with a close. The service sends a ping after 20 s, and
  closes a connection that does not answer it.

"""
CLIENT = """## Rules for a client

- **Match answers by sequence.** A late answer still arrives after a timeout; it must not be used as the answer to a
  later request.
- **Keep frames with torque until they are settled**: `learnt.through` has reached the sequence, `refused` names it, or
  the answer is an error. After a lost connection, send the remaining frames again, oldest first, with the same
  sequences and bytes, before any new frame with torque. A frame below the service's last sequence is refused.
- **Start above the last sequence** if another run uses the same stream_id. The same sequence with other numbers is
  refused as a conflict.
- **Limit pending requests.** The service answers requests in order; frames sent again after a restart delay the answers
  behind them.
- **Detect dead connections.** A machine that has vanished closes nothing: give up if an answer is missing for some
  seconds, and reconnect after increasing waits.

"""
REQUEST_FIELDS = ("sequence", "flags", "n", "deadline")
ANSWER_FIELDS = ("sequence", "flags", "n", "version", "late_answers", "revision", "seconds")
ARRAYS = {
    "request": ("q", "dq", "ddq", "tau"),
    "answer": ("gravity", "gravity_std", "mass_matrix", "coriolis", "tau", "tau_std", "scale", "external_tau",
               "external_std", "external_z", "external_statistic", "external_p", "payload"),
}  # fmt: skip


def document() -> str:
    """Return the page."""
    assert frames.__doc__ is not None
    return (
        HEAD + CONNECTION + "\n".join(_protocol(frames.__doc__)) + "\n" + CLIENT + "\n".join(_vectors()).rstrip() + "\n"
    )


def _protocol(text: str) -> Iterator[str]:
    """Yield the text of frames.py with headings; raise ValueError if a paragraph of CHAPTERS is missing."""
    left = dict(CHAPTERS)
    for paragraph in text.strip().split("\n\n")[1:]:
        for start in [start for start in left if paragraph.startswith(start)]:
            yield f"## {left.pop(start)}\n"
        yield re.sub(r"^(Deadlines|Fallback|Parts|Learning|Flow control)\. ", "", paragraph) + "\n"
    if left:
        raise ValueError(f"clients/python/lipserve/frames.py has no paragraph that starts with {list(left)}")


def _vectors() -> Iterator[str]:
    yield "## Test vectors\n"
    yield "From `clients/stream-vectors.txt`, with which both clients are tested: offsets, and bytes in hex.\n"
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
    """Yield kind, name and fields of each vector, as texts."""
    for block in re.split(r"\n\n+", text.strip()):
        lines = [line for line in block.splitlines() if not line.startswith("#")]
        if lines:
            kind, _, name = lines[0].partition(" ")
            yield kind, name, {key: value for key, _, value in (line.strip().partition(" ") for line in lines[1:])}


def _annotated(kind: str, fields: dict[str, str], data: bytes) -> Iterator[str]:
    """Yield a line for each field."""
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
        raise ValueError(f"Only {offset} of {len(data)} bytes have a name.")


def _sizes(head: Struct) -> list[int]:
    return [calcsize("<" + code) for code in head.format.lstrip("<")]


def _line(offset: int, data: bytes, meaning: str) -> str:
    return f"{offset:>4}  {data.hex():<16}  {meaning}"


def _dump(data: bytes) -> Iterator[str]:
    for offset in range(0, len(data), 32):
        yield f"{offset:>4}  {data[offset : offset + 32].hex(' ', -8)}"


if __name__ == "__main__":
    TARGET.write_text(document(), "utf-8")
