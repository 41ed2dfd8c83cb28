"""Numba compilation of the kernels' inner loops."""

from __future__ import annotations

import atexit
import os
import re
import shutil
import tempfile
from collections.abc import Callable, MutableMapping
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import config, njit, types

_F = TypeVar("_F", bound=Callable[..., object])

# Fused multiply-add and sums in any order; NaN and infinity keep their meaning.
_FASTMATH = {"contract", "reassoc", "nsz"}

FOLDER = Path(__file__).parent
"""Folder of the compiled functions that functions of other files call."""
_IMPORTS = re.compile(rf"^from {re.escape(__package__)}(?:\.(\w+))? import (.+)", re.MULTILINE)


def use_cache(environment: MutableMapping[str, str]) -> Path | None:
    """Let Numba read a cache that is not writable, as in a container with a read-only file system.

    Numba reads no machine code from a folder that is not writable. So `NUMBA_CACHE_DIR` is copied to a new private
    folder. This process and its children use it; it is deleted when the process ends. Return that folder. Return None
    if no copy is needed or no temporary folder can be created.
    """
    given = environment.get("NUMBA_CACHE_DIR")
    if not given or not Path(given).is_dir() or os.access(given, os.W_OK):
        return None
    try:
        folder = Path(tempfile.mkdtemp(prefix="lipserve-numba-"))
        shutil.copytree(given, folder, dirs_exist_ok=True)
        for each in (folder, *folder.rglob("*")):
            if each.is_dir():
                each.chmod(0o700)  # the copy has the mode of its source
    except OSError:
        return None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    environment["NUMBA_CACHE_DIR"] = str(folder)
    config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]  # read when Numba was imported
    return folder


use_cache(os.environ)


def compiled(function: _F) -> _F:
    """Compile `function` with Numba at its first call, without the GIL. Division by zero behaves as in NumPy.

    The machine code is stored on disk: in `NUMBA_CACHE_DIR`, beside the source, or below the home directory. If nothing
    is writable, not even a temporary folder, every process compiles again.
    """
    return _compile(function)


def brief(function: _F) -> _F:
    """Compile like `compiled`, but keep the GIL.

    A call takes microseconds. Without the GIL it would have to wait whenever another thread has acquired it meanwhile.
    """
    return _compile(function, nogil=False)


def inlined(function: _F) -> _F:
    """Compile like `compiled`, and inline into compiled callers. Python cannot call the function."""
    return _compile(function, forceinline=True, no_cpython_wrapper=True)


def template(function: _F) -> _F:
    """Compile like `inlined`, for a function with compiled functions as arguments.

    Only its caller is stored on disk.
    """
    return _compile(function, keep=False, forceinline=True, no_cpython_wrapper=True)


@cache
def source_stamp(path: Path) -> str:
    """Return the hash of a source file and of all files in FOLDER that it imports, directly or indirectly.

    Numba only checks that the function's own file is unchanged, not the functions that it calls. This hash covers both.
    (If a later Numba has no `_source_stamp`: run `make clean` or delete __pycache__ after editing a function that other
    files call.)
    """
    return sha256(b"".join(each.read_bytes() for each in sorted(_imported(path)))).hexdigest()


@cache
def _imported(path: Path) -> frozenset[Path]:
    named = (module or names for module, names in _IMPORTS.findall(path.read_text()))
    direct = [FOLDER / f"{name.strip()}.py" for names in named for name in names.split(",")]
    return frozenset({path}.union(*(_imported(each) for each in direct)))


def _compile(function: _F, keep: bool = True, nogil: bool = True, **options: Any) -> _F:
    # entry points for C are never used, but cost a fifth of the compile time
    options |= {"fastmath": _FASTMATH, "error_model": "numpy", "no_cfunc_wrapper": True}
    try:
        dispatcher = njit(cache=keep, nogil=nogil, **options)(function)
    except RuntimeError as error:
        # raised at decoration time, so without this the import itself would fail
        if "no locator available" not in str(error):
            raise
        dispatcher = njit(cache=False, nogil=nogil, **options)(function)
    # one machine code serves all integers, instead of one for each constant in a call
    resolve = dispatcher.get_call_template
    dispatcher.get_call_template = lambda given, named: resolve([types.unliteral(each) for each in given], named)  # type: ignore[no-untyped-call]
    with suppress(AttributeError):
        dispatcher._cache._cache_file._source_stamp = source_stamp(Path(function.__code__.co_filename))
    return cast(_F, dispatcher)
