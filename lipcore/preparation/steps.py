"""The record of a preparation: JSON objects, each with `step`, its parameters and `text`, a sentence for people."""

from __future__ import annotations

from typing import Any

from lipcore.preparation.filtering import Filters

Step = dict[str, Any]


def describe_rows_left_out(why: str, rows: int, first: int) -> Step:
    """Return the step of rows left out, the first of them counted from 1. why: as below."""
    reason = {
        "missing": "with missing values",
        "corrupt": "inconsistent with neighbouring rows",
        "braked": "with closed brakes",
        "repeated": "with a repeated time stamp",
    }[why]
    text = f"{_count(rows, 'row')} {reason} left out, the first is row {first}"
    return {"step": "leave_out", "why": why, "rows": rows, "first_row": first, "text": text}


def describe_episode_split(episodes: int) -> Step:
    """Return the step that separates episodes."""
    return {"step": "split", "by": "episode", "episodes": episodes, "text": f"{episodes} episodes kept separate"}


def describe_gap_split(gaps: int, longer_than_s: float) -> Step:
    """Return the step that splits a recording at gaps in time."""
    text = f"split at {_count(gaps, 'gap')} in time"
    return {"step": "split", "by": "gap", "gaps": gaps, "longer_than_s": longer_than_s, "text": text}


def describe_resampling(rate: float, worst: float, bridged_s: float) -> Step:
    """Return the step that replaces uneven stamps by an even clock. bridged_s: longest step that is no gap."""
    text = f"resampled to an even {rate:.4g} Hz: time steps deviated from the usual one by up to {worst:.0%}"
    return {
        "step": "resample",
        "rate_hz": rate,
        "method": "akima",
        "worst_deviation": worst,
        "longest_step_s": bridged_s,
        "text": text,
    }


def describe_low_pass(work: Filters, delay_s: float) -> Step:
    """Return the step of a Butterworth filter, run both ways or, as in a live stream, forwards only."""
    late = "without delay" if work.form == "acausal" else f"as in a live stream, with a delay of {delay_s:.3g} s"
    return {
        "step": "low_pass",
        "quantities": list(work.low_passed),
        "cutoff_hz": work.cutoff,
        "form": work.form,
        "rate_hz": work.rate,
        "delay_s": delay_s,
        "text": f"{', '.join(work.low_passed)} low-passed at {work.cutoff:g} Hz {late}",
    }


def describe_differentiation(work: Filters) -> Step:
    """Return the step that derives velocities or accelerations."""
    text = f"{' and '.join(work.derived)} derived by central differences"
    return {"step": "differentiate", "derived": list(work.derived), "rate_hz": work.rate, "text": text}


def describe_trimming(work: Filters, samples: int) -> Step:
    """Return the step that cuts off the ends of parts, and parts too short to use."""
    where = "at the filter's edges" if work.cutoff is not None else "at the ends of parts"
    return {
        "step": "trim",
        "first": work.edges[0],
        "last": work.edges[1],
        "shortest_part": work.shortest,
        "samples": samples,
        "text": f"{_count(samples, 'sample')} cut off {where}",
    }


def describe_thinning(work: Filters, rate: float) -> Step:
    """Return the step to a lower rate."""
    return {"step": "thin", "rate_hz": rate, "every": work.every, "text": f"thinned to {rate:.4g} Hz"}


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
