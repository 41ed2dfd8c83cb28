"""NPZ uploads that are broken, hostile or wrong: refused, nothing unpickled, nothing unpacked beyond the limit."""

from __future__ import annotations

import io
import os
import pickle
import zipfile

import numpy as np
import pytest

from tests.service.data import arrays, npz, stream
from tests.service.refusal import refused

GOOD = npz(**arrays(stream()))
NPZ = "application/x-npz"


def npy(array):
    file = io.BytesIO()
    np.lib.format.write_array(file, np.asarray(array), allow_pickle=True)
    return file.getvalue()


def header(text, data=b""):
    """An array file with a header of our own."""
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode("latin1") + data


def archive(compression=zipfile.ZIP_STORED, **members):
    """A good archive with some members replaced, or left out where None."""
    files = {f"{name}.npy": npy(array) for name, array in arrays(stream()).items()}
    files |= {f"{name}.npy": content for name, content in members.items()}
    return zipped({name: content for name, content in files.items() if content is not None}, compression)


def zipped(files, compression=zipfile.ZIP_STORED):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", compression) as file:
        for name, content in files.items():
            file.writestr(name, content)
    return out.getvalue()


def with_extra(name, content=b""):
    return zipped({"q.npy": npy(stream().q), "tau.npy": npy(stream().tau), name: content})


def doubled():
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        file.writestr("q.npy", npy(stream().q))
        with pytest.warns(UserWarning, match="Duplicate"):
            file.writestr("q.npy", npy(stream().q))
    return out.getvalue()


@pytest.mark.parametrize(
    ("body", "field", "message"),
    [
        pytest.param(b"", "file", "NPZ", id="empty"),
        pytest.param(b"t,q1,tau1\n", "file", "NPZ", id="not a zip"),
        pytest.param(npy(stream().q), "file", "NPZ", id="npy"),
        pytest.param(GOOD[: len(GOOD) // 2], "file", "NPZ", id="truncated"),
        pytest.param(GOOD[:-1], "file", "NPZ", id="one byte short"),
        pytest.param(GOOD.replace(stream().tau.tobytes()[:8], bytes(8)), "tau", "CRC", id="checksum"),
        pytest.param(archive(q=npy(stream().q)[1:]), "q", "magic", id="no magic"),
        pytest.param(with_extra("notes.npy"), "notes", "a NumPy array", id="empty array"),
        pytest.param(with_extra("readme.txt"), "array", "readme.txt", id="other file"),
        pytest.param(with_extra("../../q.npy"), "member", "../../q.npy", id="parent folder"),
        pytest.param(with_extra("/q.npy"), "member", "/q.npy", id="absolute path"),
        pytest.param(with_extra("sub/q.npy"), "array", "sub/q.npy", id="folder"),
        pytest.param(with_extra("..\\q.npy"), "member", "q.npy", id="windows path"),
        pytest.param(doubled(), "member", "every member once", id="doubled array"),
        pytest.param(archive(zipfile.ZIP_BZIP2), "member", "stored or deflated", id="bzip2"),
        pytest.param(archive(zipfile.ZIP_LZMA), "member", "stored or deflated", id="lzma"),
        pytest.param(archive(q=None), "columns", "positions", id="no positions"),
        pytest.param(archive(tau=None), "column tau1", "missing", id="no torques"),
        pytest.param(archive(q=b""), "q", "a NumPy array", id="empty member"),
        pytest.param(archive(q=npy(stream().q)[:-8]), "q", "truncated", id="member too short"),
        pytest.param(archive(q=npy(stream().q[:, 0])), "q", "2 dimensions", id="one dimension"),
        pytest.param(archive(q=npy(stream().q[None])), "q", "2 dimensions", id="three dimensions"),
        pytest.param(archive(dt=npy([0.1])), "dt", "0 dimensions", id="dt as a list"),
        pytest.param(archive(tau=npy(stream().tau[:, :1])), "tau", "(80, 2)", id="fewer torques than joints"),
        pytest.param(archive(tau=npy(stream().tau[1:])), "tau", "(80, 2)", id="fewer torques than samples"),
        pytest.param(archive(tau=npy(stream().tau.T)), "tau", "(80, 2)", id="transposed"),
        pytest.param(archive(t=npy(stream().t[1:])), "t", "(80,)", id="fewer times than samples"),
        pytest.param(archive(episode=npy(np.zeros(79))), "episode", "(80,)", id="fewer episodes than samples"),
        pytest.param(archive(episode=npy(np.full(80, 0.5))), "episode, row 1", "a whole number", id="half episode"),
        pytest.param(archive(episode=npy(np.full(80, np.nan))), "episode, row 1", "a whole number", id="nan episode"),
        pytest.param(archive(joint_names=npy(["a"])), "joint_names", "(2,)", id="fewer names than joints"),
        pytest.param(archive(joint_names=npy(["a", "a"])), "joint_names[1]", "names that differ", id="equal names"),
        pytest.param(archive(joint_names=npy(["a", ""])), "joint_names[1]", "printable", id="empty name"),
        pytest.param(archive(joint_names=npy(["a", "b\n"])), "joint_names[1]", "printable", id="unprintable name"),
        pytest.param(archive(joint_names=npy(["a", "b" * 101])), "joint_names[1]", "printable", id="long name"),
        pytest.param(archive(joint_names=npy([b"a", b"b"])), "joint_names", "plain text", id="names as bytes"),
        pytest.param(archive(joint_names=npy(np.zeros(2))), "joint_names", "plain text", id="names as numbers"),
        pytest.param(archive(q=npy(stream().q.astype(complex))), "q", "plain numbers", id="complex"),
        pytest.param(archive(q=npy(stream().q.astype(str))), "q", "plain numbers", id="text"),
        pytest.param(archive(q=npy(stream().q > 0)), "q", "plain numbers", id="booleans"),
        pytest.param(archive(t=npy(np.zeros(80, dtype="M8[s]"))), "t", "plain numbers", id="dates"),
        pytest.param(archive(q=npy(np.zeros((80, 2), dtype=[("a", "f8")]))), "q", "plain numbers", id="records"),
        pytest.param(archive(dt=npy(0.0), t=None), "dt", "positive", id="dt zero"),
        pytest.param(archive(dt=npy(np.nan), t=None), "dt", "positive", id="dt nan"),
        pytest.param(archive(dt=npy(1e-9), t=None), "t", "seconds", id="dt in another unit"),
        pytest.param(npz(q=np.zeros((80, 0)), tau=np.zeros((80, 0))), "q", "", id="no joints"),
        pytest.param(npz(q=np.zeros((0, 2)), tau=np.zeros((0, 2))), "q", "", id="no samples"),
        pytest.param(npz(q=np.zeros((501, 1)), tau=np.zeros((501, 1))), "rows", "at most 500", id="too many samples"),
        pytest.param(npz(q=np.zeros((40, 9)), tau=np.zeros((40, 9))), "joints", "1 to 8", id="too many joints"),
    ],
)
def test_refused_with_the_array_and_what_was_expected(strict, body, field, message):
    said = refused(strict, body, NPZ)
    assert said["detail"][0]["field"] == field
    assert message in said["message"]


@pytest.mark.parametrize(
    ("descr", "shape", "data"),
    [
        pytest.param("'<f8'", "(10**12, 2)", b"\0" * 64, id="an expression"),
        pytest.param("'<f8'", "(1000000000000, 2)", b"\0" * 64, id="more than there is"),
        pytest.param("'<f8'", "(0, 100000000000000000000000000000)", b"", id="overflow"),
        pytest.param("'<f8'", "(-80, 2)", b"\0" * 64, id="negative"),
        pytest.param("'<f8'", "(80, None)", b"\0" * 64, id="not a number"),
        pytest.param("'<f8'", "80", b"\0" * 64, id="no tuple"),
        pytest.param("'|O'", "(1, 2)", b"\0" * 64, id="objects"),
        pytest.param("'<U0'", "(80, 2)", b"", id="nothing"),
        pytest.param("((), ())", "(80, 2)", b"", id="no type"),
        pytest.param("__import__('os').abort()", "(80, 2)", b"", id="a call"),
    ],
)
def test_a_header_that_lies_is_refused(strict, descr, shape, data):
    lie = header(f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}\n", data)
    assert refused(strict, archive(q=lie), NPZ)["detail"][0]["field"] == "q"


@pytest.mark.parametrize(
    "text", ["", "{'descr': '<f8', (\n", "-" * 9000 + "1\n", "(" * 9000 + "1\n", " \n  {'a\n b\n c", "\0", "{" * 60000]
)
def test_a_header_that_cannot_be_parsed_is_refused(strict, text):
    assert refused(strict, archive(q=header(text)), NPZ)["detail"][0]["field"] == "q"


@pytest.mark.parametrize("codes", [b"\x00\xd8\x00\x00" * 2, b"\xff\xff\xff\x7f" * 2])
def test_names_that_are_no_text_are_refused(strict, codes):
    names = header("{'descr': '<U1', 'fortran_order': False, 'shape': (2,)}\n", codes)
    assert refused(strict, archive(joint_names=names), NPZ)["detail"][0]["field"].startswith("joint_names")


def test_a_member_name_that_is_no_text_is_refused(strict):
    body = zipped({"é.npy": b""}).replace("é".encode(), b"\xff\xfe")
    assert refused(strict, body, NPZ)["detail"][0]["field"] == "file"


class Trap:
    """Creates a file when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize("array", ["q", "joint_names", "dt"])
def test_objects_are_never_unpickled(strict, tmp_path, array):
    marker = tmp_path / "unpickled"
    trap = np.empty({"q": (80, 2), "joint_names": (2,), "dt": ()}[array], dtype=object)
    trap.flat[0] = Trap(marker)
    body = archive(**{array: npy(trap)})
    assert refused(strict, body, NPZ)["detail"][0]["field"] == array
    assert not marker.exists()

    with np.load(io.BytesIO(body), allow_pickle=True) as loaded:
        loaded[array]
    assert marker.exists()  # the trap works: what does not unpickle it is the service


def test_a_pickle_in_place_of_an_archive_is_never_unpickled(strict, tmp_path):
    body = pickle.dumps(Trap(tmp_path / "unpickled"))
    assert refused(strict, body, NPZ)["detail"][0]["field"] == "file"
    assert not (tmp_path / "unpickled").exists()


def test_a_zip_bomb_is_measured_before_it_is_unpacked(strict):
    bomb = io.BytesIO()
    np.savez_compressed(bomb, q=np.zeros((2_000_000, 2)), tau=np.zeros((2_000_000, 2)))
    assert len(bomb.getvalue()) < 100_000
    said = refused(strict, bomb.getvalue(), NPZ, 413, "too_large")
    assert "at most 400000" in said["message"]


def test_a_zip_bomb_that_lies_about_its_size_is_cut_off(strict):
    bomb = io.BytesIO()
    np.savez_compressed(bomb, q=np.zeros((2_000_000, 2)), tau=np.zeros((2_000_000, 2)))
    with zipfile.ZipFile(bomb) as file:
        size = file.getinfo("q.npy").file_size.to_bytes(4, "little")
    body = bomb.getvalue().replace(size, (1000).to_bytes(4, "little"))
    assert size not in body
    assert refused(strict, body, NPZ)["detail"][0]["field"] in ("q", "file")


def test_many_members_are_refused(strict):
    assert refused(strict, zipped({f"{n}.npy": b"" for n in range(1000)}), NPZ)["detail"][0]["field"] == "0"
