"""The servers that several services share, as tests/cluster has them."""

from tests.cluster.conftest import postgres, s3, shared

__all__ = ["postgres", "s3", "shared"]
