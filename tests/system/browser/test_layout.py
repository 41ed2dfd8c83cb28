"""Check that no page overlaps or cuts texts, for arms with few and many joints, on desktop and phone, light and dark."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from itertools import cycle

import pytest

from tests.system.browser.accessibility import expect, layout_problems
from tests.system.browser.arms import CRANE, TURNTABLE, Arm, chain, library_arm
from tests.system.browser.axe import source, violations
from tests.system.browser.conftest import Dashboard, Visit
from tests.system.browser.robot import playing
from tests.system.browser.visitor import PHONE, Visitor

pytestmark = pytest.mark.journey

WIDE = (1440, 900)
RATE = 5.0
"""Rate of the streams, Hz."""
MODEL_TABS = ("accuracy", "parts", "arm", "versions", "lineage", "ask", "learning")
DATA_TABS = ("signals", "timing", "excitation", "friction", "preparation", "again")
BROKEN = {
    "overlap": ".tabs [role=tab] { margin-right: -3rem; }",
    "is cut": ".joint { max-width: 3rem; overflow: hidden; }",
    "reaches beyond the page": ".heading h1 { margin-left: -3rem; }",
    "px beyond": ".card p { margin-right: -3rem; }",
    "wider than the window": "main { width: 120vw; max-width: none; }",
}
"""Styles that break a page, by the problem that must be found."""


@pytest.fixture(scope="module")
def arms(dashboard: Dashboard) -> Iterator[list[Arm]]:
    """Models of six, one and twelve joints; those of six and twelve have two versions and stream."""
    client = dashboard.client
    made = [library_arm(client, "ur10", 2), chain(client, "turntable", TURNTABLE), chain(client, "crane", CRANE, 2)]
    with ExitStack() as streams:
        for arm in made:
            if arm.model != "turntable":
                rows = zip(*(getattr(arm.samples, name) for name in ("q", "dq", "ddq", "tau")), strict=True)
                streams.enter_context(playing(dashboard.server.url, arm.model, cycle(rows), RATE))
        yield made


def routes(arm: Arm) -> dict[str, str]:
    """Return the addresses of the pages of an arm."""
    return {
        **{f"data set {tab}": f"#/data/{arm.dataset}?tab={tab}" for tab in DATA_TABS},
        **{f"model {tab}": f"#/models/{arm.model}?tab={tab}" for tab in MODEL_TABS},
        "job": f"#/jobs/{arm.job}",
        "train": f"#/train?datasets={arm.dataset}",
        "live": f"#/live/{arm.model}",
    }


LISTS = {"overview": "#/", "data sets": "#/data", "jobs": "#/jobs", "models": "#/models", "robots": "#/live"}


def problems_of(visitor: Visitor, name: str, route: str) -> list[str]:
    """Open a page and return its problems, of accessibility too, light and dark."""
    page = visitor.open(route)
    if name == "model versions" and page.get_by_role("button", name="Compare", exact=True).count():
        page.get_by_role("button", name="Compare", exact=True).click()
        expect(page.locator(".joint-plots").first).to_be_visible()
    if name == "live" and "turntable" not in route:
        expect(page.get_by_role("region", name="External torque")).to_be_visible()
    found = layout_problems(visitor.drawn())
    page.emulate_media(color_scheme="dark")
    found += [*layout_problems(visitor.drawn()), *violations(page)]
    page.emulate_media(color_scheme="light")
    return [f"{name}: {each}" for each in dict.fromkeys(found)]


@pytest.mark.parametrize(("device", "size"), [("desktop", WIDE), ("phone", PHONE)], ids=["desktop", "phone"])
def test_no_page_overlaps_or_cuts_texts(
    windows: Visit, dashboard: Dashboard, arms: list[Arm], device: str, size: tuple[int, int]
) -> None:
    source()  # skip early if axe is missing
    visitor = windows(dashboard.server.url, size=size, touch=device == "phone")
    problems = [problem for name, route in LISTS.items() for problem in problems_of(visitor, name, route)]
    for arm in arms:
        for name, route in routes(arm).items():
            problems += [f"{arm.model}, {problem}" for problem in problems_of(visitor, name, route)]
    assert problems == []


@pytest.mark.parametrize("problem", BROKEN)
def test_broken_layout_is_found(visitor: Visitor, dashboard: Dashboard, problem: str) -> None:
    page = visitor.open(f"#/models/{dashboard.model}?tab=versions")
    assert layout_problems(page) == []
    page.evaluate(
        "(css) => { const sheet = new CSSStyleSheet(); sheet.replaceSync(css); document.adoptedStyleSheets = [sheet]; }",
        BROKEN[problem],
    )
    assert any(problem in found for found in layout_problems(page))
