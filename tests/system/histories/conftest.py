"""Servers that several services share, from tests/system/cluster."""

from tests.system.cluster.conftest import postgres, s3, shared

__all__ = ["postgres", "s3", "shared"]
