"""NPZ archives: their arrays as columns, and false headers."""

import io
import os
import pickle
import re
import struct
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.service.datasets.reading import check_rejected, read, zipped

RNG = np.random.default_rng(2)
Q, TAU = RNG.normal(size=(100, 2)), RNG.normal(size=(100, 2))


def npz(*, compressed=False, **arrays):
    out = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(out, **arrays)
    return out.getvalue()


@pytest.mark.parametrize(
    ("compressed", "order", "kind"), [(False, "C", "<f8"), (True, "F", ">f4"), (True, "C", "<f2"), (False, "F", "u1")]
)
def test_arrays_become_columns(tmp_path, compressed, order, kind):
    values = (100 * np.abs(Q)).astype(kind, order=order)
    result = read(tmp_path, npz(q=values, tau=TAU, temp=values[:, 0], pose=values, compressed=compressed), "npz")
    assert result.names == ("q1", "q2", "tau1", "tau2", "temp", "pose[0]", "pose[1]")
    np.testing.assert_array_equal(result["q2"], values[:, 1])
    np.testing.assert_array_equal(result["pose[0]"], values[:, 0])
    np.testing.assert_array_equal(result["temp"], values[:, 0])


def test_arrays_that_are_not_columns_are_reported(tmp_path):
    extra = {"note": np.array("hi"), "limits": np.zeros((2, 7)), "cube": np.zeros((100, 2, 2)), "meta": np.array({})}
    result = read(tmp_path, npz(q=Q, tau=TAU, flags=Q > 0, **extra), "npz")
    assert result.names == ("q1", "q2", "tau1", "tau2")
    assert "flags, note, limits, cube, meta" in result.facts[0]


def test_other_array_names_are_read_without_q(tmp_path):
    others = {"limits": np.zeros((2, 2)), "joint_names": np.array(["a", "b"])}
    result = read(tmp_path, npz(position=Q, effort=TAU, **others), "npz")
    assert result.names == ("position[0]", "position[1]", "effort[0]", "effort[1]")
    assert result.joint_names == ("a", "b")


@given(lengths=st.lists(st.integers(1, 9), min_size=1, max_size=8), step=st.floats(1e-4, 1.0))
def test_dt_counts_every_episode_from_zero(tmp_path_factory, lengths, step):
    from service.datasets.formats import npz as module

    episode = np.repeat(np.arange(len(lengths)), lengths)
    expected = np.concatenate([np.arange(length) for length in lengths]) * step
    body = npz(q=np.zeros((len(episode), 1)), tau=np.zeros((len(episode), 1)), episode=episode, dt=step)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "block_rows", lambda columns: 4)
        result = read(tmp_path_factory.mktemp("npz"), body, "npz")
    np.testing.assert_array_equal(result["t"], expected)


def npy(array):
    out = io.BytesIO()
    np.lib.format.write_array(out, np.asarray(array), allow_pickle=True)
    return out.getvalue()


def header(text, data=b""):
    """Return an array file with the given header."""
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode("latin1") + data


def false_header(descr, shape, data=bytes(64)):
    """Return an array file whose header contradicts its data."""
    return header(f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}\n", data)


def false_size():
    """Return an archive of arrays of 1.6 MB, of which one declares 1000 bytes."""
    body = npz(q=np.zeros((100_000, 2)), tau=np.zeros((100_000, 2)), compressed=True)
    with zipfile.ZipFile(io.BytesIO(body)) as file:
        size = file.getinfo("q.npy").file_size.to_bytes(4, "little")
    return body.replace(size, (1000).to_bytes(4, "little"))


def false_directory():
    """Return an archive that declares a directory of 2 GB."""
    body = bytearray(npz(q=Q, tau=TAU))
    struct.pack_into("<II", body, body.rindex(b"PK\x05\x06") + 12, 2**31 - 1, 0)
    return bytes(body)


FALSE_HEADERS = [
    false_header("'<f8'", "(10**12, 2)"),
    false_header("'<f8'", "(1000000000000, 2)"),
    false_header("'<f8'", "(0, 100000000000000000000000000000)", b""),
    false_header("'<f8'", "(-80, 2)"),
    false_header("'<f8'", "80"),
    false_header("'|O'", "(1, 2)"),
    false_header("((), ())", "(80, 2)", b""),
    false_header("__import__('os').abort()", "(80, 2)", b""),
    *map(header, ["", "{'descr': '<f8', (\n", "-" * 9000 + "1\n", "(" * 9000, "\0", "{" * 60000]),
]
INVALID_UNICODE = false_header("'<U1'", "(2,)", b"\xff\xff\xff\x7f" * 2)


@pytest.mark.parametrize(
    ("body", "field", "message"),
    [
        (npz(q=Q[:, 0], tau=TAU), "q", "2 dimensions"),
        (npz(q=Q, tau=TAU[1:]), "tau", "(100, 2)"),
        (npz(q=Q, tau=TAU, t=np.zeros(99)), "t", "(100,)"),
        (npz(q=Q, tau=TAU, joint_names=np.array(["a"])), "joint_names", "(2,)"),
        (npz(q=Q.astype(complex), tau=TAU), "q", "plain numbers"),
        (npz(q=Q, tau=TAU, t=np.zeros(100, dtype="M8[s]")), "t", "plain numbers"),
        (npz(q=Q, tau=TAU, joint_names=np.array([b"a", b"b"])), "joint_names", "plain text"),
        (npz(q=Q, tau=TAU, dt=[0.1]), "dt", "0 dimensions"),
        (npz(q=np.zeros((80, 0)), tau=np.zeros((80, 0))), "q", ""),
        (npz(q=Q, tau=TAU, dt=0.0), "dt", "positive"),
        (npz(note=np.array("x")), "array", "q (N, n)"),
        (npz(position=np.asfortranarray(np.zeros((3, 70)))), "position", "C order"),
        (zipped({"q.npy": npy(Q)[:-8], "tau.npy": npy(TAU)}), "q", "truncated"),
        (zipped({"q.npy": b"", "tau.npy": npy(TAU)}), "q", "a NumPy array"),
        (zipped({"q.npy": npy(Q), "readme.txt": b""}), "array", "readme.txt"),
        (zipped({"sub/q.npy": npy(Q)}), "array", "sub/q.npy"),
        (zipped({"../q.npy": npy(Q)}), "member", "../q.npy"),
        (zipped({"a\\q.npy": npy(Q)}), "member", "q.npy"),
        (zipped({"é.npy": b""}).replace("é".encode(), b"\xff\xfe"), "file", ""),
        (zipped({f"{n}.npy": b"" for n in range(3000)}), "array", "at most 2000"),
        (zipped({"q.npy": npy(Q)}, zipfile.ZIP_BZIP2), "member", "stored or deflated"),
        (npz(q=Q, tau=TAU)[:-1], "file", "NPZ"),
        (npz(q=Q, tau=TAU).replace(TAU.tobytes()[:8], bytes(8)), "tau", "CRC"),
        *((zipped({"q.npy": array, "tau.npy": npy(TAU)}), "q", "") for array in FALSE_HEADERS),
        (zipped({"q.npy": npy(Q), "tau.npy": npy(TAU), "joint_names.npy": INVALID_UNICODE}), "joint_names", ""),
        (false_size(), "q", ""),
        (false_directory(), "file", "a complete NPZ archive"),
        (b"no archive", "file", "NPZ"),
    ],
)
def test_damaged_npz_is_rejected_with_the_array(tmp_path, body, field, message):
    reply = check_rejected(tmp_path, body, "npz", field, message)
    assert re.search("0x[0-9a-f]{3}", " ".join(reply)) is None  # errors must not disclose memory addresses


class Trap:
    """Creates a file when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize("array", ["q", "joint_names", "dt"])
def test_objects_are_never_unpickled(tmp_path, tmp_path_factory, array):
    marker = tmp_path_factory.mktemp("trap") / "unpickled"
    trap = np.empty({"q": (100, 2), "joint_names": (2,), "dt": ()}[array], dtype=object)
    trap.flat[0] = Trap(marker)
    body = npz(**{"q": Q, "tau": TAU, array: trap})
    check_rejected(tmp_path, body, "npz", array)
    check_rejected(tmp_path, pickle.dumps(Trap(marker)), "npz", "file")
    assert not marker.exists()

    with np.load(io.BytesIO(body), allow_pickle=True) as loaded:
        loaded[array]
    assert marker.exists()  # the trap works, so the service has not unpickled it


def test_too_many_members(tmp_path, monkeypatch):
    monkeypatch.setattr("service.datasets.formats.zips.MAX_MEMBERS", 20)
    body = zipped({f"{n}.npy": b"" for n in range(30)})
    check_rejected(tmp_path, body, "npz", "file", ("30 members",))
