"""Robots in xacro, expanded to URDF by its package: one file, or the zip of a description's folder.

Only files of the upload are read: `$(find pkg)` is a folder of the zip, `$(env …)` and `$(eval …)` are refused.
"""

from __future__ import annotations

import os
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lipcore.extras import import_extra
from lipcore.robots.urdf_text import UrdfError

MAX_FILES = 2000
ENDINGS = (".xacro", ".urdf", ".xml", ".sdf")
_INCLUDE = re.compile(r"""<xacro:include\b[^>]*\bfilename\s*=\s*["']([^"']+)["']""")
_ARGUMENT = re.compile(r"""<xacro:arg\b[^>]*\bname\s*=\s*["'](\w+)["']""")
_EXPAND = "Expand it where its packages are installed: xacro robot.urdf.xacro > robot.urdf"


def is_xacro(text: str) -> bool:
    """Return whether a text has elements of xacro."""
    return "<xacro:" in text or "xmlns:xacro" in text


def unpack_description(archive: Path, folder: Path, max_bytes: int) -> Path:
    """Unpack a zip into a folder; return its robot: the file that no other one includes. Raise UrdfError."""
    try:
        with zipfile.ZipFile(archive) as opened:
            members = opened.infolist()
            if len(members) > MAX_FILES or sum(each.file_size for each in members) > max_bytes:
                raise UrdfError(f"the zip has more than {MAX_FILES} files or {max_bytes} bytes")
            texts = [each for each in members if each.filename.endswith((*ENDINGS, ".yaml", ".yml"))]
            opened.extractall(folder, texts)  # drops `..` and absolute paths
    except UrdfError:
        raise
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, OSError, EOFError, ValueError) as error:
        raise UrdfError(f"the zip cannot be read: {error}") from None
    found = {path: _read(path) for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix in ENDINGS}
    included = {os.path.basename(name) for text in found.values() for name in _INCLUDE.findall(text)}
    robots = [
        path
        for path, text in found.items()
        if any(each in text for each in ("<robot", "<sdf", "<mujoco")) and path.name not in included
    ]
    plain = [path for path in robots if not is_xacro(found[path])]
    robots = plain if len(plain) == 1 else robots
    if len(robots) != 1:
        names = ", ".join(str(path.relative_to(folder)) for path in robots[:10]) or "none"
        raise UrdfError(f"the zip must have one robot that no other file includes; it has: {names}")
    return robots[0]


def expand_xacro(file: Path, folder: Path, arguments: Mapping[str, str]) -> str:
    """Return the URDF of a xacro. folder: contains all files that it may include. Raise UrdfError."""
    xacro = import_extra("xacro", "robots")
    for path in folder.rglob("*"):
        if path.is_file() and path.suffix in ENDINGS and "<!" in re.sub(r"<!--|<!\[CDATA\[", "", _read(path)):
            raise UrdfError(f"{path.name} has a document type, which is not read")
    try:
        with _confined(xacro, folder):
            document = xacro.process_file(str(file), mappings=dict(arguments))
            return str(document.documentElement.toxml())
    except UrdfError:
        raise
    except Exception as error:  # of expressions and macros, which come with the file
        reason = str(error).strip() or type(error).__name__
        names = {name for path in folder.rglob("*") if path.is_file() for name in _ARGUMENT.findall(_read(path))}
        listed = f"Its arguments are {', '.join(sorted(names))}: set xacro={min(names)}=…. Or: " if names else ""
        raise UrdfError(
            f"xacro cannot expand {file.name}: {reason[:300].replace(str(folder), '')}. {listed}{_EXPAND}"
        ) from None


@contextmanager
def _confined(xacro: Any, folder: Path) -> Iterator[None]:
    """Let xacro read only files of a folder, and evaluate no `$(eval …)` and no `$(env …)`."""
    substitution = import_extra("xacro.substitution_args", "robots")
    absolute = xacro.abs_filename_spec

    def inside(name: str) -> str:
        path = Path(str(absolute(name))).resolve()
        if not path.is_relative_to(folder.resolve()):
            raise UrdfError(f"the xacro includes {name}, which is not in the upload")
        return str(path)

    def find(package: str) -> str:
        for path in sorted(folder.rglob(package)):
            if path.is_dir():
                return str(path)
        raise UrdfError(
            f"the xacro includes files of the package {package}. Upload a zip with the folder {package}. Or: {_EXPAND}"
        )

    def refuse(*_: Any) -> str:
        raise UrdfError(f"the xacro uses $(eval), $(env) or $(optenv), which are not evaluated. {_EXPAND}")

    replaced = {
        (xacro, "abs_filename_spec"): inside,
        (substitution, "_eval_find"): find,
        **{(substitution, name): refuse for name in ("_eval", "_eval_env", "_eval_optenv")},
    }
    before = {key: getattr(*key) for key in replaced}
    for (module, name), function in replaced.items():
        setattr(module, name, function)
    try:
        yield
    finally:
        for (module, name), function in before.items():
            setattr(module, name, function)


def _read(path: Path) -> str:
    return path.read_text("utf-8-sig", "replace")
