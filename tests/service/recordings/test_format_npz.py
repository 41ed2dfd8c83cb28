"""NPZ archives: what becomes of their arrays, block after block, and archives that lie."""

from __future__ import annotations

import io
import struct
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.foundation.errors import InvalidDataError, TooLargeError
from tests.service.recordings.reading import read, refused

RNG = np.random.default_rng(2)
Q, TAU = RNG.normal(size=(100, 2)), RNG.normal(size=(100, 2))


def npz(*, compressed=False, **arrays):
    out = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(out, **arrays)
    return out.getvalue()


def zipped(files, compression=zipfile.ZIP_STORED):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", compression) as file:
        for name, content in files.items():
            file.writestr(name, content)
    return out.getvalue()


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("kind", ["<f8", ">f4", "<f2", "<i2", "u1"])
def test_arrays_become_columns(tmp_path, compressed, order, kind):
    values = (100 * np.abs(Q)).astype(kind, order=order)
    found = read(tmp_path, npz(q=values, tau=TAU, temp=values[:, 0], pose=values, compressed=compressed), "npz")
    assert found.names == ("q1", "q2", "tau1", "tau2", "temp", "pose[0]", "pose[1]")
    np.testing.assert_array_equal(found["q2"], values[:, 1])
    np.testing.assert_array_equal(found["pose[0]"], values[:, 0])
    np.testing.assert_array_equal(found["temp"], values[:, 0])


@pytest.mark.parametrize("order", ["C", "F"])
def test_more_rows_than_a_block(tmp_path, order):
    q = np.asarray(RNG.normal(size=(40_000, 3)), order=order)
    found = read(tmp_path, npz(q=q, tau=q, t=np.arange(40_000), compressed=True), "npz")
    np.testing.assert_array_equal(np.column_stack([found[f"q{joint}"] for joint in (1, 2, 3)]), q)
    np.testing.assert_array_equal(found["t"], np.arange(40_000))


def test_what_is_no_table_is_left_out_and_told(tmp_path):
    extra = {"note": np.array("hi"), "limits": np.zeros((2, 7)), "cube": np.zeros((100, 2, 2)), "meta": np.array({})}
    found = read(tmp_path, npz(q=Q, tau=TAU, flags=Q > 0, **extra), "npz")
    assert found.names == ("q1", "q2", "tau1", "tau2")
    assert "flags, note, limits, cube, meta" in found.facts[0]


def test_names_of_other_programs_need_no_q(tmp_path):
    assert read(tmp_path, npz(position=Q, effort=TAU, limits=np.zeros((2, 2))), "npz").names == (
        "position[0]", "position[1]", "effort[0]", "effort[1]",
    )  # fmt: skip


def test_joint_names_are_told(tmp_path):
    assert read(tmp_path, npz(q=Q, tau=TAU, joint_names=np.array(["a", "b"])), "npz").joint_names == ("a", "b")


@given(lengths=st.lists(st.integers(1, 9), min_size=1, max_size=8), step=st.floats(1e-4, 1.0))
def test_dt_counts_every_episode_from_zero_whatever_the_blocks(tmp_path_factory, lengths, step):
    from service.datasets.formats import npz as module

    episode = np.repeat(np.arange(len(lengths)), lengths)
    expected = np.concatenate([np.arange(length) for length in lengths]) * step
    body = npz(q=np.zeros((len(episode), 1)), tau=np.zeros((len(episode), 1)), episode=episode, dt=step)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "block_rows", lambda columns: 4)
        found = read(tmp_path_factory.mktemp("npz"), body, "npz")
    np.testing.assert_array_equal(found["t"], expected)


def test_dt_counts_on_without_episodes(tmp_path):
    found = read(tmp_path, npz(q=np.zeros((40_000, 1)), tau=np.zeros((40_000, 1)), dt=0.004), "npz")
    np.testing.assert_array_equal(found["t"], np.arange(40_000) * 0.004)


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
        (npz(q=Q.astype(object), tau=TAU), "q", "plain numbers"),
        (npz(q=Q, tau=TAU, dt=0.0), "dt", "positive"),
        (npz(note=np.array("x")), "array", "q (N, n)"),
        (npz(position=np.asfortranarray(np.zeros((3, 70)))), "position", "C order"),
        (zipped({"q.npy": npy(Q)[:-8], "tau.npy": npy(TAU)}), "q", "truncated"),
        (zipped({"q.npy": b"", "tau.npy": npy(TAU)}), "q", "a NumPy array"),
        (zipped({"q.npy": npy(Q), "readme.txt": b""}), "array", "readme.txt"),
        (zipped({"sub/q.npy": npy(Q)}), "array", "sub/q.npy"),
        (zipped({"../q.npy": npy(Q)}), "member", "../q.npy"),
        (zipped({"/q.npy": npy(Q)}), "member", "/q.npy"),
        (zipped({"a\\q.npy": npy(Q)}), "member", "q.npy"),
        (zipped({f"{n}.npy": b"" for n in range(3000)}), "array", "at most 2000"),
        (zipped({"q.npy": npy(Q)}, zipfile.ZIP_BZIP2), "member", "stored or deflated"),
        (npz(q=Q, tau=TAU)[:-1], "file", "NPZ"),
        (npz(q=Q, tau=TAU).replace(TAU.tobytes()[:8], bytes(8)), "tau", "CRC"),
        (b"no archive", "file", "NPZ"),
        (npy(Q), "file", "NumPy array"),
    ],
)
def test_refused_with_the_array(tmp_path, body, field, message):
    said = refused(tmp_path, body, "npz", error=InvalidDataError)
    assert said[0] == field
    assert message in " ".join(said)


def test_a_doubled_member_is_refused(tmp_path):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        file.writestr("q.npy", npy(Q))
        with pytest.warns(UserWarning, match="Duplicate"):
            file.writestr("q.npy", npy(Q))
    assert refused(tmp_path, out.getvalue(), "npz")[0] == "member"


def test_a_bomb_is_measured_before_it_is_unpacked(tmp_path):
    body = npz(q=np.zeros((1_000_000, 2)), tau=np.zeros((1_000_000, 2)), compressed=True)
    assert len(body) < 60_000
    assert "at most 400000" in refused(tmp_path, body, "npz", error=TooLargeError, max_unpacked_bytes=400_000)


def test_a_bomb_that_lies_about_its_size_is_cut_off(tmp_path):
    body = npz(q=np.zeros((1_000_000, 2)), tau=np.zeros((1_000_000, 2)), compressed=True)
    with zipfile.ZipFile(io.BytesIO(body)) as file:
        size = file.getinfo("q.npy").file_size.to_bytes(4, "little")
    assert refused(tmp_path, body.replace(size, (1000).to_bytes(4, "little")), "npz")[0] == "q"


def test_a_directory_of_two_gigabytes_is_never_read(tmp_path):
    body = bytearray(npz(q=Q, tau=TAU))
    end = body.rindex(b"PK\x05\x06")
    struct.pack_into("<II", body, end + 12, 2**31 - 1, 0)
    field, _, expected = refused(tmp_path, bytes(body), "npz")
    assert (field, expected) == ("file", "a complete NPZ archive")


def test_too_many_members(tmp_path):
    body = zipped({f"{n}.npy": b"" for n in range(30)})
    assert refused(tmp_path, body, "npz", max_zip_members=20)[:2] == ("file", "30 members")


def test_the_error_of_who_takes_the_blocks_stays_what_it_is(tmp_path):
    from service.datasets.formats.opening import open_table
    from service.datasets.options import ReadOptions
    from service.foundation.settings import Settings

    path = tmp_path / "upload"
    path.write_bytes(npz(q=Q, tau=TAU))

    def take():
        with open_table(path, "npz", ReadOptions(), Settings(home=tmp_path)) as table:
            next(table.blocks)
            raise OSError("disk")

    with pytest.raises(OSError, match="disk"):
        take()
