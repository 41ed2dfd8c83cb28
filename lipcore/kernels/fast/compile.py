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
"""Where the compiled functions are that those of other files call."""
_IMPORTS = re.compile(rf"^from {re.escape(__package__)}(?:\.(\w+))? import (.+)", re.MULTILINE)


def use_cache(environment: MutableMapping[str, str]) -> Path | None:
    """Let Numba read a cache that cannot be written, as in a container whose file system is read-only.

    Numba takes no machine code from a folder that it cannot write. So `NUMBA_CACHE_DIR` is copied to a new private
    folder, which this process and its children use and which goes when it ends. Return that folder, None where nothing
    was to be done or no temporary folder can be made.
    """
    given = environment.get("NUMBA_CACHE_DIR")
    if not given or not Path(given).is_dir() or os.access(given, os.W_OK):
        return None
    try:
        folder = Path(tempfile.mkdtemp(prefix="lipserve-numba-"))
        shutil.copytree(given, folder, dirs_exist_ok=True)
        for each in (folder, *folder.rglob("*")):
            if each.is_dir():
                each.chmod(0o700)  # copying gave it the mode of its source
    except OSError:
        return None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    environment["NUMBA_CACHE_DIR"] = str(folder)
    config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]  # read when Numba was imported
    return folder


use_cache(os.environ)


def compiled(function: _F) -> _F:
    """Compile `function` with Numba at its first call, without the GIL; division by zero gives what NumPy gives.

    The machine code is kept on disk: in `NUMBA_CACHE_DIR`, beside the source, or else below the home directory. Where
    nothing can be written at all, not even a temporary folder, every process compiles anew.
    """
    return _compile(function)


def brief(function: _F) -> _F:
    """Like `compiled`, but with the GIL: who answers one query in microseconds would have to wait for it again, each
    time, where another thread has taken it meanwhile."""
    return _compile(function, nogil=False)


def inlined(function: _F) -> _F:
    """Like `compiled`, and inlined where another compiled function calls it; Python itself cannot call it."""
    return _compile(function, forceinline=True, no_cpython_wrapper=True)


def template(function: _F) -> _F:
    """Like `inlined`, of a function that is given compiled functions: its caller alone is kept on disk."""
    return _compile(function, keep=False, forceinline=True, no_cpython_wrapper=True)


@cache
def source_stamp(path: Path) -> str:
    """Hash of a source file and of all files of FOLDER that it imports, directly or not.

    Numba takes machine code from disk while the function's own file is unchanged, whatever became of the functions it
    calls. Here it is taken while this is. (Should a later Numba not know `_source_stamp`: after editing a function that
    is called from another file, run `make clean` or delete __pycache__.)
    """
    return sha256(b"".join(each.read_bytes() for each in sorted(_imported(path)))).hexdigest()


@cache
def _imported(path: Path) -> frozenset[Path]:
    named = (module or names for module, names in _IMPORTS.findall(path.read_text()))
    direct = [FOLDER / f"{name.strip()}.py" for names in named for name in names.split(",")]
    return frozenset({path}.union(*(_imported(each) for each in direct)))


def _compile(function: _F, keep: bool = True, nogil: bool = True, **options: Any) -> _F:
    # entry points for C are never used, and take a fifth of the compile time
    options |= {"fastmath": _FASTMATH, "error_model": "numpy", "no_cfunc_wrapper": True}
    try:
        dispatcher = njit(cache=keep, nogil=nogil, **options)(function)
    except RuntimeError as error:
        # raised at decoration time, so without this the import itself would fail
        if "no locator available" not in str(error):
            raise
        dispatcher = njit(cache=False, nogil=nogil, **options)(function)
    # one machine code for all integers, not another one for each constant that a caller names
    resolve = dispatcher.get_call_template
    dispatcher.get_call_template = lambda given, named: resolve([types.unliteral(each) for each in given], named)  # type: ignore[no-untyped-call]
    with suppress(AttributeError):
        dispatcher._cache._cache_file._source_stamp = source_stamp(Path(function.__code__.co_filename))
    return cast(_F, dispatcher)
