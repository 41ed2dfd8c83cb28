"""Binary frames of `WS /v1/models/{model}/stream`, layout 1.

Each frame is one binary message, little-endian and without padding; numbers are 8-byte aligned. n is the number of
joints.

Request, 16 + 24 n bytes, or 16 + 32 n with tau; 16 + 8 n with flag 8 or 16, 16 + 16 n with flag 32:

    offset  type     field
    0       u32      sequence: chosen by the client, repeated in the answer
    4       u16      flags: 1 = return tau_std; 2 = learn from tau; 4 = return the external torque of tau; instead of
                     the torque, return 8 = gravity, 9 = gravity and its standard deviation, 16 = the mass matrix,
                     32 = the Coriolis torque
    6       u16      n
    8       f64      deadline in s after the frame's arrival in the service; 0 = none
    16      f64 n    q, rad (prismatic: m)
    …       f64 n    dq, rad/s (m/s); not with flag 8 or 16
    …       f64 n    ddq, rad/s² (m/s²); not with flag 8, 16 or 32
    …       f64 n    with flag 2 or 4: tau, N·m (prismatic: N), measured at this motion

The arrays of a request begin at 16 (q), 16 + 8 n (dq), 16 + 16 n (ddq) and 16 + 24 n (tau).

Answer, 32 + 8 n bytes; plus 8 n with tau_std, 8 n with scale, 24 n + 16 with external torque, 16 with payload:

    offset  type     field
    0       u32      sequence of the request
    4       u16      flags: 1 = has tau_std after tau; 2 = late; 4 = error; 8 = no sequence;
                     16 = has scale; 32 = has external torque; 64 = has payload, at the end;
                     128 = fallback: training does not, or not fully, determine some torque;
                     256 = gravity, 512 = mass matrix, 1024 = Coriolis torque, instead of tau
    6       u16      n; 0 in an error
    8       u32      serving version
    12      u32      late answers of this connection so far
    16      u64      revision: online updates applied to the version
    24      f64      seconds from the frame's arrival to the answer's departure
    32      f64 n    tau, N·m (prismatic: N): mean torque
    …       f64 n    tau_std, if requested, N·m: standard deviation of the function
    …       f64 n    scale, if requested: factor on the half width of intervals for measurements
    …       f64 n    tau_external, if requested, N·m: the request's tau minus the mean; with flag 128, the mean
                     of the full model
    …       f64 n    tau_external_std, N·m: scale · √(tau_std² + noise_std²)
    …       f64 n    tau_external_z: tau_external / tau_external_std
    …       f64      tau_external_statistic of the whole arm: T = eᵀ C⁻¹ e, e = tau_external. The diagonal of C has
                     the squares of tau_external_std; elsewhere, C has the function's covariance between the
                     joints, with the same scale
    …       f64      tau_external_p: P(χ² with n degrees of freedom > T)
    …       f64 2    payload, if requested: estimated payload mass of this stream_id, mean and standard deviation, kg;
                     both NaN without a payload

An answer with flag 256 has gravity, N·m, and with flag 1 its standard deviation; with flag 1024, the Coriolis torque,
N·m; with flag 512, the n × n mass matrix row by row, kg·m² (rotors included, symmetric). It has no scale, external
torque or payload.

An error has the same header, followed by UTF-8 JSON: {"error": {code, message, detail}}. The connection stays open.
Flag 8: the request was too short or not a binary message, so its sequence is unknown (0 in the answer).

Every request gets exactly one binary answer, in the order of the requests. When the connection opens, and before the
first answer of another version, the service sends one text message, a JSON object:

    {"layout": 1, "model", "version", "revision", "joint_names", "torque_convention", "noise_std", "max_position"}

Deadlines. A frame arrives when the service has read its last byte. An answer leaves when it is handed to the socket.
`seconds` is the time between both. An answer is late, with flag 2, if `seconds` exceeds the deadline of its request. On
the client's clock, the network and the socket buffers add to this time: an answer that is late for the service is late
for its client too.

Fallback. With flag 128, training does not determine some joint's torque at this motion. This torque falls back to
gravity, offset and friction, or to the training mean. The `fallback` of `POST /v1/models/{model}/predict` has the share
per joint. tau_std, external torque and learning are those of the full model.

Parts. M(q) ddq + Coriolis torque + gravity + friction is the torque, without the correction of `rigid-body+local`. Each
part includes the payload of this stream_id. A request is no part of the motion that friction follows. Gravity and
Coriolis torque need an estimator with energies (`lip`, `lip-chain`, `rigid-body` and its variants). The mass matrix
needs a torque that is affine in ddq (also `gip`). Other models answer with an error; so does a model of
gravity-compensated torque for gravity. A part takes 1.1 to 1.5 times as long as a torque, over TCP on one machine.

External torque is not a safety function. It is the torque that the model does not explain: a contact, a payload, or an
error of the sensor or of the model. It needs a finite tau. Without flag 2, nothing is learnt from it.

Learning. A request with flag 2 is answered like any other, before the service learns from its torque. It needs
`stream_id` in the address, the name of the robot or recording, and no `version`: a pinned version does not learn. Its
sequence identifies it permanently within the stream_id. Among the requests with flag 2 of a connection, the sequence
must increase; gaps are allowed. A request with a torque that is not finite is answered, and counted as not learnt. The
service logs such requests in batches of LIPSERVE_STREAM_FLUSH_ROWS, or after the first one has waited
LIPSERVE_STREAM_FLUSH_S. Once they are durable, it sends a text message

    {"learnt": {"through": sequence, "accepted", "duplicates", "rejected": {code: count}, "revision"}}

for the requests since the last such message, with `through` the newest one: how many are accepted, duplicates, and
rejected by code. Answers of `revision` and above contain them. Requests that cannot be logged are reported by

    {"refused": {"first": sequence, "through": sequence, "error": {code, message, detail}}}

Requests that got an error are in neither. These messages come between answers, after the answers of their requests.
Requests without flag 2 cause none. When a connection ends, pending requests are logged, but not reported. After a lost
connection, send all requests above the last `through` again, with the same sequences: requests that are already logged
count as duplicates and are learnt once. Refused requests are lost unless they are sent again with new sequences. While
ten times LIPSERVE_STREAM_FLUSH_ROWS requests wait to be logged, the service stops reading.

Query parameters of the address:

    version       pin a version; by default the serving version answers, and changes between two frames
    alias         follow the version of an alias
    min_revision  wait until the version has learnt this revision
    std=1         return tau_std for every frame, as with flag 1
    scale=1       return the scale for every frame: tau ± 1.96 · scale · √(tau_std² + noise_std²) is the 95 % interval
                  of a measurement, by the rows of this stream_id so far, or of all recent streams if it has none
    payload=1     return the payload for every frame; predictions of this stream_id include it in any case
    rich=1        answer from all centres of a correction
    without_gravity=1
                  return the torque minus gravity in every answer, with the standard deviation of the difference, for
                  robots that add gravity. It takes about 1 ms longer with a term `lip`, else microseconds.
                  External torque and learning are unchanged
    stream_id     stream to learn from: up to 64 letters, digits, dots, underscores and hyphens, a letter or digit first

Flow control. The service stops reading while an answer waits to be written. A client that sends but does not read is
slowed down by its own socket, and disconnected if it reads nothing for 10 s.

Closing codes: 1009 after a frame of more than 64 KiB, 1000 after LIPSERVE_STREAM_IDLE_S without a frame, 1001 when the
service stops, 1008 when the API key expires or is revoked. A connection may be refused before the upgrade with an HTTP
error of the same form: 401 (an API key is required), 403 (a key without the scope `predict` or, with stream_id,
`update`; a web page of another site), 404, 422 (an invalid parameter), 429 (LIPSERVE_MAX_STREAMS are open).
"""

from __future__ import annotations

from struct import Struct

LAYOUT = 1

REQUEST = Struct("<IHHd")
"""sequence, flags, n, deadline."""
ASK_STD = 1
ASK_LEARN = 2
ASK_EXTERNAL = 4
ASK_GRAVITY = 8
ASK_MASS_MATRIX = 16
ASK_CORIOLIS = 32
VECTORS = {0: 3, ASK_STD: 3, **dict.fromkeys(range(ASK_LEARN, ASK_GRAVITY), 4)}
VECTORS |= {ASK_GRAVITY: 1, ASK_GRAVITY | ASK_STD: 1, ASK_MASS_MATRIX: 1, ASK_CORIOLIS: 2}
"""Number of vectors of a request by its flags: the first of q, dq, ddq and tau."""

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
HAS_GRAVITY = 256
HAS_MASS_MATRIX = 512
HAS_CORIOLIS = 1024

NUMBER = "<f8"


def request_bytes(n_joints: int, flags: int = 0) -> int:
    """Return the size of a request in bytes. flags: a key of VECTORS."""
    return REQUEST.size + 8 * VECTORS[flags] * n_joints
