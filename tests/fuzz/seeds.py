"""Small files that fuzzing starts from, written by this project and by other programs.

`python -m tests.fuzz.seeds` writes them to the corpus.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import openpyxl
import pyarrow as pa
from pyarrow import feather

from lipcore.files import persistence
from lipcore.files.manifest import MANIFEST, TENSORS
from service.models.archive_reading import EXPORT, FORMAT, FORMAT_VERSION
from tests.fuzz.targets import JOINTS
from tests.service.datasets import bag_writers as bags
from tests.service.datasets import test_bag_messages as messages
from tests.service.datasets.reading import parquet, zipped
from tests.service.models.archives.packing import pack, with_checksums

ROWS = 24
T = np.arange(ROWS) / 50
ANGLE = np.outer(T, np.arange(1, JOINTS + 1))
ARRAYS = {"q": np.sin(ANGLE), "dq": np.cos(ANGLE), "ddq": -np.sin(ANGLE), "tau": 2 * np.cos(ANGLE)}
COLUMNS = {"t": T} | {f"{name}{j + 1}": values[:, j] for name, values in ARRAYS.items() for j in range(JOINTS)}
URDF = """<robot name="two"><link name="base"/>{}<joint name="tool" type="fixed"><parent link="l2"/><child link="tool"/>
<origin xyz="0 0 0.1" rpy="0 0 0"/></joint><link name="tool"/></robot>"""
LINK = """<link name="l{1}"><inertial><origin xyz="0 0 0.1" rpy="0 0 0"/><mass value="1.5"/>
<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
<joint name="j{1}" type="revolute"><parent link="{0}"/><child link="l{1}"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="10" velocity="3"/></joint>"""

SDF = """<sdf version="1.9"><model name="m"><link name="a"/><link name="b"><pose relative_to="a">0 0 1 0 1 0</pose>
<inertial><pose>0 0 .1 0 0 0</pose><mass>1</mass><inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz></inertia></inertial>
</link>
<joint name="j" type="revolute"><parent>a</parent><child>b</child><axis><xyz expressed_in="__model__">0 1 0</xyz><limit>
<lower>-1</lower><upper>1</upper><effort>9</effort></limit></axis></joint></model></sdf>"""

XACRO = """<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arg name="m" default="2"/>
<xacro:property name="l" value="${2 * pi}"/><xacro:macro name="link" params="n *o"><link name="${n}"><inertial>
<xacro:insert_block name="o"/><mass value="$(arg m)"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>
</inertial></link></xacro:macro><link name="a"/><xacro:link n="b"><origin xyz="0 0 ${l}"/></xacro:link>
<xacro:if value="${l > 1}"><joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>
</xacro:if></robot>"""


def seeds() -> Iterator[tuple[str, bytes]]:
    """Yield the target and the content of each file."""
    rows = [dict(zip(COLUMNS, map(float, row), strict=True)) for row in np.column_stack(list(COLUMNS.values()))]
    table = [",".join(COLUMNS), *(",".join(f"{each:.5g}" for each in row.values()) for row in rows)]
    text = "\n".join(table) + "\n"
    yield "csv", text.encode()
    yield "csv", text.replace(",", ";").replace(".", ",").encode()
    yield "csv", ("# " + text.replace(",", " \t")).encode()
    yield "csv", _dated(table).encode()
    yield from _layouts(text)
    yield "json", json.dumps(rows).encode()
    yield "json", json.dumps({name: values.tolist() for name, values in COLUMNS.items()}).encode()
    yield "json", json.dumps({"columns": list(COLUMNS), "data": [list(row.values()) for row in rows]}).encode()
    nested = [{"t": float(t), "arm": {"q": q.tolist(), "tau": q.tolist()}} for t, q in zip(T, ARRAYS["q"], strict=True)]
    yield "json_lines", "".join(f"{json.dumps(row)}\n" for row in nested).encode()
    for save in (np.savez, np.savez_compressed):
        yield "npz", _written(lambda file, save=save: save(file, t=T, **ARRAYS))
    other = {"joint_names": np.array(["a", "b"]), "dt": np.float64(0.02), "picture": np.zeros((ROWS, 2, 2), np.uint8)}
    yield "npz", _written(lambda file: np.savez(file, **{k: np.asfortranarray(v) for k, v in ARRAYS.items()}, **other))
    flat = pa.table(COLUMNS)
    lists = pa.table({"t": T, "q": ARRAYS["q"].tolist(), "tau": ARRAYS["tau"].tolist(), "s": [{"a": 1.0}] * ROWS})
    for compression, entries, dictionary in (("none", flat, False), ("zstd", lists, True)):
        options = {"compression": compression, "use_dictionary": dictionary, "store_schema": False}
        yield "parquet", parquet(entries, **options)
    with tempfile.TemporaryDirectory() as given:
        folder = Path(given)
        written = bags.states(12, ("a", "b"))
        for compression in (None, "bz2"):
            yield "rosbag1", bags.write_rosbag1(folder / f"{compression}.bag", written, compression).read_bytes()
        yield "rosbag2", bags.write_db3(folder / "two.db3", written).read_bytes()
        yield "zip", bags.zipped(folder / "two", folder / "two.zip").read_bytes()
        for compression in ("NONE", "ZSTD"):
            yield "mcap", bags.write_mcap(folder / f"{compression}.mcap", written, compression).read_bytes()
        yield "yaml", messages.echo(messages.NUMBERS[:12].round(3)).encode()
        for write in (messages.write_json, messages.write_protobuf):
            yield "mcap", write(folder / f"{write.__name__}.mcap", messages.NUMBERS[:12]).read_bytes()
    texts = {"positions.txt": _text("q"), "velocities.txt": _text("dq"), "torques.txt": _text("tau")}
    yield "zip", zipped(texts, zipfile.ZIP_STORED)
    yield "zip", _lerobot()
    yield "urdf", SDF.encode()
    yield "urdf", XACRO.encode()
    yield "urdf", URDF.format(LINK.format("base", 1) + LINK.format("l1", 2)).encode()
    yield from _models()


def _layouts(text: str) -> Iterator[tuple[str, bytes]]:
    """Yield tables of text in other layouts, and files of arrays."""
    names, *lines = text.splitlines()
    units = ",".join("s" if name == "t" else "rad" if name.startswith("q") else "Nm" for name in COLUMNS)
    yield "csv", f"Recorder;1.0\n\n{names}\n{units}\n{chr(10).join(lines)}".encode("utf-16")
    cells = [line.split(",") for line in text.splitlines()]
    yield "csv", "\n".join(",".join(row) for row in zip(*cells, strict=True)).encode()
    joints = (
        f"{t:.2f},{name},{q:.4f},{2 * q:.4f}"
        for t, row in zip(T, ARRAYS["q"], strict=True)
        for name, q in zip("ab", row, strict=True)
    )
    yield "csv", "\n".join(["time,joint,position,effort", *joints]).encode()
    lists = (f'{t:.2f},"{list(q)}","[a, b]"' for t, q in zip(T, ARRAYS["q"].round(4).tolist(), strict=True))
    yield "csv", "\n".join(["time,position,names", *lists]).encode()
    yield "gzip", gzip.compress(text.encode(), mtime=0)
    few = {"t": T, "q": ARRAYS["q"], "tau": ARRAYS["tau"]}

    def write_hdf5(file: Any, **options: Any) -> None:
        with h5py.File(file, "w") as root:
            for name, values in few.items():
                root.create_dataset(f"demo_1/{name}", data=values, **options)

    yield "hdf5", _written(write_hdf5)
    yield "hdf5", _written(lambda file: write_hdf5(file, chunks=True, compression="gzip", shuffle=True))
    record = np.rec.fromarrays(list(COLUMNS.values()), names=list(COLUMNS))
    yield "npy", _written(lambda file: np.save(file, record))
    yield "feather", _written(lambda file: feather.write_feather(pa.table(COLUMNS), file, compression="uncompressed"))
    book = openpyxl.Workbook()
    for row in cells[:12]:
        book.active.append([float(cell) if cell[-1:].isdigit() and cell[0] in "-0123456789" else cell for cell in row])
    yield "xlsx", _written(book.save)


def _models() -> Iterator[tuple[str, bytes]]:
    from tests.service.learning.pendulums import trained_model

    _, content = persistence.encode(trained_model(), {"datasets": []})
    about = {"format": FORMAT, "format_version": FORMAT_VERSION, "model": "m", "version": 1, "revision": 0}
    about |= {"learnt": False, "created_at": "", "exported_at": "", "software": {}}
    yield "archive", pack(with_checksums({EXPORT: json.dumps(about).encode(), **content}))
    yield "manifest", content[MANIFEST]
    yield "tensors", content[TENSORS]


def _written(write: Any) -> bytes:
    out = io.BytesIO()
    write(out)
    return out.getvalue()


def _text(quantity: str) -> bytes:
    return _written(lambda file: np.savetxt(file, ARRAYS[quantity], "%.4f"))


def _dated(table: list[str]) -> str:
    lines = [f"2026-01-01 00:00:{row:09.6f}{line[line.index(',') :]}" for row, line in enumerate(table[1:])]
    return "\n".join([table[0], *lines])


def _lerobot() -> bytes:
    joints = ["a.pos", "b.pos"]
    features = {"observation.state": {"dtype": "float32", "shape": [2], "names": joints}}
    info = {"codebase_version": "v3.0", "robot_type": "arm", "fps": 50, "features": features}
    state = pa.array(ARRAYS["q"].tolist(), pa.list_(pa.float32()))
    rows = {"observation.state": state, "action": state, "timestamp": T, "episode_index": [0] * ROWS}
    names = {"meta/info.json": json.dumps(info).encode()}
    data = {"data/chunk-000/file-000.parquet": parquet(rows, store_schema=False)}
    return zipped(names | data, zipfile.ZIP_STORED)


if __name__ == "__main__":
    for target, content in seeds():
        path = Path(__file__).parent / "corpus" / target / hashlib.sha256(content).hexdigest()[:40]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
