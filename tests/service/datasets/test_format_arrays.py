"""HDF5, MATLAB, NumPy, Feather and Excel, each written by its own ecosystem: the same samples."""

import io
from contextlib import suppress

import h5py
import numpy as np
import openpyxl
import pytest
import scipy.io

from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, TooLargeError
from tests.service.data import post
from tests.service.datasets.reading import read_rejected
from tests.service.datasets.same_samples import DATA, FRAME, STAMPS, check_same, samples

ALL = ("t", "q", "dq", "ddq", "tau")
STEP = ReadOptions(dt=0.01)


def hdf5(arrays, **options):
    """Return an HDF5 file of arrays by path."""
    out = io.BytesIO()
    with h5py.File(out, "w") as file:
        for name, values in arrays.items():
            file.create_dataset(name, data=values, **options)
    return out.getvalue()


def mat(content):
    out = io.BytesIO()
    scipy.io.savemat(out, content)
    return out.getvalue()


def npy(array):
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def excel(frame, **options):
    out = io.BytesIO()
    frame.to_excel(out, index=False, **options)
    return out.getvalue()


def feather(frame, **options):
    out = io.BytesIO()
    frame.to_feather(out, **options)
    return out.getvalue()


ACT = {
    "action": DATA["q"] + 0.01,
    "observations/qpos": DATA["q"],
    "observations/qvel": DATA["dq"],
    "observations/effort": DATA["tau"],
    "observations/images/top": np.zeros((40, 4, 4, 3), np.uint8),
}
DROID = {
    "observation/robot_state/joint_positions": DATA["q"],
    "observation/robot_state/joint_velocities": DATA["dq"],
    "observation/robot_state/motor_torques_measured": DATA["tau"],
    "observation/timestamp/robot_state/robot_timestamp_seconds": np.floor(DATA["t"]).astype(int),
    "observation/timestamp/robot_state/robot_timestamp_nanos": (DATA["t"] % 1 * 1e9).round().astype(int),
}
RECORD = np.rec.fromarrays(FRAME.to_numpy().T, names=list(FRAME))


@pytest.mark.parametrize(
    ("body", "names"),
    [
        pytest.param(hdf5(DATA), ALL, id="HDF5"),
        pytest.param(hdf5({name: values.T for name, values in DATA.items()}), ALL, id="HDF5, columns first"),
        pytest.param(hdf5(DATA, chunks=True, compression="gzip", shuffle=True), ALL, id="HDF5, compressed"),
        pytest.param(hdf5({f"log/{name}": values for name, values in DATA.items()}), ALL, id="HDF5, in a group"),
        pytest.param(mat(DATA), ALL, id="MATLAB"),
        pytest.param(mat({name: values.T for name, values in DATA.items()}), ALL, id="MATLAB, columns first"),
        pytest.param(
            mat({"log": {"t": DATA["t"][:, None], "joint": {n: DATA[n] for n in ALL[1:]}}}), ALL, id="structure"
        ),
        pytest.param(mat({"q": DATA["q"], "tau": DATA["tau"], "Ts": 0.01, "who": "me"}), ("t", "q", "tau"), id="step"),
        pytest.param(npy(RECORD), ALL, id="NumPy, named fields"),
        pytest.param(feather(FRAME), ALL, id="Feather"),
        pytest.param(feather(FRAME, compression="zstd", chunksize=7), ALL, id="Feather, compressed"),
        pytest.param(excel(FRAME), ALL, id="Excel"),
        pytest.param(
            excel(FRAME.assign(t=STAMPS.to_numpy()), startrow=3), ALL[1:], id="Excel, dates, empty rows above"
        ),
    ],
)
def test_formats_give_the_same_samples(tmp_path, body, names):
    check_same(samples(tmp_path, body), names)


def test_matlab_7_3_is_hdf5_behind_a_user_block(tmp_path):
    path = tmp_path / "matlab.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in DATA.items():
            file[f"log/{name}"] = np.atleast_2d(values.T)
        file["#refs#/a"] = np.zeros((5, 5))
    body = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + path.read_bytes()[512:]
    check_same(samples(tmp_path, body), ALL)


def test_arrays_without_times_need_a_step(tmp_path):
    check_same(samples(tmp_path, hdf5(ACT), STEP), ("t", "q", "dq", "tau"))
    names = tuple(FRAME)
    check_same(samples(tmp_path, npy(FRAME.to_numpy()), ReadOptions(column_names=names)), ALL)
    assert read_rejected(tmp_path, npy(FRAME.to_numpy()), None)[0] == "column_names"


def test_droid_has_stamps_in_two_arrays(tmp_path):
    check_same(samples(tmp_path, hdf5(DROID)), ("t", "q", "dq", "tau"))


def test_numbered_groups_are_episodes(tmp_path):
    parts = {f"data/demo_{k}/obs/{name}": DATA[name][:rows] for k, rows in ((10, 40), (2, 25)) for name in DATA}
    found = samples(tmp_path, hdf5(parts))
    assert len(found["q"]) == 65
    np.testing.assert_array_equal(found["q"][25:], DATA["q"])  # after demo_2
    assert found["facts"][0] == "2 groups are episodes"
    check_same(samples(tmp_path, hdf5(parts), ReadOptions(topic="data/demo_10")), ALL)
    field, value, expected = read_rejected(tmp_path, hdf5(parts), None, ReadOptions(topic="data/demo_3"))
    assert (field, value) == ("topic", "data/demo_3")
    assert "data/demo_2/obs" in expected


def test_other_files_are_not_read(tmp_path):
    secret = tmp_path / "secret.h5"
    secret.write_bytes(hdf5(DATA))
    (tmp_path / "raw").write_bytes(DATA["q"].tobytes())
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["q"] = h5py.ExternalLink("secret.h5", "/q")
        file["tau"] = DATA["tau"]
    with pytest.raises(InvalidDataError, match="No joint positions"):
        samples(tmp_path, (tmp_path / "a.h5").read_bytes())
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file.create_dataset("q", (40, 3), "f8", external=[("raw", 0, h5py.h5f.UNLIMITED)])
    layout = h5py.VirtualLayout((40, 3), "f8")
    layout[:] = h5py.VirtualSource(str(secret), "q", (40, 3))
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file.create_virtual_dataset("q", layout)
    for name in ("b.h5", "c.h5"):
        with pytest.raises(InvalidDataError, match="stored in another file"):
            samples(tmp_path, (tmp_path / name).read_bytes())


def test_sheet_is_chosen_and_read_with_its_units(tmp_path):
    book = openpyxl.Workbook()
    book.active.append(["only a title"])
    sheet = book.create_sheet("Log 1")
    sheet.append(["Scope", None, 4.5])
    sheet.append(list(FRAME))
    sheet.append(["s", *3 * ["deg"], *3 * ["deg/s"], *3 * ["deg/s²"], *3 * ["Nm"]])
    for row in FRAME.assign(**{name: np.degrees(FRAME[name]) for name in FRAME if "q" in name}).to_numpy().tolist():
        sheet.append(row)
    book.create_sheet("other").append(["x", "y"])
    out = io.BytesIO()
    book.save(out)
    for reply in (None, ReadOptions(topic="Log 1")):
        check_same(samples(tmp_path, out.getvalue(), reply), ALL)
    assert read_rejected(tmp_path, out.getvalue(), None, ReadOptions(topic="Log 2"))[2].endswith("Sheet, Log 1, other")


@pytest.mark.parametrize("body", [npy(RECORD), feather(FRAME), excel(FRAME)], ids=["npy", "feather", "xlsx"])
def test_damaged_files_are_read_or_rejected(tmp_path, body):
    for broken in damaged(body, 60):
        with suppress(InvalidDataError, TooLargeError):
            samples(tmp_path, broken)


@pytest.mark.parametrize(
    ("body", "media_type"), [(hdf5(DATA), "application/x-hdf5"), (mat(DATA), "application/x-matlab-data")]
)
def test_damage_that_crashes_a_library_ends_only_its_process(api, body, media_type):
    for broken in damaged(body, 25):
        assert post(api, broken, media_type).status_code in (201, 413, 422)
    assert post(api, body, media_type).status_code == 201


def damaged(body, count):
    """Yield damaged variants of a file, a third of them cut off."""
    rng = np.random.default_rng(5)
    for number in range(count):
        broken = bytearray(body if number % 3 else body[: rng.integers(len(body))])
        for place in rng.integers(0, max(len(broken), 1), 4):
            broken[place : place + 2] = rng.bytes(2)
        yield bytes(broken)
