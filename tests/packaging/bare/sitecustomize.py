"""Hides packages. Python imports this at its start, from PYTHONPATH.

LIPSERVE_TEST_HIDDEN: their modules, separated by commas. Spawned processes inherit it.
"""

import os

from hiding import hide

hide(*filter(None, os.environ.get("LIPSERVE_TEST_HIDDEN", "").split(",")))
