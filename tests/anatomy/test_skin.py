"""The skin from a CT, a label and a mesh; where the field of view cuts the body."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from case_world import skin_from_ct
from places import REAL_CT
from refusals import refused

from puncture_twin.planning.anatomy.skin import flat_ends, skin_from_label, skin_from_mesh
from puncture_twin.planning.formats.labels.labelmaps import LabelMap
from puncture_twin.planning.formats.volumes.volume_files import Volume, read_volume
from puncture_twin.planning.geometry.mesh import TriangleMesh

SHAPE = (60, 56, 30)
SPACING = np.array([3.0, 3.0, 5.0])
RADIUS = 55.0
CENTRE = np.array([88.5, 70.0])
T_CT_INDEX = np.diag([*SPACING, 1.0])
T_CT_INDEX.setflags(write=False)


def cylinder_ct(radius=RADIUS, centre=CENTRE):
    """HU of a body along z that both ends cut, with a lung cut by the top, gas, a table and a sheet.

    At the edge a voxel's value is the mixture of air and tissue that its share of the body gives.
    """
    x, y, z = (np.indices(SHAPE).T * SPACING).T
    distance = np.hypot(x - centre[0], y - centre[1])
    hu = -1000.0 + 1030.0 * np.clip((radius - distance) / SPACING[0] + 0.5, 0.0, 1.0)
    hu[(np.hypot(x - centre[0] - 20, y - centre[1]) < 18) & (z > 80)] = -850.0
    hu[np.linalg.norm([x - centre[0] + 20, y - centre[1], z - 60], axis=0) < 12] = -1000.0
    hu[:, 50:52, :] = 150.0
    hu[10:50, 2, :] = -300.0
    return hu


def ct_of(hu, T=T_CT_INDEX):
    return Volume(hu.astype(np.int16), T, Path("made.nii"))


@pytest.fixture(scope="module")
def skin():
    return skin_from_ct(ct_of(cylinder_ct()))


def corners_at_z(skin, low, high):
    z = skin.mesh.vertices[:, 2]
    return skin.mesh.vertices[(z > low) & (z < high)]


def test_skin_of_a_cylinder_is_the_cylinder_alone(skin):
    """Closed; every vertex between the ends within 0.5 mm of the true radius: no table, sheet, lung or gas."""
    sides = corners_at_z(skin, 0.0, 145.0)
    radii = np.hypot(*(sides[:, :2] - CENTRE).T)
    assert skin.mesh.closed
    assert len(sides) > 1000
    assert np.abs(radii - RADIUS).max() < 0.5
    assert skin.mesh.volume == pytest.approx(np.pi * RADIUS**2 * 150.0, rel=0.02)


def test_ends_that_the_field_of_view_cuts_are_not_skin(skin):
    """The caps lie on the box and are marked, the sides are not; both z faces and no other count as cut."""
    view = skin.field_of_view
    assert view.cut.tolist() == [[False, False], [False, False], [True, True]]
    assert view.size_mm[2] == pytest.approx(SPACING[2] * SHAPE[2])
    assert view.T_ct_box[2, 3] == pytest.approx(-SPACING[2] / 2)
    centres = skin.mesh.triangles.mean(axis=1)
    assert np.array_equal(skin.cut_faces, (centres[:, 2] < 0.0) | (centres[:, 2] > 145.0))
    assert skin.mesh.bounds[:, 2].tolist() == pytest.approx([-2.5, 147.5])


def test_skin_does_not_depend_on_how_the_ct_is_stored(skin):
    """Axis orders and flips leave the surface, the marks and the box in place."""
    hu = cylinder_ct()
    for order, flips in (((2, 0, 1), (1, -1, 1)), ((1, 0, 2), (-1, -1, -1))):
        T_index = np.zeros((4, 4))
        T_index[3, 3] = 1
        for new, old in enumerate(order):
            T_index[old, new] = flips[new]
            T_index[old, 3] = 0 if flips[new] == 1 else hu.shape[old] - 1
        stored = hu.transpose(order)[tuple(slice(None, None, flip) for flip in flips)]
        other = skin_from_ct(ct_of(stored, T_CT_INDEX @ T_index))
        assert np.array_equal(other.mesh.faces, skin.mesh.faces)
        assert np.abs(other.mesh.vertices - skin.mesh.vertices).max() < 1e-4
        assert np.array_equal(other.cut_faces, skin.cut_faces)


def test_a_lung_that_a_side_face_cuts_stays_inside_the_body():
    """Air with the density of lung at the border is filled, so that its wall is no skin, and a warning says so."""
    hu = cylinder_ct(centre=np.array([30.0, 70.0]))
    x, y, z = (np.indices(SHAPE).T * SPACING).T
    lung = (np.hypot(x, y - 70.0) < 30) & (z > 20) & (z < 130)
    hu[lung] = -850.0
    skin = skin_from_ct(ct_of(hu))
    inner = corners_at_z(skin, 25.0, 125.0)
    assert np.all((np.abs(np.hypot(*(inner[:, :2] - [30.0, 70.0]).T) - RADIUS) < 0.6) | (inner[:, 0] < 0.0))
    assert any("lung or gas" in warning for warning in skin.warnings)
    assert skin.field_of_view.cut.tolist() == [[True, False], [False, False], [True, True]]
    centres = skin.mesh.triangles[skin.cut_faces].mean(axis=1)
    assert np.count_nonzero(np.abs(centres[:, 0] + 1.5) < 1e-6) > 100


def test_where_the_scanner_did_not_look_there_is_no_skin():
    """Voxels of -2000 HU beside the body: the surface there is the rim of what was measured, not skin."""
    hu = cylinder_ct()
    hu[:20] = -2000.0
    skin = skin_from_ct(ct_of(hu))
    middle = np.abs(skin.mesh.triangles.mean(axis=1)[:, 2] - 75.0) < 60.0
    at_rim = skin.mesh.triangles.mean(axis=1)[:, 0] < 60.0
    assert skin.cut_faces[middle & at_rim].all()
    assert not skin.cut_faces[middle & (skin.mesh.triangles.mean(axis=1)[:, 0] > 63.0)].any()
    assert any("scanned region" in warning for warning in skin.warnings)


@pytest.mark.parametrize(
    ("hu", "match"),
    [(np.full(SHAPE, -1000), "no_body"), (np.full(SHAPE, 40), "no_air"), (cylinder_ct(radius=10.0), "no_body")],
)
def test_a_ct_without_a_plausible_body_is_refused(hu, match):
    """Air alone, tissue alone, and something far smaller than a patient."""
    with refused(match):
        skin_from_ct(ct_of(hu))


def test_skin_from_a_label_that_is_only_a_shell_is_solid():
    """A ring of skin voxels becomes the outer surface alone; cut ends are marked."""
    x, y, _ = (np.indices(SHAPE).T * SPACING).T
    distance = np.hypot(x - CENTRE[0], y - CENTRE[1])
    labels = ((distance < RADIUS) & (distance > RADIUS - 7)).astype(np.int32) * 4
    labelmap = LabelMap(labels, T_CT_INDEX, None, Path("made.nii"))
    skin = skin_from_label(labelmap, 4)
    sides = corners_at_z(skin, 0.0, 145.0)
    assert skin.mesh.closed
    assert np.hypot(*(sides[:, :2] - CENTRE).T).min() > RADIUS - 4.5
    assert skin.cut_faces.any()
    assert skin.field_of_view.cut.tolist() == [[False, False], [False, False], [True, True]]
    with refused("label_absent"):
        skin_from_label(labelmap, 5)


def test_skin_from_a_mesh_warns_when_it_is_open(ball):
    """A closed mesh is taken whole; of an open one the inside is not known."""
    whole = skin_from_mesh(ball(100.0))
    assert whole.warnings == ()
    assert whole.field_of_view is None
    assert not whole.cut_faces.any()
    opened = skin_from_mesh(TriangleMesh(whole.mesh.vertices, whole.mesh.faces[1:]))
    assert "open" in opened.warnings[0]


@pytest.mark.skipif(not REAL_CT.is_dir(), reason=f"the real CT is not at {REAL_CT}")
def test_skin_of_the_real_patient_is_closed_and_knows_its_four_cut_faces():
    """Left, right, top and bottom are cut, front and back are not; the body holds a plausible 20 to 28 litres."""
    skin = skin_from_ct(read_volume(REAL_CT / "ct.nii.gz"))
    assert skin.mesh.closed
    assert skin.field_of_view.cut.tolist() == [[True, True], [False, False], [True, True]]
    assert 0.1 < skin.cut_faces.mean() < 0.4
    assert 20e6 < skin.mesh.volume < 28e6


def stepped(field):
    """The faces of the voxels of 4 mm where a field is positive, as one closed mesh."""
    inside, quads = np.pad(field > 0.0, 1), []
    for axis, way in itertools.product(range(3), (1, -1)):
        at = np.argwhere(inside & ~np.roll(inside, -way, axis)).astype(float)
        out, right, up = np.eye(3)[[axis, (axis + 1) % 3, (axis + 2) % 3]] / 2
        corners = [at + way * out + a * right + b * up for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        quads.append(np.stack(corners[::way], axis=1))
    vertices, faces = np.unique(4.0 * np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    corner = faces.reshape(-1, 4)
    return TriangleMesh(vertices, np.concatenate([corner[:, [0, 1, 2]], corner[:, [0, 2, 3]]]).astype(np.int32))


@pytest.mark.parametrize("cut_mm", [0.0, 40.0])
def test_straight_steps_of_voxels_at_the_sides_are_no_cuts(cut_mm):
    """An elliptic column ends flat at head and feet alone; one that a scan has cut at its left there too."""
    x, y, _ = np.meshgrid(*(4.0 * (np.arange(n) - (n - 1) / 2) for n in (70, 50, 46)), indexing="ij")
    column = np.where(x > 130.0 - cut_mm, -1.0, 1.0 - np.hypot(x / 130.0, y / 95.0))
    assert flat_ends(stepped(column)) == (("left", "feet", "head") if cut_mm else ("feet", "head"))
