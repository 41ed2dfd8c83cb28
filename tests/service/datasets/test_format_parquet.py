"""Parquet from pandas and pyarrow, flat and nested; damaged files, and files that unpack to too much."""

import struct
from decimal import Decimal

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from tests.service.datasets.reading import check_rejected, parquet, read

RNG = np.random.default_rng(11)


def frame(rows=300):
    return pd.DataFrame({name: RNG.normal(size=rows) for name in ("t", "q1", "tau1")})


@pytest.mark.parametrize(
    ("compression", "version"), [("none", "1.0"), ("snappy", "2.0"), ("gzip", "1.0"), ("zstd", "2.0"), ("lz4", "1.0")]
)
def test_pandas_is_read_back_exactly(tmp_path, compression, version):
    data = frame()
    data.loc[[3, 4], "q1"] = np.nan
    data["phase"], data["contact"] = "up", True
    body = data.to_parquet(compression=compression, data_page_version=version)
    result = read(tmp_path, body, "parquet")
    assert result.names == ("t", "q1", "tau1")
    np.testing.assert_array_equal(result.rows, data[list(result.names)])
    assert any("phase, contact" in fact for fact in result.facts)


@pytest.mark.parametrize("kind", [pa.uint16(), pa.int64(), pa.float16(), pa.decimal128(9, 3), pa.decimal256(40, 2)])
def test_numbers_of_every_kind(tmp_path, kind):
    number = Decimal if pa.types.is_decimal(kind) else int
    array = pa.array([number(1), None, number(3)], kind)
    np.testing.assert_array_equal(read(tmp_path, parquet({"q1": array}), "parquet")["q1"], [1, np.nan, 3])


@pytest.mark.parametrize(("unit", "step"), [("s", 1.0), ("ns", 1e-9)])
def test_times_become_seconds(tmp_path, unit, step):
    start = round(1_700_000_000 / step)
    stamps = pa.array([start, start + 1, None, start + 500], pa.timestamp(unit, "UTC"))
    spans = pa.array([0, 1, None, 500], pa.duration(unit))
    result = read(tmp_path, parquet({"t": stamps, "d": spans}), "parquet")
    for name in ("t", "d"):
        np.testing.assert_allclose(result[name], [0, step, np.nan, 500 * step], rtol=1e-14)
    assert result.units == {"t": "s", "d": "s"}
    assert any(fact.startswith("t holds dates") for fact in result.facts)


@pytest.mark.parametrize("kind", [pa.list_(pa.float32()), pa.large_list(pa.float64()), pa.list_(pa.float32(), 2)])
def test_lists_become_columns(tmp_path, kind):
    values = pa.array([[1, 2], None, [3, None], [5, 6]], kind)
    result = read(tmp_path, parquet({"q": values, "t": [0, 1, 2, 3]}, row_group_size=2), "parquet")
    np.testing.assert_array_equal(result["q[0]"], [1, np.nan, 3, 5])
    np.testing.assert_array_equal(result["q[1]"], [2, np.nan, np.nan, 6])


def test_nested_columns_get_dotted_and_indexed_names(tmp_path):
    table = {
        "pose": [[[1.0, 2.0], [3.0, 4.0]], [[1.5, 2.5], [3.5, 4.5]]],
        "joint": [{"pos": 5.0, "name": "a", "in": {"w": [6]}}, None],
        "all": [[{"x": 7}, {"x": 8}], None],
    }
    result = read(tmp_path, parquet(table), "parquet")
    first = {name: values[0] for name, values in result.columns.items()}
    assert first == {
        "pose[0][0]": 1, "pose[0][1]": 2, "pose[1][0]": 3, "pose[1][1]": 4,
        "joint.pos": 5, "joint.in.w[0]": 6, "all[0].x": 7, "all[1].x": 8,
    }  # fmt: skip
    assert [result[name][1] for name in result.names] == [1.5, 2.5, 3.5, 4.5] + [pytest.approx(np.nan, nan_ok=True)] * 4


def test_column_names_with_points_are_not_confused(tmp_path):
    table = {"state.now": [[1.0, 2.0]], "state.next": [[3.0, 4.0]], "state": [5.0], "x.y": ["a"]}
    result = read(tmp_path, parquet(table), "parquet")
    flat = {"state.now[0]": 1, "state.now[1]": 2, "state.next[0]": 3, "state.next[1]": 4, "state": 5}
    assert {name: values[0] for name, values in result.columns.items()} == flat


def test_lists_of_varying_length_are_ignored_and_one_odd_list_is_rejected(tmp_path):
    different = [[0.0] * (row % 5) for row in range(100)]
    result = read(tmp_path, parquet({"t": np.arange(100), "contacts": different}), "parquet")
    assert result.names == ("t",)
    assert any("contacts" in fact for fact in result.facts)
    odd = [[1.0, 2.0]] * 20_000
    odd[17_000] = [1.0]
    check_rejected(tmp_path, parquet({"q": odd}), "parquet", "q, row 17001", ("a list of 1 values",))


def test_images_are_ignored(tmp_path):
    table = {"t": [0, 1], "image": [{"bytes": b"x" * 100, "path": None}] * 2, "flat": [[1] * 3000] * 2}
    result = read(tmp_path, parquet(table), "parquet")
    assert result.names == ("t",)
    assert any("image, flat" in fact for fact in result.facts)


def test_units_come_from_field_metadata(tmp_path):
    schema = pa.schema([pa.field("q", pa.list_(pa.float64()), metadata={"unit": "deg"})])
    result = read(tmp_path, parquet(pa.table({"q": [[1.0, 2.0]]}, schema=schema)), "parquet")
    assert result.units == {"q[0]": "deg", "q[1]": "deg"}


def test_extension_types_are_read_as_their_storage(tmp_path):
    values = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    array = pa.FixedShapeTensorArray.from_numpy_ndarray(values)
    result = read(tmp_path, parquet({"m": array}), "parquet")
    assert [result[name][1] for name in result.names] == list(range(6, 12))


def test_empty_table_is_read_but_not_false_footer_or_too_many_columns(tmp_path, monkeypatch):
    assert len(read(tmp_path, parquet({"t": pa.array([], pa.float64())}), "parquet")["t"]) == 0
    assert read(tmp_path, parquet({"x": ["a"]}), "parquet").names == ()
    footer = parquet(pa.Table.from_pandas(frame()))[:-8] + struct.pack("<I4s", 2**31 - 1, b"PAR1")
    check_rejected(tmp_path, footer, "parquet", "file")
    many = parquet({f"c{i}": [1.0] for i in range(50)})
    monkeypatch.setattr("service.datasets.formats.table.MAX_COLUMNS", 20)
    check_rejected(tmp_path, many, "parquet", "columns", ("50",))
