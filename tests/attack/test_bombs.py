"""Bombs: small uploads that become large, deep or long when they are read."""

import gzip
import io
import json
import os
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from random import Random

import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.attack.attacked import AttackedService, MiB, attack_random, peak_bytes
from tests.service.api.limits.test_hostile_uploads import HOSTILE, NPZ, PARQUET, TAR

LIMITS = {"MAX_UNPACKED_BYTES": str(50 * MiB), "PARSER_MEMORY_BYTES": str(300 * MiB), "PARSER_S": "10"}
MAX_PEAK_GROWTH = 150 * MiB
"""Memory that the service itself may use more while others read for it."""
DATASETS, ROBOTS, IMPORT = "/v1/datasets", "/v1/robots", "/v1/models/import?name=bomb"
ZIP, GZIP, ZSTD, JSON = "application/zip", "application/gzip", "application/zstd", "application/json"
WORKBOOK = "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet"
Bomb = tuple[str, str, bytes]
"""Path, media type and body."""


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AttackedService]:
    with AttackedService(tmp_path_factory.mktemp("bombs"), populated=False, **LIMITS) as service:
        yield service


def zipped(members: dict[str, bytes], copies: int = 1) -> bytes:
    """Return a ZIP archive of members, each with copies of its content."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            with archive.open(name, "w") as member:
                for _ in range(copies):
                    member.write(content)
    return out.getvalue()


def row(random: Random) -> bytes:
    """Return a row of a CSV file."""
    return b",".join(b"%d" % random.randrange(3) for _ in range(5)) + b"\n"


def csv_in_gzip(random: Random) -> Bomb:
    return DATASETS, GZIP, gzip.compress(b"t,q1,dq1,ddq1,tau1\n" + row(random) * random.randrange(6 * MiB, 10 * MiB))


def gzip_in_gzip(random: Random) -> Bomb:
    content = gzip.compress(bytes(random.randrange(60, 100) * MiB))
    for _ in range(random.randrange(1, 6)):
        content = gzip.compress(content)
    return DATASETS, GZIP, content


def csv_in_zstd(random: Random) -> Bomb:
    content = b"t,q1,dq1,ddq1,tau1\n" + row(random) * random.randrange(6 * MiB, 10 * MiB)
    return DATASETS, ZSTD, pa.compress(content, codec="zstd", asbytes=True)


def csv_in_zip(random: Random) -> Bomb:
    return DATASETS, ZIP, zipped({"a.csv": row(random) * (MiB // 10)}, random.randrange(60, 100))


def zip_in_zip(random: Random) -> Bomb:
    content = zipped({"a.csv": bytes(MiB)}, random.randrange(60, 200))
    for number in range(random.randrange(1, 6)):
        content = zipped({f"{number}-{copy}.zip": content for copy in range(10)})
    return DATASETS, ZIP, content


def array_that_claims_more(random: Random) -> Bomb:
    out = io.BytesIO()
    shape = random.choice(((2**40, 7), (10**9, 1), (1, 2**31), (2**62, 2**62), (-1, 7)))
    np.lib.format.write_array_header_1_0(out, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return DATASETS, NPZ, zipped({f"{name}.npy": out.getvalue() for name in ("q", "dq", "ddq", "tau")})


def array_in_zip(random: Random) -> Bomb:
    out, count = io.BytesIO(), random.randrange(60, 120)
    shape = (count * MiB // 8, 1)
    np.lib.format.write_array_header_1_0(out, {"descr": "<f8", "fortran_order": False, "shape": shape})
    content = out.getvalue() + bytes(count * MiB)
    return DATASETS, NPZ, zipped(dict.fromkeys(("q.npy", "tau.npy"), content))


def equal_values_in_parquet(random: Random) -> Bomb:
    out, value = io.BytesIO(), random.random()
    part = pa.table({name: np.full(MiB, value) for name in ("t", "q1", "dq1", "ddq1", "tau1")})
    with pq.ParquetWriter(out, part.schema) as writer:
        for _ in range(random.randrange(10, 20)):
            writer.write_table(part)
    return DATASETS, PARQUET, out.getvalue()


def columns_in_parquet(random: Random) -> Bomb:
    out = io.BytesIO()
    pq.write_table(pa.table({f"q{number}": [0.0] for number in range(random.randrange(5000, 9000))}), out)
    return DATASETS, PARQUET, out.getvalue()


def deep_json(random: Random) -> Bomb:
    depth, (left, right) = random.randrange(1000, 200_000), random.choice((("[", "]"), ('{"a":', "}")))
    return DATASETS, JSON, (left * depth + "1" + right * depth).encode()


def names_in_json(random: Random) -> Bomb:
    names = {f"q{random.getrandbits(40)}": [0.0] for _ in range(100_000)}
    return DATASETS, JSON, json.dumps(names).encode()


def digits_in_json(random: Random) -> Bomb:
    return DATASETS, JSON, b'[{"t": ' + b"9" * random.randrange(10**5, 10**6) + b"}]"


def row_of_a_workbook(random: Random) -> Bomb:
    book, out = openpyxl.Workbook(), io.BytesIO()
    book.active.append(["t", "q1", "dq1", "ddq1", "tau1"])
    book.active.cell(row=1_048_576, column=random.randrange(5, 16_384), value=1.0)
    book.save(out)
    return DATASETS, WORKBOOK, out.getvalue()


def text_of_a_workbook(random: Random) -> Bomb:
    book, out = openpyxl.Workbook(), io.BytesIO()
    book.save(out)
    with zipfile.ZipFile(out) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["xl/sharedStrings.xml"] = b"<sst>" + b"<si><t>a</t></si>" * random.randrange(4 * MiB, 6 * MiB) + b"</sst>"
    return DATASETS, WORKBOOK, zipped(members)


def members_of_an_archive(random: Random) -> Bomb:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        for number in range(random.randrange(5000, 9000)):
            archive.addfile(tarfile.TarInfo(f"{'d/' * random.randrange(40)}{number}"))
    return IMPORT, TAR, out.getvalue()


def sparse_archive(random: Random) -> Bomb:
    header = tarfile.TarInfo("model.safetensors")
    header.size = random.choice((2**33, 2**40, 2**62))
    return IMPORT, TAR, header.tobuf(tarfile.GNU_FORMAT) + bytes(2000)


def entities(random: Random) -> Bomb:
    size = random.randrange(10**5, 10**6)
    return ROBOTS, "application/xml", b"<!DOCTYPE r [<!ENTITY a '" + b"a" * size + b"'>]><r>" + b"&a;" * 9999 + b"</r>"


def meshes_in_zip(random: Random) -> Bomb:
    return ROBOTS, ZIP, zipped({"robot.urdf": b"<robot name='a'>" + b" " * MiB}, random.randrange(60, 200))


BOMBS: tuple[Callable[[Random], Bomb], ...] = (
    *(csv_in_gzip, gzip_in_gzip, csv_in_zstd, csv_in_zip, zip_in_zip, array_that_claims_more, array_in_zip),
    *(equal_values_in_parquet, columns_in_parquet, deep_json, names_in_json, digits_in_json, row_of_a_workbook),
    *(text_of_a_workbook, members_of_an_archive, sparse_archive, entities, meshes_in_zip),
)


@pytest.mark.parametrize("bomb", BOMBS, ids=lambda each: each.__name__)
def test_bombs_are_rejected(attacked, bomb):
    path, kind, body = bomb(attack_random(bomb.__name__))
    before = peak_bytes(attacked.server.process.pid)
    answer = attacked.client.post(path, content=body, headers={"content-type": kind})
    assert answer.status_code in (413, 422), answer.text
    assert peak_bytes(attacked.server.process.pid) - before < MAX_PEAK_GROWTH + len(body)
    attacked.check_sound()


@pytest.mark.parametrize("coding", ["gzip", "deflate", "br", "zstd", "gzip, gzip"])
def test_packed_requests_are_refused(attacked, coding):
    """The service unpacks uploads of data sets only, in a process with limits."""
    body, before = gzip.compress(bytes(50 * MiB)), peak_bytes(attacked.server.process.pid)
    headers = {"content-type": JSON, "content-encoding": coding}
    for path in ("predict", "observations", "evaluate"):
        answer = attacked.client.post(f"/v1/models/panda-sim/{path}", content=body, headers=headers)
        assert answer.status_code == 415, answer.text
    assert peak_bytes(attacked.server.process.pid) - before < 20 * MiB
    attacked.check_sound()


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_texts_are_rejected_by_a_real_service(attacked, kind):
    body, media_type, path, _ = HOSTILE[kind]
    answer = attacked.client.post(path, content=body, headers={"content-type": media_type})
    assert answer.status_code == 422, answer.text
    attacked.check_sound()


def test_deep_json_is_no_request(attacked):
    random = attack_random("requests")
    for path in ("predict", "observations", "evaluate", "gravity", "wrench", "trace", "compare", "rollback"):
        for left, right in (("[", "]"), ('{"q":', "}"), ('{"q":[', "]}")):
            depth = random.randrange(500, 100_000)
            body = (left * depth + "1" + right * random.choice((0, depth))).encode()
            answer = attacked.client.post(f"/v1/models/panda-sim/{path}", content=body, headers={"content-type": JSON})
            assert answer.status_code in (413, 422), answer.text
    attacked.check_sound()


def test_leftovers_of_bombs_are_deleted(attacked):
    assert os.listdir(attacked.home / "uploads") == []
