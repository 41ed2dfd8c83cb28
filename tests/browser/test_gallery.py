"""Every page, on a desk and on a phone, light and dark: nothing is wider than the window; pictures where asked for."""

from __future__ import annotations

from itertools import cycle

import pytest

from tests.browser.accessibility import expect
from tests.browser.conftest import Dashboard, Visit
from tests.browser.robot import playing
from tests.browser.visitor import DESKTOP, PHONE
from tests.service.data import QUICK, stream, train, upload

pytestmark = pytest.mark.slow

NARROWEST = (320, 640)
"""A window 1280 px wide at 400 %: WCAG 2.2, 1.4.10."""
HEIGHT = 1600
"""Of pictures, px."""


@pytest.fixture(scope="module")
def exhibit(dashboard: Dashboard) -> dict[str, str]:
    """An arm worth a look: its recording, the job that made its newest version, and the model's name."""
    held = {"kind": "last", "share": 0.3}
    fit = {**QUICK, "posterior_samples": 200}
    for seed in (61, 62):
        recorded = stream("panda", samples=300, seed=seed, rate=20.0, noise=0.05, viscous=0.5, coulomb=0.3)
        data = upload(dashboard.client, recorded, name=f"cell-3, shift {seed}", robot="panda")["id"]
        made = {"estimator": "rigid-body", "robot": "panda", "options": fit, "holdout": held}
        job = train(dashboard.client, "cell-3", data, **made)
    return {"dataset": data, "job": job["id"], "model": "cell-3"}


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
    windows: Visit, dashboard: Dashboard, exhibit: dict[str, str], name: str, size: tuple[int, int], scheme: str
) -> None:
    visitor = windows(dashboard.server.url, size=size, scheme=scheme)
    model = f"#/models/{exhibit['model']}"
    pages = {
        "overview": "#/",
        "data": "#/data",
        "dataset": f"#/data/{exhibit['dataset']}",
        "jobs": "#/jobs",
        "job": f"#/jobs/{exhibit['job']}",
        "train": "#/train",
        "models": "#/models",
        **{f"model-{tab}": f"{model}?tab={tab}" for tab in ("accuracy", "parts", "arm", "versions", "lineage", "ask")},
        "live": f"#/live/{exhibit['model']}",
    }
    wider = {}
    motion = stream("panda", samples=600, seed=63, rate=20.0, noise=0.05, viscous=0.5, coulomb=0.3)
    rows = cycle(zip(motion.q, motion.dq, motion.ddq, motion.tau, strict=True))
    with playing(dashboard.server.url, exhibit["model"], rows, rate=20.0):
        visitor.open("#/")
        expect(visitor.page.get_by_text("live", exact=True)).to_be_visible()
        for page, route in pages.items():
            visitor.open(route)
            wider[page] = visitor.overflow()
            if name != "narrowest":
                visitor.shot(f"pages/{page}-{name}", HEIGHT)
    assert wider == dict.fromkeys(pages, 0)
