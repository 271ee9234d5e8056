"""The page on a phone and a desk, by Playwright in headless Chromium; skipped where there is no browser.

What its script cuts out of the page's block of the CT is what ``slices.png`` shows; and what it says where a person
points, clicks and types.
"""

import base64
import json
import re
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import report_world as world
import scipy
from page_browser import (
    GREYS,
    PATIENCE_MS,
    SHOWN,
    at_pixel,
    drawn,
    pick_first,
    picture,
    ready,
    row_of,
    serious_findings,
)
from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.search.candidates import Pick
from puncture_twin.twin.report.map_view import map_view
from puncture_twin.twin.report.page import page_slices, page_surfaces
from puncture_twin.twin.report.page.page import Shown, write_page
from puncture_twin.twin.report.page.page_data import scene_figure
from puncture_twin.twin.report.page.page_slices import ct_block
from puncture_twin.twin.report.slices.panel import PIXELS, TONES, Subject, draw_panel
from puncture_twin.twin.report.slices.planes import needle_planes
from puncture_twin.twin.report.slices.sheet import flat

SCENE = "#scene3d"
LIVER = (224, 124, 72)
LETTERS = 46  # pixels from the middle of an edge within which letters stand; the browser's are of another font


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    world.make_page(path)
    return path.as_uri()


@pytest.fixture(scope="module")
def patient(case, candidates):
    """Case, anatomy with a CT of noise, candidates."""
    anatomy = world.make_anatomy()
    anatomy.scan = world.make_scan()
    return case, anatomy, candidates


@pytest.fixture(scope="module")
def phone(browser, address):
    with ready(browser, address, 390) as page:
        yield page


@pytest.fixture(scope="module")
def desk(browser, address):
    """The page, open and drawn; what it cuts, says and reads does not hang on the window."""
    with ready(browser, address, 1440) as page:
        yield page


@pytest.fixture(params=["phone", "desk"])
def page(request):
    return request.getfixturevalue(request.param)


def same_slices(page, patient, row, off_mm=0.0):
    """Every slice of a row as ``slices.png`` has it: the CT to `GREYS`, lines where its are, outlines to so much."""
    case, anatomy, candidates = patient
    region = world.REGION if candidates.safe[row] else None
    subject = Subject(case, anatomy, Pick(candidates, row), region)
    planes = needle_planes(case.target_ct, subject.outward_ct, subject.path_mm)
    wanted = [draw_panel(subject, plane) for plane in planes]
    for (base, both), panel in zip(page.evaluate(SHOWN), wanted, strict=True):
        grey = TONES["abdomen"].grey(panel.hu).astype(int)
        assert (np.abs(picture(base)[..., 0] - grey) > GREYS).mean() < 1e-3, panel.plane.name
        found, theirs = picture(both), np.asarray(flat(panel, TONES["abdomen"])).astype(int)
        free, pixels = ~letters_and_scale(), 1 + int(np.ceil(off_mm * PIXELS / (2 * panel.plane.half_mm)))
        for colour in ((0, 229, 255), (255, 77, 240), LIVER):
            mine, other = (np.abs(one - colour).max(axis=2) for one in (found, theirs))
            for one, two in ((mine, other), (other, mine)):
                alone = (one < 40) & free & ~widened(two < 110, pixels if colour == LIVER else 1)
                assert alone.sum() <= 0.02 * (one < 40).sum() + 3, (panel.plane.name, colour)
        off = (np.abs(found - theirs).max(axis=2) > 80) & free
        assert off.mean() < 0.005 * pixels, panel.plane.name


def widened(mask, pixels):
    return scipy.ndimage.binary_dilation(mask, np.ones((3, 3)), pixels)


def letters_and_scale():
    mask = np.zeros((PIXELS, PIXELS), bool)
    middle = slice(PIXELS // 2 - LETTERS, PIXELS // 2 + LETTERS)
    for one in (slice(0, LETTERS), slice(PIXELS - LETTERS, PIXELS)):
        mask[middle, one] = mask[one, middle] = True
    mask[PIXELS - 60 :, :200] = True
    return mask


def test_axe_finds_nothing_serious(page):
    """Names, contrasts, landmarks, nesting: by axe-core's own rules, none of them left out."""
    assert serious_findings(page) == []


COLOURS = """() => {
    const shown = [], channels = (colour) => colour.match(/[\\d.]+/g).map(Number);
    const groundOf = (one) => {
        const colour = channels(getComputedStyle(one).backgroundColor);
        return (colour[3] ?? 1) === 1 ? colour : groundOf(one.parentElement);
    };
    for (const one of document.querySelectorAll("body *")) {
        if (one.closest("svg, #scene3d, .slice, script, [hidden]") || !one.getClientRects().length) continue;
        const style = getComputedStyle(one), name = `${one.tagName} ${one.textContent.slice(0, 30)}`;
        if ([...one.childNodes].some((node) => node.nodeType === 3 && node.data.trim()))
            shown.push([name, 4.5, channels(style.color), groundOf(one)]);
        if (one.tagName === "BUTTON") shown.push([name, 3, channels(style.borderColor), groundOf(one.parentElement)]);
    }
    return shown;
}"""
"""Texts and edges of buttons with their colours and grounds; 4.5 and 3 are what WCAG 2.1 AA demands of them."""


def luminance(colour):
    """WCAG's relative luminance of sRGB."""
    part = np.array(colour[:3]) / 255
    return np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_colour_has_contrast(desk, scheme):
    """All text 4.5 and all buttons' edges 3 to 1 in both styles; what is drawn stays, and paper is light."""
    drawn_colours = desk.evaluate(SHOWN)
    desk.emulate_media(color_scheme=scheme)
    found = desk.evaluate(COLOURS)
    assert len(found) > 150
    for text, least, *colours in found:
        dark, light = sorted(map(luminance, colours))
        assert (light + 0.05) / (dark + 0.05) >= least, (text, colours)
    ground = "getComputedStyle(document.body).backgroundColor"
    assert (desk.evaluate(ground) == "rgb(255, 255, 255)") == (scheme == "light")
    assert desk.evaluate(SHOWN) == drawn_colours
    desk.emulate_media(color_scheme=scheme, media="print")
    assert desk.evaluate(ground) == "rgb(255, 255, 255)"
    desk.emulate_media(color_scheme="light", media="screen")


def test_slices_of_what_is_chosen_are_those_of_the_program(desk, patient):
    """By the map, a slider and a row of the table, safe or not: pixels of CT, needle, margin, region and outlines."""
    candidates = patient[2]
    box = desk.locator("#map-image").bounding_box()
    desk.locator("#map-image").click(position={"x": 0.3 * box["width"], "y": 0.62 * box["height"]})
    clicked = (
        desk.evaluate("+document.getElementById('command').textContent.match(/theta (\\S+)/)[1]"),
        desk.evaluate("+document.getElementById('command').textContent.match(/beta (\\S+)/)[1]"),
    )
    row = row_of(candidates, *clicked)
    drawn(desk, row)
    same_slices(desk, patient, row)
    desk.locator("#theta").focus()
    for _ in range(6):
        desk.keyboard.press("ArrowLeft")
    slid = row_of(candidates, clicked[0] - 30, clicked[1])
    drawn(desk, slid)
    same_slices(desk, patient, slid)
    same_slices(desk, patient, pick_first(desk))
    assert desk.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_lighter_surfaces_are_drawn_where_the_program_draws_the_checked_ones(browser, patient, tmp_path):
    """With half of the triangles: outlines, and the structure under the cursor 1 mm inside and outside of them."""
    whole = sum(len(one.mesh.faces) for one in patient[1].checked) + len(patient[1].skin.mesh.faces)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page_surfaces, "MOST_TRIANGLES", whole // 2)
        world.make_page(tmp_path / "report.html")
    with ready(browser, (tmp_path / "report.html").as_uri(), 1440) as page:
        shown = page.evaluate("unpacked.then(({ slices }) => slices.surfaces)")
        assert shown["off_mm"] <= 0.5 and sum(one["triangles"] for one in shown["parts"]) <= whole // 2
        row = pick_first(page)
        same_slices(page, patient, row, shown["off_mm"])
        plane = plane_of(patient, row, 0)
        far = np.linalg.norm(plane.points_ct(PIXELS) - patient[0].target_ct, axis=1).reshape(PIXELS, PIXELS)
        for mm, place in ((39.0, "liver"), (41.0, "in no structure")):
            line = int(np.argmin(np.abs(far[240:, 240] - mm))) + 240
            at_pixel(page, 0, 240, line)
            assert place in page.locator("#cursor").inner_text()
        assert f"{shown['off_mm']:.2f} mm" in page.locator("#slices-notes").inner_text()


def plane_of(patient, row, number):
    case, _, candidates = patient
    return needle_planes(case.target_ct, candidates.outward_ct[row], candidates.path.length[row])[number]


def test_the_cursor_reads_units_and_structure(desk, patient):
    """At pixels of an axial slice: the CT's value within what is stated, and the structure that holds the point."""
    case, anatomy, _ = patient
    row = pick_first(desk)
    points = plane_of(patient, row, 0).points_ct(PIXELS).reshape(PIXELS, PIXELS, 3)
    for column, line in ((240, 250), (200, 380), (60, 380), (20, 30)):
        at_pixel(desk, 0, column, line)
        said, point = desk.locator("#cursor").inner_text(), points[line, column]
        hu, doubt = map(float, re.match(r"(\S+) ± (\d+) HU", said.replace("−", "-")).groups())
        wanted = anatomy.scan.hu_at(point[None])[0]
        assert abs(hu - wanted) <= doubt + 0.5, said
        far = np.linalg.norm(point - case.target_ct)
        place = "liver" if far < 39 else "in no structure" if far < 99 else "outside of the skin"
        if np.linalg.norm(point - case.target_ct - [-70, 0, 0]) < 7:
            place = "rib right 9"
        assert place in said


def test_a_scrolled_slice_is_that_of_the_place(desk, patient):
    """The wheel moves one plane along its normal; its CT is the program's there, and the others stay."""
    _, anatomy, _ = patient
    row = pick_first(desk)
    desk.locator("#slices-centre").click()
    drawn(desk, row)
    slider = desk.locator("#slices-a input[type=range]").first
    slider.fill("20")
    desk.wait_for_function("document.querySelector('#slices-a output').textContent === '20 mm'")
    plane = plane_of(patient, row, 0)
    moved = replace(plane, at_ct=plane.at_ct + 20.0 * plane.normal)
    grey = TONES["abdomen"].grey(anatomy.scan.hu_at(moved.points_ct(PIXELS)).reshape(PIXELS, PIXELS)).astype(int)
    assert (np.abs(picture(desk.evaluate(SHOWN)[0][0])[..., 0] - grey) > GREYS).mean() < 1e-3
    assert "20 mm from the target, toward the feet" in desk.locator("#slices-a figcaption").first.inner_text()
    desk.locator("#slices-centre").click()


def test_a_path_of_ones_own_has_no_verdict_of_its_own(page, patient):
    """A dragged entry gets the nearest direction's, said to be that; a moved target none; two paths side by side."""
    row = pick_first(page)
    page.locator("#slices-keep").click()
    page.locator("[data-mode=move]").click()
    drawn(page, row)
    plane, outward = plane_of(patient, row, 1), patient[2].outward_ct[row]
    for step, said in ((100.0 * outward, "the nearest searched direction"), (0.0 * outward, "the target was moved by")):
        x, y = plane.place(plane.at_ct + step) - plane.centre
        column, line = (1 + np.array([x, -y]) / plane.half_mm) * PIXELS / 2 - 0.5
        start = at_pixel(page, 1, column, line)
        page.mouse.down()
        page.mouse.move(start[0] + 14, start[1] + 3, steps=2)
        page.mouse.up()
        text = page.locator("#slices-of").inner_text()
        assert "not known" in text and said in text and "bad" in page.locator("#slices-of").get_attribute("class")
    assert "rank" not in page.locator("#hover").inner_text()  # a verdict of another path stands nowhere as this one's
    assert page.locator("#slices-numbers thead th").count() == 3 and page.locator("#slices-b .over").count() == 4
    assert "--targets" in page.locator("#command").inner_text()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.locator("#slices-back").click()
    page.locator("#slices-keep").click()
    page.locator("[data-mode=point]").click()
    assert drawn(page, row)


@pytest.fixture(scope="module")
def lossy(browser, tmp_path_factory):
    """A page whose CT is packed with loss, open, and its block."""
    path, case, anatomy = tmp_path_factory.mktemp("lossy") / "report.html", world.make_case(), world.make_anatomy()
    anatomy.scan = world.make_noisy_scan()
    blocks = []

    def small(hu, T_ct_index, box_ct, _):
        blocks.append(ct_block(hu, T_ct_index, box_ct, world.NOISY_BYTES))
        return blocks[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page_slices, "ct_block", small)
        write_page(Shown(case, anatomy, world.make_candidates(case)), path)
    with ready(browser, path.as_uri(), 1000) as page:
        yield page, path, blocks[0]


def test_a_browser_decodes_what_the_program_measured(lossy, browser):
    """Every byte of a CT with loss as Pillow has it, to 1; the page states the loss; a browser that alters is told."""
    page, path, block = lossy
    shown = page.evaluate("""() => unpacked.then(({ ct }) => new Promise((done) => {
        const reader = new FileReader();
        reader.onload = () => done(reader.result);
        reader.readAsDataURL(new Blob([ct]));
    }))""")
    nx, ny, nz = block.facts["shape"]
    found = np.frombuffer(base64.b64decode(shown.partition(",")[2]), np.uint8).reshape(nz, ny, nx)
    assert np.abs(found.astype(int) - world.unpacked_bytes(block)).max() <= 1
    notes = page.locator("#slices-notes").inner_text()
    assert "packed with loss" in notes and f"off by {np.ceil(block.facts['rms_hu']):.0f} HU" in notes
    with altered(browser, path) as page:
        assert "alters pictures" in page.locator("#slices-notes").inner_text()


@contextmanager
def altered(browser, path):
    """The page in a browser that answers a large canvas with noise, as some do against fingerprints."""
    context = browser.new_context(viewport={"width": 1000, "height": 900})
    page = context.new_page()
    page.add_init_script("""const read = CanvasRenderingContext2D.prototype.getImageData;
        CanvasRenderingContext2D.prototype.getImageData = function (...box) {
            const found = read.apply(this, box);
            if (found.height > 1000) for (let k = 0; k < found.data.length; k++) found.data[k] = 255 * Math.random();
            return found;
        };""")
    page.goto(path.as_uri())
    drawn(page)
    yield page
    context.close()


def test_the_arm_follows_what_is_chosen(browser, tmp_path):
    """Links, needle and holder of a chosen row lie where Python's link poses have them, to 0.1 mm; else the first's."""
    case, anatomy = world.make_case(), world.make_anatomy()
    found = world.make_candidates(case)
    q = np.random.default_rng(3).uniform(-3, 3, (len(found), 6))
    q[found.verdict.reason != ""] = np.nan
    found = replace(found, arm=replace(found.arm, q_insertion=q))
    T_base_ct = random_pose(np.random.default_rng(4))
    first, path = found.best, tmp_path / "report.html"
    write_page(Shown(case, anatomy, found, pick=first, T_base_ct=T_base_ct), path)
    drawn_first = scene_figure(Shown(case, anatomy, found, pick=first, T_base_ct=T_base_ct))["data"]
    before = [unpacked(one) for one in drawn_first if one.get("meta", {}).get("frame")]
    with ready(browser, path.as_uri(), 1000) as page:
        if page.evaluate("document.getElementById('scene3d').hidden"):
            pytest.skip("this browser has no WebGL")
        follow_rows(page, found, before, case.robot.model, (q, first.row, T_base_ct))


def follow_rows(page, found, before, model, arm):
    """Choose rows by the slider and compare every link."""
    q, first, T_base_ct = arm
    page.evaluate("document.getElementById('scene3d').scrollIntoView()")
    links = "document.getElementById('scene3d').data.filter(t => t.meta && t.meta.frame)"
    places = f"JSON.stringify({links}.map(t => ['x', 'y', 'z'].map(a => [...t[a]].filter((_, k) => k % 50 === 0))))"
    frames = page.evaluate(f"{links}.map(t => t.meta.frame)")
    assert {1, 2, 3, 4, 5, 6} <= set(frames)
    for theta, beta, follows in ((30, 200, True), (80, 200, False)):
        choose = f"document.getElementById('theta').value = {theta}; document.getElementById('beta').value = {beta};"
        page.evaluate(choose + "document.getElementById('theta').dispatchEvent(new Event('input'))")
        row = row_of(found, theta, beta)
        end = world.TARGET + 210 * found.outward_ct[row]
        last = "document.getElementById('scene3d').data.at(-1)"
        page.wait_for_function(f"{last}.x.length === 2 && Math.abs({last}.x[1] - {end[0]}) < 0.01")
        moves = [np.linalg.inv(T_base_ct) @ link_poses(model, one) for one in (q[first], q[row])]
        for mine, frame, points in zip(json.loads(page.evaluate(places)), frames, before, strict=True):
            T = moves[1][frame] @ np.linalg.inv(moves[0][frame]) if follows else np.eye(4)
            assert np.abs(np.array(mine).T - (points[::50] @ T[:3, :3].T + T[:3, 3])).max() < 0.1, (row, frame)
        assert page.evaluate("document.querySelector('.of-scene').hidden") == follows


def unpacked(trace):
    return np.stack([np.frombuffer(base64.b64decode(trace[axis]["bdata"]), "<f4") for axis in "xyz"], axis=1)


def random_pose(rng):
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.uniform(-300, 300, 3)
    return T


@pytest.fixture
def scene(desk):
    """The page, whose scene is drawn."""
    if desk.evaluate("document.getElementById('scene3d').hidden"):
        pytest.skip("this browser has no WebGL")
    desk.locator(SCENE).scroll_into_view_if_needed()  # what nobody sees is not drawn
    desk.wait_for_selector(f"{SCENE} canvas >> nth=0")
    return desk


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


def test_hover_explains_a_refusal(desk, case, candidates):
    """Over a rejected cell: angles, verdict, reason with structure, depth and mm; the sentence that comes with it."""
    words = point_at(desk, case, candidates, 40, 60)
    assert "θ 40°, β 60°" in words
    assert "rejected" in words and "too_close" in words and "rib right 9" in words
    assert "55.5 mm from the target" in words and re.search(r"clearance 0\.3 mm", words)
    assert "the shaft ends at 150 mm" in point_at(desk, case, candidates, 80, 200)


def test_hover_shows_a_safe_direction(desk, case, candidates):
    """Verdict, rank, clearance with the nearest structure, path; beyond the rim the chosen one's, at first the best."""
    words = point_at(desk, case, candidates, 40, 220)
    assert "θ 40°, β 220°" in words
    assert f"safe, rank {candidates.ranking.rank[row_of(candidates, 40, 220)]}" in words
    assert "least clearance 9.0 mm (rib right 9)" in words and "100.0 mm" in words
    words = point_at(desk, case, candidates, 120, 45)
    assert "rank 1" in words and "θ 0°, β 0°" in words


def test_choosing_moves_everything(desk, case, candidates):
    """Table, sliders and map all set panel, sliders, command and slices, which say whose they are."""
    point_at(desk, case, candidates, 30, 200, click=True)
    command, chosen = desk.locator("#command"), desk.locator("#slices-of")
    assert command.inner_text() == f"run-twin plan {Path.cwd().resolve()}/ball.toml --theta 30 --beta 200"
    assert [desk.locator(name).input_value() for name in ("#theta", "#beta")] == ["30", "200"]
    assert "θ 30°, β 200° · safe" in chosen.inner_text()
    desk.locator("button.pick").first.click()
    assert desk.locator("button.pick").first.get_attribute("aria-pressed") == "true"
    assert "θ 0°, β 0° · safe" in chosen.inner_text()
    desk.locator("#theta").fill("80")
    assert command.inner_text().startswith("run-twin check /")
    assert "rejected" in desk.locator("#hover").inner_text()


def test_slices_are_shown_in_every_window(desk):
    """The CT's bytes become greys of each window."""
    pixels = "document.querySelector('#slices-a .ct').getContext('2d').getImageData(0, 0, 480, 480).data"
    largest = f"{pixels}.reduce((most, value, k) => k % 4 ? most : Math.max(most, value), 0)"
    for tone in ("lung", "bone", "brain", "abdomen"):
        desk.locator(f"#tones [data-tone={tone}]").click()
        desk.wait_for_function(f"document.getElementById('slices-a').dataset.tone === '{tone}'")
        level, width = TONES[tone]
        brightest = 255 * min(1.0, (299 - level) / width + 0.5)  # the densest voxels, to half a step of the table
        assert abs(desk.evaluate(largest) - brightest) <= 255 * 12 / width + 1


def test_the_focus_is_visible(desk):
    desk.keyboard.press("Tab")
    assert desk.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"


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


def test_no_error_and_no_request(browser, address, case, candidates):
    """Under the page's own policy, whatever is chosen: nothing on the console; only the file itself was asked for."""
    page = browser.new_page(viewport={"width": 1300, "height": 900})
    page.set_default_timeout(PATIENCE_MS)
    told, asked = [], []
    page.on("pageerror", lambda error: told.append(str(error)))
    page.on("console", lambda one: told.append(one.text) if one.type in {"error", "assert"} else None)
    page.on("request", lambda one: asked.append(one.url) if not one.url.startswith(("data:", "blob:")) else None)
    page.goto(address)
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
    assert told == [] and asked == [address]
