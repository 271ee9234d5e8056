"""A gantry goes around the patient: every point of the skin is asked, not its vertices, and FCL is the oracle."""

import fcl
import numpy as np
import pytest
import trimesh
from case_world import write_case
from refusals import refused

from puncture_twin.planning.arm.tool import SIDES, gantry_boxes
from puncture_twin.planning.case.settings import Gantry
from puncture_twin.planning.collision.bodies import surface
from puncture_twin.planning.collision.workcell import gantry_in_patient_mm
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.search.context import prepare

GANTRY = """
[gantry]
bore_diameter_mm = 700.0
center_mm = [0.0, 0.0, 0.0]
thickness_mm = 300.0
wall_mm = {wall}
"""
FAR_WALL_MM = 5000.0
SAMPLES = 60
"""Along a triangle's side."""


def in_gantry(folder, skin_mm, wall=150.0, gantry=GANTRY):
    """The usual patient with a box for a skin, of twelve triangles."""
    path = write_case(folder, ('unit = "mm"\nrole = "skin"', 'unit = "mm"\nrole = "skin"\ncut = []'))
    trimesh.creation.box(skin_mm).export(folder / "skin.stl")
    path.write_text(path.read_text() + gantry.format(wall=wall))
    return path


@pytest.mark.parametrize("wall", [10.0, 150.0, 600.0])
def test_a_coarse_skin_through_the_wall_is_refused(tmp_path, wall):
    """None of its vertices is near the wall, and two of its sides pass through it; no arm needs to be checked."""
    with refused("gantry_in_patient", "62.4"):
        prepare(in_gantry(tmp_path, (800.0, 200.0, 2000.0), wall), arm=False)


@pytest.mark.parametrize("skin_mm", [(680.0, 160.0, 2000.0), (660.0, 230.0, 290.0)])
def test_a_patient_who_fits_is_not_refused(tmp_path, skin_mm):
    """One who goes through the bore, and one who ends in it; the first reaches to a millimetre of it."""
    assert prepare(in_gantry(tmp_path, skin_mm), arm=False)


def test_a_wall_wholly_inside_of_the_skin_is_refused(tmp_path):
    """The whole gantry, bore and all, in a skin whose every vertex and edge is beyond it."""
    small = GANTRY.replace("700.0", "200.0").replace("300.0", "20.0")
    with refused("gantry_in_patient"):
        prepare(in_gantry(tmp_path, (1000.0, 1000.0, 1000.0), 10.0, small), arm=False)


def test_a_patient_beyond_the_wall_is_refused_and_one_before_the_gantry_is_not():
    """Beside the wall is where its housing stands; drawn out of the gantry he may be as wide as he is."""
    gantry = Gantry(np.eye(4), 700.0, 100.0, 300.0)
    beside = trimesh.creation.box((100.0, 100.0, 100.0)).apply_translation((600.0, 0.0, 0.0))
    before = trimesh.creation.box((900.0, 900.0, 100.0)).apply_translation((0.0, 0.0, 201.0))
    assert gantry_in_patient_mm(gantry, mesh_of(beside)) == pytest.approx(np.hypot(650.0, 50.0) - 350.0)
    assert gantry_in_patient_mm(gantry, mesh_of(before)) == 0.0


def mesh_of(mesh):
    """Of trimesh."""
    return TriangleMesh(mesh.vertices, mesh.faces)


def tilted_gantries(rng, count):
    """Gantries that lean any way, anywhere near the origin."""
    for _ in range(count):
        T = trimesh.transformations.random_rotation_matrix(rng.uniform(size=3))
        T[:3, 3] = rng.uniform(-100.0, 100.0, 3)
        yield Gantry(T, rng.uniform(200.0, 900.0), FAR_WALL_MM, rng.uniform(10.0, 500.0))


def touches_boxes(gantry, mesh, bore_mm):
    """Whether FCL has the surface touch the boxes of a bore of this diameter."""
    sizes = {"bore_diameter_mm": bore_mm, "wall_mm": FAR_WALL_MM, "depth_mm": gantry.thickness_mm}
    skin = fcl.CollisionObject(surface(mesh))
    solids = (
        fcl.CollisionObject(fcl.Box(*box.size_mm), fcl.Transform(box.T_base_box[:3, :3], box.T_base_box[:3, 3]))
        for box in gantry_boxes(gantry.T_ct_gantry, **sizes)
    )
    return any(fcl.collide(skin, one, fcl.CollisionRequest(), fcl.CollisionResult()) > 0 for one in solids)


def sampled_mm(gantry, mesh):
    """The same depth over a grid of points of every triangle."""
    a, b = (one.ravel() for one in np.meshgrid(*2 * [np.linspace(0.0, 1.0, SAMPLES)]))
    weights = np.stack([a, b, 1.0 - a - b], axis=1)[a + b <= 1.0]
    points = np.einsum("sk,tki->tsi", weights, mesh.triangles).reshape(-1, 3)
    at = (points - gantry.T_ct_gantry[:3, 3]) @ gantry.T_ct_gantry[:3, :3]
    radius = np.hypot(at[:, 0], at[:, 1])[np.abs(at[:, 2]) <= gantry.thickness_mm / 2]
    return max(0.0, float(radius.max(initial=0.0)) - gantry.bore_diameter_mm / 2)


def test_each_triangle_is_decided_as_fcl_decides():
    """FCL's boxes about the bore hold the wall, those of a bore wider by 1/cos(pi / 24) lie in it: it is between them.

    And a grid of points finds almost as deep a one, and never a deeper.
    """
    rng = np.random.default_rng(20261123)
    seen, missed = {True: 0, False: 0}, []
    for gantry in tilted_gantries(rng, 400):
        middle, reach = rng.uniform(-500.0, 500.0, 3), rng.uniform(50.0, 900.0)
        mesh = TriangleMesh(middle + rng.uniform(-reach, reach, (6, 3)), np.array([[0, 1, 2], [3, 4, 5]]))
        deep = gantry_in_patient_mm(gantry, mesh)
        seen[deep > 0.0] += 1
        if deep > 0.0:
            assert touches_boxes(gantry, mesh, gantry.bore_diameter_mm)
        else:
            assert not touches_boxes(gantry, mesh, gantry.bore_diameter_mm / np.cos(np.pi / SIDES) + 1e-6)
        found = sampled_mm(gantry, mesh)
        assert found <= deep + 1e-9
        missed.append(deep - found)
    assert min(seen.values()) > 80
    assert np.median(missed) < 1.0 and np.mean(np.array(missed) > 20.0) < 0.05
