"""Sentences for people about evaluations and comparisons of versions."""

from __future__ import annotations


def describe_too_little(blocks: int, block_s: float, least: int) -> str:
    """Return the verdict that data are too short. blocks: number of segments of `block_s` seconds, or of episodes."""
    return (
        f"The data are too short for a verdict: they have {blocks} segments of {block_s:g} s (or episodes), and at "
        f"least {least} are needed. Record longer, or record more episodes."
    )


def describe_better(better: int, worse: int, amount: str) -> str:
    """Return the verdict for one version. amount: difference of the log density, with its interval."""
    return (
        f"Version {better} predicts better than version {worse}: its negative log predictive density is lower by "
        f"{amount} nats per sample (95 % interval)."
    )


def describe_no_difference(first: int, second: int, amount: str) -> str:
    """Return the verdict that neither version is better."""
    return (
        f"Versions {first} and {second} do not differ significantly: their negative log predictive densities differ by "
        f"{amount} nats per sample (95 % interval)."
    )


def describe_equal_errors(amount: str) -> str:
    """State that errors do not differ."""
    return f"Their mean nMSE differs by {amount}, which is not significant."


def describe_errors(version: int, smaller: bool, amount: str) -> str:
    """Return whether the errors of a version are smaller or larger than those of the other."""
    size, side = ("smaller", "lower") if smaller else ("larger", "higher")
    return f"The errors of version {version} are {size}: its mean nMSE is {side} by {amount}."


BETTER_UNCERTAINTY = "It is better because its stated uncertainty is more accurate."


def describe_trained_on(version: int) -> str:
    """Return the warning that a version was trained on the data."""
    return f"Version {version} was trained on this data set, so its figures are too optimistic."


def describe_learnt_online(version: int, revision: int) -> str:
    """Return the warning that a version may have learnt the data online."""
    return (
        f"Version {version} has learnt online, up to revision {revision}. If it has learnt this motion, its figures "
        "are too optimistic."
    )


def describe_unknown_repetition(error: object) -> str:
    """Return the warning that training data cannot be read, so that repetition is unknown."""
    return f"It is unknown whether these samples repeat the training motion: {error}."
