"""Sentences for people about a model: warnings about a version, and reasons of its acceptance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

MAX_LISTED_JOINTS = 8
"""Max joints named in a sentence."""


def _cut(items: Sequence[str]) -> Sequence[str]:
    return [*items[:MAX_LISTED_JOINTS], "…"] if len(items) > MAX_LISTED_JOINTS else items


def list_joints(items: Sequence[str], separator: str = ", ") -> str:
    """Return the items as one list, cut after MAX_LISTED_JOINTS."""
    return separator.join(_cut(items))


def list_with_and(items: Sequence[str]) -> str:
    """Return the items as one list with "and" before the last."""
    return " and ".join(", ".join(items).rsplit(", ", 1))


def describe_failed_fit(error: str) -> str:
    """Return the warning that the final fit failed."""
    return f"The final fit, on all rows, failed ({error}). The model has not learnt the held-out rows."


def describe_dependent_motion(dimensions: float, joints: int) -> str:
    """Return the warning that joints moved together, in fewer independent dimensions than there are joints."""
    return (
        f"The joints moved together: {joints} joints moved like {dimensions:.1f} independent ones. Errors on other "
        "motions may be larger than tau_std states. Record motion in which each joint moves independently."
    )


STANDSTILL = (
    "The robot stood still in the recording. The model knows gravity at positions like the recorded ones. In motion it "
    "answers with gravity, and tau_std includes unknown friction and inertia."
)
"""Warning that no joint moved."""


def describe_search_limit(seconds: float) -> str:
    """Return the warning that the search for the geometry ended early."""
    return (
        f"The search for the geometry stopped after {seconds:g} s of processor time (`search_seconds`). A longer "
        "search may find a better geometry."
    )


def describe_unmodelled_torque(has_correction: bool) -> str:
    """Return the warning that rigid bodies do not explain the torque. has_correction: whether a kernel helps them."""
    text = "The error of the rigid bodies is larger than the sensor noise: the torque has other causes, too."
    return text if has_correction else f"{text} Compare with rigid-body+lip-chain."


def describe_unidentifiable(parameters: Mapping[str, Sequence[str]], calibrated: bool) -> str:
    """Return the warning about unidentifiable parameters, by joint. calibrated: whether there is a prior arm."""
    values = "keep the values of the URDF or the base" if calibrated else "are guesses"
    listed = list_joints([f"{joint}: {', '.join(each)}" for joint, each in parameters.items()], "; ")
    count = sum(map(len, parameters.values()))
    return f"{count} geometry parameters are not identifiable from this recording. They {values} ({listed})."


def describe_gains(errors: Mapping[str, tuple[float, float]]) -> str:
    """Return the warning about gains, by joint: mean and standard deviation of the error, as shares of the torque."""
    listed = [
        f"{joint} reads {100 * abs(mean):.0f} ± {100 * std:.0f} % too {'high' if mean > 0 else 'low'}"
        for joint, (mean, std) in errors.items()
    ]
    return f"The torque does not fit the masses: {list_joints(listed)}. Check the torque constants or sensors."


def describe_mounting(position: str) -> str:
    """Return the warning about the position of the base. position: of `lipcore.arm.mounting.POSITIONS`."""
    return f"The recording shows the robot {position}, not as in the URDF. The model follows the recording."


def describe_tilt(mean: float, std: float) -> str:
    """Return the warning about the tilt of the base, degrees."""
    return f"The base is tilted by {mean:.1f} ± {std:.1f}° from the URDF. Check how the robot is mounted."


def describe_zeros(zeros: Mapping[str, tuple[float, float]]) -> str:
    """Return the warning about zeros of joints: mean and standard deviation by joint, degrees."""
    listed = list_joints([f"{joint} by {mean:.1f} ± {std:.1f}°" for joint, (mean, std) in zeros.items()])
    return f"The zero position differs from the URDF: {listed}. Check the calibration of the joints."


def describe_fallback(joints: Sequence[str], factor: float) -> str:
    """Return the warning about joints that fall back at `factor` times the range and speed of the recording."""
    listed = list_with_and(_cut(joints))
    return (
        f"At {factor:g} times the recorded range and speed, the torque of {listed} falls back to gravity and friction, "
        "as far as the recording identifies them. Record wider and faster motion to extend the model."
    )


def describe_alternatives(probabilities: Sequence[float], motion: str, difference: str, joint: str) -> str:
    """Return the warning about several arms. motion: would distinguish them, by a `difference` in torque at `joint`."""
    count = {2: "Two", 3: "Three", 4: "Four"}.get(len(probabilities), str(len(probabilities)))
    percent = list_with_and([f"{each:.0%}" for each in probabilities])
    return (
        f"{count} arms explain the recording about equally well (probabilities {percent}); tau_std includes their "
        f"difference. To distinguish them, record motion in which {motion}: at twice that, they differ by "
        f"{difference} in {joint}."
    )


NOTHING_HELD_OUT = "No samples were held out of its training, so its errors are unknown."
HOLD_OUT = "Evaluate it on another recording, or train with a held-out part."
NO_ROWS = "No stream has sent measured torque lately, so the present errors are unknown."
SEND_ROWS = "Send the measured torque with the motion."
JUDGED_ON_TRAINING = "It was trained on these samples, so its errors on other motion are unknown."
EVALUATE_OTHER = "Evaluate its held-out part or another recording."
NO_SIGNAL = "The torque of these samples is not larger than its noise, so the errors say nothing."
RECORD_FASTER = "Record faster and wider motion."
JUDGED_AT_REST = "Its errors in motion are unknown: the samples stand still."
UNKNOWN_RANGE = "Its errors outside the recorded range are unknown."
ONLY_PRESENT_MOTION = "It predicts the present motion; its errors on other motion are unknown."
CHECK_TORQUE = "Check sign, unit and order of the torque, then record more varied motion and train again."
RECORD_VARIED = "Record more varied motion and train again."
RECORD_MORE = "Record more motion of these joints and train again."
RECORD_LONGER = "Record longer and train again."
STAY_INSIDE = "Stay inside the recorded range, or record wider and faster motion."
NOTHING_TO_DO = "No action is needed."
LONG_AND_VARIED = "The recording moves long enough, and does not repeat itself."
RECORD_OTHER_MOTION = "Record other motion, too."
TRAIN = "Train a model to get its verdict."


def describe_large_error(joints: str) -> str:
    """Return that a model is no better than the mean torque on some joints."""
    return f"The errors are no smaller than with the mean torque: {joints}."


def describe_joint_error(rmse: float, mean: float, unit: str) -> str:
    """Return the error of one joint, and that of its mean torque."""
    return f"{rmse:.2g} {unit} RMSE (mean torque: {mean:.2g} {unit})"


def describe_narrow(joints: str) -> str:
    """Return that intervals are too narrow on some joints."""
    return f"The 95 % intervals are too narrow: {joints}."


def describe_joint_coverage(share: float, low: float, high: float, samples: float) -> str:
    """Return the coverage of one joint. low, high: its confidence interval; samples: effective ones."""
    ci = f"95 % CI {100 * low:.0f}–{100 * high:.0f} %"
    return f"{100 * share:.0f} % inside ({ci}, {samples:.0f} effective samples)"


def describe_wide(joints: str) -> str:
    """Return that intervals are no narrower than without a model on some joints."""
    return f"The 95 % intervals are no narrower than those of the mean torque: {joints}."


def describe_joint_width(width: float, mean: float, unit: str) -> str:
    """Return the width of the intervals of one joint, and of its mean torque."""
    return f"{width:.2g} {unit} wide (mean torque: {mean:.2g} {unit})"


def describe_few_samples(joints: str) -> str:
    """Return that too few samples are there to compare the error with that of the mean torque."""
    return f"Too few effective samples to judge the errors: {joints}."


def describe_short(seconds: float, least: float) -> str:
    """Return that the samples are too short to judge a model."""
    return f"Only {seconds:.2g} s can be judged, at least {least:g} s are needed."


def describe_periodic(period: float) -> str:
    """Return that a recording repeats its motion after a period, s."""
    return f"The motion repeats itself every {period:.2g} s, so errors on other motion stay unknown."


def describe_repeated(share: float) -> str:
    """Return that samples repeat the training motion."""
    return f"The errors are known only on repeated motion: {100 * share:.0f} % of the samples repeat the training."


def describe_few_outside(share: float, count: float) -> str:
    """Return that too few samples are outside the training range. count: effective samples there."""
    amount = f"{100 * share:.0f} % of the samples, {count:.0f} effective ones"
    return f"Its errors outside the recorded range are unknown: too few samples were outside it ({amount})."


def describe_worse_outside(joints: str) -> str:
    """Return that a model is wrong outside the training range on some joints."""
    return f"Outside the recorded range its errors or intervals are wrong: {joints}."


def describe_best(share: float | None, coverage: float) -> str:
    """Return the largest error of the joints, as a share of the torque range, and the smallest coverage."""
    error = "" if share is None else f"RMSE is at most {100 * share:.2g} % of the torque range and "
    return f"{error}coverage at least {100 * coverage:.0f} % on every joint"


def describe_usable(best: str) -> str:
    """Return why a model is usable. best: its figures."""
    return f"{best[0].upper()}{best[1:]}, inside and outside the recorded range."
