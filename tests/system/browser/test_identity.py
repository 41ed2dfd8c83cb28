"""Visual identity: joint colours that are distinguishable and equal in plots and pages, and text sizes."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.system.browser.conftest import Dashboard, Visit

if TYPE_CHECKING:
    from numpy.typing import NDArray

SIGHT = {
    "usual": np.eye(3),
    "no red": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "no green": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "no blue": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
"""Linear RGB as seen without one kind of cones: Machado, Oliveira and Fernandes (2009), severity 1."""
TO_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
TO_OKLAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)
"""Linear RGB to Oklab by cube roots of cone responses: Ottosson (2020). Distances approximate perception."""
APART = 0.075
"""Min distance of two colours in Oklab: that of the closest pair of Okabe and Ito's eight."""
CONTRAST = 3.0
"""Min contrast of lines with their background: WCAG 2.2, 1.4.11."""


def linear(colour: str) -> NDArray[np.float64]:
    """Linear RGB of #rrggbb."""
    value = np.array([int(colour[at : at + 2], 16) for at in (1, 3, 5)]) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def oklab(rgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """Oklab of linear RGB."""
    return TO_OKLAB @ np.cbrt(TO_CONES @ np.clip(rgb, 0, 1))


def luminance(colour: str) -> float:
    """Relative luminance as WCAG defines it."""
    return float(linear(colour) @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_joint_colours_are_distinguishable_if_colour_blind(windows: Visit, dashboard: Dashboard, scheme: str) -> None:
    page = windows(dashboard.server.url, scheme=scheme).open("#/models")
    joints, surface, seen = page.evaluate("""async () => {
      const { css, jointColour, jointVar, JOINT_COLOURS } = await import("/dashboard/colours.js");
      const each = Array.from({ length: JOINT_COLOURS }, (_, index) => index);
      const shown = (index) => {
        const probe = document.createElement("i");
        probe.style.color = jointVar(index);
        document.body.append(probe);
        return getComputedStyle(probe).color;
      };
      return [each.map(jointColour), css("surface"), each.map(shown)];
    }""")
    assert len(set(joints)) == 8
    assert seen == [f"rgb({int(c[1:3], 16)}, {int(c[3:5], 16)}, {int(c[5:], 16)})" for c in joints]
    for sight, left in SIGHT.items():
        for one, other in combinations(joints, 2):
            distance = np.linalg.norm(oklab(left @ linear(one)) - oklab(left @ linear(other)))
            assert distance >= APART, f"{one} and {other}, {sight}"
    for colour in joints:
        dim, bright = sorted([luminance(colour), luminance(surface)])
        assert (bright + 0.05) / (dim + 0.05) >= CONTRAST, colour


SCALE = {14, 15, 16, 18, 24}
"""Sizes of the dashboard's text, px."""
SIZES = """() => {
  const said = [...document.querySelectorAll("body *")].filter((each) => !each.closest("svg, .js-plotly-plot, option")
    && each.checkVisibility() && [...each.childNodes].some((child) => child.nodeType === 3 && child.data.trim()));
  return said.map((each) => [parseFloat(getComputedStyle(each).fontSize), each.outerHTML.slice(0, 100)]);
}"""


def test_text_sizes_belong_to_one_scale(windows: Visit, dashboard: Dashboard) -> None:
    visitor = windows(dashboard.server.url)
    pages = ["#/", "#/data", f"#/data/{dashboard.dataset['id']}", "#/jobs", "#/train", "#/models", "#/live"]
    for route in [*pages, f"#/models/{dashboard.model}?tab=lineage", f"#/live/{dashboard.model}"]:
        odd = [each for each in visitor.open(route).evaluate(SIZES) if each[0] not in SCALE]
        assert odd == [], route
