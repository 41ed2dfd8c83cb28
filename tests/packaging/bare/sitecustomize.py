"""Hides the modules in LIPSERVE_TEST_HIDDEN, separated by commas.

Python imports this file from PYTHONPATH at its start; spawned processes inherit both variables.
"""

import os

from hiding import hide

hide(*filter(None, os.environ.get("LIPSERVE_TEST_HIDDEN", "").split(",")))
