"""The map of verdicts: each is that of the engine with distances, on hostile scenes; the first structure is named."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.safe_map import hostile, random_grid
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.case.entry import grid
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.clearance.verdict_map import VerdictMap
from puncture_twin.planning.formats.guard import guard_mesh
from puncture_twin.planning.geometry.mesh import TriangleMesh
from tools.hostile_scenes import KINDS

WHOLE = grid((0, np.pi), (0, 2 * np.pi), np.radians(6.0), np.eye(3))


def ball(center, radius, *, role=Role.AVOID, margin=2.0):
    """A ball as a structure."""
    mesh = trimesh.creation.icosphere(3, radius)
    return Structure("ball", role, margin, guard_mesh(mesh.vertices + center, mesh.faces, where="ball"), "made")


def mapped(*structures, length=100.0, radius=0.6, target=(0.0, 0.0, 0.0)):
    """The numbers of the structures that block the whole sphere first."""
    found = VerdictMap(np.array(target), WHOLE.grid, WHOLE.outward_ct, np.eye(3))
    engine = FastEngine([one.mesh for one in structures])
    for number, one in enumerate(structures):
        found.add(engine, number, one, np.full(len(WHOLE), length), radius)
    return found.structure


@pytest.mark.parametrize("kind", KINDS)
def test_every_verdict_is_the_engines(kind):
    """Random grids, frames and lengths; limits that are a direction's own distance, or off by less than rounding."""
    found = [hostile(kind, seed, step_deg=15.0) for seed in range(100, 106)]
    assert sum(asked for asked, _ in found) > 1000
    assert sum(wrong for _, wrong in found) == 0


def test_a_ball_blocks_its_cone():
    """Of a ball at a distance: the directions within asin((R + r) / d) of it, but for its facets."""
    structure = mapped(ball([0.0, 60.0, 0.0], 20.0))
    away = np.arccos(np.clip(WHOLE.outward_ct[:, 1], -1, 1))
    low, high = np.arcsin((20.0 * 0.98 + 2.6) / 60.0), np.arcsin(22.6 / 60.0)
    assert (structure[away < low] == 0).all() and (structure[away > high] == -1).all()


def test_the_first_structure_that_blocks_is_named():
    """In the order in which they are added, whichever is nearer; one without a margin blocks nothing."""
    near, far = ball([0.0, 30.0, 0.0], 10.0), ball([0.0, 70.0, 0.0], 25.0)
    one, other = mapped(near, far), mapped(far, near)
    assert np.array_equal(one < 0, other < 0), "the near one hides the far one"
    assert set(np.unique(one)) == {-1, 0} and set(np.unique(other)) == {-1, 0, 1}
    assert (mapped(ball([0.0, 30.0, 0.0], 10.0, role=Role.TRAVERSE)) == -1).all()


def test_a_target_inside_blocks_all_and_one_out_of_reach_nothing():
    """A needle wholly inside a closed surface meets no triangle of it; one that is too short none either."""
    assert (mapped(ball([0.0, 0.0, 0.0], 50.0), length=10.0) == 0).all()
    assert (mapped(ball([0.0, 60.0, 0.0], 20.0), length=37.0) == -1).all()
    assert (mapped(ball([0.0, 60.0, 0.0], 20.0), length=38.0) == 0).sum() > 0


@pytest.mark.parametrize("seed", range(4))
def test_a_point_blocks_all_within_its_limit(seed):
    """Of a triangle as small as a point the cone is tight, also about poles, at the grid's ends and beside the target.

    Blocked is what comes within the limit by the plain distance of a point from an axis, and nothing else.
    """
    rng, asked = np.random.default_rng(seed), 0
    for _ in range(25):
        R = Rotation.random(random_state=rng).as_matrix() if rng.random() < 0.5 else np.eye(3)
        directions = random_grid(rng, R, 3.0)
        where = R @ rng.choice([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]) + rng.choice([0.0, 0.1, 1.0]) * (
            rng.normal(size=3)
        )
        point, length = rng.uniform(5.0, 80.0) * where, rng.uniform(5.0, 90.0)
        along = np.clip(directions.outward_ct @ point, 0.0, length)
        away = np.linalg.norm(point - along[:, None] * directions.outward_ct, axis=1)
        limit = max(1.0, rng.choice([away.min(), rng.choice(away)]) + rng.choice([-5e-4, -5e-5, 0.1, 5.0, 5e-5, 5e-4]))
        mesh = TriangleMesh(point + 1e-6 * np.eye(3), np.array([[0, 1, 2]]))
        found = VerdictMap(np.zeros(3), directions.grid, directions.outward_ct, R)
        one = Structure("point", Role.AVOID, limit, mesh, "made")
        found.add(FastEngine([mesh]), 0, one, np.full(len(directions), length), 0.0)
        clear = np.abs(away - limit) > 1e-5
        assert np.array_equal(found.free[clear], (away > limit)[clear])
        asked += int((~found.free).sum())
    assert asked > 1000
