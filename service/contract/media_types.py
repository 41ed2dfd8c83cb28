"""File types that can be uploaded."""

from __future__ import annotations

MEDIA_TYPES = {
    "text/csv": "csv",
    "application/x-npz": "npz",
    "application/vnd.apache.parquet": "parquet",
    "application/x-ndjson": "json_lines",
    "application/json": "json",
    "application/x-rosbag2": "rosbag2",
    "application/x-rosbag": "rosbag1",
    "application/x-mcap": "mcap",
    "application/zip": "zip",
    "application/vnd.apache.arrow.file": "feather",
    "application/x-hdf5": "hdf5",
    "application/x-matlab-data": "mat",
    "application/x-npy": "npy",
    "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet": "xlsx",
    "application/yaml": "yaml",
    "application/gzip": "gzip",
    "application/zstd": "zstd",
}
"""File type by media type. A zip holds a LeRobot or rosbag2 directory, text tables to be joined, or one file."""
SUFFIXES = {
    ".csv": "csv",
    ".tsv": "csv",
    ".txt": "csv",
    ".npz": "npz",
    ".parquet": "parquet",
    ".pq": "parquet",
    ".ndjson": "json_lines",
    ".jsonl": "json_lines",
    ".json": "json",
    ".db3": "rosbag2",
    ".bag": "rosbag1",
    ".mcap": "mcap",
    ".zip": "zip",
    ".feather": "feather",
    ".arrow": "feather",
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".mat": "mat",
    ".npy": "npy",
    ".xlsx": "xlsx",
    ".yaml": "yaml",
    ".yml": "yaml",
    ".gz": "gzip",
    ".zst": "zstd",
}
"""File type by suffix."""
_FIRST = {kind: media_type for media_type, kind in reversed(MEDIA_TYPES.items())}
MEDIA_TYPE_OF = {suffix: _FIRST[kind] for suffix, kind in SUFFIXES.items()}
"""Media type by suffix, for clients."""
