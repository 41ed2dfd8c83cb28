"""Every page, on a desk and on a phone, light and dark: nothing is wider than the window; pictures where asked for."""

from __future__ import annotations

import pytest

from tests.browser.conftest import Dashboard, Visit
from tests.browser.visitor import DESKTOP, PHONE

pytestmark = pytest.mark.slow

NARROWEST = (320, 640)
"""A window 1280 px wide at 400 %: WCAG 2.2, 1.4.10."""
HEIGHT = 1600
"""Of pictures, px."""


@pytest.mark.parametrize(
    ("name", "size", "scheme"),
    [
        ("desk-light", DESKTOP, "light"),
        ("desk-dark", DESKTOP, "dark"),
        ("phone-light", PHONE, "light"),
        ("phone-dark", PHONE, "dark"),
        ("narrowest", NARROWEST, "light"),
    ],
)
def test_every_page_fits_its_window(
    windows: Visit, dashboard: Dashboard, name: str, size: tuple[int, int], scheme: str
) -> None:
    visitor = windows(dashboard.server.url, size=size, scheme=scheme)
    model, job = f"#/models/{dashboard.model}", f"#/jobs/{dashboard.job['id']}"
    pages = {
        "overview": "#/",
        "data": "#/data",
        "dataset": f"#/data/{dashboard.dataset['id']}",
        "jobs": "#/jobs",
        "job": job,
        "train": "#/train",
        "models": "#/models",
        **{f"model-{tab}": f"{model}?tab={tab}" for tab in ("accuracy", "parts", "versions", "lineage", "ask")},
        "model-arm": "#/models/panda-sim?tab=arm",
        "live": f"#/live/{dashboard.model}",
    }
    wider = {}
    for page, route in pages.items():
        visitor.open(route)
        wider[page] = visitor.overflow()
        if name != "narrowest":
            visitor.shot(f"pages/{page}-{name}", HEIGHT)
    assert wider == dict.fromkeys(pages, 0)
