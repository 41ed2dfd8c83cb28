"""Imported by the fork server of `cage` before it forks: the readers of recordings."""

import os
from contextlib import suppress

from service.runtime.confinement import ENVIRONMENT
from service.runtime.remote import import_without_gc

os.environ |= ENVIRONMENT
with suppress(Exception):  # the confined process reports a failed import
    import_without_gc("service.datasets.caged").warm()
