"""Checks of a query and its answer that every transport makes, with one wording."""

from __future__ import annotations

from math import isfinite

import numpy as np
from numpy.typing import NDArray

from service.foundation.errors import invalid_request

Array = NDArray[np.float64]


def element(name: str, *place: int | np.intp) -> str:
    """Name one number of an array, as in `q[0][3]`."""
    return name + "".join(f"[{index}]" for index in place)


def one_choice(version: int | None, alias: str | None) -> None:
    """Raise InvalidRequestError where a version is named by its number and by an alias."""
    if version is not None and alias is not None:
        raise invalid_request("alias", alias, f"no alias beside the version, {version}: name one of the two")


def positions(q: Array, limit: float) -> None:
    """Raise InvalidRequestError where a position is beyond ±limit. q: (n,) or (N, n) rad or m, finite."""
    size = np.abs(q)
    if size.max() > limit:
        place = np.unravel_index(size.argmax(), q.shape)
        expected = f"radians (or metres) within ±{limit:g}: are these degrees?"
        raise invalid_request(element("q", *place), f"{q[place]:g}", expected)


def answer(name: str, values: Array) -> None:
    """Raise InvalidRequestError where a number of an answer, of any shape, is not finite."""
    if isfinite(np.vdot(values, values)):  # at one query a third of what np.isfinite takes
        return
    wrong = np.argwhere(~np.isfinite(values))
    if len(wrong):  # else their squares alone are beyond numbers
        place = tuple(wrong[0])
        expected = "a finite number: are dq in rad/s and ddq in rad/s²?"
        raise invalid_request(element(name, *place), f"{values[place]:g}", expected)
