"""Slices about a path: where the planes lie, what is cut, and what is drawn where."""

from types import SimpleNamespace

import numpy as np
import pytest
import report_world as world
import trimesh
from hypothesis import given, strategies as st
from PIL import Image

from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.search.candidates import Pick
from puncture_twin.twin.report.slices.panel import KNOTS_BYTE, KNOTS_HU, PIXELS, TONES, Subject, draw_panel, stored
from puncture_twin.twin.report.slices.planes import capsule, ellipse, letters, needle_planes, outline
from puncture_twin.twin.report.slices.sheet import NO_CT, draw_slices, write_sheet

UNITS = st.tuples(*[st.floats(-1, 1) for _ in range(3)]).filter(lambda v: np.linalg.norm(v) > 0.1)
CYAN = np.array([0, 229, 255])


@given(UNITS, st.floats(5, 200))
def test_planes_hold_target_and_needle(direction, path):
    """All pass the target with square axes; two hold the needle, one is across it; target and entry are in view."""
    target, outward = np.array([3.0, -4.0, 5.0]), np.array(direction) / np.linalg.norm(direction)
    axial, first, second, across = planes = needle_planes(target, outward, path)
    for plane in planes:
        assert np.allclose([plane.right @ plane.right, plane.up @ plane.up, plane.right @ plane.up], [1, 1, 0])
        assert np.allclose(plane.place(target), 0)
    assert np.allclose(abs(axial.normal), [0, 0, 1])
    assert np.allclose([first.normal @ outward, second.normal @ outward, first.normal @ second.normal], 0, atol=1e-9)
    assert np.isclose(across.normal @ outward, 1)
    for plane in (first, second):
        seen = plane.place(np.stack([target, target + path * outward])) - plane.centre
        assert (np.abs(seen) < plane.half_mm).all()


def test_the_patients_right_is_on_the_left():
    """An axial slice is seen from the feet; who looks along a needle from the front sees the same side on the left."""
    axial, first, _, across = needle_planes(np.zeros(3), np.array([0.0, -1.0, 0.0]), 50.0)
    for plane, up in ((axial, "A"), (first, "A"), (across, "H")):
        assert letters("LPS", plane.right) == "L" and letters("LPS", -plane.right) == "R"
        assert letters("LPS", plane.up) == up
    assert letters("LPS", np.array([0.6, -0.8, 0.0])) == "A L"
    assert letters("local", np.array([0.0, 1.0, 0.0])) == "+y"


def test_pixels_lie_where_the_plane_says():
    plane = needle_planes(np.array([1.0, 2.0, 3.0]), np.array([1.0, 0.0, 0.0]), 40.0)[0]
    points = plane.points_ct(4).reshape(4, 4, 3)
    assert np.allclose(plane.place(points).mean(axis=(0, 1)), plane.centre)
    assert points[0, 0] @ plane.up > points[1, 0] @ plane.up
    assert points[0, 0] @ plane.right < points[0, 1] @ plane.right


@given(UNITS, st.integers(0, 9))
def test_a_cut_is_that_of_another_library(direction, seed):
    """The segments, ends in either order, that trimesh finds of a soup of triangles that share corners."""
    rng = np.random.default_rng(seed)
    mesh = TriangleMesh(rng.normal(size=(30, 3)) * 20, rng.integers(0, 30, (60, 3)).astype(np.int32))
    along = np.array(direction) / np.linalg.norm(direction)
    plane = needle_planes(rng.normal(size=3), along, 50.0)[seed % 4]
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    theirs = trimesh.intersections.mesh_plane(surface, plane.normal, plane.at_ct).reshape(-1, 2, 3)

    def in_order(segments):
        ends = [sorted(map(tuple, one)) for one in segments.round(9).tolist()]
        return np.array(sorted(ends)).reshape(-1, 2, 2)

    found, wanted = in_order(outline(mesh, plane)), in_order(plane.place(theirs))
    assert len(found) == len(wanted) > 0
    assert np.allclose(found, wanted, atol=1e-6)


@given(UNITS, st.integers(0, 9))
def test_the_region_is_cut_on_its_surface(direction, seed):
    """Every point of the line lies in the plane and on the ellipsoid x' inv(R) x = 1."""
    spread = np.random.default_rng(seed).normal(size=(3, 3))
    region = spread @ spread.T + 0.1 * np.eye(3)
    outward = np.array(direction) / np.linalg.norm(direction)
    for plane in needle_planes(np.zeros(3), outward, 50.0):
        x, y = ellipse(region, plane).T
        points = x[:, None] * plane.right + y[:, None] * plane.up
        assert np.allclose(np.einsum("ni,ij,nj->n", points, np.linalg.inv(region), points), 1.0)


@pytest.mark.parametrize("name", TONES)
def test_stored_bytes_give_every_window(name):
    """What a page makes of the stored bytes differs from the window itself by what a byte holds, at most."""
    hu = np.linspace(KNOTS_HU[0], KNOTS_HU[-1], 5000)
    of_byte = np.interp(np.arange(256), KNOTS_BYTE, KNOTS_HU)
    shown, wanted = (TONES[name].grey(one).astype(float) / 255 for one in (of_byte[stored(hu)], hu))
    assert np.abs(shown - wanted).max() < np.diff(of_byte).max() / TONES[name].width / 2 + 0.004


def subject(*, scan=None, region=None, row=None):
    case, anatomy = world.make_case(), world.make_anatomy()
    candidates = world.make_candidates(case)
    anatomy.scan = scan
    anatomy.structures[0].role = "target"
    return Subject(case, anatomy, Pick(candidates, int(candidates.ranked[0]) if row is None else row), region)


def ball_ct(points_ct):
    """Soft tissue in the skin, air outside, nothing beyond 130 mm."""
    far = np.linalg.norm(points_ct - world.TARGET, axis=1)
    return np.where(far > 130, np.nan, np.where(far < world.SKIN_RADIUS, 40.0, -1000.0))


def test_the_needle_is_drawn_as_thick_as_it_is():
    """Between organ and skin the cyan pixels across the needle are its diameter; its tip ends on the target."""
    one = subject(row=100)
    plane = needle_planes(one.case.target_ct, one.outward_ct, one.path_mm)[1]
    pixels = np.asarray(draw_panel(one, plane).overlay).astype(float)
    per_mm = PIXELS / (2 * plane.half_mm)
    along = plane.place(one.case.target_ct + one.outward_ct)
    aside = np.array([-along[1], along[0]])
    steps = np.arange(-1.2, 1.2, 0.02)  # the dashes of the margin lie at 1.6 mm
    at = (60 * along + steps[:, None] * aside - plane.centre) * per_mm
    column, row = PIXELS / 2 + at[:, 0], PIXELS / 2 - at[:, 1]
    seen = pixels[row.astype(int), column.astype(int)]
    cyan = (np.abs(seen[:, :3] - CYAN) < 40).all(axis=1) * seen[:, 3] / 255
    assert cyan.sum() * 0.02 == pytest.approx(one.case.needle.diameter_mm, abs=0.35)


def test_without_a_ct_the_sheet_says_so(tmp_path):
    slices = draw_slices(subject())
    assert slices.units is None and all(panel.hu is None for panel in slices.panels)
    assert NO_CT in slices.notes
    write_sheet(slices, tmp_path / "slices.png")
    assert [path.name for path in tmp_path.iterdir()] == ["slices.png"]


def test_with_a_ct_and_errors(tmp_path):
    """Grey is tissue, black is air and where the image ends; the region and the names are in the legend."""
    scan = SimpleNamespace(hu_at=ball_ct)
    slices = draw_slices(subject(scan=scan, region=np.diag([4.0, 9.0, 16.0])))
    assert slices.units is not None
    names = [name for name, _ in slices.legend]
    assert "95 % region" in names and names[-1].startswith("rib right 9: ")
    hu = slices.panels[0].hu
    assert np.nanmax(hu) == 40.0 and TONES["abdomen"].grey(np.array([40.0, -1000.0, np.nan])).tolist() == [128, 0, 0]
    write_sheet(slices, tmp_path / "one.png")
    write_sheet(draw_slices(subject(scan=scan, region=np.diag([4.0, 9.0, 16.0]))), tmp_path / "two.png")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    assert Image.open(tmp_path / "one.png").width > 2 * PIXELS


def test_an_image_alone_proposes_no_needle(tmp_path):
    """Three planes through the target that hold the body, what lies beside it in the legend, and nothing cyan."""
    one = subject(scan=SimpleNamespace(hu_at=ball_ct))
    drawn_with = draw_slices(one)
    one.anatomy.structures[1].name, one.anatomy.structures[1].role = "outside_body", "unknown"
    alone = draw_slices(Subject(one.case, one.anatomy, None))
    write_sheet(alone, tmp_path / "slices.png")

    def cyan(panels):
        return sum(np.count_nonzero((panel.overlay[..., :3] == CYAN).all(axis=2)) for panel in panels)

    assert cyan(drawn_with.panels) > 0 == cyan(alone.panels) and alone.units is None
    names = [name for name, _ in alone.legend]
    assert "needle" not in names and any("beside the body" in name for name in names) and "needle" not in alone.notes[1]
    planes = [panel.plane for panel in alone.panels]
    assert np.allclose([abs(plane.normal) for plane in planes], [[0, 0, 1], [0, 1, 0], [1, 0, 0]])
    for plane in planes:
        assert np.abs(plane.place(one.anatomy.skin.mesh.vertices) - plane.centre).max() < plane.half_mm


def test_unknown_structures_are_beads_and_a_refused_direction_is_drawn_too():
    """Beads leave gaps where a line has none; a direction without an entry is drawn without units."""
    one = subject(scan=SimpleNamespace(hu_at=ball_ct))
    plane = needle_planes(one.case.target_ct, one.outward_ct, one.path_mm)[0]
    line = np.asarray(draw_panel(one, plane).overlay)[..., 3]
    for structure in one.anatomy.structures:
        structure.role = "unknown"
    beads = np.asarray(draw_panel(one, plane).overlay)[..., 3]
    assert 0.2 * (line > 0).sum() < (beads > 0).sum() < (line > 0).sum()
    one.pick.candidates.path.length.setflags(write=True)
    one.pick.candidates.path.length[:] = np.nan
    assert draw_slices(one).units is None


@given(UNITS, st.floats(5, 200), st.floats(0.3, 20), st.integers(0, 3))
def test_the_needles_cut_ends_at_its_tip(direction, length, radius, which):
    """A cut's points lie on the capsule about the axis, so none is beyond the target by more than the radius."""
    target, outward = np.array([3.0, -4.0, 5.0]), np.array(direction) / np.linalg.norm(direction)
    plane = needle_planes(target, outward, length)[which]
    cut = capsule(outward, length, radius, plane)
    points = cut[:, :1] * plane.right + cut[:, 1:] * plane.up
    along = points @ outward
    assert along.min() >= -radius * (1 + 1e-9) and along.max() <= length + radius * (1 + 1e-9)
    axis = np.clip(along, 0, length)[:, None] * outward
    assert np.allclose(np.linalg.norm(points - axis, axis=1), radius, atol=1e-6 * (length + radius))
    assert np.isfinite(cut).all() and np.allclose(cut[0], cut[-1], atol=1e-6 * (length + radius))


def test_a_needle_near_the_slice_is_cut_long_but_not_beyond_its_tip():
    """A needle 5 degrees out of an axial slice: a half circle beyond the target, a long half ellipse before it."""
    tilt = np.radians(5.0)
    outward = np.array([0.0, -np.cos(tilt), np.sin(tilt)])
    cut = capsule(outward, 100.0, 0.6, needle_planes(np.zeros(3), outward, 60.0)[0])
    assert cut[:, 1].max() == pytest.approx(0.6 / np.sin(tilt)) and cut[:, 1].min() == pytest.approx(-0.6)
    assert np.abs(cut[:, 0]).max() == pytest.approx(0.6, rel=1e-3)
