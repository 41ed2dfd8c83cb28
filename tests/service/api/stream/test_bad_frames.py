"""Wrong frames: each gets an error, and the stream continues."""

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosedError

from tests.service.data import DEADLINE
from tests.service.streams import (
    ASK_CORIOLIS,
    ASK_EXTERNAL,
    ASK_GRAVITY,
    ASK_MASS_MATRIX,
    ERROR,
    MOTION,
    TAU,
    UNREAD,
    frame,
    open_stream,
    read,
    read_hello,
    send_frame,
)


def changed(row, joint, value):
    """Return the motion with one number changed."""
    motion = MOTION.copy()
    motion[row, joint] = value
    return motion


def external_frame(tau):
    """Return a frame that asks for the external torque."""
    return frame(flags=ASK_EXTERNAL, tau=tau, learn=False)


BAD = {
    "text": ("what is the torque?", "frame", "a text message", "a binary message"),
    "empty": (b"", "frame", "0 bytes long", "a header of 16 bytes"),
    "another robot": (frame(np.zeros((3, 7))), "n", "7", "2 joints: "),
    "unknown flag": (frame(flags=64), "flags", "64", "a sum of 1 (return tau_std), 2 (learn from tau) and 4"),
    "two parts": (
        frame(MOTION[:2], flags=ASK_MASS_MATRIX | ASK_CORIOLIS),
        "flags",
        "48",
        "a sum of 1 (return tau_std)",
    ),
    "gravity with dq": (frame(MOTION[:2], flags=ASK_GRAVITY), "frame", "48 bytes long", "32 bytes for 2 joints with q"),
    "coriolis without dq": (frame(MOTION[:1], flags=ASK_CORIOLIS), "frame", "32 bytes long", "48 bytes for 2 joints"),
    "no number": (frame([[np.nan, 0.0]], flags=ASK_MASS_MATRIX), "q[0]", "nan", "a finite number"),
    "learn, no torque": (frame(flags=2), "frame", "64 bytes long", "80 bytes for 2 joints with tau"),
    "external, no torque": (frame(flags=ASK_EXTERNAL), "frame", "64 bytes long", "80 bytes for 2 joints with tau"),
    "torque in vain": (frame(tau=TAU, learn=False), "frame", "80 bytes long", "64 bytes for 2 joints"),
    "other torque": (external_frame([1.0, 2.0, 3.0]), "frame", "88 bytes long", "80 bytes for 2 joints with tau"),
    "nan in tau": (external_frame([0.0, np.nan]), "tau[1]", "nan", "a finite number"),
    "inf in tau": (external_frame([-np.inf, np.nan]), "tau[0]", "-inf", "a finite number"),
    "torque beyond numbers": (external_frame([1e300, 0.0]), "tau_external_statistic[0]", "", "a finite number"),
    "nobody's torque": (frame(tau=TAU), "stream_id", "missing", "as in ?stream_id=arm-1, for flag 2"),
    "nan deadline": (frame(budget=float("nan")), "deadline", "nan", "a number of seconds, or 0 for none"),
    "nan in q": (frame(changed(0, 1, np.nan)), "q[1]", "nan", "a finite number"),
    "inf in dq": (frame(changed(1, 0, np.inf)), "dq[0]", "inf", "a finite number"),
    "degrees": (frame(changed(0, 0, -90.0)), "q[0]", "-90", "radians (or metres) within ±12.6: are these degrees?"),
    "std beyond numbers": (frame(changed(1, 0, 1e120)), "tau_std[", "", "a finite number: are dq in rad/s"),
    "beyond numbers": (frame(changed(1, 0, 1e300)), "tau[", "", "a finite number: are dq in rad/s and ddq in rad/s²?"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_frame_gets_an_error_and_the_stream_continues(streaming, kind):
    request, field, value, expected = BAD[kind]
    with open_stream(streaming.server) as connection:
        read_hello(connection)
        before = send_frame(connection, frame(sequence=5))
        refused = send_frame(connection, request)
        after = send_frame(connection, frame(sequence=6))
    unread = isinstance(request, str) or len(request) < 16
    assert (refused.flags, refused.sequence) == ((ERROR | UNREAD, 0) if unread else (ERROR, 1))
    assert refused.error["code"] == "invalid_request"
    (problem,) = refused.error["detail"]
    assert problem["field"].startswith(field)
    assert problem["value"].startswith(value)
    assert expected in problem["expected"]
    assert refused.error["message"] == f"{problem['field']} is {problem['value']}, expected {problem['expected']}"
    assert after.sequence == 6
    np.testing.assert_array_equal(after.tau, before.tau)
    np.testing.assert_array_equal(after.std, before.std)


def test_largest_position_is_allowed_with_either_sign(streaming):
    with open_stream(streaming.server) as connection:
        read_hello(connection)
        assert send_frame(connection, frame([[12.6, -12.6], [0, 0], [0, 0]])).error is None
        assert send_frame(connection, frame([[0, -np.nextafter(12.6, 13)], [0, 0], [0, 0]])).error is not None


def close_frame(server, message, **options):
    """Send a message after which the server closes the stream; return its close frame."""
    with open_stream(server) as connection:
        read_hello(connection)
        connection.send(message, **options)
        with pytest.raises(ConnectionClosedError) as ended:
            connection.recv(DEADLINE)
    return ended.value.rcvd


def test_giant_frame_closes_the_stream_before_it_is_read(streaming):
    assert close_frame(streaming.server, bytes(64 * 1024 + 1)).code == 1009
    with open_stream(streaming.server) as connection:
        read_hello(connection)
        assert send_frame(connection, bytes(64 * 1024)).error["code"] == "invalid_request"


def test_invalid_text_closes_the_stream_with_a_short_reason(streaming):
    before = len(streaming.server.log.read_text())
    closed = close_frame(streaming.server, b"\xff\xfe", text=True)
    assert (closed.code, closed.reason) == (1007, "a text message is not UTF-8")
    with open_stream(streaming.server) as connection:
        read_hello(connection)
        connection.send([b"caf", b"\xc3", b"\xa9"], text=True)  # a character may be split between two pieces
        assert read(connection.recv(DEADLINE)).error["detail"][0]["value"] == "a text message"
    assert "Traceback" not in streaming.server.log.read_text()[before:]
