"""The tests, in folders like those of the product."""

import tarfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
"""The repository."""


def unpack(archive: tarfile.TarFile, folder: Path) -> None:
    """Unpack an archive of ours. Python before 3.11.4 has no filters, and ignores the attribute."""
    archive.extraction_filter = getattr(tarfile, "data_filter", None)
    archive.extractall(folder)
