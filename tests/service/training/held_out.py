"""A recording of 120 rows whose last 30 % are held out, and its record in a lineage."""

ROWS = 120
ENTRY = {"id": "ds_1", "sha256": "s", "whole": False, "guard": 0.25, "guard_unit": "s", "rows": 34, "guarded": 4}
HOLDOUT = {"split": {"share": 0.3}, "datasets": [ENTRY], "rows": 34, "guarded": 4, "nmse": [0.1]}
