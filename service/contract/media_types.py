"""Kinds of files that can be uploaded."""

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
}
"""Kind of a file by its media type. A zip is a directory of LeRobot or of a rosbag2, or tables of text to be joined."""
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
}
"""Kind of a file by the ending of its name."""
_FIRST = {kind: media_type for media_type, kind in reversed(MEDIA_TYPES.items())}
MEDIA_TYPE_OF = {suffix: _FIRST[kind] for suffix, kind in SUFFIXES.items()}
"""Media type by the ending of a file's name, for clients."""
