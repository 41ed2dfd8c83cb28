"""Print a version: its verdict, its fit and its arm."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from service.cli.consoles import echo, out, print_warnings
from service.cli.wording import in_shell
from service.foundation.text import counted

if TYPE_CHECKING:
    from lipserve.records.models import Selection
    from lipserve.records.verdicts import Verdict
    from lipserve.results.arm import Version


def print_selection(selection: Selection) -> None:
    """Print the comparison of estimators and the one that was selected."""
    from service.cli.tables import selection_table  # noqa: PLC0415 - slow import, not needed for help

    out.print(selection_table(selection))
    echo(f"  selected {selection.chosen}: {selection.reason}")
    if selection.held_out.repeats:
        echo("  held-out motion repeats training motion: figures are too optimistic, except at the edge")


def print_verdict(title: str, verdict: Verdict) -> None:
    """Print a verdict: figures joint by joint, then its level, why, and what to do."""
    from service.cli.tables import verdict_table  # noqa: PLC0415 - slow import, not needed for help

    if verdict.joints:
        out.print(verdict_table(title, verdict))
    echo(f"{verdict.label}: {in_shell(verdict.reason)}")
    if verdict.level != "usable":
        echo(f"  {in_shell(verdict.action)}")


def print_judged(version: Version) -> None:
    """Print the verdict on a version, and why it does not serve although it is usable."""
    held: dict[str, Any] = version.lineage.get("holdout") or {}
    samples = held.get("samples", 0)
    print_verdict(counted(samples, "held-out sample") if samples else "verdict by joint", version.verdict)
    if held.get("learnt"):
        echo("  Evaluated on held-out rows; the version was then trained on all rows.")
    if (curve := held.get("learning_curve")) is not None:
        echo(f"  {curve['text']}")
    promotion = version.promotion
    if promotion is not None and not promotion.answers and version.verdict.serves:
        print_warnings([promotion.reason])


def _print_guarantee(conformal: dict[str, Any]) -> None:
    """Print the coverage that cross-conformal calibration guarantees."""
    least, widest = min(conformal["guaranteed"]), max(conformal["scale"])
    blocks = "1 block" if conformal["blocks"] == 1 else f"{conformal['blocks']} blocks"
    wider = "not widened" if widest == 1 else f"widened up to {widest:.2f} times"
    few = "; more blocks would guarantee 95 %" if least < 0.95 - 1e-9 else ""
    echo(f"  intervals {wider}: {blocks} left out in turn guarantee coverage {100 * least:.0f} % on such motion{few}")


def print_of_joints(version: Version) -> None:
    """Print what the fit reports joint by joint."""
    joints = {
        "right_angle_": "probability that the axis is at a right angle",
        "local_": "remaining squared error after local correction",
        "widened_": "factor on interval width from held-out data",
        "zero_": "zero position in degrees (mm)",
    }
    for prefix, text in joints.items():
        numbered = ((key.removeprefix(prefix), value) for key, value in version.fit.items() if key.startswith(prefix))
        found = {int(number): value for number, value in numbered if number.isdecimal()}  # not `local_nats`
        if found:
            echo(f"  {text}: {', '.join(f'{version.joint_names[j - 1]} {found[j]:.2g}' for j in sorted(found))}")


def print_version(version: Version) -> None:
    """Print a version with its verdict and its arm."""
    names = version.joint_names
    echo(f"version {version.version}: {version.estimator}, {counted(len(names), 'joint')}: {', '.join(names)}")
    noise = ", ".join(f"{value:.3g}" for value in version.noise_std)
    echo(f"  torque {version.torque_convention.replace('_', ' ')}, measurement noise {noise} N·m")
    if version.selection is not None:
        print_selection(version.selection)
    lineage: dict[str, Any] = version.lineage
    sets = [each.get("name") or each.get("id") for each in lineage.get("datasets") or () if isinstance(each, dict)]
    if sets:
        echo(f"  trained on {', '.join(map(str, sets))}")
    if (independent := version.fit.get("independent_samples")) is not None:
        echo(f"  {counted(version.fit['samples_given'], 'sample')}, {round(independent):,} effective")
    if version.conformal is not None:
        _print_guarantee(version.conformal)
    if (arms := version.fit.get("arms")) is not None:
        echo(f"  {arms} arms on one base, independent of each other")
    if (fixed := version.fit.get("fixed_joints")) is not None:
        echo(f"  fixed at zero, as the data lack them: {fixed}")
    if (followed := version.fit.get("followed_joints")) is not None:
        echo(f"  by the URDF, {followed}")
    print_of_joints(version)
    print_judged(version)
    print_warnings(version.warnings)
    arm = version.arm
    if arm is not None:
        from lipserve.results.arm import LIMITS  # noqa: PLC0415
        from service.cli.tables import arm_tables  # noqa: PLC0415 - as above

        for table in arm_tables(arm):
            out.print(table)
        for text in LIMITS:
            echo(text)
