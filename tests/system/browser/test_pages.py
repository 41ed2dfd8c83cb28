"""Check every page on desktop, phone and narrow windows, light and dark: WCAG 2.2 AA and width.

`pytest tests/browser/test_pages.py --pictures FOLDER` keeps a picture of each page.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain, cycle
from pathlib import Path

import pytest

from lipcore.robots.simulation import Payload
from tests.service.data import QUICK, stream, train, upload
from tests.system.browser.accessibility import audit, expect, layout_problems
from tests.system.browser.axe import source, violations
from tests.system.browser.conftest import Dashboard, Visit
from tests.system.browser.robot import playing
from tests.system.browser.visitor import DESKTOP, PHONE, Visitor, compress

NARROWEST = (320, 640)
"""A window 1280 px wide at 400 %: WCAG 2.2, 1.4.10."""
MODEL_TABS = ("accuracy", "parts", "arm", "versions", "lineage", "ask", "learning")
DATA_TABS = ("signals", "timing", "excitation", "friction", "preparation", "again")
MODEL = "cell-3"
RATE, TAKEN = 20.0, 8.0
"""Rate of the stream, Hz, and time at which the robot picks up 1.5 kg, s."""
LIKE = {"rate": RATE, "noise": 0.05, "viscous": 0.5, "coulomb": 0.3}
"""Options of the simulated robot."""


@pytest.fixture(scope="module")
def pictures(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the pictures."""
    folder = request.config.getoption("--pictures") or tmp_path_factory.mktemp("pictures")
    Path(folder).mkdir(parents=True, exist_ok=True)
    return Path(folder)


@pytest.fixture(scope="module")
def routes(dashboard: Dashboard) -> Iterator[dict[str, str]]:
    """Addresses of all pages by picture name, for a model with two versions and a streaming robot with a payload."""
    source()  # fail early if axe is missing
    made = {"estimator": "rigid-body", "robot": "panda", "options": {**QUICK, "posterior_samples": 200}}
    for seed in (61, 62):
        recorded = stream("panda", samples=600, seed=seed, **LIKE)
        data = upload(dashboard.client, recorded, name=f"{MODEL}, day {seed}", robot="panda")["id"]
        job = train(dashboard.client, MODEL, data, **made, holdout={"kind": "last", "share": 0.3})
    lifted = stream("panda", samples=600, seed=63, payload=Payload(1.5, TAKEN), **LIKE)
    rows = list(zip(lifted.q, lifted.dq, lifted.ddq, lifted.tau, strict=True))
    first = round(TAKEN * RATE)
    with playing(dashboard.server.url, MODEL, chain(rows[:first], cycle(rows[first:])), RATE):
        model = f"#/models/{MODEL}"
        yield {
            "overview": "#/",
            "data-sets": "#/data",
            **{f"data-set-{tab}": f"#/data/{data}?tab={tab}" for tab in DATA_TABS},
            "jobs": "#/jobs",
            "job": f"#/jobs/{job['id']}",
            "train": f"#/train?datasets={data}",
            "models": "#/models",
            **{f"model-{tab}": f"{model}?tab={tab}" for tab in MODEL_TABS},
            "robots": "#/live",
            "live-quiet": f"#/live/{dashboard.model}",
            "live": f"#/live/{MODEL}",
            "guide": "/guide/",
            "guide-page": "/guide/first-model/",
        }


def ready(visitor: Visitor, name: str) -> None:
    """Wait until a page is complete."""
    page = visitor.page
    if name == "overview":
        expect(page.locator(f".robot[data-key={MODEL}] .course")).to_be_attached()
    if name == "live":
        page.locator(".trace").first.scroll_into_view_if_needed()  # invisible plots are not updated
        expect(page.get_by_role("region", name="Innovation").locator(".linked")).to_be_attached()
        expect(page.get_by_role("region", name="External torque")).to_be_visible()
        expect(page.get_by_role("region", name="Payload").get_by_text("kg")).to_be_visible()
        expect(page.get_by_role("img", name="over the last 30 seconds").first).to_be_attached()
    if name == "live-quiet":
        expect(page.get_by_text("lipserve stream")).to_be_visible()
    if name == "data-set-signals":
        expect(page.locator(".strip .linked")).to_have_count(4)
    if name == "model-arm":
        expect(page.locator("canvas").first).to_be_attached()
    if name == "model-versions":
        page.get_by_role("button", name="Compare", exact=True).click()
        expect(page.locator(".js-plotly-plot:has(.main-svg)")).to_have_count(7)


@pytest.mark.parametrize(
    ("device", "size", "scheme"),
    [
        ("desktop", DESKTOP, "light"),
        ("desktop", DESKTOP, "dark"),
        ("phone", PHONE, "light"),
        ("phone", PHONE, "dark"),
        ("narrowest", NARROWEST, "light"),
    ],
    ids=lambda each: each if isinstance(each, str) else "",
)
def test_every_page_is_accessible_and_fits_the_window(
    windows: Visit,
    dashboard: Dashboard,
    routes: dict[str, str],
    pictures: Path,
    device: str,
    size: tuple[int, int],
    scheme: str,
) -> None:
    visitor = windows(dashboard.server.url, size=size, scheme=scheme, touch=device == "phone")
    problems = []
    for name, route in routes.items():
        page = visitor.open(route)
        ready(visitor, name)
        if (wider := visitor.overflow()) > 0:
            problems.append(f"{name}: {wider} px wider than the window")
        problems += [f"{name}: {problem}" for problem in [*violations(page), *audit(page)]]
        path = pictures / f"{name}-{device}-{scheme}.png"
        page.screenshot(path=path, full_page=True, animations="disabled", caret="hide")
        compress(path)
        if not route.startswith("/"):  # last, as it opens details
            problems += [f"{name}: {problem}" for problem in layout_problems(visitor.drawn())]
    assert not problems, "\n".join(problems)
