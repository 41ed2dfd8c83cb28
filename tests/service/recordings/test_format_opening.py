"""A file is read as what it is, whatever it is called; damaged ones are read or refused, never an unexpected error."""

from __future__ import annotations

import io
import json
import pickle
import tarfile
import zipfile

import numpy as np
import pandas as pd
import pytest

from service.datasets.formats.opening import KINDS, sniff
from service.foundation.errors import InvalidDataError, TooLargeError
from tests.service.recordings.reading import read, refused
from tests.service.recordings.test_format_lerobot import dataset, zipped

RNG = np.random.default_rng(8)
FRAME = pd.DataFrame({"t": np.arange(50) / 100, "q1": RNG.normal(size=50), "tau1": RNG.normal(size=50)})


def bodies():
    parquet, npz = io.BytesIO(), io.BytesIO()
    FRAME.to_parquet(parquet)
    np.savez(npz, t=FRAME.t, q=FRAME[["q1"]].to_numpy(), tau=FRAME[["tau1"]].to_numpy())
    return {
        "csv": FRAME.to_csv(index=False).encode(),
        "parquet": parquet.getvalue(),
        "npz": npz.getvalue(),
        "json_lines": FRAME.to_json(orient="records", lines=True, double_precision=15).encode(),
        "json": FRAME.to_json(double_precision=15).encode(),
    }


BODIES = bodies()


@pytest.mark.each_once
@pytest.mark.parametrize("actual", BODIES)
@pytest.mark.parametrize("said", [*KINDS, None])
def test_a_file_is_read_as_what_it_is(tmp_path, actual, said):
    found = read(tmp_path, BODIES[actual], said)
    assert found.names == ("t", "q1", "tau1")
    np.testing.assert_allclose(found["q1"], FRAME["q1"], rtol=0, atol=1e-15)
    told = [fact for fact in found.facts if "read as that" in fact]
    alike = said in (None, actual) or {said, actual} == {"json", "json_lines"}
    assert told == ([] if alike else [f"sent as {KINDS[said]}, but is {KINDS[actual]}: read as that"])


def tar():
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as file:
        file.addfile(tarfile.TarInfo("a.csv"))
    return out.getvalue()


@pytest.mark.each_once
@pytest.mark.parametrize("said", [*KINDS, "zip", None])
@pytest.mark.parametrize(
    ("body", "name"),
    [
        (b"\x89HDF\r\n\x1a\n" + bytes(100), "HDF5"),
        (b"MATLAB 5.0 MAT-file, Platform: GLNXA64" + bytes(100), "MATLAB"),
        (pickle.dumps({"q": [1.0]}), "a pickle"),
        (tar(), "gzip"),
        (FRAME.to_csv(index=False).encode("utf-16"), "UTF-16"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "a picture"),
        (b"", "empty"),
    ],
    ids=["HDF5", "MATLAB", "pickle", "gzip", "UTF-16", "picture", "empty"],
)
def test_what_is_not_read_is_named_with_what_it_was_sent_as(tmp_path, said, body, name):
    field, value, expected = refused(tmp_path, body, said, error=InvalidDataError)
    assert field == "file"
    assert name in value
    assert said not in KINDS or KINDS[said] in value + expected


@pytest.mark.parametrize("said", ["zip", None, "csv"])
@pytest.mark.parametrize("files", [{"a.txt": b"hi"}, {"xl/a.xml": b"", "[Content_Types].xml": b""}, {}])
def test_a_zip_of_something_else(tmp_path, said, files):
    assert "zip" in " ".join(refused(tmp_path, zipped(files), said, error=InvalidDataError))


def test_random_bytes_are_no_kind(tmp_path):
    path = tmp_path / "upload"
    for size in (1, 10, 1000, 100_000):
        for _ in range(20):
            path.write_bytes(RNG.bytes(size))
            assert sniff(path) is None or size < 100


def damaged(body, rng):
    """Some bytes replaced, removed, doubled or cut off; mostly where structure is: at both ends."""
    out = bytearray(body)
    for _ in range(rng.integers(1, 5)):
        if not out:
            break
        place = int(rng.choice([rng.integers(len(out)), rng.integers(130), len(out) - 1 - rng.integers(130)]))
        place = max(0, min(place, len(out) - 1))
        width, kind = int(rng.integers(1, 5)), rng.integers(5)
        if kind == 0:
            out[place : place + width] = rng.bytes(width)
        elif kind == 1:
            del out[place : place + width]
        elif kind == 2:
            out[place:place] = out[place : place + width]
        elif kind == 3:
            out[place : place + width] = bytes([int(rng.choice([0, 0xFF, 0x7F, 0x2C, 0x2D, 0x0A, 0x22]))]) * width
        elif rng.integers(4) == 0:
            del out[max(place, 1) :]
    return bytes(out)


def damaged_member(body, rng):
    """A sound archive with one damaged member: its checksums do not give that away."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(body)) as source, zipfile.ZipFile(out, "w") as target:
        names = source.namelist()
        chosen = names[rng.integers(len(names))]
        for name in names:
            target.writestr(name, damaged(source.read(name), rng) if name == chosen else source.read(name))
    return out.getvalue()


@pytest.mark.parametrize("kind", [*BODIES, "lerobot"])
def test_damaged_files_are_read_or_refused(tmp_path, kind):
    rng = np.random.default_rng(6)
    body = zipped(dataset()) if kind == "lerobot" else BODIES[kind]
    outcomes = {"read": 0, "refused": 0}
    for number in range(40 if kind == "lerobot" else 100):
        inside = kind in ("npz", "lerobot") and number % 3
        try:
            read(tmp_path, damaged_member(body, rng) if inside else damaged(body, rng), kind)
            outcomes["read"] += 1
        except (InvalidDataError, TooLargeError):
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 5, outcomes


def test_every_kind_is_in_words():
    assert json.dumps(KINDS)
    assert set(BODIES) <= set(KINDS)
