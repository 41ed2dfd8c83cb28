"""Randomly changed archives: each is imported or rejected, without any other effect."""

import json
import random
from functools import partial

import pytest

from tests.choosing import slow
from tests.service.models.archives.packing import (
    MANIFEST,
    TENSORS,
    import_archive,
    pack,
    with_first_header,
    with_header,
    with_json,
    with_payload,
)
from tests.service.models.versions import predict_json

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
    packed, half, change = pack(files), len(files[TENSORS]) // 2, partial(mutate, rng)

    def change_checksums():
        sums = json.loads(files["checksums.json"])
        change(sums)
        return pack({**files, "checksums.json": json.dumps(sums).encode()})

    def change_tensors():
        return files[TENSORS][:half] + change_bytes(rng, files[TENSORS][half:], 3)

    kinds = {
        "tar": lambda: change_bytes(rng, packed),
        "headers": lambda: with_first_header(packed, changed=bytes([rng.randrange(256)]), place=rng.randrange(512)),
        "export": lambda: pack(with_json(files, "export.json", change)),
        "manifest": lambda: pack(with_json(files, MANIFEST, change)),
        "header": lambda: pack(with_header(files, change)),
        "tensors": lambda: pack(with_payload(files, change_tensors())),
        "cut": lambda: packed[: rng.randrange(len(packed))],
        "checksums": change_checksums,
    }
    return kinds[rng.choice(list(kinds))]()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(("seed", "count"), [(1, 15), slow(2, 3000)])
def test_mutants_are_imported_unchanged_or_rejected(api, files, seed, count):
    rng, rejected = random.Random(seed), 0
    for _ in range(count):
        answer = import_archive(api, mutant(rng, files), name="mutant")
        assert answer.status_code in (201, 422), answer.text
        rejected += answer.status_code == 422
        if answer.status_code == 201:
            # an imported version can be shown and queried
            version = answer.json()["version"]
            assert api.get(f"/v1/models/mutant/versions/{version}").status_code == 200
            assert predict_json(api, "mutant", version=version)
    assert rejected > count / 2
