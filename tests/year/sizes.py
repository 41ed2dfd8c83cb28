"""The sizes of a service over the months, and the check that none of them grows without a bound."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Literal, NamedTuple

from service.models.aliases import KEPT_MOVES
from tests.attack.attacked import memory_bytes
from tests.service.server import children
from tests.system.faults.ledger import query_rows

MiB = 2**20
Bound = Literal["retention", "models", "deleted models", "requests"]
"""What bounds a size: limits of age, size and number, or the models that exist; or, if it grows, what it grows with."""
WARM_UP = 2
"""Periods at the start until the limits of age are reached."""
TOLERANCE = 1.25
"""Factor by which a bounded size may vary."""
BYTES = """SELECT coalesce(m.tbl_name, s.name), sum(s.pgsize) FROM dbstat s LEFT JOIN sqlite_master m ON m.name = s.name
GROUP BY 1"""
TABLES = "SELECT name FROM sqlite_master WHERE type = 'table'"
GROWS: dict[str, tuple[Bound, float]] = {
    "rows in table deleted_models": ("deleted models", 1.0),
    "bytes in table deleted_models": ("deleted models", 200.0),
    "bytes of the log": ("requests", 500.0),
}
"""Sizes that grow, with what, and by how much for each. All others are bounded."""
LIMITS: dict[str, Callable[[Mapping[str, float]], float]] = {
    "rows in table alias_moves": lambda sizes: KEPT_MOVES * sum(sizes[f"rows in table {of}"] for of in ALIASES),
}
"""Max sizes that a year may not reach: it shows that they grow to these limits, and no further."""
ALIASES = ("aliases", "serving")
COUNTS = ("acknowledged rows", "deleted models", "requests")
"""Numbers that grow by what clients do."""
OF_MODELS = frozenset(
    f"{what} in table {table}"
    for what in ("rows", "bytes")
    for table in ("models", "versions", "learners", "serving", "aliases", "learning", "datasets", "robots")
) | {"series of /metrics", "files in versions/", "bytes in versions/", "files in datasets/", "bytes in datasets/"}
"""Sizes that are bounded by the number of models and of versions that their owners keep."""


class Slack(NamedTuple):
    """By how much a bounded size may grow at least, by the first word of its name."""

    rows: float = 30
    bytes: float = 1.5 * MiB
    files: float = 20
    series: float = 200
    threads: float = 10
    descriptors: float = 20
    memory: float = 60 * MiB
    processes: float = 2


SLACK = Slack()._asdict()


def bound_of(name: str) -> Bound:
    """Return what bounds a size, or with what it grows."""
    return GROWS[name][0] if name in GROWS else ("models" if name in OF_MODELS else "retention")


def measure(home: Path, temporary: Path, pid: int, log: Path, metrics: str) -> dict[str, float]:
    """Return every size of a service: rows and bytes of tables, files, processes, series.

    temporary: folder of its temporary files.
    """
    found: dict[str, float] = {f"bytes in table {name}": size for name, size in query_rows(home, BYTES)}
    for (table,) in query_rows(home, TABLES):
        found[f"rows in table {table}"] = query_rows(home, f'SELECT count(*) FROM "{table}"')[0][0]
    for folder in (temporary, *(each for each in home.iterdir() if each.is_dir())):
        files = [each for each in folder.rglob("*") if each.is_file()]
        found[f"files in {folder.name}/"] = len(files)
        found[f"bytes in {folder.name}/"] = sum(_size(each) for each in files)
    for file in home.glob("lipserve.sqlite3*"):
        found[f"bytes of {file.name}"] = _size(file)
    found["bytes of the log"] = _size(log)
    found["series of /metrics"] = sum(not line.startswith("#") for line in metrics.splitlines())
    own, others = [pid], _descendants(pid)
    found["processes"] = 1 + len(others)
    for name, pids in (("service", own), ("its processes", others)):
        found[f"threads of {name}"] = sum(_count(each, "task") for each in pids)
        found[f"descriptors of {name}"] = sum(_count(each, "fd") for each in pids)
    found["memory of service and processes"] = memory_bytes(pid)
    return found


def find_growth(periods: Sequence[Mapping[str, float]]) -> list[str]:
    """Return the sizes that grow without a bound: the later periods exceed the earlier ones, without the warm-up.

    Both median and max of the halves count: either is larger in one half by chance, with the number of processes.
    """
    middle = (WARM_UP + len(periods) + 1) // 2
    earlier, later = periods[WARM_UP:middle], periods[middle:]
    if not earlier or not later:
        return []
    found = []
    for name in later[-1]:
        if name in COUNTS:
            continue
        if name in GROWS:
            cause, each = GROWS[name]
            more, allowed = (later[-1][of] - earlier[0][of] for of in (name, cause))
            if more > each * allowed + SLACK[name.split()[0]]:
                found.append(f"{name} grows by {more:g}, with {allowed:g} {cause}")
            continue
        if name in LIMITS:
            limit = LIMITS[name](later[-1]) + SLACK["rows"]
            if later[-1][name] > limit:
                found.append(f"{name} is {later[-1][name]:g}, but is bounded by {limit:g}")
            continue
        first, last = ([each.get(name, 0.0) for each in part] for part in (earlier, later))
        pairs = [(statistic(first), statistic(last)) for statistic in (median, max)]
        if all(after > max(TOLERANCE * before, before + SLACK[name.split()[0]]) for before, after in pairs):
            before, after = pairs[-1]
            found.append(f"{name} grows from {before:g} to {after:g}, but is bounded by {bound_of(name)}")
    return found


def format_table(periods: Sequence[Mapping[str, float]], days: Sequence[int], most: int = 12) -> str:
    """Return the sizes as a table: a line for each size, a column for each of at most `most` periods."""
    step = max(-(-len(periods) // most), 1)
    shown = sorted(range(len(periods) - 1, -1, -step))
    lines = [f"{'size':42}{'bounded by':>16}" + "".join(f"{f'day {days[place]}':>11}" for place in shown)]
    for name in sorted({name for each in periods for name in each}):
        scale = MiB if name.startswith(("bytes", "memory")) else 1
        values = [periods[place].get(name, 0.0) / scale for place in shown]
        if not any(values):
            continue
        unit = ", MiB" if scale > 1 else ""
        bound = "" if name in COUNTS else bound_of(name)
        lines.append(f"{name + unit:42}{bound:>16}" + "".join(f"{value:11.4g}" for value in values))
    return "\n".join(lines)


def _size(file: Path) -> int:
    return _or_zero(lambda: file.stat().st_size)


def _count(pid: int, what: str) -> int:
    return _or_zero(lambda: len(list(Path(f"/proc/{pid}/{what}").iterdir())))


def _or_zero(read: Callable[[], int]) -> int:
    """Return a number, 0 if the file or process has ended meanwhile."""
    try:
        return read()
    except OSError:
        return 0


def _descendants(pid: int) -> list[int]:
    found = children(pid)
    return [*found, *(each for child in found for each in _descendants(child))]
