"""Uploads that are rejected because of their headers, parameters or content."""

from tests.service.api.bad_requests.bad import DATASETS, ROBOTS, BadRequest

CSV, NPZ, XML, FORM = "text/csv", "application/x-npz", "application/xml", "multipart/form-data; boundary=x"
IMPORT, TAR = "/v1/models/import", "application/x-tar"
TEXTS = ((DATASETS, CSV), (ROBOTS, XML))
PATHS = (DATASETS, ROBOTS, IMPORT)
UNSUPPORTED = ("", "text/plain", "application/octet-stream", "text/csvx", "*/*", "a" * 500)
UNSUPPORTED_FILES = (b"data.docx", b"data", b".csv.exe")
TYPE = ("unsupported_media_type", 415)
UNNAMED = ("", "%20", "%0A", "a%00", "%1B[31ma", "a%E2%80%AEvsc", "a%E2%80%8Bb", "%EF%BB%BFa", "a%C2%85", "a" * 201)
"""Names that are not accepted."""
_NUMBERS = ("-1", "nan", "inf", "x", "")
CHOICES: dict[str, dict[str, str]] = {
    "rate": dict.fromkeys(("0", *_NUMBERS), "rate"),
    "gap": dict.fromkeys(("1", *_NUMBERS), "gap"),
    "trim": dict.fromkeys(_NUMBERS, "trim"),
    "cutoff": dict.fromkeys(("0", "1001", *_NUMBERS), "cutoff"),
    "torque_convention": dict.fromkeys(("", "gravity"), "torque_convention"),
    "filtering": dict.fromkeys(("", "ALWAYS"), "filtering"),
    "form": {"anticausal": "form"},
    "effort": {"volts": "effort"},
    "torque_constants": dict.fromkeys(("", "1,,2", "0", "nan", "1e9"), "torque_constants"),
    "torque_factors": dict.fromkeys(("", "1,,2", "0", "1e9"), "torque_factors"),
    "delimiter": dict.fromkeys(("", ",,"), "delimiter"),
    "robot": dict.fromkeys(("r2d2", "urdf_0123456789abcdef", "a" * 201), "robot"),
    "columns": {
        **{"{": "body", "[]": "columns", '{"q":1}': "columns.q", '{"q":[]}': "columns.q", '{"q":""}': "columns.q"},
        **{'{"force":"f"}': "columns.force", '{"q":"a","q":"b"}': "q"},
    },
    "units": {"{}x": "body", "[]": "units", '{"q":1}': "units.q", '{"speed":"deg"}': "units.speed"},
    "joint_names": {"a" * 8001: "joint_names"},
    "joint_name": {"a": "joint_name"},
    "name": {"a&name=b": "name"},
}
"""Invalid query parameters of an upload: the values, and the field that the error names."""


def upload(
    path: str,
    content: bytes,
    named: str | None,
    kind: str = CSV,
    code: str = "invalid_data",
    status: int = 422,
    encoding: str = "",
) -> BadRequest:
    headers = {"content-type": kind, "content-encoding": encoding}
    return BadRequest(
        "POST", path, status, code, named, content, {name: text for name, text in headers.items() if text}
    )


def form(file_name: bytes, content: bytes = b"", field: bytes = b"file") -> bytes:
    disposition = b'form-data; name="%b"' % field + (b'; filename="%b"' % file_name if file_name else b"")
    return b"--x\r\nContent-Disposition: " + disposition + b"\r\n\r\n" + content + b"\r\n--x--\r\n"


def parameter(path: str, query: str, named: str, kind: str = CSV) -> BadRequest:
    return upload(f"{path}?{query}", b"t,q1\n", named, kind, "invalid_request")


BAD: list[BadRequest] = [
    *(parameter(path, f"name={name}", "name", kind) for path, kind in TEXTS for name in UNNAMED),
    *(parameter(DATASETS, f"{name}={value}", named) for name, all_ in CHOICES.items() for value, named in all_.items()),
    parameter(ROBOTS, "joint_names=a", "joint_names", XML),
    *(parameter(IMPORT, f"name={name}", "name", TAR) for name in ("", "A", "a%20b", "..", "a%2fb", "a" * 65)),
    *(upload(path, b"{}", "content-type", kind, *TYPE) for path in PATHS for kind in UNSUPPORTED),
    *(upload(path, form(name), "file name", FORM, *TYPE) for path in PATHS for name in UNSUPPORTED_FILES),
    upload(DATASETS, form("a\u202evsc.csv".encode()), "file name", FORM, "invalid_request"),
    upload(DATASETS, form(b"a\x07.csv"), "file name", FORM, "invalid_request"),
    upload(DATASETS, form(b""), "file", FORM, "invalid_request"),
    upload(DATASETS, form(b"a.csv", field=b"data"), "file", FORM, "invalid_request"),
    upload(ROBOTS, form(b""), "file", FORM, "invalid_request"),
    upload(DATASETS, b"garbage", "body", FORM, "invalid_request"),
    upload(DATASETS, b"--x\r\n", None, FORM, "invalid_request"),
    upload(DATASETS, form(b"a.csv"), "content-type", "multipart/form-data", "invalid_request"),
    *(upload(DATASETS, content, None) for content in (b"", b"q1,tau1\n", b"\x00" * 100, b"\xff\xfe")),
    *(upload(DATASETS, content, None, NPZ) for content in (b"", b"PK\x03\x04", b"\x93NUMPY", b"not a zip")),
    *(upload(ROBOTS, content, "urdf", XML) for content in (b"", b"<robot", b"<html/>", b"\xff", b'<robot name="a"/>')),
    *(upload(IMPORT, text, None, TAR) for text in (b"", b"\0" * 1024, b"garbage", b"\x1f\x8b\x08", b"PK\x03\x04")),
    upload(ROBOTS, b" " * (2 * 2**20 + 1), None, XML, "too_large", 413),
    *(upload(path, b"", "Content-Encoding", kind, *TYPE, encoding="gzip") for path, kind in TEXTS),
]
