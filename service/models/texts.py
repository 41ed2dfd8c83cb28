"""Sentences for people about versions of models."""

from __future__ import annotations


def describe_correction(dataset: str) -> str:
    """Return what to do about a fault of the training data."""
    return f"Read data set {dataset} again with the correction, then train again."


def describe_other_reading(dataset: str) -> str:
    """Return what to do about a fault of the data of an evaluation."""
    return f"Read data set {dataset} again with the correction, then evaluate again."


def describe_verdict(label: str, reason: str) -> str:
    """Return a verdict: its level in words, and why."""
    return f"{label[0].upper()}{label[1:]}. {reason}"


def describe_refusal(version: int, verdict: str) -> str:
    """Return why an alias does not move to a version."""
    return f"Version {version} is not usable. {verdict} To move the alias anyway, add `override=true`."
