"""Binary frames of `WS /v1/models/{model}/stream`, layout 1.

One binary message a frame, little-endian and without padding; numbers are 8-byte aligned. n is the number of joints.

Request, 16 + 24 n bytes:

    offset  type     field
    0       u32      sequence: chosen by the client, repeated in the answer
    4       u16      flags: 1 = answer tau_std too; 2 = carries tau to learn from (reserved, refused)
    6       u16      n
    8       f64      deadline budget in s, counted from the frame's arrival in the service; 0 = none
    16      f64 n    q, rad (prismatic: m)
    …       f64 n    dq, rad/s (m/s)
    …       f64 n    ddq, rad/s² (m/s²)

Answer, 32 + 8 n bytes, or 32 + 16 n with tau_std:

    offset  type     field
    0       u32      sequence of the request
    4       u16      flags: 1 = tau_std follows tau; 2 = late: left after its deadline; 4 = error; 8 = no sequence
    6       u16      n; 0 in an error
    8       u32      version that answers
    12      u32      answers of this connection that missed their deadlines so far
    16      u64      revision: online updates applied to the version
    24      f64      seconds from the frame's arrival to the answer's departure
    32      f64 n    tau, N·m (prismatic: N): mean torque
    …       f64 n    tau_std, N·m: standard deviation of the function, where asked for

An error has the same header, and instead of numbers UTF-8 JSON: {"error": {code, message, detail}}. The connection goes
on. Flag 8 says that the request was too short, or no binary message, so that its sequence is unknown (and 0 here).

Every request has exactly one binary answer, in the order of the requests. When the connection opens, and before the
first answer of another version, the service sends one text message, a JSON object:

    {"layout": 1, "model", "version", "revision", "joint_names", "torque_convention", "noise_std", "max_position"}

A frame arrives when the service has read its last byte, and an answer leaves when it is handed to the socket: what
either waits in the network or in the sockets' buffers is not counted. An answer that had to wait for a client that
does not read is counted as late in the header of the next.

The query of the address: `version` pins one, else the newest answers as soon as it is there, between two frames;
`std=1` answers tau_std to every frame, as if each had flag 1.

The service reads no further while an answer waits to be written, so a client that sends but does not read is slowed
down by its own socket, and cut off when it reads nothing for LIPSERVE_STREAM_WRITE_S. A frame beyond
LIPSERVE_MAX_STREAM_FRAME_BYTES ends the connection with code 1009, LIPSERVE_STREAM_IDLE_S without a frame with 1000, a
service that stops with 1001. A connection that cannot be had is refused before the upgrade, in HTTP, with an error of
the same shape: 403 (a web page of another site), 404, 422 (a wrong parameter), 429 (LIPSERVE_MAX_STREAMS are open).
"""

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


def request_bytes(n_joints: int) -> int:
    """Length of a request of so many joints."""
    return REQUEST.size + 3 * 8 * n_joints
