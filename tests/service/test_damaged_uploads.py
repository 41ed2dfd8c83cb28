"""Good files with bytes changed at random: read or refused, never an unexpected error."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest

from lipcore.preparation.recipe import Recipe
from service.datasets.formats.opening import open_table
from service.datasets.mapping.reading import read
from service.datasets.options import ReadOptions, UploadOptions
from service.datasets.staging import prepare, staging
from service.foundation.errors import InvalidDataError, TooLargeError
from service.foundation.settings import Settings
from service.storage.storage import Disk
from tests.service.data import arrays, columns, csv, npz, stream

SAMPLES = stream(samples=60, rate=50.0)
NAMES = np.array(["a", "b"])
CSV = csv({name: values for name, values in columns(SAMPLES).items() if "d" not in name})
NPZ = npz(**arrays(SAMPLES), joint_names=NAMES, episode=np.zeros(60))


def damaged_npz(rng: np.random.Generator) -> bytes:
    """The archive damaged, or a sound archive with one damaged array: its checksums do not give that away."""
    if rng.integers(3) == 0:
        return damaged(NPZ, rng)
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(NPZ)) as source, zipfile.ZipFile(out, "w") as target:
        names = source.namelist()
        chosen = names[rng.integers(len(names))]
        for name in names:
            target.writestr(name, damaged(source.read(name), rng) if name == chosen else source.read(name))
    return out.getvalue()


DAMAGED = {"csv": lambda rng: damaged(CSV, rng), "npz": damaged_npz}


def damaged(body: bytes, rng: np.random.Generator) -> bytes:
    """Some bytes replaced, removed, doubled or moved; mostly where structure is: at both ends."""
    out = bytearray(body)
    for _ in range(rng.integers(1, 6)):
        place = int(rng.choice([rng.integers(len(out)), rng.integers(130), len(out) - 1 - rng.integers(130)]))
        place = max(0, min(place, len(out) - 1))
        width = int(rng.integers(1, 5))
        kind = rng.integers(4)
        if kind == 0:
            out[place : place + width] = rng.bytes(width)
        elif kind == 1:
            del out[place : place + width]
        elif kind == 2:
            out[place:place] = out[place : place + width]
        else:
            out[place : place + width] = bytes([int(rng.choice([0, 0xFF, 0x7F, 0x2C, 0x2D, 0x0A, 0x22]))]) * width
    return bytes(out)


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_files_are_read_or_refused(kind, tmp_path):
    rng, settings = np.random.default_rng(5), Settings(home=tmp_path)
    path, disk = tmp_path / "upload", Disk(settings)
    outcomes = {"read": 0, "refused": 0}
    for _ in range(300):
        path.write_bytes(DAMAGED[kind](rng))
        try:
            with staging(tmp_path) as folder:
                with open_table(path, kind, ReadOptions(), settings) as table:
                    found = read(table, folder, UploadOptions(), None, settings, disk)
                staged = prepare(found.staged, folder, Recipe(), 30).staged
                for name in ("q", "dq", "ddq", "tau"):
                    assert np.isfinite(staged.table(name)).all()
            outcomes["read"] += 1
        except (InvalidDataError, TooLargeError):
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 10, outcomes
