"""NPZ archives: their arrays as columns, and false headers."""

import io
import os
import pickle
import struct
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.foundation.errors import InvalidDataError
from tests.service.datasets.reading import read, read_rejected
from tests.service.datasets.test_format_lerobot import zipped

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
    result = read(
        tmp_path, npz(position=Q, effort=TAU, limits=np.zeros((2, 2)), joint_names=np.array(["a", "b"])), "npz"
    )
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
        (b"no archive", "file", "NPZ"),
        (npy(Q), "file", "NumPy array"),
    ],
)
def test_damaged_npz_is_rejected_with_the_array(tmp_path, body, field, message):
    reply = read_rejected(tmp_path, body, "npz", error=InvalidDataError)
    assert reply[0] == field
    assert message in " ".join(reply)


def header(text, data=b""):
    """Return an array file with the given header."""
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode("latin1") + data


@pytest.mark.parametrize(
    ("descr", "shape", "data"),
    [
        ("'<f8'", "(10**12, 2)", b"\0" * 64),
        ("'<f8'", "(1000000000000, 2)", b"\0" * 64),
        ("'<f8'", "(0, 100000000000000000000000000000)", b""),
        ("'<f8'", "(-80, 2)", b"\0" * 64),
        ("'<f8'", "80", b"\0" * 64),
        ("'|O'", "(1, 2)", b"\0" * 64),
        ("((), ())", "(80, 2)", b""),
        ("__import__('os').abort()", "(80, 2)", b""),
    ],
)
def test_false_array_header_is_rejected(tmp_path, descr, shape, data):
    lie = header(f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}\n", data)
    reply = read_rejected(tmp_path, zipped({"q.npy": lie, "tau.npy": npy(TAU)}), "npz")
    assert reply[0] == "q"
    assert "0x" not in " ".join(reply)  # errors must not disclose memory addresses


@pytest.mark.parametrize("text", ["", "{'descr': '<f8', (\n", "-" * 9000 + "1\n", "(" * 9000, "\0", "{" * 60000])
def test_unparsable_array_header_is_rejected(tmp_path, text):
    assert read_rejected(tmp_path, zipped({"q.npy": header(text), "tau.npy": npy(TAU)}), "npz")[0] == "q"


def test_joint_names_with_invalid_unicode_are_rejected(tmp_path):
    names = header("{'descr': '<U1', 'fortran_order': False, 'shape': (2,)}\n", b"\xff\xff\xff\x7f" * 2)
    body = zipped({"q.npy": npy(Q), "tau.npy": npy(TAU), "joint_names.npy": names})
    assert read_rejected(tmp_path, body, "npz")[0].startswith("joint_names")


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
    assert read_rejected(tmp_path, body, "npz")[0] == array
    assert read_rejected(tmp_path, pickle.dumps(Trap(marker)), "npz")[0] == "file"
    assert not marker.exists()

    with np.load(io.BytesIO(body), allow_pickle=True) as loaded:
        loaded[array]
    assert marker.exists()  # the trap works, so the service has not unpickled it


def test_zip_bomb_with_a_false_size_is_rejected(tmp_path):
    body = npz(q=np.zeros((1_000_000, 2)), tau=np.zeros((1_000_000, 2)), compressed=True)
    with zipfile.ZipFile(io.BytesIO(body)) as file:
        size = file.getinfo("q.npy").file_size.to_bytes(4, "little")
    assert read_rejected(tmp_path, body.replace(size, (1000).to_bytes(4, "little")), "npz")[0] == "q"


def test_declared_directory_of_two_gigabytes_is_rejected(tmp_path):
    body = bytearray(npz(q=Q, tau=TAU))
    end = body.rindex(b"PK\x05\x06")
    struct.pack_into("<II", body, end + 12, 2**31 - 1, 0)
    field, _, expected = read_rejected(tmp_path, bytes(body), "npz")
    assert (field, expected) == ("file", "a complete NPZ archive")


def test_too_many_members(tmp_path, monkeypatch):
    monkeypatch.setattr("service.datasets.formats.zips.MAX_MEMBERS", 20)
    body = zipped({f"{n}.npy": b"" for n in range(30)})
    assert read_rejected(tmp_path, body, "npz")[:2] == ("file", "30 members")
