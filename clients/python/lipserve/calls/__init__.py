"""Every route of the API as a function that makes a call of it."""

from lipserve.calls import datasets, inference, learning, models

__all__ = ["datasets", "inference", "learning", "models"]
