"""Writers × layouts × units × compression: every combination gives the same samples."""

import gzip
import io
import zipfile

import numpy as np
import pandas as pd
import pyarrow as pa
from hypothesis import given, settings
from hypothesis import strategies as st

from service.datasets.options import ReadOptions
from tests.service.datasets import bag_writers as bags
from tests.service.datasets.same_samples import DATA, check_same, samples
from tests.service.datasets.test_format_arrays import excel, feather, hdf5, mat

JOINTS = ("shoulder", "elbow", "wrist")
STYLES = {
    "canonical": lambda quantity, j: f"{quantity}{j + 1}",
    "by joint": lambda quantity, j: f"{JOINTS[j]}/{ {'q': 'position', 'dq': 'velocity', 'tau': 'torque'}[quantity] }",
    "RTDE": lambda quantity, j: f"{ {'q': 'actual_q', 'dq': 'actual_qd', 'tau': 'joint_torque'}[quantity] }_{j}",
    "MATLAB": lambda quantity, j: (
        f"{ {'q': 'jointPosition', 'dq': 'jointVelocity', 'tau': 'jointTorque'}[quantity] }{j + 1}"
    ),
}


def frame_of(arrays, style):
    columns = {STYLES[style](name, j): arrays[name][:, j] for name in ("q", "dq", "tau") for j in range(3)}
    return pd.DataFrame({"t": arrays["t"], **columns})


def npz(arrays):
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def parquet(frame):
    out = io.BytesIO()
    frame.to_parquet(out)
    return out.getvalue()


def states(arrays):
    """Return joint states; messages hold numbers of 64 bits and whole nanoseconds."""
    times = bags.START + (arrays["t"] * 1e9).round().astype(int)
    rows = zip(times.tolist(), *(arrays[name].tolist() for name in ("q", "dq", "tau")), strict=True)
    return [bags.State(time, JOINTS, q, dq, tau) for time, q, dq, tau in rows]


TABLES = {
    "CSV": lambda frame: frame.to_csv(index=False).encode(),
    "Parquet": parquet,
    "Feather": feather,
    "Excel": excel,
    "JSON": lambda frame: frame.to_json(orient="records", double_precision=15).encode(),
    "JSON lines": lambda frame: frame.to_json(orient="records", lines=True, double_precision=15).encode(),
}
ARRAYS = {"HDF5": hdf5, "MATLAB": mat, "NPZ": npz}
BAGS = {
    "rosbag1": lambda folder, rows: bags.write_rosbag1(folder / "a.bag", rows),
    "rosbag2": lambda folder, rows: bags.write_db3(folder / "a.db3", rows),
    "MCAP": lambda folder, rows: bags.write_mcap(folder / "a.mcap", rows),
}


def zipped(body):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("recording.bin", body)
    return out.getvalue()


PACKED = {"": bytes, "gzip": gzip.compress, "zstd": lambda body: pa.compress(body, "zstd", asbytes=True), "zip": zipped}
UNITS = {"q": ("rad", np.pi / 180, "deg"), "tau": ("N*m", 1e-3, "N*mm")}


@given(data=st.data())
@settings(max_examples=40)
def test_writers_layouts_units_and_compression_give_the_same_samples(tmp_path_factory, data):
    draw, folder = data.draw, tmp_path_factory.mktemp("writers")
    arrays, units = {name: DATA[name].copy() for name in ("t", "q", "dq", "tau")}, {}
    for name in draw(st.sets(st.sampled_from(sorted(UNITS)))):
        arrays[name] = arrays[name] / UNITS[name][1]
        units[name] = UNITS[name][2]
    writer = draw(st.sampled_from([*TABLES, *ARRAYS, *BAGS]))
    if writer in TABLES:
        body = TABLES[writer](frame_of(arrays, draw(st.sampled_from(sorted(STYLES)))))
    elif writer in ARRAYS:
        body = ARRAYS[writer](arrays)
    else:
        body = BAGS[writer](folder, states(arrays)).read_bytes()
    packing = "" if writer in ("Excel", "NPZ") else draw(st.sampled_from(sorted(PACKED)))
    found = samples(folder, PACKED[packing](body), ReadOptions(units=units))
    check_same(found, ("t", "q", "dq", "tau"))
