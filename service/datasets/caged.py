"""Reading of uploads in a confined process, which `service.runtime.cage` starts."""

from __future__ import annotations

import sys
from contextlib import suppress
from importlib import import_module
from importlib.abc import MetaPathFinder
from pathlib import Path
from typing import Any

from lipcore.extras import import_extra
from lipcore.profiles import Profile
from service.datasets.formats.opening import open_table
from service.datasets.mapping.reading import Recording, read
from service.datasets.options import UploadOptions
from service.foundation.settings import Settings
from service.storage.disk import DiskBudget, Usage


def warm() -> None:
    """Import all readers before processes are forked; raise MissingExtraError if they are not installed."""
    sys.meta_path.insert(0, _WithoutPandas)
    types = ("rosbags.typesys.stores.ros1_noetic", "rosbags.typesys.stores.ros2_humble")
    for name in ("numpy.ma", "encodings.utf_8_sig", "dateutil.relativedelta", *types):
        with suppress(ImportError):
            import_module(name)
    import_extra("pyarrow", "ingest")
    for name in ("csv", "parquet", "feather", "bags.reading", "lerobot", "joined", "arrays", "workbook"):
        import_extra(f"service.datasets.formats.{name}", "ingest")
    # the first call of an Arrow function takes 50 ms to find it: once here, not in each forked process
    cells = import_module("service.datasets.formats.cells")
    text = import_module("pyarrow").array(["1", "1.5", "a"])
    cells.plan_cells("", text[2:], True, 10)
    cells.NumberCells("", decimal_comma=True).read(text[:2], 1)


class _WithoutPandas(MetaPathFinder):
    """Import hook that hides pandas: Arrow would import it without need, which takes 0.5 s."""

    @staticmethod
    def find_spec(fullname: str, *_: Any) -> None:
        """Raise ModuleNotFoundError for pandas; leave other modules to other finders."""
        if fullname == "pandas":
            raise ModuleNotFoundError(fullname, name=fullname)


def read_upload(
    upload: Path,
    kind: str,
    options: UploadOptions,
    robot: Profile | None,
    usage: Usage,
    folder: Path,
    settings: Settings,
) -> Recording:
    """Read an upload to columns in a folder; raise as `open_table` and `read` do. usage: of the disk before reading."""
    with open_table(upload, kind, options.read, settings) as table:
        made = read(table, folder, options, robot, settings, DiskBudget(usage))
    return Recording(made.staged.joint_names, made.staged.lengths, made.torque_convention, made.facts, made.noted)
