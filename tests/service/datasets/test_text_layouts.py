"""Text tables in the layouts that recorders write: the same samples, or an error with a remedy that works."""

import bz2
import gzip

import clevercsv
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.datasets.formats.opening import open_table
from service.datasets.formats.text import DIALECT_CHARS, MAX_WORD_CHARS, read_layout
from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, TooLargeError
from tests.service.datasets.reading import check_rejected, read_rejected, settings_of, zipped
from tests.service.datasets.same_samples import DATA, FRAME, JOINTS, STAMP, STAMPS, check_same, samples


def csv(frame=FRAME, **options):
    return frame.to_csv(index=False, **options)


def states():
    """Return columns as ROS tools write them: stamps and arrays of a joint state."""
    arrays = {"name": JOINTS, "position": "q", "velocity": "dq", "effort": "tau"}
    frame = pd.DataFrame({"stamp": STAMP * 10**9 + (DATA["t"] * 1e9).round().astype(int)})
    for name, of in arrays.items():
        for j in range(3):
            frame[f"field.{name}{j}"] = of[j] if name == "name" else FRAME[f"{of}{j + 1}"]
    return frame


def long_table(labels):
    """Return a table with one row for each joint."""
    parts = [
        pd.DataFrame({"time": FRAME["t"], "joint": label, "position": FRAME[f"q{j}"], "torque": FRAME[f"tau{j}"]})
        for j, label in enumerate(labels, start=1)
    ]
    return pd.concat(parts).sort_index(kind="stable")


def units_row():
    names, rows = csv().split("\n", 1)
    units = ["ms" if name == "t" else "deg/s^2" if name.startswith("dd") else "Nm" for name in FRAME]
    return f"{names}\n{','.join(units)}\n{rows}"


def trailing_separators():
    names, *rows = csv(sep=";").splitlines()
    return "\n".join([names, *(f"{row};" for row in rows)])


PREAMBLE = "Recorder;Version 3.4\nOperator;Jürgen\nStart;2024-03-05 10:11:12\nInterval [ms];8\n\n"
LAYOUTS = {
    "lines above the names": PREAMBLE + csv(),
    "lines above, decimal commas": PREAMBLE + csv(sep=";", decimal=","),
    "a separator ends each row": trailing_separators(),
    "written by R": "\n".join(
        [
            " ".join(f'"{name}"' for name in FRAME),
            *(f'"{k + 1}" {row.replace(",", " ")}' for k, row in enumerate(csv().splitlines()[1:])),
        ]
    ),
    "names in the last of several comments": f"% MATLAB\n% {csv()}",
    "lists": FRAME.pipe(
        lambda f: pd.DataFrame(
            {
                "Time": f.t,
                **{
                    name: list(np.asarray(f[[f"{of}{j}" for j in (1, 2, 3)]]))
                    for name, of in (("Position", "q"), ("Effort", "tau"))
                },
            }
        )
    ).to_csv(index=False),
    "lists with commas": FRAME.pipe(
        lambda f: pd.DataFrame(
            {"t": f.t, **{name: f[[f"{name}{j}" for j in (1, 2, 3)]].to_numpy().tolist() for name in ("q", "tau")}}
        )
    ).to_csv(index=False, sep=";"),
    "transposed": FRAME.T.to_csv(header=False),
    "transposed, blanks": FRAME.T.to_csv(header=False, sep=" "),
    "a row for each joint": long_table(["1", "2", "3"]).to_csv(index=False),
    "times of day": csv(FRAME.assign(t=STAMPS.dt.strftime("%H:%M:%S.%f"))),
    "German dates": csv(FRAME.assign(t=STAMPS.dt.strftime("%d.%m.%Y %H:%M:%S.%f"))),
    "American dates": csv(FRAME.assign(t=STAMPS.dt.strftime("%m/%d/%Y %I:%M:%S.%f %p"))),
    "time named ts": csv(FRAME.rename(columns={"t": "pc_ts"})),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_give_the_same_samples(tmp_path, layout):
    check_same(samples(tmp_path, LAYOUTS[layout].encode()))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "cp1252", "latin-1"])
def test_encodings_give_the_same_samples(tmp_path, encoding):
    names = {name: f"{name} [°]" if name.startswith("q") else name for name in FRAME}
    body = (PREAMBLE + csv(FRAME.rename(columns=names))).encode(encoding)
    found = samples(tmp_path, body)
    np.testing.assert_allclose(found["q"], np.radians(DATA["q"]), atol=1e-9)
    check_same(found, ("t", "tau"))


@pytest.mark.parametrize(
    "pack",
    [gzip.compress, lambda body: zipped({"a/log.csv": body}), lambda body: pa.compress(body, "zstd", asbytes=True)],
)
@pytest.mark.parametrize("body", [csv().encode(), FRAME.to_parquet()], ids=["csv", "parquet"])
def test_compressed_files_give_the_same_samples(tmp_path, pack, body):
    check_same(samples(tmp_path, pack(body)))


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (gzip.compress(gzip.compress(b"t,q1\n1,2\n")), "compressed twice"),
        (gzip.compress(csv().encode())[:-20], "could not be read"),
        (bz2.compress(csv().encode()), "bzip2"),
    ],
    ids=["twice", "cut off", "bzip2"],
)
def test_damaged_and_unknown_compressions_are_rejected(tmp_path, body, words):
    with pytest.raises(InvalidDataError) as caught:
        samples(tmp_path, body)
    assert words in caught.value.message


def test_unpacked_size_is_limited(tmp_path):
    path = tmp_path / "upload"
    path.write_bytes(gzip.compress(b"t,q1\n" + b"0,1\n" * 10**6))
    limits = settings_of(tmp_path, max_unpacked_bytes=10**5)
    with (
        pytest.raises(TooLargeError, match="unpacks to more than 100000"),
        open_table(path, None, ReadOptions(), limits),
    ):
        pass


def test_units_in_a_row_below_the_names_are_used(tmp_path):
    found = samples(
        tmp_path, units_row().replace("deg/s^2", "rad/s^2").replace("Nm", "rad", 3).replace("Nm", "rad/s", 3).encode()
    )
    np.testing.assert_allclose(found["t"][:, 0], DATA["t"] / 1000, atol=1e-12)
    check_same(found, ("q", "dq", "ddq", "tau"))


@pytest.mark.parametrize("time", ["%time", "time"])
def test_joint_names_are_read_from_cells(tmp_path, time):
    """`rostopic echo -p` writes names in columns of their own."""
    body = csv(states().rename(columns={"stamp": time}).assign(**{"field.header.stamp": states()["stamp"]}))
    check_same(samples(tmp_path, body.encode()), ("q", "dq", "tau", "t"), JOINTS, time_error=5e-7)
    other = states()
    other.loc[7, "field.name1"] = "hip"
    check_rejected(tmp_path, csv(other).encode(), "csv", "field.name1, row 8", ("hip", "shoulder, as in the first row"))


def test_ros2_topic_echo_has_no_header(tmp_path):
    frame = states()
    head = pd.DataFrame({"sec": frame["stamp"] // 10**9, "nanosec": frame["stamp"] % 10**9, "frame": ""})
    body = pd.concat([head, frame.drop(columns="stamp")], axis=1).to_csv(index=False, header=False)
    check_same(samples(tmp_path, body.encode()), ("q", "dq", "tau"), JOINTS)


def test_joints_of_a_long_table_are_named(tmp_path):
    check_same(samples(tmp_path, long_table(JOINTS).to_csv(index=False).encode()), joints=JOINTS)
    cut = long_table(JOINTS)[:-1].to_csv(index=False)
    assert any("the last 2 rows are left out" in fact for fact in samples(tmp_path, cut.encode())["facts"])


@pytest.mark.parametrize("order", ["sorted by joint", "shuffled"])
def test_remedy_for_a_long_table_in_another_order_works(tmp_path, order):
    frame = long_table(JOINTS)
    frame = (
        frame.sort_values(["joint", "time"])
        if "joint" in order
        else frame.sample(frac=1, random_state=0).sort_values("time")
    )
    frame = frame if "joint" in order else pd.concat([frame[:3].sort_values("joint"), frame[3:]])
    field, _, expected = read_rejected(tmp_path, frame.to_csv(index=False).encode(), "csv")
    assert field.startswith("joint, row ")
    remedy = expected.partition("pandas: ")[2]
    space = {"frame": frame}
    exec(remedy.replace("wide.to_csv('wide.csv')", "text = wide.to_csv()"), space)
    check_same(samples(tmp_path, space["text"].encode()), joints=JOINTS)


def test_rows_of_one_time_must_agree_in_time(tmp_path):
    frame = long_table(JOINTS).reset_index(drop=True)
    frame.loc[10, "time"] += 0.001
    check_rejected(
        tmp_path,
        frame.to_csv(index=False).encode(),
        "csv",
        "time, row 11",
        ("0.031", "0.03, the time of the joints before"),
    )


def test_text_of_a_plc_program_is_named(tmp_path):
    body = b"n : UDINT := 2;\nq_1 : ARRAY[1..2] OF REAL := [-0.29, -0.28];\n"
    check_rejected(tmp_path, body, "csv", "file", "PLC")


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("t," + "x" * 1000 + ",y", "t," + "x" * MAX_WORD_CHARS + ",y"),
        ("t," + "x." * DIALECT_CHARS, "t," + "x." * (MAX_WORD_CHARS // 2)),
        ("t," * DIALECT_CHARS, "t," * (DIALECT_CHARS // 2)),
    ],
    ids=["word", "line of one word", "line"],
)
def test_separator_is_found_in_short_words_at_the_start(tmp_path, monkeypatch, line, text):
    """CleverCSV takes minutes for a word of 200 000 characters."""
    read = []
    monkeypatch.setattr(clevercsv.Detector, "detect", lambda _, text, **options: read.append(text))
    path = tmp_path / "long.csv"
    path.write_text(line)
    read_layout(path, None)
    assert read == [text]


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_writers_layouts_units_and_encodings_give_the_same_samples(tmp_path_factory, data):
    draw = data.draw
    sep = draw(st.sampled_from([",", ";", "\t", "|"]))
    decimal = "," if sep != "," and draw(st.booleans()) else "."
    degrees = draw(st.booleans())
    frame = FRAME[["t", *(f"{name}{j}" for name in ("q", "tau") for j in (1, 2, 3))]].copy()
    if degrees:
        frame[["q1", "q2", "q3"]] = np.degrees(frame[["q1", "q2", "q3"]])
    unit = draw(st.sampled_from(["in the name", "in a row", "in an option"])) if degrees else ""
    reply = ReadOptions(units={"q": "deg"}) if unit == "in an option" else ReadOptions()
    if unit == "in the name":
        frame = frame.rename(columns={f"q{j}": f"q{j} [°]" for j in (1, 2, 3)})
    text = frame.to_csv(index=False, sep=sep, decimal=decimal)
    if unit == "in a row":
        names, rows = text.split("\n", 1)
        text = f"{names}\n{sep.join(['s', *3 * ['deg'], *3 * ['Nm']])}\n{rows}"
    elif draw(st.booleans()):
        text = "\n".join(sep.join(row) for row in zip(*(line.split(sep) for line in text.splitlines()), strict=True))
    text = draw(st.sampled_from(["", "Scope Project\n\n", "# of Monday\n"])) + text
    end = draw(st.sampled_from(["\n", "\r\n"]))
    body = text.replace("\n", end).encode(draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"])))
    body = draw(st.sampled_from([lambda each: each, gzip.compress]))(body)
    found = samples(tmp_path_factory.mktemp("text"), body, reply)
    np.testing.assert_allclose(found["q"], DATA["q"], atol=1e-8)
    check_same(found, ("t", "tau"))
