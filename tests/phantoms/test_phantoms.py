"""The bodies with known truth: closed, smooth, plausible, apart from each other, and what their fields say."""

import csv
import tomllib
from functools import cache
from itertools import combinations

import numpy as np
import pytest
import trimesh

from puncture_twin import meshes
from puncture_twin.planning.geometry.mesh import TriangleMesh
from tests.carton_truth import carton_field
from tools.phantoms import bones, carton, guidance
from tools.phantoms.abdomen import STRUCTURES, abdomen_field, abdomen_mesh
from tools.phantoms.carton import carton_meshes
from tools.phantoms.implicit import capsule, ellipsoid, smooth_max
from tools.phantoms.manifest import ply_bytes
from tools.phantoms.mesher import SamplingBox, mesh_field
from tools.phantoms.sweep import tube
from tools.phantoms.viscera import LESION_CENTRE_LPS_MM

FOLDER = meshes.folder()
INSIDE_THE_LIVER = ("lesion", "portal_vein", "hepatic_veins")
ORGANS = [name for name in STRUCTURES if name != "skin"]
SURFACE_MM = 0.2
"""No vertex is farther than this from the true surface (field units); almost all are within 1e-4 mm."""
UNDER_SKIN_MM = 2.0
RIB_GAP_MM = 10.0
SLIVER_DEG = 4.0


@cache
def abdomen(name: str) -> trimesh.Trimesh:
    return trimesh.load(FOLDER / f"abdomen/{name}.ply", process=False)


def vertices(name: str) -> np.ndarray:
    return np.asarray(abdomen(name).vertices, dtype=float)


def rows(path: str) -> dict[str, np.ndarray]:
    with (FOLDER / path).open(encoding="ascii") as file:
        return {row["name"]: np.array([float(row[f"{axis}_mm"]) for axis in "xyz"]) for row in csv.DictReader(file)}


@pytest.fixture(scope="module")
def inside() -> dict[str, np.ndarray]:
    """Which nodes of an 18 mm grid over the trunk lie in which structure."""
    axes = [np.arange(low, high, 18.0) for low, high in ((-170, 171), (-118, 119), (-195, 262))]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return {name: abdomen_field(name)(nodes) < 0 for name in STRUCTURES}


@pytest.mark.parametrize("name", STRUCTURES)
def test_mesh_is_closed_oriented_outward_and_without_slivers(name):
    """Watertight by trimesh's and by our own measure, triangles outward, none flat or degenerate."""
    mesh = abdomen(name)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert TriangleMesh(mesh.vertices, mesh.faces).closed and mesh.area_faces.min() > 0.01
    assert np.degrees(mesh.face_angles.min()) > SLIVER_DEG
    assert np.degrees(np.percentile(mesh.face_angles.min(axis=1), 1)) > 25.0


@pytest.mark.parametrize("name", STRUCTURES)
def test_a_structure_is_as_large_and_where_it_should_be(name):
    """A plausible volume; vertices on the true surface (0.2 mm, 99.5 % 1e-3 mm), of organs 2 mm under the skin."""
    low, high = STRUCTURES[name].volume_ml
    assert low <= abdomen(name).volume / 1000 <= high
    error = np.abs(abdomen_field(name)(vertices(name)))
    assert error.max() < SURFACE_MM and np.percentile(error, 99.5) < 1e-3
    assert name == "skin" or abdomen_field("skin")(vertices(name)).max() < -UNDER_SKIN_MM


@pytest.mark.parametrize("name", ["lesion", "gallbladder"])
def test_generator_makes_the_committed_mesh(name):
    """Made again, the mesh is the committed one: same triangles, vertices within 1e-3 mm."""
    made = abdomen_mesh(name)
    assert np.array_equal(made.faces, abdomen(name).faces)
    assert np.abs(made.vertices - vertices(name)).max() < 1e-3


def test_structures_are_disjoint_on_a_grid(inside):
    """No node lies in two structures, but for the skin and for what lies inside the liver by nature."""
    for a, b in combinations(ORGANS, 2):
        if a == "liver" and b in INSIDE_THE_LIVER:
            continue
        assert not np.any(inside[a] & inside[b]), (a, b)
        assert not np.any(inside[a] & ~inside["skin"]), a


def test_no_vertex_lies_in_another_structure():
    """Also between the nodes of the grid: every sixth vertex is outside every other structure."""
    for b in ORGANS:
        own = {b, *INSIDE_THE_LIVER} if b == "liver" else {b, "liver"} if b in INSIDE_THE_LIVER else {b}
        points = np.concatenate([vertices(a)[::6] for a in ORGANS if a not in own])
        low, high = abdomen(b).bounds
        close = points[np.all((points > low) & (points < high), axis=1)]  # all at once: a body has hundreds of parts
        assert not len(close) or abdomen_field(b)(close).min() > 0, b


@pytest.mark.parametrize("name", ["liver", "spleen", "ribs_right", "hepatic_veins", "colon"])
def test_field_and_mesh_agree_on_inside(name):
    """Away from the surface the sign of the field is what ray casting on the mesh says."""
    mesh, generator = abdomen(name), np.random.default_rng(3)
    points = generator.uniform(*mesh.bounds, (6000, 3))
    value = abdomen_field(name)(points)
    clear = np.abs(value) > 0.5
    assert np.array_equal(mesh.contains(points[clear]), value[clear] < 0)
    assert 20 < np.sum(value[clear] < 0) < clear.sum()


def test_target_is_the_middle_of_the_lesion():
    """Of 21 to 24 mm, at least 10 mm inside the liver and 5 mm from its vessels; the case's and the stated place."""
    surface = vertices("lesion")
    assert abdomen_field("liver")(surface).max() < -10.0
    for vessel in ("portal_vein", "hepatic_veins"):
        assert np.linalg.norm(vertices(vessel)[:, None] - surface[None, ::4], axis=2).min() > 5.0
    case = tomllib.loads((FOLDER / "abdomen/case.toml").read_text(encoding="utf-8"))
    assert np.array_equal(case["target"]["position_mm"], LESION_CENTRE_LPS_MM)
    assert np.linalg.norm(abdomen("lesion").center_mass - LESION_CENTRE_LPS_MM) < 0.01
    across = 2 * np.linalg.norm(surface - LESION_CENTRE_LPS_MM, axis=1)
    assert 20.9 < across.min() < across.max() < 24.1


@pytest.mark.parametrize(("side", "mirror"), [("ribs_right", 1.0), ("ribs_left", -1.0)])
def test_intercostal_gaps_are_open(side, mirror):
    """Nine ribs a side; from the surface of each to the nearest point of the next it is 10 mm or more."""
    ribs = sorted(abdomen(side).split(), key=lambda part: -part.center_mass[2])
    assert len(ribs) == len(bones.RIBS)
    for lower, number in zip(ribs[1:], bones.RIBS[:-1], strict=True):
        distance = bones.rib(number)(np.asarray(lower.vertices) * [mirror, 1.0, 1.0])
        assert distance.min() >= RIB_GAP_MM


def test_organs_are_on_their_sides():
    """LPS: x to the left. Liver, gallbladder and vena cava right; spleen, stomach and aorta left; spine behind."""
    middle = {name: abdomen(name).center_mass for name in STRUCTURES}
    for name in ("liver", "gallbladder", "vena_cava_inferior", "kidney_right", "lung_right", "ribs_right", "hip_right"):
        assert middle[name][0] < -10, name
    for name in ("spleen", "stomach", "kidney_left", "lung_left", "ribs_left", "hip_left"):
        assert middle[name][0] > 10, name
    assert 0 < middle["aorta"][0] < 20
    assert middle["sternum"][1] < middle["heart"][1] < middle["aorta"][1] < middle["spine"][1]
    assert middle["kidney_right"][2] < middle["kidney_left"][2] < middle["spleen"][2] < middle["lung_left"][2]


def test_aorta_is_as_wide_as_an_adults():
    """Cut at the level of the kidneys the aorta is a disc of 18 to 24 mm."""
    x, y = np.meshgrid(np.arange(-10, 30, 0.25), np.arange(-20, 30, 0.25))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, 20.0)], axis=1)
    area = 0.25**2 * np.sum(abdomen_field("aorta")(points) < 0)
    assert 18.0 < 2 * np.sqrt(area / np.pi) < 24.0


def test_markers_lie_on_the_skin_and_far_apart():
    """Six markers, on the skin to 1e-9 mm, at least 60 mm from each other."""
    points = np.stack(list(guidance.skin_markers_ct().values()))
    assert points.shape == (6, 3) and np.abs(abdomen_field("skin")(points)).max() < 1e-9
    assert min(np.linalg.norm(a - b) for a, b in combinations(points, 2)) > 60.0


def test_placement_is_a_rigid_motion_with_the_arm_clear_of_the_patient():
    """Proper rotation; a 150 mm wide base, and its axis, stay outside the skin by 150 mm or more."""
    T_base_ct = guidance.patient_placement()
    R = T_base_ct[:3, :3]
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12) and np.linalg.det(R) == pytest.approx(1.0, abs=1e-12)
    skin_base = vertices("skin") @ R.T + T_base_ct[:3, 3]
    beside_base = skin_base[np.abs(skin_base[:, 2]) < 160.0]
    assert np.linalg.norm(beside_base[:, :2], axis=1).min() > 75.0 + 150.0


def test_point_lists_are_the_simulated_ones_and_keep_their_bounds():
    """The committed lists come from the stated seed; reading errs within half the resolution, touch by the noise."""
    known = guidance.abdomen_guidance(np.random.default_rng(guidance.GUIDANCE_SEED))
    read, touched, truth = (rows(f"abdomen/{name}.csv") for name in ("markers_ct", "touch", "truth"))
    assert list(read) == list(touched) == ["M1", "M2", "M3", "M4", "M5", "M6"]
    assert list(truth) == [*read, "target"]
    T_base_ct = guidance.patient_placement()
    exact = {**guidance.skin_markers_ct(), "target": LESION_CENTRE_LPS_MM}
    for name, point in truth.items():
        assert np.abs(T_base_ct[:3, :3] @ exact[name] + T_base_ct[:3, 3] - point).max() < 1e-6
    for name, point in read.items():
        assert np.abs(point - known.markers_ct[name]).max() < 1e-3
        assert np.all(
            np.abs(point - exact[name])
            < np.array([guidance.IN_PLANE_MM, guidance.IN_PLANE_MM, guidance.SLICE_SPACING_MM]) / 2 + 1e-3
        )
        assert np.linalg.norm(touched[name] - truth[name]) < 5 * guidance.TOUCH_SIGMA_MM
    assert max(np.linalg.norm(read[name] - exact[name]) for name in read) > 0.2


@pytest.mark.parametrize("name", ["skin", "bolt_l", "bolt_m", "bolt_h"])
def test_carton_mesh_is_made_again_byte_for_byte(name):
    """The committed file is what the generator writes, closed, outward, corners on the true surface."""
    mesh = carton_meshes()[name]
    assert (FOLDER / f"carton/{name}.ply").read_bytes() == ply_bytes(mesh)
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert mesh.closed and shape.is_watertight and shape.is_winding_consistent and shape.volume > 0
    assert np.abs(carton_field(name)(mesh.vertices)).max() < 1e-9


def test_carton_bolts_end_at_the_lesions_and_stay_apart():
    """A lesion is the middle of its bolt's upper end; bolts, prisms of 64 sides, are apart and inside the box."""
    made = carton_meshes()
    solid = {name: trimesh.Trimesh(mesh.vertices, mesh.faces).volume for name, mesh in made.items()}
    assert solid["skin"] == pytest.approx(170.0 * 220.0 * 157.0, rel=1e-12)
    for letter, end in carton.LESIONS_CT_MM.items():
        mesh = made[f"bolt_{letter.lower()}"]
        prism = 64 / 2 * np.sin(2 * np.pi / 64) * 4.0**2 * end[2]
        assert solid[f"bolt_{letter.lower()}"] == pytest.approx(prism, rel=1e-12)
        upper = mesh.vertices[mesh.vertices[:, 2] == end[2]]
        assert np.allclose(upper.mean(axis=0), end, atol=1e-12)
        assert mesh.vertices[:, 2].max() == end[2]
        assert carton_field("skin")(mesh.vertices).max() < -5.0
        for other in set(made) - {"skin", f"bolt_{letter.lower()}"}:
            assert carton_field(other)(mesh.vertices).min() > 1.9
    assert np.abs(carton_field("skin")(np.array(list(carton.MARKERS_CT_MM.values())))).max() == 0.0


@pytest.mark.parametrize("letter", ["L", "M", "H"])
def test_carton_case_has_the_papers_lesion(letter):
    """Each case's target is the paper's lesion, named as in the touched points, in the bolt of that name."""
    case = tomllib.loads((FOLDER / f"carton/case_{letter.lower()}.toml").read_text(encoding="utf-8"))
    assert case["target"]["name"] == letter
    assert tuple(case["target"]["position_mm"]) == carton.LESIONS_CT_MM[letter]
    roles = {structure["name"]: structure["role"] for structure in case["structure"]}
    assert [name for name, role in roles.items() if role == "target"] == [f"bolt_{letter.lower()}"]
    assert letter in rows("carton/truth.csv")


def test_mesher_meets_a_sphere():
    """Vertices on it to 1e-4 mm, Euler number 2, volume of the inscribed polyhedron; out of its box it is refused."""
    mesh = mesh_field(ellipsoid((1.0, 2.0, 3.0), (10.0, 10.0, 10.0)), SamplingBox((-12, -11, -10), (14, 15, 16), 1.0))
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert np.abs(np.linalg.norm(mesh.vertices - [1.0, 2.0, 3.0], axis=1) - 10.0).max() < 1e-4
    assert solid.euler_number == 2
    assert 0.99 < solid.volume / (4 / 3 * np.pi * 1000) < 1.0
    with pytest.raises(ValueError, match="must lie inside the box"):
        mesh_field(ellipsoid((0, 0, 0), (10.0, 10.0, 10.0)), SamplingBox((-8, -12, -12), (12, 12, 12), 1.0))


def test_straight_tube_is_a_capsule():
    """A tube through two points is the rod with round ends, to 1e-9 mm."""
    points = np.random.default_rng(5).uniform(-30, 30, (500, 3))
    rod, pipe = capsule((-10, 0, 5), (12, 4, -3), 3.0), tube([(-10, 0, 5), (12, 4, -3)], 3.0)
    assert np.abs(rod(points) - pipe(points)).max() < 1e-9


def test_smooth_maximum_is_never_below_the_maximum():
    """What makes carved bodies disjoint: the blend only takes away."""
    a, b = np.random.default_rng(6).normal(0, 5, (2, 1000))
    blended = smooth_max(a, b, 4.0)
    assert np.all(blended >= np.maximum(a, b)) and np.all(blended <= np.maximum(a, b) + 1.0)
