"""Answers of a compact posterior, compiled: what serving runs for every query."""

from lipcore.evaluator.evaluator import Evaluator

__all__ = ["Evaluator"]
