"""The page on a phone, a tablet and a desk, by Playwright in headless Chromium; skipped where there is no browser.

What its script cuts out of the page's block of the CT is what ``slices.png`` shows.
"""

import base64
import json
import re
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import report_world as world
import scipy
from page_browser import GREYS, SHOWN, at_pixel, drawn, pick_first, picture, ready, row_of, serious_findings
from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.search.candidates import Pick
from puncture_twin.twin.report.page import page_slices, page_surfaces
from puncture_twin.twin.report.page.page import Shown, write_page
from puncture_twin.twin.report.page.page_data import scene_figure
from puncture_twin.twin.report.page.page_slices import ct_block
from puncture_twin.twin.report.slices.panel import PIXELS, TONES, Subject, draw_panel
from puncture_twin.twin.report.slices.planes import needle_planes
from puncture_twin.twin.report.slices.sheet import flat

WIDTHS = [390, 900, 1440]
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


@pytest.fixture(scope="module", params=WIDTHS)
def page(request, browser, address):
    """The page, open and drawn, at one width; all tests of a width share it."""
    with ready(browser, address, request.param) as page:
        yield page


@pytest.fixture(scope="module")
def desk(browser, address):
    """The page on a desk alone: what it cuts and reads does not hang on the window."""
    with ready(browser, address, WIDTHS[-1]) as page:
        yield page


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
def test_every_colour_has_contrast(page, scheme):
    """All text 4.5 and all buttons' edges 3 to 1 in both styles; what is drawn stays, and paper is light."""
    drawn_colours = page.evaluate(SHOWN)
    page.emulate_media(color_scheme=scheme)
    found = page.evaluate(COLOURS)
    assert len(found) > 150
    for text, least, *colours in found:
        dark, light = sorted(map(luminance, colours))
        assert (light + 0.05) / (dark + 0.05) >= least, (text, colours)
    ground = "getComputedStyle(document.body).backgroundColor"
    assert (page.evaluate(ground) == "rgb(255, 255, 255)") == (scheme == "light")
    assert page.evaluate(SHOWN) == drawn_colours
    page.emulate_media(color_scheme=scheme, media="print")
    assert page.evaluate(ground) == "rgb(255, 255, 255)"
    page.emulate_media(color_scheme="light", media="screen")


def test_a_click_chooses_and_everything_follows(page):
    """On the map, in the table, by the keyboard; the page never grows wider than its window."""
    command = page.locator("#command")
    page.locator("#map-image").click(position={"x": 150, "y": 150})
    chosen = command.inner_text()
    assert chosen.startswith("run-twin ") and "--theta" in chosen
    page.locator("button.pick").first.click()
    assert command.inner_text() != chosen and page.locator("button.pick[aria-pressed=true]").count() == 1
    picked = command.inner_text()
    page.locator("#theta").focus()
    page.keyboard.press("ArrowRight")
    assert command.inner_text() != picked
    page.locator("#pose-target").click()
    assert page.locator("#pose-target").get_attribute("aria-pressed") == "true"
    page.locator("[data-view=axial]").click()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_dates_film_and_fractions_are_there(desk):
    """When it was made, that the scan's day is not stated, a link to the film, parts of the solid angle."""
    said = desk.locator("header").inner_text()
    assert "Made on 20" in said and "scan date not stated" in said
    assert desk.locator("a[href='rehearsal.mp4']").count() == 1
    assert "of solid angle" in desk.locator(".mapside").inner_text()


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
