"""Every page on a phone, light and dark: nothing is wider than the screen, everything has a name and can be read."""

from __future__ import annotations

import pytest

from tests.browser.accessibility import audit
from tests.browser.conftest import Dashboard, Visit
from tests.browser.looking import expect
from tests.browser.visitor import PHONE

TABS = ("accuracy", "parts", "versions", "lineage", "ask", "learning")


def test_every_page_can_be_read_on_a_phone_in_both_themes(windows: Visit, dashboard: Dashboard) -> None:
    visitor = windows(dashboard.server.url, size=PHONE, scheme="dark", touch=True)
    model = f"#/models/{dashboard.model}"
    routes = [
        *("#/", "#/data", f"#/data/{dashboard.dataset['id']}", "#/jobs", f"#/jobs/{dashboard.job['id']}", "#/train"),
        *("#/models", *(f"{model}?tab={tab}" for tab in TABS), "#/live", f"#/live/{dashboard.model}"),
    ]
    problems = []
    for route in [*routes, "/guide", "/guide/first-model"]:
        page = visitor.open(route)
        if (wider := visitor.overflow()) > 0:
            problems.append(f"{route}: {wider} px wider than the screen")
        problems += [f"{route}, dark: {problem}" for problem in audit(page)]
        page.emulate_media(color_scheme="light")
        problems += [f"{route}, light: {problem}" for problem in audit(page)]
        page.emulate_media(color_scheme="dark")
    assert problems == []


@pytest.mark.slow
def test_the_theme_that_was_chosen_stays(windows: Visit, dashboard: Dashboard) -> None:
    visitor = windows(dashboard.server.url)
    page = visitor.open("#/")

    def background() -> str:
        return page.evaluate("getComputedStyle(document.body).backgroundColor")

    light = background()
    page.get_by_role("button", name="Theme: auto").click()
    page.get_by_role("button", name="Theme: light").click()
    expect(page.get_by_role("button", name="Theme: dark")).to_be_visible()
    assert background() != light
    visitor.open("#/")
    expect(page.get_by_role("button", name="Theme: dark")).to_be_visible()
    assert background() != light
