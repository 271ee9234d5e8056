"""The page of a case whose block of the CT holds little: what lies beyond is never said to be free.

The image's slices are tilted as by a gantry and run from the left, so the block is no box of the body's.
"""

import re
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import report_world as world
from page_browser import GREYS, SHOWN, at_pixel, drawn, picture, ready, row_of

from puncture_twin.planning.case.entry import angles
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.search.candidates import Pick
from puncture_twin.twin.report.page.page import Shown, write_page
from puncture_twin.twin.report.page.page_slices import block_box
from puncture_twin.twin.report.palette import organ_colours
from puncture_twin.twin.report.slices.panel import PIXELS, TONES, Subject
from puncture_twin.twin.report.slices.planes import needle_planes

TILTED = ((-1.0, 0.0, 0.0), (0.0, 0.9, -0.3), (0.0, 0.3, 0.95))
GROUND, HATCH = (44, 47, 54), (106, 113, 122)


@pytest.fixture(scope="module")
def patient():
    """Safe are directions within 20 degrees of the entry axis alone: entries beyond 60 mm of theirs are on no page."""
    case = world.make_case(space="RAS", frame=None)
    found = world.make_candidates(case)
    reason = np.where(
        (found.verdict.reason == "") & (found.theta > np.radians(20.1)), "skin_angle", found.verdict.reason
    )
    safe = reason == ""
    ranking = replace(
        found.ranking, rank=np.where(safe, found.ranking.rank, 0), cost=np.where(safe, found.ranking.cost, np.nan)
    )
    found = replace(found, verdict=replace(found.verdict, reason=reason), ranking=ranking)
    anatomy = world.make_anatomy()
    anatomy.scan = world.make_scan(axes=TILTED)
    return case, anatomy, found


@contextmanager
def page_of(browser, patient, path, has_ct):
    case, anatomy, found = patient
    shown = world.make_anatomy()
    shown.scan = anatomy.scan if has_ct else None
    write_page(Shown(case, shown, found, world.make_plan(case, found), subject=Subject(case, shown, found.best)), path)
    with ready(browser, path.as_uri()) as page:
        yield page


@pytest.fixture(scope="module")
def page(browser, patient, tmp_path_factory):
    with page_of(browser, patient, tmp_path_factory.mktemp("page") / "report.html", True) as page:
        yield page


def choose(page, found, theta_deg, beta_deg):
    page.locator("#beta").fill(str(beta_deg))
    page.locator("#theta").fill(str(theta_deg))
    page.locator("#beta").fill(str(beta_deg))
    row = row_of(found, theta_deg, beta_deg)
    drawn(page, row)
    return row


def in_box(points, case, found):
    """Which points the page holds."""
    low, high = block_box(case.target_ct, found)
    return ((points >= low) & (points <= high)).all(axis=1)


@pytest.mark.parametrize("has_ct", [True, False])
def test_what_the_page_does_not_hold_is_hatched(browser, page, patient, has_ct, tmp_path):
    """Of a rejected direction each pixel beyond the box is hatched, with or without a CT; those in it are the CT's."""
    case, anatomy, found = patient
    with nullcontext(page) if has_ct else page_of(browser, patient, tmp_path / "report.html", False) as one:
        row = choose(one, found, 60, 180)
        drawings = one.evaluate(SHOWN)
    planes = needle_planes(case.target_ct, found.outward_ct[row], found.path.length[row])
    for (base, _), plane in zip(drawings, planes, strict=True):
        points, shown = plane.points_ct(PIXELS), picture(base).reshape(-1, 3)
        held = in_box(points, case, found)
        hatched = (shown == GROUND).all(axis=1) | (shown == HATCH).all(axis=1)
        assert (hatched != ~held)[~held].mean() < 1e-2 if (~held).any() else True, plane.name
        if has_ct:
            grey = TONES["abdomen"].grey(anatomy.scan.hu_at(points)).astype(int)
            assert (np.abs(shown[held, 0] - grey[held]) > GREYS).mean() < 2e-3, plane.name
        else:
            assert (shown[held] == GROUND).all(axis=1).mean() > 0.99 and (
                not (~held).any() or (shown[~held] == HATCH).all(axis=1).any()
            )
    assert any(not in_box(plane.points_ct(PIXELS), case, found).all() for plane in planes)


def test_a_point_beyond_the_page_has_no_structure_and_no_units(page, patient):
    """Where surfaces are coarse nothing is said to be free."""
    case, _, found = patient
    row = choose(page, found, 60, 180)
    plane = needle_planes(case.target_ct, found.outward_ct[row], found.path.length[row])[1]
    held = in_box(plane.points_ct(PIXELS), case, found).reshape(PIXELS, PIXELS)
    line, column = np.argwhere(~held)[len(np.argwhere(~held)) // 2]
    at_pixel(page, 1, column, line)
    said = page.locator("#cursor").inner_text()
    assert said.startswith("not on this page") and "structure" not in said and "HU" not in said


def test_a_resting_pointer_reads_what_is_drawn_now(page, patient):
    """The wheel, or another direction, changes the plane under the pointer: the words follow."""
    _, anatomy, found = patient
    choose(page, found, 0, 0)
    at_pixel(page, 0, 240, 240)
    place = r"\(([^)]+)\) mm RAS"
    before = re.search(place, page.locator("#cursor").inner_text())[1]
    page.mouse.wheel(0, 100)
    page.wait_for_function("document.querySelector('#slices-a output').textContent !== '0 mm'")
    after = page.locator("#cursor").inner_text()
    assert re.search(place, after)[1] != before
    right, front, head = (float(mm) for mm in re.search(place, after.replace("−", "-"))[1].split(","))
    hu, doubt = map(float, re.match(r"(\S+) ± (\d+) HU", after.replace("−", "-")).groups())
    near = np.array([-right, -front, head]) + np.stack(np.meshgrid(*[[-0.5, 0, 0.5]] * 3), -1).reshape(-1, 3)
    assert np.abs(anatomy.scan.hu_at(near) - hu).min() <= doubt + 0.5
    page.locator("#slices-centre").click()


def dragged(page, patient, row, aside):
    """Drag the entry in the second slice by pixels; returns the direction that it then has."""
    case, _, found = patient
    plane = needle_planes(case.target_ct, found.outward_ct[row], found.path.length[row])[1]
    x, y = plane.place(plane.at_ct + found.path.length[row] * found.outward_ct[row]) - plane.centre
    start = at_pixel(page, 1, *((1 + np.array([x, -y]) / plane.half_mm) * PIXELS / 2 - 0.5))
    page.mouse.down()
    page.mouse.move(start[0] + aside[0], start[1] + aside[1], steps=2)
    page.mouse.up()
    size = page.locator("#slices-a .over").nth(1).bounding_box()["width"]
    per_mm = size / (2 * plane.half_mm)
    end = plane.at_ct + found.path.length[row] * found.outward_ct[row]
    end = end + (aside[0] * plane.right - aside[1] * plane.up) / per_mm
    return (end - case.target_ct) / np.linalg.norm(end - case.target_ct)


def test_an_own_path_is_its_own_everywhere(page, patient):
    """Command and sliders have its angles, no window is pressed; kept beside the next it has no other verdict."""
    case, _, found = patient
    row = choose(page, found, 10, 180)
    page.locator("[data-mode=move]").click()
    outward = dragged(page, patient, row, (9, 2))
    theta, beta = (float(np.degrees(one)) for one in angles(outward @ case.T_ct_entry[:3, :3]))
    said = re.match(r"run-twin check \S+ --theta (\S+) --beta (\S+)$", page.locator("#command").inner_text())
    assert float(said[1]) == pytest.approx(theta, abs=0.4) and float(said[2]) == pytest.approx(beta, abs=4)
    assert page.locator("#theta-out").inner_text() == f"{round(float(said[1]), 3):g}°"
    assert page.locator("button.pick[aria-pressed=true]").count() == 0
    own = page.locator("#slices-of b").inner_text()
    page.locator("#slices-keep").click()
    page.locator("button.pick").first.click()
    kept = page.locator("#slices-kept-of").inner_text()
    assert own in kept and "not known" in kept
    page.locator("#slices-keep").click()
    page.locator("[data-mode=point]").click()


def test_an_own_entry_beyond_the_page_is_not_made_up(page, patient):
    """The skin there is coarse: no entry, no path, no needle to take is read off it."""
    row = choose(page, patient[2], 85, 180)
    page.locator("[data-mode=move]").click()
    dragged(page, patient, row, (3, 4))
    assert "not on this page" in page.locator("#slices-of").inner_text()
    numbers = dict(line.split("\t") for line in page.locator("#slices-numbers tbody").inner_text().splitlines())
    assert numbers["skin entry"] == "not on this page" and numbers["path in the body"] == "–"
    assert "NaN" not in page.locator("main").inner_text()
    page.locator("[data-mode=point]").click()
    page.locator("#slices-back").click()


def test_parts_of_another_direction_say_so(page, patient):
    """Plan and scene are of the planned one: beside another that is chosen they name theirs, and lead back to it."""
    found = patient[2]
    page.locator("button.pick").first.click()
    assert page.locator(".of-first:visible").count() == 0
    choose(page, found, 15, 200)
    notes = page.locator(".of-first:visible").all_inner_texts()
    assert len(notes) == page.locator(".of-first").count() >= 2 and all("θ 0°, β 0°" in one for one in notes)
    page.locator(".of-first button").first.click()
    assert (
        page.locator(".of-first:visible").count() == 0 and "--theta 0 --beta 0" in page.locator("#command").inner_text()
    )


def test_a_pick_beside_the_grid_leaves_the_sliders_whole(browser, patient, tmp_path):
    """Their step is the grid's, and each key moves by one of its steps, past the pick too."""
    case, anatomy, found = patient
    apart = replace(found, theta=found.theta + np.radians(0.37))
    row = row_of(found, 10, 180)
    write_page(
        Shown(case, anatomy, found, pick=Pick(apart, row), subject=Subject(case, anatomy, Pick(apart, row))),
        tmp_path / "p.html",
    )
    with ready(browser, (tmp_path / "p.html").as_uri()) as page:
        assert "--theta 10.37 --beta 180" in page.locator("#command").inner_text()
        page.locator("#theta").focus()
        seen = set()
        for _ in range(3):
            page.keyboard.press("ArrowRight")
            seen.add(page.locator("#theta-out").inner_text())
        assert len(seen) == 3


def test_an_open_structure_is_crossed_too(browser, patient, tmp_path):
    """It has no inside: its crossings are marked along the needle, and no point in it is said to be in no structure."""
    case, anatomy, found = patient
    liver, rib, aorta = anatomy.checked
    mesh = TriangleMesh(rib.mesh.vertices, rib.mesh.faces[1:])
    toward = int(np.argmin(found.outward_ct[:, 0]))  # the rib, on the patient's right
    right = [round(float(np.degrees(one[toward]))) for one in (found.theta, found.beta)]
    parts = (liver, SimpleNamespace(**{**vars(rib), "mesh": mesh, "closed": False}), aorta)
    shown = SimpleNamespace(**{**vars(anatomy), "checked": parts, "structures": parts, "scan": None})
    write_page(Shown(case, shown, found), tmp_path / "p.html")
    with ready(browser, (tmp_path / "p.html").as_uri()) as page:
        row = choose(page, found, *right)
        units = picture(page.evaluate("document.getElementById('slices-units').toDataURL()"))
        colour = np.array(organ_colours(("liver", "rib_right_9", "aorta"))["rib_right_9"])
        columns = np.flatnonzero((np.abs(units - colour).max(axis=2) < 8).any(axis=0))
        assert 2 * 2 <= len(columns) <= 30 and np.diff(columns).max() > 50  # 16 mm apart, a mark of one each
        mine = needle_planes(case.target_ct, found.outward_ct[row], found.path.length[row])[0]
        x, y = mine.place(case.target_ct + [-70.0, 0, 0]) - mine.centre
        at_pixel(page, 0, *((1 + np.array([x, -y]) / mine.half_mm) * PIXELS / 2))
        assert page.locator("#cursor").inner_text().startswith("in no closed structure")
