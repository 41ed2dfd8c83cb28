"""Every page, on a desktop and a phone, light and dark: nothing of WCAG 2.2 AA is violated, and a picture is taken.

`pytest tests/browser/test_pages.py --pictures FOLDER` keeps the pictures.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.browser.accessibility import audit, expect
from tests.browser.axe import source, violations
from tests.browser.conftest import Dashboard, Visit
from tests.browser.robot import playing
from tests.browser.visitor import DESKTOP, PHONE, Visitor, compress
from tests.service.models.versions import publish_arm_at

if TYPE_CHECKING:
    from tests.browser.robot import Row

pytestmark = pytest.mark.slow

MODEL_TABS = ("accuracy", "parts", "versions", "lineage", "ask", "learning")
DATA_TABS = ("signals", "timing", "excitation", "friction", "preparation")
RATE = 50.0


@pytest.fixture(scope="module")
def pictures(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the pictures."""
    folder = request.config.getoption("--pictures") or tmp_path_factory.mktemp("pictures")
    Path(folder).mkdir(parents=True, exist_ok=True)
    return Path(folder)


@pytest.fixture(scope="module")
def streamed(dashboard: Dashboard) -> Iterator[str]:
    """A model whose robot streams to it, with torques as the model predicts them, and noise."""
    source()  # else nothing needs to be made
    publish_arm_at(dashboard.server.home, "streamed")
    rows = motion(dashboard, "streamed")
    with playing(dashboard.server.url, "streamed", cycle(rows), RATE):
        yield "streamed"


def motion(dashboard: Dashboard, model: str) -> list[Row]:
    """Ten seconds of all joints swinging, which begin as they end."""
    phase = 2 * np.pi * np.arange(500)[:, None] / 500 * np.arange(1, 8)
    q, speed = 0.4 * np.sin(phase), 2 * np.pi / 10 * np.arange(1, 8)
    dq, ddq = 0.4 * speed * np.cos(phase), -0.4 * speed**2 * np.sin(phase)
    body = {"q": q.tolist(), "dq": dq.tolist(), "ddq": ddq.tolist()}
    tau = np.array(dashboard.client.post(f"/v1/models/{model}/predict", json=body).json()["tau"])
    tau += 0.1 * np.random.default_rng(0).standard_normal(tau.shape)
    return list(zip(q, dq, ddq, tau, strict=True))


def routes(dashboard: Dashboard, streamed: str) -> dict[str, str]:
    """Every page by the name of its picture."""
    model, data = f"#/models/{dashboard.model}", f"#/data/{dashboard.dataset['id']}"
    return {
        "overview": "#/",
        "data-sets": "#/data",
        **{f"data-set-{tab}": f"{data}?tab={tab}" for tab in DATA_TABS},
        "jobs": "#/jobs",
        "job": f"#/jobs/{dashboard.job['id']}",
        "train": "#/train",
        "models": "#/models",
        **{f"model-{tab}": f"{model}?tab={tab}" for tab in MODEL_TABS},
        "model-arm": f"#/models/{streamed}?tab=arm",
        "robots": "#/live",
        "live-quiet": f"#/live/{dashboard.model}",
        "live": f"#/live/{streamed}",
        "guide": "/guide",
        "guide-page": "/guide/first-model",
    }


def ready(visitor: Visitor, name: str) -> None:
    """Wait until a page has all that its picture should show."""
    page = visitor.page
    if name == "live":
        expect(page.get_by_role("region", name="Innovation").locator(".linked")).to_be_attached()
        expect(page.get_by_role("region", name="External torque")).to_be_visible()
        expect(page.get_by_role("img", name="over the last 10 seconds, large")).to_be_attached()
    if name == "data-set-signals":
        expect(page.locator(".strip .linked")).to_have_count(4)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_every_page_can_be_used_by_everyone(
    windows: Visit, dashboard: Dashboard, streamed: str, pictures: Path, size: tuple[int, int], scheme: str
) -> None:
    device = "phone" if size == PHONE else "desktop"
    visitor = windows(dashboard.server.url, size=size, scheme=scheme, touch=size == PHONE)
    problems = []
    for name, route in routes(dashboard, streamed).items():
        page = visitor.open(route)
        ready(visitor, name)
        if (wider := visitor.overflow()) > 0:
            problems.append(f"{name}: {wider} px wider than the screen")
        problems += [f"{name}: {problem}" for problem in [*violations(page), *audit(page)]]
        path = pictures / f"{name}-{device}-{scheme}.png"
        page.screenshot(path=path, full_page=True, animations="disabled", caret="hide")
        compress(path)
    assert problems == []
