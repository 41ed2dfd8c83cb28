"""Functions that return the call of a route, one for each route of the API."""

from lipserve.calls import datasets, inference, learning, models

__all__ = ["datasets", "inference", "learning", "models"]
