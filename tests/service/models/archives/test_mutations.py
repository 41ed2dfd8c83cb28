"""Randomly changed archives: each is imported or rejected, without any other effect."""

import json
import random

import pytest

from tests.choosing import slow
from tests.service.models.archives.packing import (
    MANIFEST,
    TENSORS,
    exported,
    import_archive,
    pack,
    unpack,
    with_checksums,
    with_header,
    with_json,
    with_payload,
)

ODD = [
    None, True, -1, 0, 1e308, 2**62, "", "x" * 300, "\u202e", [], {}, [[]], [None], {"": 0}, [1e308] * 2, ["a", "a"],
    [-1.0, 1.0], 0.5, "rigid-body", "se", "lip",
]  # fmt: skip


def paths(value, path=()):
    """Yield the path of every value in a JSON value."""
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield (*path, key)
            yield from paths(value[key], (*path, key))


def mutate(rng, value):
    """Replace or delete one value in a JSON value."""
    *path, last = rng.choice(list(paths(value)))
    for key in path:
        value = value[key]
    if rng.random() < 0.2:
        del value[last]
    else:
        value[last] = rng.choice(ODD)


def change_bytes(rng, content, max_changes=8):
    changed = bytearray(content)
    for _ in range(rng.randint(1, max_changes)):
        changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def mutant(rng, files):
    """Return an archive that differs from a correct one in one way."""
    kind = rng.choice(["tar", "headers", "export", "manifest", "header", "tensors", "cut", "checksums"])
    if kind == "tar":
        return change_bytes(rng, pack(files))
    if kind == "headers":
        packed = bytearray(pack(files))
        packed[rng.randrange(512)] = rng.randrange(256)
        packed[148:156] = b" " * 8
        packed[148:156] = f"{sum(packed[:512]):06o}\0 ".encode()
        return bytes(packed)
    if kind == "cut":
        packed = pack(files)
        return packed[: rng.randrange(len(packed))]
    if kind == "tensors":
        at = len(files[TENSORS]) // 2
        return pack(with_payload(files, files[TENSORS][:at] + change_bytes(rng, files[TENSORS][at:], 3)))
    if kind == "header":
        return pack(with_header(files, lambda header: mutate(rng, header)))
    if kind == "checksums":
        sums = json.loads(files["checksums.json"])
        mutate(rng, sums)
        return pack({**files, "checksums.json": json.dumps(sums).encode()})
    name = MANIFEST if kind == "manifest" else "export.json"
    return pack(with_json(with_checksums(files), name, lambda value: mutate(rng, value)))


def import_mutants(api, files, seed, count):
    rng = random.Random(seed)
    codes = {201: 0, 422: 0}
    for _ in range(count):
        answer = import_archive(api, mutant(rng, files), name="mutant")
        assert answer.status_code in codes, answer.text
        codes[answer.status_code] += 1
        if answer.status_code == 201:
            # an imported version can be shown and queried
            version = answer.json()["version"]
            assert api.get(f"/v1/models/mutant/versions/{version}").status_code == 200
            body = {"q": [0.1, 0.1], "dq": [0.1, 0.1], "ddq": [0.1, 0.1], "version": version}
            assert api.post("/v1/models/mutant/predict", json=body).status_code == 200
    return codes


@pytest.fixture(scope="module")
def files(api, trained):
    return unpack(exported(api, trained.name))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(("seed", "count"), [(1, 15), slow(2, 3000)])
def test_mutants_are_imported_unchanged_or_rejected(api, files, seed, count):
    assert import_mutants(api, files, seed, count)[422] > count / 2
