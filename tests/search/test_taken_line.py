"""The line that a needle takes: a direction's own verdict where it is one, and of what bends or misses."""

from itertools import pairwise

import numpy as np
import pytest

from puncture_twin.meshes import folder
from puncture_twin.planning.geometry.triangle_distance import squared_distance
from puncture_twin.planning.registration.fits import carried_along
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.taken_line import SAFE, UNCERTAIN, check_line, hit_chance, next_aims


def exact(path):
    return np.zeros((len(path), 6, 6))


@pytest.fixture(scope="module")
def context():
    return prepare(folder() / "abdomen", arm=False)


@pytest.fixture(scope="module")
def best(context):
    theta, beta = np.meshgrid(np.radians(np.arange(20, 80, 10)), np.radians(np.arange(0, 360, 20)))
    found = context.check(theta.ravel(), beta.ravel())
    return found.outward_ct[np.flatnonzero(found.safe)[np.argmax(found.clearance.least[found.safe])]]


def straight(context, outward, off=(0.0, 0.0, 0.0)):
    tip = context.case.target_ct + np.array(off)
    return np.stack([tip, tip + 60.0 * outward])


@pytest.mark.parametrize("pieces", [1, 12])
def test_a_needle_on_a_direction_has_that_directions_clearances(context, pieces):
    theta, beta = np.radians([25.0, 60.0, 40.0]), np.radians([30.0, 200.0, 120.0])
    candidates = context.check(theta, beta)
    for row, outward in enumerate(candidates.outward_ct):
        steps = np.linspace(0.0, 60.0 if pieces == 1 else context.case.needle.length_mm, pieces + 1)  # out of the skin
        path = context.case.target_ct + np.outer(steps, outward)
        line = check_line(context, path, exact(path))
        known = dict(zip(candidates.clearance.structures, candidates.clearance.by_structure[row], strict=True))
        outside = {one.name for one in context.anatomy.surroundings}  # a plan's needle comes from farther out
        found = {one.name: one.clearance_mm for one in line.each}
        assert all(found[name] >= known.pop(name) - 1e-6 and found.pop(name) > 0 for name in outside)
        assert found == pytest.approx(known, abs=1e-6)
        if candidates.verdict.reason[row] not in ("skin_angle",):
            assert line.verdict == (candidates.verdict.reason[row] or SAFE)
        if line.safe:
            assert line.inserted_mm == pytest.approx(candidates.path.length[row])
            assert line.entry_ct == pytest.approx(candidates.path.entry_ct[row])


def test_clearance_of_a_bent_needle_is_that_of_its_points(context, best):
    s = np.linspace(0.0, 80.0, 17)
    side = np.cross(best, [0.0, 0.0, 1.0])
    path = context.case.target_ct + np.outer(s, best) + np.outer(0.002 * s**2, side / np.linalg.norm(side))
    line = check_line(context, path, exact(path))
    end = path[-1] + np.linspace(0.0, context.case.needle.length_mm, 300)[:, None] * (path[-1] - path[-2]) / 5.0
    dense = np.concatenate([a + np.linspace(0, 1, 40)[:, None] * (b - a) for a, b in pairwise(path)])
    dense = np.concatenate([dense, end[np.linalg.norm(end - path[-1], axis=1) < 100.0]])
    for name in ("ribs_right", "portal_vein", "lung_right"):
        triangles = context.anatomy.structure(name).mesh.triangles
        known = np.sqrt(min(squared_distance(point, triangles).min() for point in dense))
        found = next(one.clearance_mm for one in line.each if one.name == name)
        assert found == pytest.approx(known - context.case.needle.radius_mm, abs=0.1)


def test_what_the_reading_errs_is_no_safety(context, best):
    path = straight(context, best)
    known = check_line(context, path, exact(path))
    assert known.verdict == SAFE and all(one.sure for one in known.each)
    slack = known.each[0].clearance_mm - known.each[0].margin_mm
    unsure = check_line(context, path, carried_along(path, np.diag([slack**2] * 3 + [0.0] * 3)))
    assert (unsure.verdict, unsure.safe) == (UNCERTAIN, False)
    rib = context.anatomy.structure("ribs_right").mesh
    through = rib.vertices[np.argmin(np.linalg.norm(rib.vertices - context.case.target_ct, axis=1))]
    outward = through - context.case.target_ct
    path = straight(context, outward / np.linalg.norm(outward))
    hit = check_line(context, path, exact(path))
    assert not hit.safe and hit.structure == "ribs_right"
    assert hit.each[0].clearance_mm < 0


def test_what_is_known_worse_elsewhere_than_where_it_is_nearest(context, best):
    """A bend that is unknown at the tip, far from the nearest structure: each piece keeps its margin by its own error.

    Oracle: the line moved by two standard deviations along its tip's end breaks a margin or does not.
    """
    steps = np.linspace(0.0, 60.0, 7)
    path = context.case.target_ct + np.outer(steps, best)
    known = check_line(context, path, exact(path))
    near = known.each[0]
    for row in range(len(path)):
        covs = exact(path)
        covs[row, :3, :3] = 400.0 * np.eye(3)
        line = check_line(context, path, covs)
        one = next(one for one in line.each if one.name == near.name)
        assert one.clearance_mm == near.clearance_mm and one.sd_mm >= 0
        assert line.verdict == (SAFE if row == len(path) - 1 and not one.sd_mm else UNCERTAIN)


def test_a_tip_outside_of_the_body_has_no_safe_line(context, best):
    tip = context.case.target_ct + 140.0 * best
    path = np.stack([tip, tip + 60.0 * best])
    line = check_line(context, path, exact(path))
    assert not line.safe and np.isnan(line.inserted_mm)


def test_the_chance_to_hit_is_that_of_draws(context):
    rng = np.random.default_rng(5)
    mesh, target = context.anatomy.structure("lesion").mesh, context.case.target_ct
    size = float(np.ptp(mesh.vertices, axis=0).mean()) / 2
    tip = target + np.array([0.7 * size, 0.0, 0.0])
    cov = np.diag([0.5, 0.3, 0.4]) * size**2
    draws = tip + rng.multivariate_normal(np.zeros(3), cov, 20_000)
    radius = np.linalg.norm(mesh.vertices - target, axis=1)
    known = np.mean(np.linalg.norm(draws - target, axis=1) < radius.mean())  # the lesion is a ball, nearly
    assert hit_chance(context, tip, cov) == pytest.approx(known, abs=0.03)


def test_next_aims(context, best):
    cov = np.diag([0.04] * 3 + [1e-6] * 3)
    side = np.cross(best, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)

    def aims(off):
        path = straight(context, best, off)
        covs = carried_along(path, cov)
        return next_aims(context, path, covs, -best, check_line(context, path, covs))

    assert aims(np.zeros(3))[0].kind == "accept"
    short = aims(25.0 * best)[0]
    assert (short.kind, short.by_mm) == ("deeper", pytest.approx(25.0))
    beside = aims(30.0 * side)
    turn = next(one for one in beside if one.kind == "turn")
    assert beside[0] is turn or not turn.allowed
    path = straight(context, best, 30.0 * side)
    entry = check_line(context, path, exact(path)).entry_ct - context.case.target_ct
    known = np.degrees(np.arccos(best @ entry / np.linalg.norm(entry)))
    assert turn.turn_deg == pytest.approx(known) and turn.p_hit > 0.9
