"""Reading LeRobot data sets sent as a zip; `meta/info.json` describes the columns of the Parquet files."""

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
from service.datasets.formats.table import Table, clean_names, first_line, unreadable
from service.datasets.formats.zips import (
    ERRORS,
    INFO_PATH,
    add_member,
    check_unpacked_size,
    find_lerobot_folder,
    numbers_in_name,
    open_zip,
)
from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, ServiceError, invalid_data, readable
from service.foundation.settings import Settings

EXPECTED = "a zip of a LeRobot data set: meta/info.json and data/…parquet"
MAX_INFO_BYTES = 4 * 1024 * 1024
ENDINGS = {"observation.state": ".pos", "observation.velocity": ".vel", "observation.effort": ".effort"}
ENDINGS |= {"observation.torque": ".torque", "observation.current": ".current", "observation.acceleration": ".acc"}
"""Suffix of a joint's name by feature."""
_ENDING = re.compile(r"\.(pos|position|vel|velocity|acc|acceleration|effort|torque|current)$")
_RENAMED = {"timestamp": "t", "episode_index": "episode"}


@contextmanager
def open_lerobot(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a LeRobot data set (version 2 or 3) as a table; raise InvalidDataError or TooLargeError.

    `observation.state` becomes one column per joint, such as `shoulder_pan.pos`. Other observations get `.vel` or
    `.effort`; `action` becomes a prefix. `t` in s and `episode` come from `timestamp` and `episode_index`. One Parquet
    file at a time is unpacked, into a temporary file next to the archive.
    """
    with open_zip(path, EXPECTED) as archive:
        names = archive.namelist()
        root = find_lerobot_folder(names)
        if root is None:
            raise _missing(INFO_PATH)
        info = _read_info(archive, f"{root}{INFO_PATH}")
        files = [name for name in names if name.startswith(f"{root}data/") and name.endswith(".parquet")]
        files.sort(key=numbers_in_name)
        if not files:
            raise _missing(f"{root}data/…parquet")
        check_unpacked_size([archive.getinfo(name) for name in files], settings)
        features = info.get("features")
        reader = _ParquetFiles(archive, files, path.parent, features if isinstance(features, dict) else {}, settings)
        with reader.opened(files[0]) as first:
            columns = clean_names(first.names)
            facts = [f"LeRobot data set {_text(info, 'codebase_version')}, robot type {_text(info, 'robot_type')}"]
            facts += first.facts
            clock = _find_clock(columns, info, facts)
        if any(name.endswith(".pos") for name in columns):
            facts.append("LeRobot positions may be in degrees or normalised: set `units` if they are not in radians")
        yield Table(("t", *columns) if clock else columns, reader.blocks(columns, clock), units={"t": "s"}, facts=facts)


class _ParquetFiles:
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
                raise add_member(name, error) from None
            yield source

    def blocks(self, columns: tuple[str, ...], clock: tuple[int, float] | None) -> Iterator[Array]:
        """Yield the rows of all files; an error names its file."""
        for name in self.files:
            with self.opened(name) as source:
                if tuple(source.names) != columns:
                    value = f"a table of {', '.join(source.names)[:150]}"
                    raise invalid_data(name, value, "the columns of the first file")
                try:
                    for block in source.blocks():
                        yield block if clock is None else np.column_stack([block[:, clock[0]] * clock[1], block])
                except ServiceError as error:
                    raise add_member(name, error) from None

    def _unpack(self, name: str, file: IO[bytes]) -> None:
        try:
            with self.archive.open(name) as member:
                shutil.copyfileobj(member, file, 1024 * 1024)
        except ERRORS as error:
            raise unreadable(name, first_line(error), "a member that can be unpacked") from None

    def _rename(self, feature: str, names: list[str]) -> list[str]:
        """Return the names of a feature's columns; `names` are the default ones, by position."""
        if feature in _RENAMED:
            return [_RENAMED[feature]] if len(names) == 1 else names
        joints = _feature_names(self.features.get(feature))
        if len(joints) != len(names) or len(set(joints)) != len(joints):
            return names
        if feature in ENDINGS:
            keep = feature == "observation.state"
            return [
                joint if keep and _ENDING.search(joint) else _ENDING.sub("", joint) + ENDINGS[feature]
                for joint in joints
            ]
        return [f"{feature}.{joint}" for joint in joints]


def _missing(path: str) -> InvalidDataError:
    message = f"The archive has no {readable(path[:200])}, expected {EXPECTED}."
    return invalid_data("member", f"no {path}", EXPECTED, message)


def _read_info(archive: zipfile.ZipFile, name: str) -> dict[str, Any]:
    try:
        with archive.open(name) as member:
            text = member.read(MAX_INFO_BYTES + 1)
        info = decode(text) if len(text) <= MAX_INFO_BYTES else None
    except ERRORS as error:
        raise unreadable(name, first_line(error), EXPECTED) from None
    if not isinstance(info, dict):
        raise invalid_data(name, info, f"a JSON object of at most {MAX_INFO_BYTES} bytes")
    return info


def _feature_names(feature: Any) -> list[str]:
    """Return the names of a feature's parts: a list, or in older versions a list in an object ({"motors": […]})."""
    names = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict):
        names = next(iter(names.values()), None)
    return [str(name) for name in names] if isinstance(names, list) else []


def _find_clock(columns: tuple[str, ...], info: dict[str, Any], facts: list[str]) -> tuple[int, float] | None:
    """Return the column of frame numbers and the time step in s, if the files hold no times."""
    fps = info.get("fps")
    if "t" in columns or "frame_index" not in columns or not isinstance(fps, int | float) or not 0 < fps < np.inf:
        return None
    facts.append(f"times are computed from frame numbers at {fps:g} Hz, the rate in {INFO_PATH}")
    return columns.index("frame_index"), 1.0 / fps


def _text(info: dict[str, Any], key: str) -> str:
    value = info.get(key)
    return value[:50] if isinstance(value, str) and value.isprintable() else "unknown"
