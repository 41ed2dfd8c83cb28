"""Reading LeRobot data sets, a folder sent as zip: `meta/info.json` says what the columns of the Parquet files are."""

from __future__ import annotations

import re
import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from lipcore.data.samples import Array
from service.datasets.formats.json import decode
from service.datasets.formats.parquet import ParquetSource
from service.datasets.formats.table import Table, checked_names, first_line
from service.datasets.formats.zips import ERRORS, INFO, by_numbers, measure, open_zip, root_of, within
from service.datasets.options import ReadOptions
from service.foundation.errors import ServiceError, invalid_data
from service.foundation.settings import Settings

EXPECTED = "a zip of a LeRobot data set: meta/info.json and data/…parquet"
MAX_INFO = 4 * 1024 * 1024
ENDINGS = {"observation.state": ".pos", "observation.velocity": ".vel", "observation.effort": ".effort"}
ENDINGS |= {"observation.torque": ".torque", "observation.current": ".current", "observation.acceleration": ".acc"}
"""What a joint's name gets at its end, by the feature that it stands in."""
_ENDING = re.compile(r"\.(pos|position|vel|velocity|acc|acceleration|effort|torque|current)$")
_PLAIN = {"timestamp": "t", "episode_index": "episode"}


@contextmanager
def open_lerobot(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a LeRobot data set (version 2 or 3) as a table; raise InvalidDataError naming the member, or TooLargeError.

    `observation.state` becomes columns by the names of its joints (`shoulder_pan.pos`), other observations alike
    (`.vel`, `.effort`), `action` with that word in front; `t` in s and `episode` come from `timestamp` and
    `episode_index`. One Parquet file at a time is unpacked, beside the archive, under no name.
    """
    with open_zip(path, EXPECTED) as archive:
        names = archive.namelist()
        root = root_of(names)
        if root is None:
            raise invalid_data("member", "no meta/info.json", EXPECTED)
        info = _info(archive, f"{root}{INFO}")
        files = sorted((n for n in names if n.startswith(f"{root}data/") and n.endswith(".parquet")), key=by_numbers)
        if not files:
            raise invalid_data("member", f"no {root}data/…parquet", EXPECTED)
        measure([archive.getinfo(name) for name in files], settings)
        features = info.get("features")
        reader = _Files(archive, files, path.parent, features if isinstance(features, dict) else {}, settings)
        with reader.opened(files[0]) as first:
            columns = checked_names(first.names)
            facts = [f"LeRobot data set {_text(info, 'codebase_version')} of robot type {_text(info, 'robot_type')}"]
            facts += first.facts
            clock = _clock(columns, info, facts)
        if any(name.endswith(".pos") for name in columns):
            facts.append(
                "states of LeRobot may be degrees or shares of a range: give `units` where they are not radians"
            )
        yield Table(("t", *columns) if clock else columns, reader.blocks(columns, clock), units={"t": "s"}, facts=facts)


class _Files:
    """The Parquet files of a data set, opened one after the other."""

    def __init__(
        self, archive: zipfile.ZipFile, files: list[str], folder: Path, features: dict[str, Any], settings: Settings
    ) -> None:
        self.archive, self.files, self.folder, self.settings = archive, files, folder, settings
        self.features = features

    @contextmanager
    def opened(self, name: str) -> Iterator[ParquetSource]:
        with tempfile.TemporaryFile(dir=self.folder) as file:
            self._unpack(name, file)
            try:
                source = ParquetSource(file, self.settings, self._rename)
            except ServiceError as error:
                raise within(name, error) from None
            yield source

    def blocks(self, columns: tuple[str, ...], clock: tuple[int, float] | None) -> Iterator[Array]:
        """Rows of all files; errors name the file that they are in."""
        for name in self.files:
            with self.opened(name) as source:
                if tuple(source.names) != columns:
                    raise invalid_data(name, f"columns {', '.join(source.names)[:150]}", "those of the first file")
                try:
                    for block in source.blocks():
                        yield block if clock is None else np.column_stack([block[:, clock[0]] * clock[1], block])
                except ServiceError as error:
                    raise within(name, error) from None

    def _unpack(self, name: str, file: IO[bytes]) -> None:
        try:
            with self.archive.open(name) as member:
                shutil.copyfileobj(member, file, 1024 * 1024)
        except ERRORS as error:
            raise invalid_data(name, first_line(error), "a member that can be unpacked") from None

    def _rename(self, feature: str, names: list[str]) -> list[str]:
        """The names of a feature's columns; `names` are those by position."""
        if feature in _PLAIN:
            return [_PLAIN[feature]] if len(names) == 1 else names
        joints = _names(self.features.get(feature))
        if len(joints) != len(names) or len(set(joints)) != len(joints):
            return names
        if feature in ENDINGS:
            keep = feature == "observation.state"
            return [
                joint if keep and _ENDING.search(joint) else _ENDING.sub("", joint) + ENDINGS[feature]
                for joint in joints
            ]
        return [f"{feature}.{joint}" for joint in joints]


def _info(archive: zipfile.ZipFile, name: str) -> dict[str, Any]:
    try:
        with archive.open(name) as member:
            text = member.read(MAX_INFO + 1)
        info = decode(text) if len(text) <= MAX_INFO else None
    except ERRORS as error:
        raise invalid_data(name, first_line(error), EXPECTED) from None
    if not isinstance(info, dict):
        raise invalid_data(name, info, f"an object, of at most {MAX_INFO} bytes")
    return info


def _names(feature: Any) -> list[str]:
    """Names of a feature's parts: a list, or one within an object ({"motors": […]}), as older versions have it."""
    names = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict):
        names = next(iter(names.values()), None)
    return [str(name) for name in names] if isinstance(names, list) else []


def _clock(columns: tuple[str, ...], info: dict[str, Any], facts: list[str]) -> tuple[int, float] | None:
    """Column of the number of a frame and the step of time in s, where the files hold no times."""
    fps = info.get("fps")
    if "t" in columns or "frame_index" not in columns or not isinstance(fps, int | float) or not 0 < fps < np.inf:
        return None
    facts.append(f"times from the number of each frame, at {fps:g} Hz as {INFO} says")
    return columns.index("frame_index"), 1.0 / fps


def _text(info: dict[str, Any], key: str) -> str:
    value = info.get(key)
    return value[:50] if isinstance(value, str) and value.isprintable() else "unknown"
