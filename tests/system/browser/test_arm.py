"""Drawing of a learnt arm on the model page and on the live page."""

import re
from collections.abc import Iterator
from itertools import count

import numpy as np
import pinocchio as pin
import pytest

from tests.choosing import slow
from tests.lipcore.arm_oracles import arm as arm_of
from tests.lipcore.arms import parameters
from tests.service.models.versions import NO_BODIES, publish_arm_at
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard
from tests.system.browser.robot import playing
from tests.system.browser.visitor import PHONE, Visitor

FRAMES = """async ([geometry, q]) => {
  const { frames } = await import("/dashboard/pages/arm/kinematics.js");
  return frames(geometry, q).map(({ rotation, origin }) => [rotation, origin]);
}"""
UPRIGHT = """async (gravity) => {
  const { times, gravityAlignment } = await import("/dashboard/pages/arm/kinematics.js");
  return times(gravityAlignment(gravity), gravity);
}"""
SEEN = """async ([points, ratio]) => {
  const { acrossPlane, cameraFor } = await import("/dashboard/pages/arm/camera.js");
  const direction = acrossPlane(points);
  return [direction, cameraFor(direction, [1, 0.6, 0.8], ratio, false).eye];
}"""
LINKS = "(plot) => plot.data[0].x"
"""Coordinates of the frames along one axis, in Plotly's data."""


@pytest.fixture(scope="module")
def arm(dashboard: Dashboard) -> str:
    """A model whose version has a geometry."""
    publish_arm_at(dashboard.server.home, "drawn")
    return "drawn"


@pytest.mark.parametrize("kinds", ["RPRRPR", slow("RRRRRRR")])
def test_joint_frames_match_pinocchio(visitor: Visitor, kinds: str) -> None:
    n, rng = len(kinds), np.random.default_rng(1)
    order, q, (geometry, bodies, robot) = rng.permutation(n), rng.uniform(-2, 2, n), arm_of(kinds, 4)
    report = parameters(geometry, bodies, [f"j{joint}" for joint in range(n)], order.tolist())
    drawn = visitor.open("#/train").evaluate(FRAMES, [report["geometry"], q.tolist()])
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q[order])
    for (rotation, origin), frame in zip(drawn, list(data.oMi)[1:], strict=True):
        np.testing.assert_allclose(rotation, frame.rotation, atol=1e-12)
        np.testing.assert_allclose(origin, frame.translation, atol=1e-12)


def test_gravity_points_down_in_the_drawing(visitor: Visitor) -> None:
    page = visitor.open("#/train")
    for gravity in ([0, 0, -9.81], [0, 0, 9.81], [9.81, 0, 0], [3.0, -4.0, 5.0], [1e-9, 0, -9.81]):
        down = page.evaluate(UPRIGHT, gravity)
        np.testing.assert_allclose(down, [0, 0, -np.linalg.norm(gravity)], atol=1e-9)


@pytest.mark.parametrize("normal", [[1.0, 0.0, 0.0], [0.6, -0.8, 0.0], [0.0, 0.0, 1.0]])
@pytest.mark.parametrize("ratio", [2.2, 0.8], ids=["desktop", "phone"])
def test_camera_sees_the_whole_scene_across_the_plane_of_the_arm(
    visitor: Visitor, normal: list[float], ratio: float
) -> None:
    rng = np.random.default_rng(0)
    across = np.linalg.svd([normal])[2][1:]
    points = rng.standard_normal((7, 2)) @ across
    direction, eye = visitor.open("#/train").evaluate(SEEN, [points.tolist(), ratio])
    assert abs(np.dot(direction, normal)) > 0.8
    position = np.array([eye["x"], eye["y"], eye["z"]])
    right = np.cross([0, 0, 1], direction)
    right /= np.linalg.norm(right)
    corners = np.array(np.meshgrid([-0.5, 0.5], [-0.3, 0.3], [-0.4, 0.4])).reshape(3, -1).T
    away, tangent = (position - corners) @ direction, np.tan(np.pi / 8)  # half of the angle of Plotly's camera
    assert (abs((corners - position) @ right) < away * tangent * ratio).all()
    assert (abs((corners - position) @ np.cross(direction, right)) < away * tangent).all()


def test_every_joint_of_the_drawing_has_its_colour(visitor: Visitor, arm: str) -> None:
    page = visitor.open(f"#/models/{arm}?tab=arm")
    figure = page.get_by_role("img", name=re.compile("The arm in 3-D"))
    expect(figure.locator("canvas").first).to_be_visible()
    links, *lines = figure.evaluate(
        "(plot) => plot.data.filter((each) => each.mode === 'lines').map((e) => e.line.color)"
    )
    key = page.locator(".arm-stage .key .joint")
    expect(key).to_have_count(7)
    colours = key.evaluate_all("(all) => all.map((each) => getComputedStyle(each, '::before').backgroundColor)")
    drawn = {tuple(int(line[at : at + 2], 16) for at in (1, 3, 5)) for line in lines if line.startswith("#")}
    assert {tuple(int(part) for part in re.findall(r"\d+", each)) for each in colours} <= drawn
    assert links not in lines


def test_arm_is_drawn_and_moves_with_the_sliders(visitor: Visitor, arm: str) -> None:
    page = visitor.open(f"#/models/{arm}?tab=arm")
    figure = page.get_by_role("img", name=re.compile("The arm in 3-D, 7 joints from base to tip"))
    expect(figure.locator("canvas").first).to_be_visible()
    before = figure.evaluate(LINKS)
    assert len(before) == 8
    slider = page.get_by_role("slider", name="Position of panda_joint2")
    slider.focus()
    slider.press("End")
    visitor.until(lambda: figure.evaluate(LINKS) != before)
    page.get_by_role("button", name="Reset posture").click()
    visitor.until(lambda: figure.evaluate(LINKS) == before)
    axes = page.get_by_role("region", name="Axes and centres of mass").get_by_role("table")
    expect(axes.get_by_role("row").last).to_contain_text("shift 2")
    expect(axes).to_contain_text("mass, first moment")
    parameters = page.get_by_role("region", name="Masses and friction").get_by_role("table")
    expect(parameters.get_by_role("columnheader", name="Mass, kg")).to_be_visible()
    expect(parameters.get_by_role("columnheader", name="Coulomb, N·m")).to_be_visible()
    page.get_by_role("region", name="Learnt arm").get_by_text("How to read this").click()
    expect(page.get_by_text("does not distinguish an arm from its mirror image")).to_be_visible()
    for label, file in (("URDF", "drawn-v1.urdf"), ("MJCF (MuJoCo)", "drawn-v1.xml"), ("C", "drawn-v1-c.tar")):
        with page.expect_download() as saved:
            page.get_by_role("button", name=f"Save as {label}", exact=True).click()
        assert saved.value.suggested_filename == file
    assert audit(page) == []
    visitor.shot("arm", height=1500)
    # resize the window: a new one would compile the 3-D code again
    page.set_viewport_size({"width": PHONE[0], "height": PHONE[1]})
    page.emulate_media(color_scheme="dark")
    expect(figure.locator("canvas").first).to_be_visible()
    visitor.until(lambda: visitor.overflow() == 0)
    assert audit(page) == []


def test_version_without_geometry_explains_how_to_get_one(visitor: Visitor, dashboard: Dashboard) -> None:
    publish_arm_at(dashboard.server.home, "not-drawn", **NO_BODIES)
    page = visitor.open("#/models/not-drawn?tab=arm")
    expect(page.get_by_text("Train a version with the estimator rigid-body")).to_be_visible()
    assert audit(page) == []


def swinging() -> Iterator[list[np.ndarray]]:
    """Yield rows of a robot that oscillates its second joint."""
    for row in count():
        yield [0.5 * np.sin(0.05 * row) * np.eye(7)[1], *np.zeros((3, 7))]


def test_arm_follows_its_stream(visitor: Visitor, dashboard: Dashboard, arm: str) -> None:
    with playing(dashboard.server.url, arm, swinging(), rate=50.0):
        page = visitor.open(f"#/live/{arm}")
        figure = page.get_by_role("img", name=re.compile("The arm in 3-D"))
        figure.scroll_into_view_if_needed()
        canvas = figure.locator("canvas").first.element_handle()
        for _ in range(3):
            before = figure.evaluate(LINKS)
            visitor.until(lambda: figure.evaluate(LINKS) != before)  # noqa: B023
        assert canvas.evaluate("(each) => each.isConnected"), "the plot was created again"
        assert audit(page) == []
