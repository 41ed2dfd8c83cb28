"""Files are read by their content, not their name; damaged files are read or rejected, without unexpected errors."""

import io
import pickle
import tarfile
import zipfile

import numpy as np
import pandas as pd
import pytest

from lipcore.preparation.recipe import Recipe
from service.datasets.formats.opening import KINDS, open_table
from service.datasets.mapping.reading import read as read_columns
from service.datasets.staging import prepare, staging
from service.foundation.errors import InvalidDataError, TooLargeError
from service.foundation.settings import Settings
from service.storage.disk import Disk
from tests.service.data import npz
from tests.service.datasets.mapping_tables import options
from tests.service.datasets.reading import check_rejected, parquet, read, read_rejected, zipped
from tests.service.datasets.test_format_lerobot import LAST, dataset

RNG = np.random.default_rng(8)
FRAME = pd.DataFrame({"t": np.arange(50) / 100, "q1": RNG.normal(size=50), "tau1": RNG.normal(size=50)})


BODIES = {
    "csv": FRAME.to_csv(index=False).encode(),
    "parquet": FRAME.to_parquet(),
    "npz": npz(t=FRAME.t, q=FRAME[["q1"]].to_numpy(), tau=FRAME[["tau1"]].to_numpy()),
    "json_lines": FRAME.to_json(orient="records", lines=True, double_precision=15).encode(),
    "json": FRAME.to_json(double_precision=15).encode(),
    "lerobot": zipped(dataset()),
}
TABLES = [kind for kind in BODIES if kind != "lerobot"]


@pytest.mark.each_once
@pytest.mark.parametrize("actual", TABLES)
@pytest.mark.parametrize("reply", [*KINDS, None])
def test_file_is_read_by_its_content(tmp_path, actual, reply):
    result = read(tmp_path, BODIES[actual], reply)
    assert result.names == ("t", "q1", "tau1")
    np.testing.assert_allclose(result["q1"], FRAME["q1"], rtol=0, atol=1e-15)
    record = [fact for fact in result.facts if "was sent as" in fact]
    alike = reply in (None, actual) or {reply, actual} == {"json", "json_lines"}
    assert record == ([] if alike else [f"the file was sent as {KINDS[reply]}, but was read as {KINDS[actual]}"])


def tar():
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as file:
        file.addfile(tarfile.TarInfo("a.csv"))
    return out.getvalue()


@pytest.mark.each_once
@pytest.mark.parametrize("reply", [*KINDS, "zip", None])
@pytest.mark.parametrize(
    ("body", "name"),
    [
        (b"7z\xbc\xaf\x27\x1c" + bytes(100), "7z"),
        (pickle.dumps({"q": [1.0]}), "a pickle"),
        (b"\xfd7zXZ\0" + bytes(100), "xz"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "an image"),
        (b"", "empty"),
    ],
    ids=["7z", "pickle", "xz", "image", "empty"],
)
def test_unsupported_format_is_named_with_the_declared_one(tmp_path, reply, body, name):
    _, value, expected = check_rejected(tmp_path, body, reply, "file")
    assert name in value
    assert reply not in KINDS or KINDS[reply] in value + expected


@pytest.mark.parametrize("reply", ["zip", None, "csv"])
@pytest.mark.parametrize("files", [{"a.txt": b"hi"}, {"xl/a.xml": b"", "[Content_Types].xml": b""}, {}])
def test_zip_of_other_files_is_rejected(tmp_path, reply, files):
    assert "zip" in " ".join(read_rejected(tmp_path, zipped(files), reply, error=InvalidDataError))


def damaged(body, rng):
    """Return a body with random damage, most of it near both ends, where formats have their structure."""
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
    """Return an archive with one damaged member but correct checksums."""
    with zipfile.ZipFile(io.BytesIO(body)) as source:
        members = {name: source.read(name) for name in source.namelist()}
    chosen = list(members)[rng.integers(len(members))]
    return zipped(members | {chosen: damaged(members[chosen], rng)}, zipfile.ZIP_STORED)


@pytest.mark.parametrize("kind", BODIES)
def test_damaged_files_are_read_or_rejected(tmp_path, kind):
    """Recordings that can be read are also prepared, and all results are finite."""
    rng, limits = np.random.default_rng(6), Settings(home=tmp_path)
    body = BODIES[kind]
    path, outcomes = tmp_path / "upload", {"read": 0, "rejected": 0}
    for number in range(40 if kind == "lerobot" else 100):
        inside = kind in ("npz", "lerobot") and number % 3
        path.write_bytes(damaged_member(body, rng) if inside else damaged(body, rng))
        try:
            with staging(tmp_path) as folder:
                with open_table(path, kind, options().read, limits) as table:
                    recording = read_columns(table, folder, options(), None, limits, Disk(limits))
                staged = prepare(recording.staged, folder, Recipe(filtering="never"), 30).staged
                assert all(np.isfinite(staged.table(name)).all() for name in ("q", "dq", "ddq", "tau"))
            outcomes["read"] += 1
        except (InvalidDataError, TooLargeError):
            outcomes["rejected"] += 1
    assert min(outcomes.values()) > 5, outcomes
    assert {each.name for each in tmp_path.iterdir()} == {"upload"}


@pytest.mark.parametrize("body", ["#\n\n\r\n#\n\n", "%\n#\n%%\n", "#\n#\n1"])
def test_file_of_comment_marks_is_rejected(tmp_path, body):
    """Found by fuzzing."""
    read_rejected(tmp_path, body.encode(), "csv")


PAGES = parquet({"t": np.zeros(200_000)}, compression="zstd", use_dictionary=False)
BOMB = zipped(dataset(**{LAST: bytes(3_000_000)}))
TEXTS = zipped({f"{name}.txt": "0.5 0.25 0.125\n" * 90 for name in ("positions", "torques")})


@pytest.mark.parametrize(
    ("kind", "body", "limit", "message"),
    [
        ("lerobot", BOMB, 100_000, "at most 100000"),
        ("parquet", PAGES, 1_000_000, "at most 1000000"),
        ("zip", TEXTS, 2000, "unpacks to"),
        ("json", b"[" + b'{"t": 0.5},' * 100 + b"{}]", 10**6, "NDJSON"),
    ],
)
def test_unpacked_size_is_limited(tmp_path, monkeypatch, kind, body, limit, message):
    monkeypatch.setattr("service.datasets.formats.json.MAX_BYTES", 1000)
    assert len(body) < 50_000
    assert Settings().max_unpacked_bytes > limit
    assert message in read_rejected(tmp_path, body, kind, error=TooLargeError, max_unpacked_bytes=limit)
