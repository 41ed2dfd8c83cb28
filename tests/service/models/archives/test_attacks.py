"""Malicious archives: each is rejected with its error named, and nothing of it is stored."""

import gzip
import math
import struct
import tarfile
from functools import reduce
from operator import getitem
from unittest.mock import Mock

import numpy as np
import pytest

from service.models import archive_import
from tests.service.conftest import BODY_LIMITS
from tests.service.data import error, service_of
from tests.service.models.archives.packing import (
    MANIFEST,
    TENSORS,
    assert_rejected,
    import_archive,
    member,
    pack,
    pack_members,
    rejected_field,
    with_checksums,
    with_first_header,
    with_header,
    with_json,
    with_payload,
    with_tensors,
)

EVERY = ("checksums.json", "export.json", MANIFEST, TENSORS)


def parts(files):
    return [(member(name, content), content) for name, content in files.items()]


def add_member(name, content=b"", form=tarfile.USTAR_FORMAT, **fields):
    """Return a change of an archive that adds a member, instead of one of the same name."""

    def change(files):
        rest = {each: held for each, held in files.items() if each != name}
        return pack_members([*parts(rest), (member(name, content, **fields), content)], form)

    return change


LINKS = {
    "symbolic link": {"type": tarfile.SYMTYPE, "linkname": "/etc/passwd"},
    "hard link": {"type": tarfile.LNKTYPE, "linkname": MANIFEST},
    "device": {"type": tarfile.CHRTYPE, "devmajor": 1, "devminor": 3},
    "pipe": {"type": tarfile.FIFOTYPE},
    "sparse": {"type": tarfile.GNUTYPE_SPARSE},
    "contiguous": {"type": tarfile.CONTTYPE},
}
PAX = {"form": tarfile.PAX_FORMAT, "pax_headers": {"size": "1"}}
MEMBER_ATTACKS = {
    **{kind: (add_member(TENSORS, **fields), TENSORS, "expected a plain file") for kind, fields in LINKS.items()},
    "long name": (add_member("x" * 200, form=tarfile.GNU_FORMAT), "././@LongLink", "plain file"),
    "extended header": (lambda files: add_member(TENSORS, files[TENSORS], **PAX)({}), "././@PaxHeader", "a plain"),
    "duplicate": (lambda files: pack_members([*parts(files), *parts(files)[-1:]]), TENSORS, "given twice"),
    "large description": (add_member("export.json", b" " * 70_000), "export.json", "at most 65536"),
    "large manifest": (add_member(MANIFEST, b" " * 1_100_000), MANIFEST, "at most 1048576"),
    "unnamed robot": (
        lambda files: pack(with_checksums({**files, "robot.urdf": b"<robot/>"})),
        "robot.urdf",
        "names no robot",
    ),
}


@pytest.mark.parametrize(("attack", "field", "reply"), MEMBER_ATTACKS.values(), ids=MEMBER_ATTACKS)
def test_wrong_member(api, files, attack, field, reply):
    assert_rejected(api, attack(files), field, reply)


@pytest.mark.parametrize(
    "name",
    ["/etc/passwd", "../../home/evil", "./manifest.json", "a/manifest.json", "evil.py", "robot.urdf\n", "caf\u00e9"],
)
def test_member_of_another_name(api, files, name):
    body = error(import_archive(api, add_member(name, b"evil")(files)), 422, "invalid_data")
    assert "expected one of" in body["message"] or "expected a plain name" in body["message"]


@pytest.mark.parametrize("name", EVERY)
def test_missing_or_damaged_member(api, files, name):
    rest = {each: content for each, content in files.items() if each != name}
    assert_rejected(api, pack(rest if name == "checksums.json" else with_checksums(rest)), name, "missing")
    if name != "checksums.json":
        content = bytearray(files[name])
        content[len(content) // 2] ^= 1
        assert_rejected(api, pack({**files, name: bytes(content)}), name, "sha256")


@pytest.mark.parametrize(
    "size", [b"77777777777", b"-0000000001", b"0x000000010", b" " * 11, b"\x80" + (2**40).to_bytes(11, "big")]
)
def test_wrong_member_size(api, files, size):
    packed = with_first_header(pack({TENSORS: files[TENSORS]}), 124, size.ljust(12, b"\0"))
    assert_rejected(api, packed, "archive" if size.startswith(b"0x") else TENSORS)


SPOILT = {
    "empty": lambda packed: b"",
    "zip": lambda packed: b"PK\x03\x04" + packed,
    "gzip": gzip.compress,
    "no end": lambda packed: packed[:-10240],
    "cut in a member": lambda packed: packed[:700],
    "more after it": lambda packed: packed + b"more",
    "twice": lambda packed: packed + packed,
    "damaged header": lambda packed: b"\xff" + packed[1:],
}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_incomplete_tar_file(api, files, spoil):
    assert rejected_field(api, spoil(pack(files))) in ("archive", *EVERY)


JSON_ATTACKS = {
    "deep list": (b'{"a":' + b"[" * 5000 + b"]" * 5000 + b"}", "nests more than"),
    "deeper than the stack": (b"[" * 60_000, "nests more than"),
    "NaN": (b'{"format": NaN}', "not JSON"),
    "overflow": (b'{"format": 1e999}', "out of range"),
    "huge integer": (b'{"format": ' + b"9" * 10_000 + b"}", "out of range"),
    "half a character": (b'{"format": "\\ud800"}', "not JSON"),
    "not UTF-8": (b'{"format": "\xff"}', "not JSON"),
    "not JSON": (b"{'format': 1}", "not JSON"),
    "empty": (b"", "not JSON"),
    "a list": (b"[]", ""),
}


@pytest.mark.each_once
@pytest.mark.parametrize(("content", "reply"), JSON_ATTACKS.values(), ids=JSON_ATTACKS)
@pytest.mark.parametrize("name", ["checksums.json", "export.json", MANIFEST])
def test_excessive_json(api, files, name, content, reply):
    changed = {**files, name: content}
    assert_rejected(api, pack(changed if name == "checksums.json" else with_checksums(changed)), name, reply)


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"format": "other"}, "export.json.format"),
        ({"format_version": 2}, "export.json.format_version"),
        ({"model": "../up"}, "export.json.model"),
        ({"version": 0}, "export.json.version"),
        ({"revision": -1}, "export.json.revision"),
        ({"software": []}, "export.json.software"),
        ({"more": 1}, "export.json.more"),
        ({"exported_at": "\u202eevil"}, "export.json"),
    ],
    ids=str,
)
def test_wrong_description(api, files, change, where):
    assert_rejected(api, pack(with_json(files, "export.json", lambda about: about.update(change))), where)


def set_entry(path, value):
    """Return a change of one entry of a manifest, which may be nested."""
    *parents, name = path
    return lambda manifest: reduce(getitem, parents, manifest).update({name: value})


MANIFEST_ATTACKS = [
    (("format",), "zip", "format"),
    (("format_version",), 99, "format_version is 99"),
    (("surprise",), 1, "surprise"),
    (("joint_names",), [], "joint_names"),
    (("joint_names",), ["a", "a"], "distinct names"),
    (("joint_names",), ["a", "\u202eb"], "joint_names[1]"),
    (("joint_names",), ["a", "b" * 101], "joint_names[1]"),
    (("joint_types",), ["revolute", "ball"], "joint_types[1]"),
    (("estimator",), "oracle", "estimator"),
    (("estimator",), "rigid-body", "fit.geometry is missing, expected one of learn, calibrate, fixed"),
    (("noise_std",), [0.1], "noise_std"),
    (("noise_std",), [1.0, 1.0], "noise_std is not that of the tensors"),
    (("options", "posterior_samples"), 4000, "expected at most 1000"),
    (("options", "hyperparameter_samples"), 1.5, "hyperparameter_samples"),
    (("options", "device"), "tpu", "device"),
    (("options", "command"), "rm", "command"),
    (("fit", "jitter"), -1, "fit.jitter"),
    (("fit", "deep"), {}, "fit.deep"),
    (("fit", "seconds"), "<img src=x onerror=alert(1)>", "fit.seconds"),
    (("fit", "seconds"), -1.0, "fit.seconds"),
    (("fit", "iterations"), 1.5, "fit.iterations"),
    (("fit", "converged"), 1, "fit.converged"),
    (("fit", "device"), "<b>", "fit.device"),
    (("fit", "corrupt"), "none", "fit.corrupt"),
    (("fit", "unknown"), "<b>", "fit.unknown"),
    (("compact", "weights"), True, "compact.weights"),
    (("compact", "std_max"), -0.1, "compact.std_max"),
    (("compact", "tolerance_reached"), 1, "compact.tolerance_reached"),
    (("compact", "unknown"), "<b>", "compact.unknown"),
    (("lineage", "training_metrics", "rmse"), [-1.0, 0.1], "training_metrics.rmse.0"),
    (("lineage", "training_metrics", "coverage"), [0.5, 1.5], "training_metrics.coverage.1"),
    (("lineage", "training_process", "seconds"), -1.0, "training_process.seconds"),
    (("lineage", "training_process", "note"), "<b>", "training_process.note"),
    (("lineage", "job"), 7, "lineage.job"),
    (("compact", "data_samples"), "many", "compact.data_samples"),
    (("calibration", "function_std_factor"), 0.5, "function_std_factor"),
    (("training_range", "q", "min"), [0.0], "training_range.q.min"),
    (
        ("training_range", "q", "min"),
        [9e9, 0.0],
        "training_range.q: min[0] is 9e+09, expected at most max[0]",
    ),
    (("training_range", "dq"), {}, "training_range.dq"),
    (("lineage",), [], "lineage"),
    (("lineage", "datasets"), [{"name": "no id"}], "datasets.0.id"),
    (("lineage", "datasets"), [{"id": "ds_1", "sha256": ["list"]}], "datasets.0.sha256"),
    (("lineage", "imported"), [1], "imported"),
    (("lineage", "note"), "\x1b[2J", "unprintable"),
    (("tensors", "file"), "../../etc/passwd", "tensors.file"),
    (("tensors", "sha256"), "0" * 64, "sha256"),
    (("tensors", "bytes"), 10, "size"),
    (("robot",), {}, "robot"),
    (("parameters", "friction"), {}, "parameters.friction"),
    (("hyperparameters",), {}, "hyperparameters are not those"),
]


@pytest.mark.parametrize(("path", "value", "reply"), MANIFEST_ATTACKS, ids=lambda each: str(each)[:40])
def test_wrong_manifest(api, files, path, value, reply):
    packed = pack(with_json(files, MANIFEST, set_entry(path, value)))
    assert rejected_field(api, packed, reply).startswith((MANIFEST, TENSORS))


def test_tensors_must_match_the_manifest_sizes(api, files, trained):
    packed = pack(with_json(files, MANIFEST, set_entry(("compact", "weights"), 10**9)))
    known = api.get(f"/v1/models/{trained.name}/versions/1").json()["compact"]
    assert import_archive(api, packed, name="sized").json()["compact"] == known


def described(**fields):
    return lambda header: header["statistics/b"].update(fields)


def empty_tensor(*shape):
    return {"dtype": "F64", "shape": shape, "data_offsets": [0, 0]}


HEADER_ATTACKS = {
    "overlap": lambda header: header["statistics/b"].update(data_offsets=header["inducing/q"]["data_offsets"]),
    "hole": lambda header: header.pop("statistics/b"),
    "beyond the end": described(shape=[10**6], data_offsets=[0, 8 * 10**6]),
    "negative offsets": described(data_offsets=[-8, 0]),
    "huge shape": described(shape=[2**40, 2**40]),
    "empty huge shape": lambda header: header.update({"params/evil": empty_tensor(2**62, 2**62, 0)}),
    "shape of truth values": described(shape=[True]),
    "other type": described(dtype="F16"),
    "unknown type": described(dtype=["F64"]),
    "more said": described(code="import os"),
    "metadata": lambda header: header.update(__metadata__={"format": "pt"}),
    "unknown tensor": lambda header: header.update(evil=header.pop("statistics/b")),
    "a list": lambda header: [1],
    "too many": lambda header: {f"params/{each}": empty_tensor(0) for each in range(2000)},
}


@pytest.mark.parametrize("change", HEADER_ATTACKS.values(), ids=HEADER_ATTACKS)
def test_wrong_tensor_header(api, files, change):
    assert_rejected(api, pack(with_header(files, change)), TENSORS)


@pytest.mark.parametrize("length", [0, 3, 2**20, 2**40, 2**64 - 1])
def test_wrong_length_of_the_tensor_header(api, files, length):
    assert_rejected(api, pack(with_payload(files, struct.pack("<Q", length) + files[TENSORS][8:])), TENSORS, "header")
    assert_rejected(api, pack(with_payload(files, files[TENSORS][:-8])), TENSORS, "the end of the file")


def add_inducing_samples(tensors):
    """Add many unused inducing samples: their torques' covariance would fill the memory."""
    for name in ("q", "dq", "ddq"):
        tensors[f"inducing/{name}"] = np.zeros((20_000, 2))


def set_tensor(name, value):
    return lambda tensors: tensors.update({name: np.array(value)})


def change_tensor(name, change):
    return lambda tensors: tensors.update({name: change(tensors[name].copy())})


def fill_tensor(name, value):
    return change_tensor(name, lambda array: np.full_like(array, value))


TENSOR_ATTACKS = {
    "NaN": (fill_tensor("statistics/b", math.nan), "finite"),
    "memory": (add_inducing_samples, "at most 1000"),
    "statistics that no samples have": (change_tensor("statistics/a", lambda a: -a), "valid model"),
    "another size": (set_tensor("statistics/b", [1.0]), "statistics/a"),
    "outputs twice": (change_tensor("inducing/outputs", lambda outputs: outputs * 0), "distinct places"),
    "outputs out of range": (change_tensor("inducing/outputs", lambda outputs: outputs + 10**9), "outputs reaches"),
    "unknown hyperparameter": (set_tensor("params/evil", [1.0]), "'evil'"),
    "hyperparameter of another shape": (set_tensor("params/noise.log_std", [1.0]), "noise.log_std"),
    "hyperparameter that overflows": (fill_tensor("params/noise.log_std", 1e3), ""),
    "answers that overflow": (fill_tensor("statistics/b", 1e300), ""),
    "floor below zero": (set_tensor("floor", [-1.0, 0.0]), "floor"),
}


@pytest.mark.parametrize(("change", "reply"), TENSOR_ATTACKS.values(), ids=TENSOR_ATTACKS)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_wrong_tensors(api, files, change, reply):
    assert rejected_field(api, pack(with_tensors(files, change)), reply) in (MANIFEST, TENSORS)


def test_archive_beyond_the_limit(strict_service):
    error(import_archive(strict_service, bytes(BODY_LIMITS["MAX_ARCHIVE_BYTES"] + 1)), 413, "too_large")
    error(import_archive(strict_service, bytes(BODY_LIMITS["MAX_ARCHIVE_BYTES"])), 422, "invalid_data")


def test_failed_publication_leaves_nothing(api, files, monkeypatch):
    monkeypatch.setattr(archive_import, "_publish", Mock(side_effect=RuntimeError("killed")))
    folder = service_of(api).files.versions
    before = sorted(folder.iterdir())
    with pytest.raises(RuntimeError, match="killed"):
        import_archive(api, pack(files))
    assert sorted(folder.iterdir()) == before
