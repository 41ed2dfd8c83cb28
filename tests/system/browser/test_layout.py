"""Check that no page overlaps or cuts texts, for arms with one, six, seven and twelve joints."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import cycle

import pytest

from tests.system.browser.accessibility import expect, layout_problems
from tests.system.browser.arms import CRANE, TURNTABLE, Arm, chain, library_arm
from tests.system.browser.axe import source, violations
from tests.system.browser.conftest import Dashboard, Visit
from tests.system.browser.robot import playing
from tests.system.browser.visitor import PHONE, Visitor

RATE = 5.0
"""Rate of the streams, Hz."""
SIZES = {"desktop": (1440, 900), "phone": PHONE}
LISTS = {"overview": "#/", "data sets": "#/data", "jobs": "#/jobs", "models": "#/models", "robots": "#/live"}
MODEL_TABS = ("accuracy", "parts", "arm", "versions", "lineage", "ask", "learning")
DATA_TABS = ("signals", "timing", "excitation", "friction", "preparation", "again")
INJECT = """(css) => {
  const sheet = new CSSStyleSheet();
  sheet.replaceSync(css);
  document.adoptedStyleSheets = [sheet];
}"""
BROKEN = {
    "overlap by": ".tabs [role=tab] { margin-right: -3rem; }",
    "is cut by": "h2 { width: 2rem; overflow: hidden; white-space: nowrap; }",
    "is cut in its input": "input { width: 3rem; }",
    "reaches beyond the page": ".heading h1 { margin-left: -3rem; }",
    "px beyond": ".card p { margin-right: -3rem; }",
    "wider than the window": "main { width: 120vw; max-width: none; }",
}
"""Styles that break a page, by the problem that must be found."""
BROKEN_TICKS = "text.xtitle { translate: 0 -1.5rem; }"


@pytest.fixture(scope="module")
def arm_of(dashboard: Dashboard) -> Iterator[Callable[[str], Arm]]:
    """Return a function that trains an arm once; those with several joints have two versions and stream."""
    client, made = dashboard.client, dict[str, Arm]()
    with ExitStack() as streams:

        def train(name: str) -> Arm:
            if name == "turntable":
                return chain(client, name, TURNTABLE)
            arm = chain(client, name, CRANE, 2) if name == "crane" else library_arm(client, name, 2)
            rows = zip(*(getattr(arm.samples, each) for each in ("q", "dq", "ddq", "tau")), strict=True)
            streams.enter_context(playing(dashboard.server.url, name, cycle(rows), RATE))
            return arm

        yield lambda name: made.get(name) or made.setdefault(name, train(name))


def routes(arm: Arm) -> dict[str, str]:
    """Return the addresses of the pages of an arm."""
    return {
        **{f"data set {tab}": f"#/data/{arm.dataset}?tab={tab}" for tab in DATA_TABS},
        **{f"model {tab}": f"#/models/{arm.model}?tab={tab}" for tab in MODEL_TABS},
        "job": f"#/jobs/{arm.job}",
        "train": f"#/train?datasets={arm.dataset}",
        "live": f"#/live/{arm.model}",
    }


def open_page(visitor: Visitor, name: str, route: str) -> None:
    """Open a page and wait until it is complete."""
    page = visitor.open(route)
    compare = page.get_by_role("button", name="Compare", exact=True)
    if name == "model versions" and compare.count():
        compare.click()
        expect(page.locator(".joint-plots")).to_be_visible()
    if name == "live" and "turntable" not in route:
        expect(page.get_by_role("region", name="External torque")).to_be_visible()
    visitor.drawn()


@pytest.mark.parametrize("device", SIZES)
@pytest.mark.parametrize(
    ("name", "schemes"),
    [
        pytest.param("crane", ("light",), marks=pytest.mark.journey),
        ("crane", ("dark",)),
        ("ur10", ("light", "dark")),
        ("panda", ("light", "dark")),
        ("turntable", ("light", "dark")),
    ],
    ids=lambda each: each if isinstance(each, str) else "-".join(each),
)
def test_no_page_overlaps_or_cuts_texts(
    windows: Visit,
    dashboard: Dashboard,
    arm_of: Callable[[str], Arm],
    name: str,
    schemes: tuple[str, ...],
    device: str,
) -> None:
    audits = "dark" in schemes
    if audits:
        source()  # skip early if axe is missing
    arm = arm_of(name)
    visitor = windows(dashboard.server.url, size=SIZES[device], scheme=schemes[0], touch=device == "phone")
    problems = []
    for place, route in {**LISTS, **routes(arm)}.items():
        open_page(visitor, place, route)
        for scheme in schemes:
            visitor.page.emulate_media(color_scheme="dark" if scheme == "dark" else "light")
            found = layout_problems(visitor.drawn()) + (violations(visitor.page) if audits else [])
            problems += [f"{place}, {scheme}: {each}" for each in found]
        visitor.page.emulate_media(color_scheme="dark" if schemes[0] == "dark" else "light")
    assert not problems, "\n".join(problems)


@pytest.mark.journey
@pytest.mark.parametrize("problem", BROKEN)
def test_broken_layout_is_found(visitor: Visitor, dashboard: Dashboard, problem: str) -> None:
    page = visitor.open(f"#/models/{dashboard.model}?tab=versions")
    assert layout_problems(page) == []
    page.evaluate(INJECT, BROKEN[problem])
    assert any(problem in found for found in layout_problems(page))


@pytest.mark.journey
def test_axis_title_over_tick_labels_is_found(visitor: Visitor, dashboard: Dashboard) -> None:
    visitor.open(f"#/models/{dashboard.model}")
    page = visitor.drawn()
    expect(page.locator("text.xtitle").first).to_be_visible()
    assert layout_problems(page) == []
    page.evaluate(INJECT, BROKEN_TICKS)
    assert any("text.xtitle" in found and "overlap" in found for found in layout_problems(page))
