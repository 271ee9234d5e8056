"""How much of a structure lies inside the skin: against exact shares of spheres, at cuts, and in a whole case."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from puncture_twin.meshes import folder
from puncture_twin.planning.anatomy.skin import skin_from_mesh
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.evidence.checks import findings
from puncture_twin.planning.evidence.inside_skin import SAMPLES, inside_skin, near_surface
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined
from puncture_twin.planning.search.context import prepare
from tests.oracles import point_triangle_distance


def of(mesh, skin, tolerance=0.01):
    return inside_skin([mesh], skin, np.array([tolerance]))[0]


@pytest.fixture(scope="module")
def carton():
    return prepare(folder() / "carton" / "case_m.toml", arm=False)


def with_structure(context, structure):
    return replace(context.anatomy, structures=(*context.anatomy.structures, structure))


def cap_outside(distance, ball_radius, skin_radius):
    """Which fraction of a small sphere's area lies outside a large one (Archimedes: area goes with height)."""
    height = (distance**2 + ball_radius**2 - skin_radius**2) / (2 * distance)
    return 0.5 + np.clip(height / ball_radius, -1, 1) / 2


@pytest.mark.parametrize("distance", [0.0, 75.0, 85.0, 95.0, 139.0])
def test_the_fraction_is_that_of_the_sphere(ball, distance):
    """A ball moved out of a ball: the fraction of its area inside, to half a percent."""
    skin = skin_from_mesh(ball(90, subdivisions=5))
    way = np.array([0.6, 0.8, 0.0])
    found = of(ball(15, distance * way, subdivisions=4), skin)
    wanted = 1.0 if distance == 0 else 1 - cap_outside(distance, 15, 90)
    assert found.fraction == pytest.approx(wanted, abs=0.005)
    assert found.inside + found.outside == SAMPLES


def test_what_lies_within_the_tolerance_counts_as_inside(ball):
    """A ball that reaches 1.5 mm out of the skin lies inside for 2 mm, not for 1 mm."""
    skin, organ = skin_from_mesh(ball(90, subdivisions=5)), ball(30, (61.5, 0, 0), subdivisions=4)
    assert of(organ, skin, 2.0).fraction == 1.0
    assert of(organ, skin, 1.0).fraction < 1.0


def test_beyond_a_cut_nothing_is_known(box):
    """A spine that goes on past the cut head side is inside; past an uncut side it is half outside."""
    spine = box((10, 10, 200), (0, 0, 100))
    body = box((100, 100, 200))
    cut = of(spine, skin_from_mesh(body, ("head",)), 2.0)
    assert cut.fraction == 1.0
    assert cut.beyond == pytest.approx(SAMPLES / 2, abs=SAMPLES / 20)
    assert of(spine, skin_from_mesh(body), 2.0).fraction == pytest.approx(0.5, abs=0.02)


def test_a_part_of_the_body_beside_the_trunk_counts(ball):
    """A bone in a detached arm is inside where the skin holds the arm, and outside where it does not."""
    trunk, arm, bone = ball(90), ball(30, (140, 0, 0)), ball(10, (140, 0, 0))
    assert of(bone, skin_from_mesh(joined([trunk, arm]))).fraction == 1.0
    assert of(bone, skin_from_mesh(trunk)).fraction == 0.0


def test_nearness_is_exact(ball, box, rng):
    """Against every triangle, on a surface whose triangles are of very different sizes."""
    mesh = joined([ball(20, subdivisions=2), box((150, 150, 150))])
    points = rng.uniform(-90, 90, (60, 3))
    limit = rng.uniform(0.5, 30, 60)
    wanted = np.array([point_triangle_distance(p, mesh.triangles).min() for p in points])
    np.testing.assert_array_equal(near_surface(points, mesh, limit), wanted <= limit)


@pytest.mark.parametrize("name", ["abdomen", "carton/case_m.toml", "carton/case_h.toml"])
def test_the_embedded_cases_lie_inside_their_skin(name):
    context = prepare(folder() / name, arm=False)
    assert not [w for w in findings(context.case, context.anatomy, None) if "outside the skin" in w.sentence]


def test_a_structure_of_role_unknown_may_lie_outside(carton, ball):
    """What is unknown may be anywhere, such as a line on the skin: nothing is said of it, nor refused."""
    line = Structure("line", Role.UNKNOWN, 0.0, ball(5, (0, 0, 400)), "line.ply")
    anatomy = with_structure(carton, line)
    assert not [w for w in findings(carton.case, anatomy, None) if "line" in w.sentence]
    with refused("outside_skin"):
        findings(carton.case, with_structure(carton, replace(line, role=Role.AVOID)), None)


def test_a_little_outside_is_a_warning_and_a_tenth_is_refused(carton, ball):
    """An organ that reaches out of the carton's wall: within the tolerance nothing is said; then its fraction is."""
    said = "of its surface lies outside the skin: a part of the body outside the skin"
    for outside_mm, role in ((1.5, Role.TRAVERSE), (5.0, Role.TRAVERSE), (15.0, Role.AVOID)):
        organ = Structure("organ", role, 0.0, ball(40, (120 + outside_mm, 100, 60), 4), "organ.ply")
        anatomy = with_structure(carton, organ)
        if role is Role.AVOID:
            with refused("outside_skin", "organ"):
                findings(carton.case, anatomy, None)
            continue
        found = [one.sentence for one in findings(carton.case, anatomy, None) if "'organ'" in one.sentence]
        assert [said in one for one in found] == [True] * (outside_mm > 2.0)


def test_an_open_skin_has_no_inside(carton):
    mesh = carton.anatomy.skin.mesh
    skin = skin_from_mesh(TriangleMesh(mesh.vertices, mesh.faces[:-3]))
    found = findings(carton.case, replace(carton.anatomy, skin=skin), None)
    assert len([w for w in found if "the part of each structure inside the body is not known" in w.sentence]) == 1
