"""Every route of the API as a function that makes a call of it."""

from service.client.calls import datasets, inference, jobs, learning, models, server

__all__ = ["datasets", "inference", "jobs", "learning", "models", "server"]
