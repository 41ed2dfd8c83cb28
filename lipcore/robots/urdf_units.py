"""URDFs in other units than m, kg and kg·m²: which units fit their bodies, and the same URDF in SI units."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, get_args
from xml.etree import ElementTree

import numpy as np

from lipcore.data.motion import Array
from lipcore.robots.urdf_text import NUMBERS, UrdfError

UrdfQuantity = Literal["length", "mass", "inertia"]
Scale = Mapping[UrdfQuantity, float]
"""Factors to SI units; those that are missing are one."""
UNITS = {
    **{"m": 1.0, "mm": 1e-3, "in": 0.0254, "kg": 1.0, "g": 1e-3, "lb": 0.45359237},
    **{"kg·m²": 1.0, "kg·cm²": 1e-4, "kg·mm²": 1e-6, "lb·in²": 2.9263965e-4},
    **{"g·m²": 1e-3, "g·cm²": 1e-7, "g·mm²": 1e-9},
}
"""Units with their factors to SI units."""
SYSTEMS = (
    *(("m", "kg", unit) for unit in ("g·mm²", "kg·mm²", "g·cm²", "kg·cm²")),
    *(("mm", "kg", unit) for unit in ("kg·m²", "kg·mm²", "g·mm²")),
    *(("m", "g", "kg·m²"), ("mm", "g", "g·mm²"), ("in", "kg", "kg·m²"), ("in", "lb", "lb·in²")),
)
"""Units of length, mass and inertia that are used together, the most usual ones first."""
MAX_REACH_M = 30.0
"""Max sum of the distances from joint to joint: no arm is longer."""
MAX_DENSITY = 25_000.0
"""Max density of a body, kg/m³: osmium has 22 590."""
TYPICAL_RADIUS = 0.3
"""Radius of gyration of a usual link, as a share of its length."""
MAX_ODDNESS = 2.5
"""Max factor between the usual radius of gyration and that of usual links, for units to be likely."""


def check_bodies(urdf: str, parse: Callable[[str], Any]) -> None:
    """Raise UrdfError if no body of its mass and size can have an inertia; zero inertia counts as missing.

    Principal moments I₁ ≤ I₂ ≤ I₃ about the centre of mass satisfy I₃ ≤ I₁ + I₂, with 5 % for rounding. The radius of
    gyration √(I₃/m) is within the robot's reach. Of all bodies of one mass and density a ball has the smallest
    I₁ + I₂ + I₃ = 6/5 m r². The message names units in which the bodies would be possible. parse: returns Pinocchio's
    model of a URDF.
    """
    fault = find_fault(parse(urdf))
    if fault is None:
        return
    for system in SYSTEMS:
        units = {name: unit for name, unit in zip(get_args(UrdfQuantity), system, strict=True) if UNITS[unit] != 1}
        scale: Scale = {name: UNITS[unit] for name, unit in units.items()}
        model = parse(scaled(urdf, scale))
        if find_fault(model) is None and _is_usual(model):
            text = ", ".join(f"{name} in {unit}" for name, unit in units.items())
            factors = ",".join(f"{name}={factor:g}" for name, factor in scale.items())
            raise UrdfError(f"{fault}. This fits {text}: set scale={factors}")
    raise UrdfError(fault)


def scaled(urdf: str, scale: Scale) -> str:
    """Return a URDF in SI units. urdf: the `plain` text of `urdf_text.read_urdf`. Raise UrdfError for another scale.

    Example:
        >>> scaled('<robot><link name="b"><inertial><mass value="5"/></inertial></link></robot>', {"mass": 0.1})
        '<robot><link name="b"><inertial><mass value="0.5" /></inertial></link></robot>'
    """
    for quantity, factor in scale.items():
        if quantity not in get_args(UrdfQuantity) or not 1e-12 <= factor <= 1e12:
            raise UrdfError(f"scale of {quantity} is {factor:g}, expected length, mass or inertia, from 1e-12 to 1e12")
    length, mass, inertia = (scale.get(quantity, 1.0) for quantity in ("length", "mass", "inertia"))
    root = ElementTree.fromstring(urdf)  # noqa: S314 - it was accepted by `read_urdf`, which rejects entities
    for element in root.iter():
        if element.tag == "origin":
            _multiply(element, ("xyz",), length)
        elif element.tag == "mass":
            _multiply(element, ("value",), mass)
        elif element.tag == "inertia":
            _multiply(element, tuple(NUMBERS["inertia"]), inertia)
    for limit in root.iterfind("./joint[@type='prismatic']/limit"):
        _multiply(limit, ("lower", "upper", "velocity"), length)
    return ElementTree.tostring(root, encoding="unicode")


def _multiply(element: ElementTree.Element, names: tuple[str, ...], factor: float) -> None:
    for name in names:
        if factor != 1.0 and (text := element.get(name)) is not None:
            element.set(name, " ".join(f"{factor * float(part):.12g}" for part in text.split()))


def find_fault(model: Any) -> str | None:
    """Return the first fault of a model's bodies, None if they are possible."""
    total = float(_steps(model).sum())
    if total > MAX_REACH_M:
        return f"the robot's links are {total:.3g} m long in all, expected at most {MAX_REACH_M:g} m"
    about = "expected kg·m² about its centre of mass"
    for name, inertia in tuple(zip(tuple(model.names), tuple(model.inertias), strict=True))[1:]:  # the base is first
        mass, moments = float(inertia.mass), np.linalg.eigvalsh(inertia.inertia)
        if mass <= 0 or moments[2] <= mass * 1e-6**2:
            continue
        body, reach = f"the body that joint {name!r} moves has", max(1.0, total)
        radius, ball = float(np.sqrt(moments[2] / mass)), float(np.sqrt(5 / 6 * moments.sum() / mass))
        if moments[2] > 1.05 * (moments[0] + moments[1]):
            listed = ", ".join(f"{each:.3g}" for each in moments)
            return f"{body} principal moments of inertia {listed}, expected none above the sum of the others"
        if radius > reach:
            return f"{body} a radius of gyration of {radius:.3g} m for a robot of {reach:.3g} m, {about}"
        if mass / (4 / 3 * np.pi * ball**3) > MAX_DENSITY:
            return f"{body} {mass:.3g} kg within {1e3 * ball:.2g} mm, denser than any metal; {about}, mass in kg"
    return None


def _steps(model: Any) -> Array:
    """Return the distances from joint to joint, m."""
    return np.array([float(np.linalg.norm(place.translation)) for place in tuple(model.jointPlacements)])


def _is_usual(model: Any) -> bool:
    """Return whether the usual radius of gyration is about that of usual links."""
    bodies = [(float(each.mass), float(np.linalg.eigvalsh(each.inertia)[2])) for each in tuple(model.inertias)[1:]]
    squares = [moment / mass for mass, moment in bodies if mass > 0 and moment > 0]
    steps = _steps(model)
    usual = TYPICAL_RADIUS * float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.1
    return bool(squares) and 1 / MAX_ODDNESS < float(np.sqrt(np.median(squares))) / usual < MAX_ODDNESS
