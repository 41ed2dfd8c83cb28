"""The report of a data set for a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.table import Table

from service.datasets.schema import DatasetReport, JointExcitation, Weight

NOTHING = "–"


def overview(report: DatasetReport) -> Iterator[str]:
    """What was read and what was done to it, a sentence each."""
    yield from report.reading
    yield from report.preparation
    rate = NOTHING if report.rate_hz is None else f"{report.rate_hz:.4g} Hz"
    yield f"{report.rows:,} of {report.rows_uploaded:,} rows are samples, in {report.episodes} episodes, at {rate}"
    if (timing := report.timing) is not None and timing.jitter_p99 is not None:
        yield f"jitter: 99 % of the steps within {timing.jitter_p99:.1%} of the usual one; {report.gaps} gaps"


def tables(report: DatasetReport, joint_names: Sequence[str]) -> Iterator[Table]:
    """What is known of each joint: motion, torque, and what the data tell of it."""
    yield _joints(report, joint_names)
    if report.excitation is not None:
        yield _friction(report.excitation.joints)


def _joints(report: DatasetReport, joint_names: Sequence[str]) -> Table:
    table = Table("joint", "q", "|dq|", "|ddq|", "tau N·m", "noise N·m", "lag ms", "of range", title="signals")
    limits = {each.joint: each for each in report.limits or ()}
    noise = {each.joint: each for each in report.noise or ()}
    lag = {each.joint: each for each in report.lag or ()}
    for index, joint in enumerate(joint_names):
        low, high = ({name: each[side][index] for name, each in report.ranges.items()} for side in ("min", "max"))
        known = noise.get(joint)
        late = lag.get(joint)
        used = limits.get(joint)
        table.add_row(
            joint,
            f"{low['q']:.2f} … {high['q']:.2f}",
            *(f"{max(-low[name], high[name]):.3g}" for name in ("dq", "ddq")),
            f"{low['tau']:.3g} … {high['tau']:.3g}",
            _number(report.torque_noise_estimate[index] if known is None else known.torque),
            NOTHING if late is None or late.seconds is None else f"{1e3 * late.seconds:.1f}",
            NOTHING if used is None or used.range_used is None else f"{used.range_used:.0%}",
        )
    return table


def _friction(joints: Sequence[JointExcitation]) -> Table:
    table = Table("joint", "reversals", "viscous", "Coulomb", "offset", title="what the data tell of friction")
    for each in joints:
        table.add_row(each.joint, str(each.reversals), *map(_weight, (each.viscous, each.coulomb, each.offset)))
    return table


def _weight(weight: Weight) -> str:
    return weight.verdict if weight.std is None else f"{weight.verdict} (±{weight.std:.2g})"


def _number(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.3g}"
