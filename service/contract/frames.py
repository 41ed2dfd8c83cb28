"""Binary frames of `WS /v1/models/{model}/stream`, layout 1.

One binary message a frame, little-endian and without padding; numbers are 8-byte aligned. n is the number of joints.

Request, 16 + 24 n bytes, or 16 + 32 n with tau:

    offset  type     field
    0       u32      sequence: chosen by the client, repeated in the answer
    4       u16      flags: 1 = answer tau_std too; 2 = learn from tau; 4 = answer the external torque of tau
    6       u16      n
    8       f64      deadline budget in s, counted from the frame's arrival in the service; 0 = none
    16      f64 n    q, rad (prismatic: m)
    …       f64 n    dq, rad/s (m/s)
    …       f64 n    ddq, rad/s² (m/s²)
    …       f64 n    with flag 2 or 4: tau, N·m (prismatic: N), as measured at this motion

So the joints of a request begin at 16 (q), 16 + 8 n (dq), 16 + 16 n (ddq) and 16 + 24 n (tau).

Answer, 32 + 8 n bytes, 8 n more with tau_std, 8 n with scale, 24 n + 16 with external torque, 16 with payload:

    offset  type     field
    0       u32      sequence of the request
    4       u16      flags: 1 = tau_std follows tau; 2 = late; 4 = error; 8 = no sequence;
                     16 = scale follows; 32 = external torque follows; 64 = payload follows, last;
                     128 = fallback: some torque is not, or not fully, determined by the training
    6       u16      n; 0 in an error
    8       u32      version that answers
    12      u32      answers of this connection that missed their deadlines so far
    16      u64      revision: online updates applied to the version
    24      f64      seconds from the frame's arrival to the answer's departure
    32      f64 n    tau, N·m (prismatic: N): mean torque
    …       f64 n    tau_std, N·m: standard deviation of the function, where asked for
    …       f64 n    scale, where asked for: factor on the half width of intervals that hold measurements
    …       f64 n    tau_external, where asked for, as all that follows, N·m: the request's tau less the
                     mean, that of the full model with flag 128
    …       f64 n    tau_external_std, N·m: scale · √(tau_std² + noise_std²)
    …       f64 n    tau_external_z: tau_external / tau_external_std
    …       f64      tau_external_statistic: of the arm as one, T = eᵀ C⁻¹ e, e = tau_external; C has the squares of
                     tau_external_std on its diagonal, and scaled alike the function's covariance between the joints
    …       f64      tau_external_p: P(χ² with n degrees of freedom > T)
    …       f64 2    payload, where asked for: mass that this stream_id carries as far as is known, mean and standard
                     deviation, kg; both NaN where it carries nothing

An error has the same header, and instead of numbers UTF-8 JSON: {"error": {code, message, detail}}. The connection goes
on. Flag 8 says that the request was too short, or no binary message, so that its sequence is unknown (and 0 here).

Every request has exactly one binary answer, in the order of the requests. When the connection opens, and before the
first answer of another version, the service sends one text message, a JSON object:

    {"layout": 1, "model", "version", "revision", "joint_names", "torque_convention", "noise_std", "max_position"}

A frame arrives when the service has read its last byte, and an answer leaves when it is handed to the socket; seconds
is the time between both. An answer is late where seconds is more than the deadline of its request: flag 2 says so, and
late_answers counts the answers of the connection with flag 2. That is the service's clock. On the client's clock an
answer is late where more than the deadline passes between sending the request and having the answer. The network and
the sockets' buffers are in that, and what is late for the service is late for its client, too.

Flag 128 says that the training does not determine some joint's torque at this motion. That torque then goes back to
gravity, offset and friction, or to the training's mean; the `fallback` of `POST /v1/models/{model}/predict` says which
joints, and how far. tau_std, external torque and learning are those of the full model.

External torque is no safety function. It is what the model does not explain: a touch, a payload, a fault of the sensor
or of the model. tau must be finite then; nothing is learnt of it without flag 2.

Learning. A request with flag 2 is answered like any other: the answer is made before the service learns of its torque.
It needs `stream_id` in the address, the name of the robot or recording that the torque comes from, and no `version`:
who pins a version only asks. Its sequence is its identity within that stream_id for good: among the requests with flag
2 of a connection it must go up, gaps allowed. A torque that is not finite is answered, and counted as not learnt. The
service gathers such requests and logs LIPSERVE_STREAM_FLUSH_ROWS of them at a time, or what has come when the first has
waited for LIPSERVE_STREAM_FLUSH_S. Once they are durable it says in a text message

    {"learnt": {"through": sequence, "accepted", "duplicates", "rejected": {code: count}, "revision"}}

of those since the last such message, of which `through` is the newest: how many are new and learnt from, were known
already, and were kept out by code; answers of `revision` and above contain them. What cannot be logged is told by

    {"refused": {"first": sequence, "through": sequence, "error": {code, message, detail}}}

Requests that got an error for an answer are in neither. These texts come between answers, after those of the requests
they speak of; requests without flag 2 cause none. At the end of a connection what is left is logged, and not told. So
after a lost one send again what is above the last `through`, under the same sequences: what is in the log counts as
duplicate and is applied once. What was refused is lost, unless it is sent again under new sequences. While ten times
LIPSERVE_STREAM_FLUSH_ROWS wait to be logged, the service reads no further.

The query of the address: `version` pins one, else the newest answers as soon as it is there, between two frames;
`alias` follows what that points to; `min_revision` waits until the version that answers has learnt that much;
`std=1` answers tau_std to every frame, as if each had flag 1; `scale=1` answers the scale to every frame: tau ± 1.96 ·
scale · √(tau_std² + noise_std²) holds 95 % of what is measured, by what this stream_id has taught until then, or where
there is none by what all recent ones have; `payload=1` answers to every frame what the arm carries; `stream_id` names
the source of torques to learn from, in up to 64 letters, digits, dots, underscores and hyphens, a letter or digit
first. What this stream_id's arm carries is part of its answers with or without `payload`.

The service reads no further while an answer waits to be written, so a client that sends but does not read is slowed
down by its own socket, and cut off when it reads nothing for 10 s. A frame of more than 64 KiB
ends the connection with code 1009, LIPSERVE_STREAM_IDLE_S without a frame with 1000, a
service that stops with 1001, an API key that is revoked or expires with 1008. A connection that cannot be had is
refused before the upgrade, in HTTP, with an error of the same shape: 401 (no API key where one is needed), 403 (a key
without the scope `predict` or, with stream_id, `update`; a web page of another site), 404, 422 (a wrong parameter), 429
(LIPSERVE_MAX_STREAMS are open).
"""

from __future__ import annotations

from struct import Struct

LAYOUT = 1

REQUEST = Struct("<IHHd")
"""sequence, flags, n, deadline budget."""
ASK_STD = 1
ASK_LEARN = 2
ASK_EXTERNAL = 4

ANSWER = Struct("<IHHIIQd")
"""sequence, flags, n, version, late answers, revision, seconds."""
HAS_STD = 1
LATE = 2
ERROR = 4
UNREAD = 8
HAS_SCALE = 16
HAS_EXTERNAL = 32
HAS_PAYLOAD = 64
FALLBACK = 128

NUMBER = "<f8"


def request_bytes(n_joints: int, torque: bool = False) -> int:
    """Length of a request of so many joints; torque: with tau."""
    return REQUEST.size + (4 if torque else 3) * 8 * n_joints
