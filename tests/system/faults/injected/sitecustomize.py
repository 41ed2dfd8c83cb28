"""Kills a process at a named function. Python imports this at its start, from PYTHONPATH.

LIPSERVE_FAULT_TARGETS: functions to watch, `module:Class.function`, separated by commas. LIPSERVE_FAULT_FILE: selects
one of them; without that file nothing happens. Spawned processes inherit both.
"""

import functools
import importlib.abc
import importlib.machinery
import itertools
import json
import os
import signal
import sys

TARGETS = [each for each in os.environ.get("LIPSERVE_FAULT_TARGETS", "").split(",") if each]
FILE = os.environ.get("LIPSERVE_FAULT_FILE", "")
_calls = itertools.count(1)


def _strike_at(target: str, when: str) -> None:
    """Strike if this is the selected point; only one process does, once."""
    try:
        with open(FILE, encoding="utf-8") as file:
            fault = json.load(file)
    except FileNotFoundError:
        return
    if (fault["target"], fault["when"]) != (target, when) or not _is_within(fault["within"]):
        return
    if next(_calls) <= fault["skip"]:
        return
    try:
        handle = os.open(f"{FILE}.happened", os.O_CREAT | os.O_EXCL | os.O_WRONLY)
    except FileExistsError:
        return
    os.write(handle, json.dumps({"pid": os.getpid(), "parent": os.getppid(), "point": fault}).encode())
    os.close(handle)
    with open(f"{FILE}.service", encoding="utf-8") as file:
        service = int(file.read())
    if fault["victim"] == "service" and service in _ancestors():  # but never a process that has adopted an orphan
        os.kill(service, signal.SIGKILL)
    os.kill(os.getpid(), signal.SIGSTOP if fault["victim"] == "frozen" else signal.SIGKILL)


def _ancestors() -> list[int]:
    """Return the ids of the parent, and on Linux of its parent and so on."""
    found = [os.getppid()]
    while sys.platform == "linux" and found[-1] > 1:
        with open(f"/proc/{found[-1]}/stat", encoding="utf-8") as file:
            found.append(int(file.read().rpartition(")")[2].split()[1]))
    return found


def _is_within(function: str | None) -> bool:
    """Return whether a function, `module:qualified.name`, is on the stack of this thread."""
    frame = sys._getframe() if function is not None else None
    while frame is not None:
        if f"{frame.f_globals.get('__name__')}:{frame.f_code.co_qualname}" == function:
            return True
        frame = frame.f_back
    return function is None


def _watch(module: object, target: str) -> None:
    *path, name = target.partition(":")[2].split(".")
    holder = functools.reduce(getattr, path, module)
    function = vars(holder)[name]

    @functools.wraps(function)
    def watched(*args: object, **kwargs: object) -> object:
        _strike_at(target, "before")
        result = function(*args, **kwargs)
        _strike_at(target, "after")
        return result

    setattr(holder, name, watched)


class _WatchingFinder(importlib.abc.MetaPathFinder):
    """Finds modules as usual, and wraps the watched functions before other modules can import them."""

    def __init__(self, targets: list[str]) -> None:
        self.targets = {target.partition(":")[0]: [] for target in targets}
        for target in targets:
            self.targets[target.partition(":")[0]].append(target)

    def find_spec(self, name: str, path: object, target: object = None) -> object:
        if name not in self.targets:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def exec_module(module: object) -> None:
            execute(module)
            for each in self.targets[name]:
                _watch(module, each)

        spec.loader.exec_module = exec_module
        return spec


if TARGETS and FILE:
    for _target in TARGETS:
        if _target.partition(":")[0] in sys.modules:
            _watch(sys.modules[_target.partition(":")[0]], _target)
    sys.meta_path.insert(0, _WatchingFinder([each for each in TARGETS if each.partition(":")[0] not in sys.modules]))
