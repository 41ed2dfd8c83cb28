"""Archives changed at random: each is taken as it is or refused, and nothing else ever happens."""

import json
import random

import pytest

from tests.choosing import slow
from tests.service.archives.packing import (
    MANIFEST,
    TENSORS,
    exported,
    pack,
    send,
    unpack,
    vouched,
    with_header,
    with_json,
    with_payload,
)

ODD = [
    None, True, -1, 0, 1e308, 2**62, "", "x" * 300, "\u202e", [], {}, [[]], [None], {"": 0}, [1e308] * 2, ["a", "a"],
    [-1.0, 1.0], 0.5, "rigid-body", "se", "lip",
]  # fmt: skip


def places(value, path=()):
    """Every place in a JSON value."""
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield (*path, key)
            yield from places(value[key], (*path, key))


def mutate(rng, value):
    """Change one place of a JSON value: another value there, or nothing."""
    *path, last = rng.choice(list(places(value)))
    for key in path:
        value = value[key]
    if rng.random() < 0.2:
        del value[last]
    else:
        value[last] = rng.choice(ODD)


def flipped(rng, content, most=8):
    changed = bytearray(content)
    for _ in range(rng.randint(1, most)):
        changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def mutant(rng, files):
    """An archive that differs from a right one in one way."""
    kind = rng.choice(["tar", "headers", "export", "manifest", "header", "tensors", "cut", "checksums"])
    if kind == "tar":
        return flipped(rng, pack(files))
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
        return pack(with_payload(files, files[TENSORS][:at] + flipped(rng, files[TENSORS][at:], 3)))
    if kind == "header":
        return pack(with_header(files, lambda header: mutate(rng, header)))
    if kind == "checksums":
        sums = json.loads(files["checksums.json"])
        mutate(rng, sums)
        return pack({**files, "checksums.json": json.dumps(sums).encode()})
    name = MANIFEST if kind == "manifest" else "export.json"
    return pack(with_json(vouched(files), name, lambda value: mutate(rng, value)))


def tried(api, files, seed, count):
    rng = random.Random(seed)
    codes = {201: 0, 422: 0}
    for _ in range(count):
        answer = send(api, mutant(rng, files), name="mutant")
        assert answer.status_code in codes, answer.text
        codes[answer.status_code] += 1
        if answer.status_code == 201:
            # whatever is taken in can be shown, and asked
            version = answer.json()["version"]
            assert api.get(f"/v1/models/mutant/versions/{version}").status_code == 200
            body = {"q": [0.1, 0.1], "dq": [0.1, 0.1], "ddq": [0.1, 0.1], "version": version}
            assert api.post("/v1/models/mutant/predict", json=body).status_code == 200
    return codes


@pytest.fixture(scope="module")
def files(api, trained):
    return unpack(exported(api, trained.name))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(("seed", "count"), [(1, 15), slow(2, 3000)])
def test_mutants_are_taken_as_they_are_or_refused(api, files, seed, count):
    assert tried(api, files, seed, count)[422] > count / 2
