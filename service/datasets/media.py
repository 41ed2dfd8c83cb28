"""What an upload of a recording may be: kinds of files by media type and by the ending of their name."""

from __future__ import annotations

from typing import Any

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
"""Kind of a file by its media type. A zip is a directory: of LeRobot, or of a rosbag2."""
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

_BINARY = {"schema": {"type": "string", "format": "binary"}}
UPLOAD_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "A recording with at least positions, torques and times. Canonical columns are `t` (s), "
        "`q1..qn`, `dq1..`, `ddq1..`, `tau1..`, optional `episode`, in SI units; other names and units are recognised "
        "or declared by `columns` and `units`. `dq` and `ddq` may be absent and are then derived. NPZ holds `q`, `dq`, "
        "`ddq`, `tau` (N, n), `t` or `dt`, `episode`, `joint_names`; bags hold `sensor_msgs/JointState` or the states "
        "of a Franka; a zip is the directory of a LeRobot data set or of a rosbag2.",
        "content": {
            "text/csv": {"schema": {"type": "string"}, "example": "t,q1,dq1,ddq1,tau1\n0.0,0.1,0.0,0.2,1.5\n"},
            "application/x-ndjson": {
                "schema": {"type": "string"},
                "example": '{"t": 0.0, "q": [0.1], "dq": [0.0], "tau": [1.5]}\n',
            },
            **{kind: _BINARY for kind in MEDIA_TYPES if kind not in ("text/csv", "application/x-ndjson")},
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {
                        "file": {
                            "type": "string",
                            "format": "binary",
                            "description": f"A file whose name ends in {', '.join(SUFFIXES)}",
                        }
                    },
                }
            },
        },
    }
}
