"""Real files that are hostile: each gets an answer, and the service keeps running."""

import io
import json
import os
import sqlite3
import struct
import zipfile
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import patch

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from service.datasets.staging import Staged
from service.foundation.errors import InvalidDataError
from service.foundation.settings import Settings
from service.runtime.confinement import protections
from service.storage.disk import Disk
from tests.service.data import ADDRESS, error
from tests.service.models.archives.packing import exported, pack, unpack, with_header

MiB = 1024 * 1024
CSV, JSON, PARQUET, NPZ = "text/csv", "application/json", "application/vnd.apache.parquet", "application/x-npz"
BAG, TAR, XML = "application/x-rosbag2", "application/x-tar", "application/xml"
ROBOTS, IMPORT = "/v1/robots", "/v1/models/import?name=hostile"
GOOD = "t,q1,dq1,ddq1,tau1\n" + "".join(f"{i / 100},{np.sin(i / 9)},0.1,0.1,{i % 7}\n" for i in range(60))
ENTITIES = "".join(f"<!ENTITY a{i + 1} '" + f"&a{i};" * 10 + "'>" for i in range(9))
LAUGHS = f"<!DOCTYPE r [<!ENTITY a0 'ha'>{ENTITIES}]><robot>&a9;</robot>"
MESH = f"<robot><link name='l'><visual><geometry><mesh filename='{'m' * MiB}'/></geometry></visual></link></robot>"
memory_is_limited = pytest.mark.skipif(not protections()["memory"], reason="this system does not limit memory")


@pytest.fixture(scope="module")
def narrow(tmp_path_factory):
    """A service whose readers have small limits."""
    limits = {"parser_memory_bytes": 256 * MiB, "max_unpacked_bytes": 100 * MiB}
    app = create_app(Settings(home=tmp_path_factory.mktemp("narrow"), **limits))
    with patch("service.runtime.cage.CPU_SHARE", 1 / 600), TestClient(app, ADDRESS) as client:
        yield client


def send(client, body, kind, path="/v1/datasets"):
    return client.post(path, content=body, headers={"content-type": kind})


def rejection(client, body, kind, path="/v1/datasets", answered=(422, "invalid_data")):
    """Upload a file that is rejected; return the message."""
    return error(send(client, body, kind, path), *answered)["message"]


def parquet(values):
    out = io.BytesIO()
    table = pa.table(dict.fromkeys(("t", "q1", "dq1", "ddq1", "tau1"), values))
    pq.write_table(table, out, use_dictionary=False, compression="zstd")
    return out.getvalue()


@memory_is_limited
@pytest.mark.parametrize(
    "again",
    [
        pytest.param(b"\x06\x04\x80\x01", id="a second size of 64 bits, which Arrow skips"),
        pytest.param(b"\x05\x84\x80\x08\xfe\xff\xff\xff\x0f", id="field 65538, which Arrow reads as field 2"),
        pytest.param(b"", id="two gigabytes, once"),
    ],
)
def test_parquet_page_that_claims_two_gigabytes(narrow, again):
    body = parquet(np.random.default_rng(1).normal(size=200_000))
    page = pq.ParquetFile(io.BytesIO(body)).metadata.row_group(0).column(0).data_page_offset
    first = b"\x80\x01" if again[:1] == b"\x05" else b"\xfe\xff\xff\xff\x0f"
    header = b"\x15\x00\x15" + first + b"\x15\x80\x01" + again + b"\x00"
    message = rejection(narrow, body[:page] + header + body[page + len(header) :], PARQUET)
    assert "bytes of memory" in message
    assert "LIPSERVE_PARSER_MEMORY_BYTES" in message


def test_parquet_footer_that_claims_two_gigabytes(narrow):
    body = parquet(np.arange(9.0))[:-8] + struct.pack("<I4s", 2**31 - 1, b"PAR1")
    assert "The file could not be read" in rejection(narrow, body, PARQUET)


def test_zip_bomb(narrow):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("q", "tau"):
            with archive.open(f"{name}.npy", "w") as member:
                header = {"descr": "<f8", "fortran_order": False, "shape": (10 * MiB, 1)}
                np.lib.format.write_array_header_1_0(member, header)
                for _ in range(80):
                    member.write(bytes(MiB))
    assert len(out.getvalue()) < MiB
    assert "expected at most 104857600" in rejection(narrow, out.getvalue(), NPZ, answered=(413, "too_large"))


@pytest.mark.slow
@memory_is_limited
def test_zip_with_too_many_members(narrow):
    entry = b"PK\x01\x02" + bytes([20, 0, 20, 0]) + bytes(20) + b"\x01\0" + bytes(16) + b"a"
    count = 1_000_000
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 65535, 65535, len(entry) * count, 4, 0)
    message = rejection(narrow, b"PK\x03\x04" + entry * count + end, NPZ)
    assert "LIPSERVE_PARSER" in message  # the memory limit or, on a slow machine, the time limit


def computing_bag(path):
    """Return a ROS 2 bag whose table is a view: it computes a number for each message from 20 megabytes of text."""
    with sqlite3.connect(path) as database:
        database.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, timestamp INTEGER, data BLOB);"
            "INSERT INTO topics VALUES (1, '/joint_states', 'sensor_msgs/msg/JointState', 'cdr');"
        )
        rows = [(time, b"\0\1\0\0") for time in range(3000)]
        database.executemany("INSERT INTO messages(timestamp, data) VALUES (?, ?)", rows)
        computed = "1 + 0 * length(hex(zeroblob(20000000 + id % 2)))"
        database.execute(f"ALTER TABLE messages ADD COLUMN topic_id INTEGER AS ({computed})")
    return path.read_bytes()


@pytest.mark.slow
def test_computing_bag_does_not_block_others(narrow, tmp_path):
    body = computing_bag(tmp_path / "bag.db3")
    with ThreadPoolExecutor() as pool:
        long = pool.submit(rejection, narrow, body, BAG)
        assert narrow.get("/health/live").status_code == 200
        assert send(narrow, GOOD, CSV).status_code == 201
        message = long.result()
    assert "1 s of processor time" in message
    assert "LIPSERVE_PARSER_S" in message


LISTS = "[" * 100_000 + "]" * 100_000
HOSTILE = {
    "lists": (LISTS, JSON, "/v1/datasets", "deep"),
    "a value": ((f'{{"t": {LISTS}}}\n') * 2, JSON, "/v1/datasets", "deep"),
    "values": (json.dumps([{"a": [{"b": [[[[[[[[[[[[1]]]]]]]]]]]]}]}] * 40), JSON, "/v1/datasets", "deep"),
    "billion laughs": (LAUGHS, XML, ROBOTS, "document type"),
    "nested elements": ("<robot>" + "<a>" * 100_000, XML, ROBOTS, "more than 32 deep"),
    "mesh file name": (MESH, XML, ROBOTS, "no joint"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_texts_are_rejected(narrow, kind):
    body, media_type, path, words = HOSTILE[kind]
    assert words in rejection(narrow, body, media_type, path)


def test_tensors_that_claim_a_larger_size_are_rejected(narrow):
    files = unpack(exported(narrow, "panda-sim"))
    lie = with_header(files, lambda tensors: tensors["statistics/b"].update(shape=[10**9]))
    assert rejection(narrow, pack(lie), TAR, IMPORT).startswith("model.safetensors: ")


def test_crash_of_a_reader_is_no_failure_of_the_service(narrow, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr("service.datasets.store.READER", "tests.service.runtime.inmates:crash_reader")
        message = rejection(narrow, GOOD, CSV)
    assert "could not be read: its reader was ended by SIGSEGV" in message
    assert send(narrow, GOOD, CSV).status_code == 201


@pytest.mark.parametrize("left", ["t", "q2", "../secret", "link", "hard link", "short", "pipe"])
def test_invalid_columns_of_a_reader_are_rejected(tmp_path, left):
    """A compromised reader could leave links to the files of the service."""
    secret, folder, column = tmp_path / "secret.f64", tmp_path / "folder", tmp_path / "folder" / "q1.f64"
    secret.write_bytes(bytes(80))
    folder.mkdir()
    make = {
        "link": lambda: column.symlink_to(secret),
        "hard link": lambda: column.hardlink_to(secret),
        "short": lambda: column.write_bytes(bytes(72)),
        "pipe": lambda: os.mkfifo(column),
    }
    make.get(left, lambda: column.write_bytes(bytes(80)))()
    names = {"q1": 10} if left in make else {"q1": 10, left: 10}
    with pytest.raises(InvalidDataError, match="The file could not be read: column"):
        Staged.of_others(folder, ("joint1",), names, Disk(Settings(home=tmp_path)))
