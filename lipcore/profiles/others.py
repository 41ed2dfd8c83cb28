"""Arms that example-robot-data alone describes: there is a profile where that package is installed."""

from __future__ import annotations

from dataclasses import replace

from lipcore.profiles.sheet import Sheet
from lipcore.robots import ROBOTS

_URDF = "URDF of example-robot-data"
_SAY = "Say what the effort of your recordings is with `effort`."
_BAXTER = (
    "The effort that its springs' deflection measures, gravity included. Commanded torque is added to the robot's own "
    "gravity compensation: upload it as `commanded`."
)
_TOY = "A small test rig: what its effort is depends on your drives. " + _SAY


def _sheet(name: str, title: str, effort_note: str = _SAY, measured: bool = False) -> Sheet:
    return Sheet(title, ROBOTS[name].free, "measured" if measured else "unknown", effort_note, _URDF)


OTHERS: dict[str, Sheet] = {
    "baxter-left": _sheet("baxter-left", "Rethink Baxter, left arm", _BAXTER, measured=True),
    "baxter-right": _sheet("baxter-right", "Rethink Baxter, right arm", _BAXTER, measured=True),
    "pr2-left": _sheet("pr2-left", "Willow Garage PR2, left arm"),
    "pr2-right": _sheet("pr2-right", "Willow Garage PR2, right arm"),
    "talos-left": _sheet("talos-left", "PAL TALOS, left arm without its first joint"),
    "tiago": _sheet("tiago", "PAL TIAGo, lift and arm"),
    "tiago-pro-left": _sheet("tiago-pro-left", "PAL TIAGo Pro, left arm"),
    "tiago-pro-right": _sheet("tiago-pro-right", "PAL TIAGo Pro, right arm"),
    "double-pendulum": _sheet("double-pendulum", "Double pendulum", _TOY),
    "asr-twodof": _sheet("asr-twodof", "Two-joint arm of ASR", _TOY),
    "finger-edu": replace(
        _sheet("finger-edu", "FingerEdu of the Open Dynamic Robot Initiative", _TOY),
        source=f"{_URDF} for the ranges; its limits of speed and torque, 1000, are placeholders and left out",
        placeholders=True,
    ),
}
