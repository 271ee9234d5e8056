"""What a person looks at: map, scene, film, page; checked by geometry."""

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path as FilePath
from types import SimpleNamespace

import imageio_ffmpeg
import numpy as np
import pytest
import report_world as world
import trimesh
from matplotlib.text import Text
from PIL import Image, ImageDraw

from puncture_twin.planning.base.reasons import REASON_COLOURS
from puncture_twin.planning.case.entry import ANATOMICAL_LPS
from puncture_twin.planning.case.tables import EntryAxes
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.place.mounts import ring_weights
from puncture_twin.planning.search.candidates import Pick
from puncture_twin.twin.report import annotate, patient as patient_blocks
from puncture_twin.twin.report.map.map_picture import DISC, map_figure
from puncture_twin.twin.report.map.map_raster import map_raster
from puncture_twin.twin.report.map_view import grid_step, map_view
from puncture_twin.twin.report.numbers import length_text, nearest_text, reason_counts
from puncture_twin.twin.report.page import page_data
from puncture_twin.twin.report.page.page import Shown, write_page
from puncture_twin.twin.report.page.page_data import TRIANGLES, lightened, map_data
from puncture_twin.twin.report.palette import SAFE_HIGH, SAFE_LOW
from puncture_twin.twin.report.raster.camera import ViewCamera
from puncture_twin.twin.report.raster.render import Layer
from puncture_twin.twin.report.scene import film, scene_picture
from puncture_twin.twin.report.scene.film import draw_film, model_note
from puncture_twin.twin.report.scene.scene_parts import (
    LIFT_MM,
    SceneBody,
    corridor,
    needle_bodies,
    overview,
    patient,
    up_ct,
)
from puncture_twin.twin.report.scene.scene_picture import draw_scene, render_bodies

FRAMES = {
    "bed": ("LPS", None),
    "axes of the CT": ("LPS", "ct"),
    "prone": ("LPS", EntryAxes(z="posterior", x="head")),
    "tilted": ("LPS", EntryAxes(z=(0.5, -1.0, 0.2), x=(0.1, 0.3, 1.0))),
    "local": ("local", None),
}


def angle_between(a, b):
    return abs(np.mod(a - b + np.pi, 2 * np.pi) - np.pi)


@pytest.mark.parametrize(
    ("name", "centre", "rim"),
    [
        ("bed", "front", {"head": 90, "patient's right": 180, "feet": 270, "patient's left": 0}),
        ("prone", "back", {"head": 90, "patient's right": 0, "feet": 270, "patient's left": 180}),
        ("local", "+z", {"+x": 0, "−x": 180, "+y": 90, "−y": 270}),
    ],
)
def test_the_rim_names_the_bodys_directions(name, centre, rim):
    """On the back, seen from the front, the patient's right is on the left; a carton has no head but axes."""
    case = world.make_case(space=FRAMES[name][0], frame=FRAMES[name][1])
    view = map_view(case, world.make_candidates(case))
    angles = {label.text: label.angle for label in view.rim}
    assert angles.keys() == rim.keys() and view.centre == centre
    assert max(angle_between(angles[one], np.radians(angle)) for one, angle in rim.items()) < 1e-9


@pytest.mark.parametrize("name", FRAMES)
def test_the_map_is_what_a_camera_outside_sees(name):
    """Where a direction lies on the map agrees with a camera that looks along -z of the entry frame: no mirroring."""
    case = world.make_case(space=FRAMES[name][0], frame=FRAMES[name][1])
    found = world.make_candidates(case, step_deg=10.0)
    view = map_view(case, found)
    R = case.T_ct_entry[:3, :3]
    up = R @ [np.cos(np.pi / 2 - view.turn), np.sin(np.pi / 2 - view.turn), 0.0]
    far = 1e6
    camera = ViewCamera(case.target_ct + far * R[:, 2], case.target_ct, up, 0.001, 1000, 1000)
    rows = np.flatnonzero((found.theta > 0.1) & (found.theta < 3.0))
    seen = camera.project(case.target_ct + 100 * found.outward_ct[rows])[:, :2] - 500
    on_map = view.place(found.theta[rows], found.beta[rows])
    angle_seen, angle_map = np.arctan2(-seen[:, 1], seen[:, 0]), np.arctan2(on_map[:, 1], on_map[:, 0])
    assert angle_between(angle_seen, angle_map).max() < 1e-3
    for label in view.rim:
        words = {"front": "anterior", "back": "posterior"}
        if "/" in label.text or FRAMES[name][0] == "local":
            continue
        body = label.text.split(" (")[0].removeprefix("patient's ")
        vector = np.array(ANATOMICAL_LPS[words.get(body, body)])
        x, y = (camera.project(case.target_ct + 100 * vector)[0, :2] - 500) * [1, -1]
        assert angle_between(np.arctan2(y, x), label.angle) < 1e-3


@pytest.mark.parametrize("theta_max", [60, 180])
def test_the_map_has_no_gap_and_each_pixel_the_colour_of_its_reason(case, theta_max):
    """Every pixel within the rim belongs to a cell; the one where (θ, β) lies shows the verdict of (θ, β)."""
    found = world.make_candidates(case, theta_deg=(0, theta_max))
    view = map_view(case, found)
    raster = map_raster(found, view, 301)
    axis = (np.arange(301) + 0.5) / 301 * 2 - 1
    inside, outside = np.hypot(axis[:, None], axis) < 0.995, np.hypot(axis[:, None], axis) > 1.005
    assert (raster.rows[inside] >= 0).all() and (raster.rgba[inside, 3] == 255).all()
    assert (raster.rgba[outside, 3] == 0).all()
    for row in np.flatnonzero((found.theta > 0.3) & (found.theta < np.radians(theta_max - 2)))[::7]:
        x, y = view.place(found.theta[row], found.beta[row])
        colour = raster.rgba[int((1 - y) * 150.5), int((1 + x) * 150.5), :3]
        if reason := str(found.verdict.reason[row]):
            assert tuple(colour) == REASON_COLOURS[reason]
        else:
            low, high = np.minimum(SAFE_LOW, SAFE_HIGH), np.maximum(SAFE_LOW, SAFE_HIGH)
            assert ((colour >= low) & (colour <= high)).all()


def map_pixel(image, view, theta_deg, beta_deg):
    """The colour of the finished picture at a direction, found from the layout of the figure."""
    left, low, wide, high = DISC
    x, y = (view.place(np.radians(theta_deg), np.radians(beta_deg)) + 1) / 2
    column, line = (left + x * wide) * image.width, (1 - low - y * high) * image.height
    return image.getpixel((int(column), int(line)))


def test_the_finished_map_has_the_colours_where_they_belong(case, candidates):
    """Of a refusal by its length, one by a rib, a safe direction; and of the only direction of a grid."""
    image, view = world.map_image(candidates, case), map_view(case, candidates)
    assert map_pixel(image, view, 82.0, 200.0) == REASON_COLOURS["too_long"]
    assert map_pixel(image, view, 35.0, 48.0) == REASON_COLOURS["too_close"]
    red, green, blue = map_pixel(image, view, 40.0, 223.0)
    assert green > 1.2 * red and green > blue
    one = world.make_candidates(case, theta_deg=(40, 40), beta_deg=(200, 200))
    assert len(one) == 1
    assert map_pixel(world.map_image(one, case), map_view(case, one), 20.0, 200.0) == (255, 255, 255)


def test_counts_and_solid_angles(case, candidates):
    """Counts add up; a cap's share of the solid angle is 1 - cos, whatever the grid's density."""
    lines = reason_counts(candidates)
    assert lines[0].code == "safe"
    assert sum(line.count for line in lines) == len(candidates)
    assert sum(line.solid_angle for line in lines) == pytest.approx(1)
    weights = ring_weights(candidates.theta, grid_step(candidates))
    cap = weights[candidates.theta < np.radians(31)].sum() / weights.sum()
    assert cap == pytest.approx((1 - np.cos(np.radians(32.5))) / (1 - np.cos(np.radians(92.5))))


def test_the_corridor_is_where_the_safe_directions_are(case, candidates):
    """Its mouth lies on the skin, has the solid angle of the safe cells, and its walls have a closed rim."""
    mouth, walls = corridor(candidates, case)
    radius = np.linalg.norm(mouth.vertices - world.TARGET, axis=1)
    assert np.allclose(radius, world.SKIN_RADIUS + LIFT_MM)
    a, b, c = np.moveaxis(mouth.triangles, 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    step = np.radians(2.5)
    cells = np.cos(candidates.theta - step).clip(max=1) - np.cos(candidates.theta + step)
    cells[candidates.theta < 1e-6] = 1 - np.cos(step)
    solid = (cells * 2 * step)[candidates.safe].sum()
    assert area == pytest.approx(solid * (world.SKIN_RADIUS + LIFT_MM) ** 2, rel=0.005)
    apex = len(walls.vertices) - 1
    assert np.allclose(walls.vertices[apex], world.TARGET)
    _, uses = np.unique(walls.faces[walls.faces != apex], return_counts=True)
    assert (uses % 2 == 0).all()
    nothing = world.make_candidates(case, safe=False)
    assert corridor(nothing, case) == []


def test_needle_and_holder_end_where_they_should(case):
    outward = np.array([0.0, 0.6, -0.8])
    bodies = needle_bodies(case.needle, world.TARGET, outward)
    spans = [np.sort((b.mesh.vertices - world.TARGET) @ outward)[[0, -1]] for b in bodies]
    assert np.allclose(spans, [[0, 150], [150, 210]])
    across = bodies[1].mesh.vertices - world.TARGET
    across = across - np.outer(across @ outward, outward)
    assert np.linalg.norm(across, axis=1).max() == pytest.approx(15)


def test_the_target_shows_where_it_is(anatomy, case):
    """The red ball shines through liver and skin where the camera's projection says, and changes nothing else."""
    bodies = patient(anatomy, case)
    camera = ViewCamera(
        world.TARGET + np.array([30, -500, 20]), world.TARGET + np.array([10, 0, -5]), np.eye(3)[2], 0.4, 120, 90
    )
    with_ball = render_bodies(bodies, camera).astype(int)
    without = render_bodies([body for body in bodies if body.group != "target"], camera).astype(int)
    column, row, depth = camera.project(world.TARGET)[0]
    rows, columns = np.mgrid[0:90, 0:120] + 0.5
    away = np.hypot(rows - row, columns - column) * depth / camera.scale
    reddened = (with_ball - without)[..., 0] - (with_ball - without)[..., 1]
    assert (reddened[away < 2.0] > 20).all()
    assert (with_ball == without)[away > 6.0].all()


@pytest.mark.parametrize("name", FRAMES)
def test_the_overview_looks_down_from_beside_the_patient(name, anatomy):
    """Never from under the table, never along the body; everything is in the picture."""
    case = world.make_case(space=FRAMES[name][0], frame=FRAMES[name][1])
    content = anatomy.skin.mesh.vertices
    camera = overview(
        case, content, world.TARGET[None], Layer([SceneBody("", "", anatomy.skin.mesh, (0, 0, 0)).surface]), (90, 60)
    )
    toward = camera.axes[2]
    assert toward @ up_ct(case) < -0.3
    if case.space != "local":
        assert abs(toward @ np.array(ANATOMICAL_LPS["head"])) < 0.65
        assert abs(up_ct(case) @ np.array(ANATOMICAL_LPS["head"])) < 0.5
    seen = camera.project(content)[:, :2]
    assert (seen >= -0.5).all() and (seen <= [90.5, 60.5]).all()


def test_the_cross_of_directions_points_the_right_way(monkeypatch, case):
    """In a view from the feet on a patient on the back, the patient's left is on the left."""
    written = {}
    monkeypatch.setattr(annotate, "write", lambda draw, at, words, **look: written.update({words: np.array(at)}))
    camera = ViewCamera(np.array([0.0, 0, -500]), np.zeros(3), np.array([0, -1.0, 0]), 0.5, 200, 200)
    draw = ImageDraw.Draw(Image.new("RGB", (200, 200)))
    annotate.body_axes(draw, camera, case.space, (100.0, 100.0), 40.0)
    assert written.keys() == {"left", "right", "front", "back"}  # head and feet lie along the view
    # Looking toward the head with the front up, right-handed LPS puts +x (left) on the viewer's right.
    assert written["left"][0] > 100 > written["right"][0]
    assert written["front"][1] < 100 < written["back"][1]


def test_the_scene_with_and_without_an_answer(anatomy, case, candidates, plan, tmp_path, monkeypatch):
    monkeypatch.setattr(scene_picture, "LEFT_BOX", (16, 84, 616, 484))
    monkeypatch.setattr(scene_picture, "RIGHT_BOX", (630, 84, 1230, 484))
    nothing = world.make_candidates(case, safe=False)
    pictures = []
    for number, (found, motion) in enumerate(((candidates, plan), (candidates, None), (nothing, None))):
        draw_scene(Shown(case, anatomy, found, motion), tmp_path / f"{number}.png")
        pictures.append(np.asarray(Image.open(tmp_path / f"{number}.png"))[90:480, 20:610].astype(int))
    greens = [((p[..., 1] > p[..., 0] + 25) & (p[..., 1] > p[..., 2] + 10)).sum() for p in pictures]
    assert greens[1] > 200 and greens[2] == 0
    assert len(list(tmp_path.iterdir())) == 3


def test_a_film_of_which_frames_are_lost_is_no_film(tmp_path, rng, monkeypatch):
    """An encoder on a full disk ends without a word: what it left must not pass for the film."""
    frames, path = [rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)] * 7, tmp_path / "film.mp4"
    film.write_mp4(frames, (64, 48), path, 15)
    assert len(decoded(path)[1]) == 7
    usual = imageio_ffmpeg.count_frames_and_secs

    def cut_off(file):
        FilePath(file).write_bytes(FilePath(file).read_bytes()[:-1000])
        return usual(file)

    monkeypatch.setattr(film.imageio_ffmpeg, "count_frames_and_secs", cut_off)
    with pytest.raises(RuntimeError):
        film.write_mp4(frames, (64, 48), tmp_path / "cut.mp4", 15)
    assert [one.name for one in tmp_path.iterdir()] == ["film.mp4"]


def test_the_film_says_what_it_does_not_show():
    """Rigid where nothing else is declared; what is declared is computed, and drawn as if it were not."""
    rigid, bent, breathes = (
        model_note(SimpleNamespace(bending=a, breathing=b))
        for a, b in zip((None, 1, None), (None, None, 1), strict=True)
    )
    assert rigid == "needle and tissue are rigid; nothing breathes; research software, not a medical device"
    assert "its end is bent, the drawing is straight" in bent and "the body is drawn still, as in the CT" in breathes


@pytest.mark.parametrize("total_s", [0.5, 5.0, 11.0, 31.0, 400.0])
def test_film_times(total_s):
    """The film plays 8 s or more where slow motion by two allows, at most 15 s, and ends with the rehearsal's end."""
    times = film.film_times(total_s)
    assert times.moments[0] == 0 and times.moments[-1] == pytest.approx(total_s)
    assert times.duration_s <= 15
    gaps = np.diff(times.moments)
    assert np.allclose(gaps[:-1], times.speed / film.FRAMES_PER_SECOND) and gaps[-1] <= gaps[0] + 1e-9
    assert times.duration_s == pytest.approx(total_s / times.speed + film.STILL_S, abs=0.2)


def decoded(path):
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    frames = [np.frombuffer(frame, np.uint8).reshape(meta["size"][1], meta["size"][0], 3) for frame in reader]
    return meta, frames


def test_the_film_has_the_frames_it_says_shows_the_patient_and_ends_with_the_result(anatomy, case, plan, tmp_path):
    """Count, duration and size as stated; the needle comes down; the last frame stands still, the end written over it.

    The body fills the overview, and the needle is four pixels wide at least.
    """
    done = world.make_rehearsal(plan, total_s=1.0)
    done.contacts = ()
    written = draw_film(done, plan, case, anatomy, tmp_path / "film.mp4")
    assert written == tmp_path / "film.mp4" and [p.name for p in tmp_path.iterdir()] == ["film.mp4"]
    times = film.film_times(1.0)
    meta, frames = decoded(written)
    assert meta["size"] == (film.WIDTH, film.HEIGHT) and meta["fps"] == film.FRAMES_PER_SECOND
    assert len(frames) == times.frames
    assert meta["duration"] == pytest.approx(times.duration_s, abs=0.15)
    end, last = len(times.moments) - 1, frames[-1]
    view = np.s_[80 : film.VIEW_HEIGHT, : film.VIEW_WIDTH]
    moved, still = (np.abs(one[view].astype(int) - frames[end][view]).mean() for one in (frames[0], last))
    assert moved > 10 * still
    before = frames[int(0.7 * end)]
    body = before[: film.VIEW_HEIGHT, : film.VIEW_WIDTH].astype(int)
    reddish = body[..., 0] - body[..., 2] > 12  # skin and organs; ground and arm are grey or blue
    assert np.ptp(np.flatnonzero(reddish.sum(axis=1) > 20)) > 0.7 * film.VIEW_HEIGHT
    dark = (body < 70).all(axis=2)[60]
    assert 4 <= dark.sum() <= 8 and np.ptp(np.flatnonzero(dark)) < 8
    band = np.s_[film.VIEW_HEIGHT - 36 : film.VIEW_HEIGHT - 8, 10:400]
    inked = [(frame[band].astype(int) < 60).all(axis=2).sum() for frame in (before, last)]
    assert inked[1] > 500 > 10 * inked[0]


def test_after_a_checked_search_the_arm_is_in_the_scene(anatomy, case, candidates, plan):
    """With the joints of the search, where the base is known; none of another direction, and none without a base."""
    best = candidates.best
    q = np.full((len(candidates), 6), np.nan)
    q[best.row] = plan.insertion.q[-1]
    reached = replace(candidates, arm=replace(candidates.arm, q_insertion=q))

    def arms(pick, T_base_ct):
        figure = page_data.scene_figure(Shown(case, anatomy, reached, pick=pick, T_base_ct=T_base_ct))
        return [trace for trace in figure["data"] if trace.get("meta", {}).get("arm")]

    assert len(arms(Pick(reached, best.row), plan.T_base_ct)) > 6
    assert not arms(Pick(reached, best.row), None) and not arms(Pick(reached, best.row + 1), plan.T_base_ct)


def test_without_an_encoder_there_is_a_gif(anatomy, case, plan, tmp_path, monkeypatch):
    """A machine without H.264 still gets a film, and no broken MP4 beside it."""

    def no_encoder(*args, **options):
        raise RuntimeError("no ffmpeg")

    monkeypatch.setattr(film.imageio_ffmpeg, "write_frames", no_encoder)
    monkeypatch.setattr(film, "film_times", lambda total: film.FilmTimes((0.0, total), 1.0, 1))
    written = draw_film(world.make_rehearsal(plan), plan, case, anatomy, tmp_path / "film.mp4")
    assert [p.name for p in tmp_path.iterdir()] == ["film.gif"] == [written.name]
    assert Image.open(written).n_frames in {2, 3}  # Pillow joins equal frames


@pytest.fixture(scope="module")
def report(anatomy, case, candidates, plan, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    rehearsal = world.make_rehearsal(plan)
    write_page(Shown(case, anatomy, candidates, plan, rehearsal, world.make_registration()), path)
    return path.read_text(encoding="utf-8")


def visible(text):
    """The page without its scripts, styles and the bytes of its pictures."""
    text = re.sub(r"data:image/png;base64,[^\"]+", "data:,", text)
    return re.sub(r"<(script|style)\b.*?</\1>", "", text, flags=re.DOTALL)


def page_of(folder, *parts, **others):
    """What the page shows of these parts."""
    return visible(world.page_text(folder, *parts, **others))


def test_the_page_holds_the_numbers(report):
    text = visible(report)
    for words in (
        "research software, not a medical device",
        "ab" * 32,
        "rib right 9",
        "0.345 mm",  # FRE
        "Scripts are switched off",
        "1.31 mm",  # the registration's own expectation: leverage times FLE, 1.25 mm, ignores the markers' weights
        "markers nearly in one line",
        "rib_right_9 is open",
        "forearm touches patient",
        "1.00 mm",  # tip error of a shift by (0.6, 0, 0.8)
        "puncture-twin",
    ):
        assert words.lower() in text.lower(), words
    assert text.count("<tr><td>") >= 10


def test_without_markers_the_page_says_what_is_not_known(tmp_path):
    """No dash and no NaN where an error would be expected; that the truth was the belief; a target in RAS as typed."""
    case = world.make_case(space="RAS")
    candidates = world.make_candidates(case)
    plan = world.make_plan(case, candidates)
    plan.expected_target_error_mm = float("nan")
    rehearsal = world.make_rehearsal(plan)
    rehearsal.predicted_error_mm, rehearsal.truth_is_belief = float("nan"), True
    text = page_of(tmp_path, case, world.make_anatomy(), candidates, plan, rehearsal)
    assert text.count("unknown (no markers)") == 3 and "NaN" not in text and "at (-10.0, 20.0, 30.0) mm RAS" in text
    assert 0 < text.index("The truth equals the belief") < text.index("safe directions")


def test_the_page_needs_no_network(report):
    """No element loads anything from an address, the page forbids it to itself, and it is small enough to mail."""
    own = re.sub(r'<script type="text/plain".*?</script>', "", report, flags=re.DOTALL)
    loads = re.findall(r"""(?:src|href)\s*=\s*["']([^"'#]+)["']""", visible(own))
    assert loads == ["data:,", "data:,", "timings.json"]  # the last is a link to a file beside it, which loads nothing
    assert "default-src 'none'" in report
    assert "@import" not in own and not re.search(r"url\(\s*['\"]?http", own)
    assert len(report) < 3e6


def test_verdict_and_doubt_come_first(report):
    """Cards, warnings, windows, map, slices, plan, scene, then the rest; every line of the contents leads somewhere."""
    text = visible(report)
    order = ["doubt", "windows", "directions", "slices", "plan", "scene-part", "rehearsal", "registration"]
    assert re.findall(r'<h2 id="([^"]+)"', text) == [*order, "methods", "inputs"]
    assert text.index("safe directions") < text.index('<h2 id="doubt"')
    assert set(re.findall(r'<a href="#([^"]+)"', text)) <= set(re.findall(r'id="([^"]+)"', text))
    assert "of the solid angle" in text and "at (10.0, -20.0, 30.0) mm LPS" in text


def test_nothing_safe_is_said_first(anatomy, case, tmp_path):
    nothing = world.make_candidates(case, safe=False)
    text = page_of(tmp_path, case, anatomy, nothing)
    assert f"{len(nothing):,} directions searched, all rejected" in text
    assert text.index("Nothing is safe") < text.index("Which directions are safe")
    assert "skin angle" in text
    for empty in ("plan", "registration", "rehearsal"):  # neither heading nor a line in the contents
        assert f'id="{empty}"' not in text and f'href="#{empty}"' not in text


def test_a_failed_plan_is_none_that_nobody_wanted(anatomy, case, candidates, tmp_path, monkeypatch):
    """Page and scene tell them apart: the one is red and says why, the other says which command plans."""
    said = []
    monkeypatch.setattr(scene_picture.annotate, "write", lambda draw, place, text, **look: said.append(text))
    parts, pages = (case, anatomy, candidates, None), []
    for box in ("LEFT_BOX", "RIGHT_BOX"):
        monkeypatch.setattr(scene_picture, box, (16, 84, 216, 284))
    for refusal in ("", "no approach was found to any of 12 candidates"):
        pages.append(page_of(tmp_path, *parts, refusal=refusal))
        draw_scene(Shown(*parts, refusal=refusal), tmp_path / "scene.png")
    searched, failed = pages
    assert 'class="card bad"' in failed and 'class="card bad"' not in searched
    assert failed.count("no approach was found to any of 12 candidates") == 2 and "Planning failed" in failed
    assert "not requested" not in failed and "only searched" not in failed
    assert "not requested" in searched and "No plan was requested" not in searched and "Planning failed" not in searched
    told = [text for text in said if "no arm is shown" in text]
    assert ["no plan was requested" in text for text in told] == [True, False] and "PLANNING FAILED" in told[1]


def test_names_from_files_cannot_become_markup(case, candidates, tmp_path):
    evil = "</script><script>alert(1)</script>"
    anatomy = world.make_anatomy(warnings=(evil,))
    case = world.make_case(name=evil)
    anatomy.structures[1].name = evil
    named = replace(
        candidates,
        clearance=replace(candidates.clearance, structures=(evil, "aorta")),
        verdict=replace(candidates.verdict, structure=np.full(len(candidates), evil)),
    )
    shown = Shown(case, anatomy, named, registration={"method": evil, "flags": [evil]}, film=evil)
    write_page(shown, tmp_path / "page.html")
    assert evil not in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_the_page_s_map_knows_its_rows(case, candidates):
    """The run lengths that the script unpacks give back the row under every pixel; numbers are JSON."""
    data = map_data(case, candidates, candidates.best)
    json.dumps(data, allow_nan=False)
    runs = np.array(data["runs"]).reshape(-1, 2)
    table = np.repeat(runs[:, 0], runs[:, 1]).reshape(data["size"], data["size"])
    view = map_view(case, candidates)
    for row in np.flatnonzero(candidates.theta > 0.2)[::11]:
        x, y = view.place(candidates.theta[row], candidates.beta[row])
        assert table[int((1 - y) * data["size"] / 2), int((1 + x) * data["size"] / 2)] == row
    rib = int(np.flatnonzero(candidates.verdict.reason == "too_close")[0])
    assert data["structures"][data["structure"][rib]] == "rib_right_9"
    assert data["depth"][rib] == 55.5 and data["details"][data["reason"][rib]] == ("clearance", "mm")


def test_the_copied_command_works_from_any_folder(case, candidates, tmp_path, monkeypatch):
    """The page gives the case's whole path, as a shell takes it, also of a case that was named within its folder."""
    (tmp_path / "my cases").mkdir()
    (tmp_path / "my cases" / "ball.toml").write_text("schema = 1")
    monkeypatch.chdir(tmp_path / "my cases")
    typed = map_data(case, candidates, candidates.best)["file"]
    monkeypatch.chdir("/")
    (word,) = shlex.split(typed)
    assert FilePath(word).read_text() == "schema = 1"


def test_meshes_are_lightened_but_none_is_lost(ball):
    bodies = [
        SceneBody("big", "organ", ball(80.0, (0, 0, 0), 6), (1, 2, 3)),
        SceneBody("small", "organ", ball(3.0), (1, 2, 3)),
    ]
    light = lightened(bodies, 10_000)
    counts = [len(b.mesh.faces) for b in light]
    assert counts[0] == pytest.approx(10_000, rel=0.1) and counts[1] >= 300
    assert TRIANGLES <= 100_000
    for before, after in zip(bodies, light, strict=True):
        assert np.allclose(before.mesh.bounds, after.mesh.bounds, atol=0.02 * np.ptp(before.mesh.bounds))


@pytest.mark.parametrize("role", ["avoid", "traverse"])
@pytest.mark.parametrize("hollow", [False, True])
def test_what_holds_the_target_is_see_through_whatever_its_role(anatomy, case, role, hollow):
    """Whatever its role, and also where the lesion is left out of its label; what the target is beside is not."""
    ball = trimesh.creation.icosphere(3, 40.0)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    if hollow:
        faces = np.concatenate([faces, faces[:, ::-1] + len(vertices)])
        vertices = np.concatenate([vertices, vertices / 4])
    around, beside = (TriangleMesh(vertices + place, faces) for place in (case.target_ct, case.target_ct + 60.0))
    structures = [
        SimpleNamespace(name="holder", role=role, mesh=around),
        SimpleNamespace(name="beside", role=role, mesh=beside),
    ]
    body = SimpleNamespace(structures=structures, surroundings=(), skin=anatomy.skin)
    alpha = {one.name: one.alpha for one in patient(body, case)}
    assert alpha["holder"] < 0.5 and alpha["skin"] < 1.0 == alpha["beside"] == alpha["target"]


def test_lengths_have_the_digits_of_the_voxels():
    """Half the longest side of a voxel as ±; of 2 mm and more no tenths; meshes alone have tenths."""
    candidates = world.make_candidates(world.make_case())
    for spacing, head, clearance in (
        ((0.7, 0.7, 0.9), "clearance ± 0.5, mm", "5.0"),
        ((0.8, 0.8, 5.0), "clearance ± 3, mm", "5"),
        (None, "clearance, mm", "5.0"),
    ):
        scan = spacing and SimpleNamespace(grid=SimpleNamespace(T_ct_index=np.diag([*spacing, 1.0])))
        table = patient_blocks.windows(candidates, scan)[0]
        column = list(table.head).index(head)
        assert table.rows[0][column] == clearance
        assert nearest_text(candidates, 0, scan).startswith(f"nearest: rib right 9, {clearance}")
        drawn = " ".join(text.get_text() for text in map_figure(candidates, world.make_case(), scan=scan).findobj(Text))
        path = length_text(float(candidates.path.length[candidates.best.row]), scan)
        told = head.removeprefix("clearance").removesuffix(", mm")
        assert f"path in the body {path}, " in drawn and path.endswith(f"{told} mm")
