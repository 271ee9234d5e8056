"""What the page says and shows where a person points, clicks and types; skipped where there is no browser."""

import re
from pathlib import Path

import numpy as np
import pytest
import report_world as world
from page_browser import PATIENCE_MS, ready, row_of

from puncture_twin.twin.report.map_view import map_view
from puncture_twin.twin.report.slices.panel import TONES

SCENE = "#scene3d"


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("browser") / "report.html"
    world.make_page(path)
    return path


@pytest.fixture(scope="module")
def page(browser, path):
    with ready(browser, path.as_uri()) as page:
        yield page


@pytest.fixture
def scene(page):
    """The page, whose scene is drawn."""
    if page.evaluate("document.getElementById('scene3d').hidden"):
        pytest.skip("this browser has no WebGL")
    page.locator(SCENE).scroll_into_view_if_needed()  # what nobody sees is not drawn
    page.wait_for_selector(f"{SCENE} canvas >> nth=0")
    return page


def point_at(page, case, candidates, theta_deg, beta_deg, *, click=False):
    """Move the pointer to a direction on the map; returns what the page says."""
    image = page.locator("#map-image")
    box = image.bounding_box()
    x, y = map_view(case, candidates).place(np.radians(theta_deg), np.radians(beta_deg))
    at = {"x": (1 + x) / 2 * box["width"], "y": (1 - y) / 2 * box["height"]}
    image.hover(position=at)
    if click:
        image.click(position=at)
    return page.locator("#hover").inner_text()


def test_hover_explains_a_refusal(page, case, candidates):
    """Over a rejected cell: angles, verdict, reason with structure, depth and mm; the sentence that comes with it."""
    words = point_at(page, case, candidates, 40, 60)
    assert "θ 40°, β 60°" in words
    assert "rejected" in words and "too_close" in words and "rib right 9" in words
    assert "55.5 mm from the target" in words and re.search(r"clearance 0\.3 mm", words)
    assert "the shaft ends at 150 mm" in point_at(page, case, candidates, 80, 200)


def test_the_rims_own_angle_stands_within_it(page):
    """Not over the line, as on the picture of the map."""
    script = """(() => {
        const circles = [...document.querySelectorAll("#map-lines circle")], rim = circles[0];
        const label = [...document.querySelectorAll("#map-lines text")].find((t) => t.textContent === "θ 90°");
        const at = (element, name) => Number(element.getAttribute(name));
        const aside = Math.hypot(at(label, "x") - at(rim, "cx"), at(label, "y") - at(rim, "cy"));
        return [aside, at(rim, "r")];
    })()"""
    aside, radius = page.evaluate(script)
    assert radius - 30 < aside < radius - 8


def test_hover_shows_a_safe_direction(page, case, candidates):
    """Verdict, rank, clearance with the nearest structure, path; beyond the rim the chosen one's, at first the best."""
    words = point_at(page, case, candidates, 40, 220)
    assert "θ 40°, β 220°" in words
    assert f"safe, rank {candidates.ranking.rank[row_of(candidates, 40, 220)]}" in words
    assert "least clearance 9.0 mm (rib right 9)" in words and "100.0 mm" in words
    words = point_at(page, case, candidates, 120, 45)
    assert "rank 1" in words and "θ 0°, β 0°" in words


def test_choosing_moves_everything(page, case, candidates):
    """Table, sliders and map all set panel, sliders, command and slices, which say whose they are."""
    point_at(page, case, candidates, 30, 200, click=True)
    command, chosen = page.locator("#command"), page.locator("#slices-of")
    assert command.inner_text() == f"run-twin plan {Path.cwd().resolve()}/ball.toml --theta 30 --beta 200"
    assert [page.locator(name).input_value() for name in ("#theta", "#beta")] == ["30", "200"]
    assert "θ 30°, β 200° · safe" in chosen.inner_text()
    page.locator("button.pick").first.click()
    assert page.locator("button.pick").first.get_attribute("aria-pressed") == "true"
    assert "θ 0°, β 0° · safe" in chosen.inner_text()
    page.locator("#theta").fill("80")
    assert command.inner_text().startswith("run-twin check /")
    assert "rejected" in page.locator("#hover").inner_text()


def test_slices_are_shown_in_every_window(page):
    """The CT's bytes become greys of each window."""
    pixels = "document.querySelector('#slices-a .ct').getContext('2d').getImageData(0, 0, 480, 480).data"
    largest = f"{pixels}.reduce((most, value, k) => k % 4 ? most : Math.max(most, value), 0)"
    for tone in ("lung", "bone", "brain", "abdomen"):
        page.locator(f"#tones [data-tone={tone}]").click()
        page.wait_for_function(f"document.getElementById('slices-a').dataset.tone === '{tone}'")
        level, width = TONES[tone]
        brightest = 255 * min(1.0, (299 - level) / width + 0.5)  # the densest voxels, to half a step of the table
        assert abs(page.evaluate(largest) - brightest) <= 255 * 12 / width + 1


def test_the_focus_is_visible(page):
    page.keyboard.press("Tab")
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"


def test_the_scene_is_drawn_and_answers_the_map(scene, case, candidates):
    """The scene holds its meshes; a click on the map draws that direction; the buttons change the arm's pose."""
    names = scene.evaluate("document.getElementById('scene3d').data.map(t => t.name)")
    assert {"liver", "aorta", "skin", "target", "safe region", "needle", "arm"} <= set(names)
    end = world.TARGET + 210 * candidates.outward_ct[row_of(candidates, 30, 200)]
    point_at(scene, case, candidates, 30, 200, click=True)
    scene.locator(SCENE).scroll_into_view_if_needed()
    last = "document.getElementById('scene3d').data.at(-1)"
    scene.wait_for_function(f"{last}.x.length === 2 && Math.abs({last}.x[1] - {end[0]}) < 0.01")  # not the line before
    line = np.array(scene.evaluate(f"[{last}.x, {last}.y, {last}.z]")).T
    assert np.allclose(line[0], world.TARGET)
    assert np.allclose(line[1], end, atol=0.01)
    visible = (
        "document.getElementById('scene3d').data.filter(t => t.meta && t.meta.pose === '{}' && (!{} || t.meta.arm))"
        ".every(t => t.visible === {})"
    )
    scene.wait_for_function(visible.format("target", "true", "false"))  # the arm is hidden at first
    scene.locator("#pose-standoff").click()
    scene.wait_for_function(visible.format("standoff", "false", "true"))
    scene.wait_for_function(visible.format("target", "false", "false"))


def test_the_scene_is_true_to_scale(scene):
    """A millimetre is as long along every axis, whatever is hidden; of itself plotly scales by what is shown."""
    for pose in ("none", "target"):
        scene.locator(f"#pose-{pose}").click()
        layout = "document.getElementById('scene3d')._fullLayout.scene"
        ratio, *ranges = scene.evaluate(
            f"(() => {{ const at = {layout}; const {{ x, y, z }} = at.aspectratio;"
            " return [[x, y, z], at.xaxis.range, at.yaxis.range, at.zaxis.range].map(one => [...one]); })()"
        )
        per_mm = [size / (high - low) for size, (low, high) in zip(ratio, ranges, strict=True)]
        assert per_mm == pytest.approx([per_mm[0]] * 3)


def test_views_look_where_they_say(scene, case, candidates):
    """Along the needle the camera looks along the chosen direction; axial looks to the head."""
    point_at(scene, case, candidates, 30, 200, click=True)
    along = candidates.outward_ct[row_of(candidates, 30, 200)]
    for view, expected in (("along", along), ("axial", [0, 0, -1]), ("coronal", [0, -1, 0])):
        scene.locator(f"[data-view={view}]").click()
        camera = scene.evaluate("document.getElementById('scene3d').layout.scene.camera")
        eye, centre = (np.array([camera[key][axis] for axis in "xyz"]) for key in ("eye", "center"))
        assert np.allclose((eye - centre) / np.linalg.norm(eye - centre), expected, atol=1e-3), view


def test_no_error_and_no_request(browser, path, case, candidates):
    """Under the page's own policy, whatever is chosen: nothing on the console; only the file itself was asked for."""
    page = browser.new_page(viewport={"width": 1300, "height": 900})
    page.set_default_timeout(PATIENCE_MS)
    told, asked = [], []
    page.on("pageerror", lambda error: told.append(str(error)))
    page.on("console", lambda one: told.append(one.text) if one.type in {"error", "assert"} else None)
    page.on("request", lambda one: asked.append(one.url) if not one.url.startswith(("data:", "blob:")) else None)
    page.goto(path.as_uri())
    page.wait_for_selector("body[data-ready=true]")
    assert "rejected" in point_at(page, case, candidates, 40, 60)
    point_at(page, case, candidates, 30, 200, click=True)
    assert page.locator("#command").inner_text().endswith("--theta 30 --beta 200")
    page.locator("#tones [data-tone=lung]").click()
    page.wait_for_selector("#slices-a[data-tone=lung]")
    if page.locator(SCENE).is_visible():
        page.locator(SCENE).scroll_into_view_if_needed()
        page.wait_for_selector(f"{SCENE} canvas >> nth=0")
        for name in ("#pose-standoff", "[data-view=along]", "[data-view=axial]"):
            page.locator(name).click()
    page.context.close()
    assert told == [] and asked == [path.as_uri()]
