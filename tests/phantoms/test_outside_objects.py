"""Arms, beds and lines about a drawn trunk: closed, where they are said to be, another with every seed."""

from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from tools.phantoms.drawn.trunk import draw_trunk
from tools.phantoms.outside_objects import Outline, OutsideObjects, drawn, tube

SEEDS = range(3)


@cache
def trunk_of(seed):
    """A trunk, the state of its generator behind it, and its skin for trimesh."""
    rng = np.random.default_rng(seed)
    trunk = draw_trunk(rng)
    return trunk, rng.bit_generator.state, as_trimesh(trunk.skin)


@cache
def laid(seed, **wanted):
    trunk, state, skin = trunk_of(seed)
    rng = np.random.default_rng()
    rng.bit_generator.state = state
    parts = OutsideObjects(**wanted).placed(trunk.skin, float(trunk.target[2]), rng)
    return skin, {one.name: one for one in parts}


@cache
def samples(skin):
    return cKDTree(trimesh.sample.sample_surface(skin, 40_000, seed=1)[0])


def as_trimesh(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def depth(skin, mesh, near):
    """How deep a part lies within the skin, mm; negative: how far off it, at heights (2,) at least."""
    points = trimesh.sample.sample_surface(as_trimesh(mesh), 400, seed=1)[0]
    points = points[(points[:, 2] > near[0]) & (points[:, 2] < near[1])]
    if not len(points):
        return -np.inf
    within, away = skin.contains(points), samples(skin).query(points)[0]
    return float(away[within].max()) if within.any() else -float(away.min())


@pytest.mark.parametrize(
    ("seed", "arms", "bed"), [(0, "beside", "flat"), (1, "pressed", "curved"), (2, "across", "pad")]
)
def test_every_part_is_closed_and_wound_outward(seed, arms, bed):
    """By trimesh, whatever is asked for; a core lies in its sheath and a bone in its arm."""
    _, parts = laid(seed, arms=arms, bed=bed, lines=2)
    for one in parts.values():
        mesh = as_trimesh(one.mesh)
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0, one.name
    for name in ("line_1", "cable_2", "table"):
        inner = parts[f"{name}_{'foam' if name == 'table' else 'core'}"].mesh
        low, high = parts[name].mesh.bounds
        assert np.all(inner.bounds[0] > low) and np.all(inner.bounds[1] < high)
    humerus, arm = parts["arm_left_humerus"].mesh, as_trimesh(parts["arm_left"].mesh)
    assert arm.contains(humerus.vertices[::7]).mean() > 0.9


@pytest.mark.parametrize("seed", SEEDS)
def test_arms_lie_where_they_are_said_to_lie(seed):
    """Beside: off the skin by some millimetres. Pressed and across: into it, but for the most part out of it."""
    for side in ("left", "right"):
        for arms in ("beside", "pressed", "across"):
            skin, parts = laid(seed, arms=arms)
            deep = max(depth(skin, parts[f"arm_{side}{end}"].mesh, (-170.0, 170.0)) for end in ("", "_hand"))
            if arms == "beside":
                assert -36.0 < deep < -1.0
            else:
                assert 0.5 < deep < 40.0
            x = parts[f"arm_{side}"].mesh.vertices[:, 0] * (1 if side == "left" else -1)
            assert x.max() > skin.bounds[1, 0]


def test_a_forearm_across_lies_before_the_front():
    """The hand of each is in front of the trunk's middle, on skin."""
    for seed in SEEDS:
        skin, parts = laid(seed, arms="across")
        for side in ("left", "right"):
            middle = parts[f"arm_{side}_hand"].mesh.vertices.mean(axis=0)
            assert middle[1] < skin.vertices[:, 1].mean()
            assert abs(middle[0]) < skin.bounds[1, 0]


@pytest.mark.parametrize("bed", ["flat", "curved", "pad"])
def test_the_back_lies_on_the_bed(bed):
    """The uppermost of it is beneath the back by no more than the body sinks in; it goes on beyond head and feet."""
    for seed in SEEDS:
        skin, parts = laid(seed, bed=bed)
        top = next(iter(parts.values())).mesh.vertices
        below = top[np.abs(top[:, 0]) < 60.0] if bed == "curved" else top
        back = skin.bounds[1, 1]
        assert -9.0 < below[:, 1].min() - back < 8.0
        assert top[:, 2].min() < skin.bounds[0, 2] - 300.0 and top[:, 2].max() > skin.bounds[1, 2] + 300.0


def test_lines_touch_the_skin_or_stand_off_it():
    """Every third lies on it, sunk in where the skin runs aslant; none is wholly within it."""
    for seed in SEEDS:
        skin, parts = laid(seed, lines=3)
        touching = depth(skin, parts["line_3"].mesh, (-190.0, 190.0))
        assert -1.5 < touching < 5.0
        for name in ("line_1", "cable_2"):
            assert depth(skin, parts[name].mesh, (-190.0, 190.0)) < 5.0


def test_seeds_differ_and_repeat():
    """The same seed draws the same arms and trunk; another one others; nothing asked for is nothing."""
    first, again, other = (laid(seed, arms="pressed")[1]["arm_left"].mesh for seed in (5, 5, 6))
    assert first.digest == again.digest != other.digest
    assert laid(1)[1] == {}


def test_a_section_of_the_skin_is_that_of_trimesh():
    """The reach along a spoke, against a ray; beyond the skin's ends as near them."""
    trunk = draw_trunk(np.random.default_rng(3))
    outline, mesh = Outline(trunk.skin), as_trimesh(trunk.skin)
    for angle in (0.1, 1.3, 2.9):
        spoke = np.array([np.cos(angle), -np.sin(angle)])
        origin = np.append(outline.middle(33.0), 33.0)
        hits = mesh.ray.intersects_location([origin], [np.append(spoke, 0.0)])[0]
        assert outline.reach(33.0, spoke) == pytest.approx(np.linalg.norm(hits - origin, axis=1).max(), abs=1e-6)
    assert outline.reach(900.0, spoke) == pytest.approx(outline.reach(170.0, spoke))


def test_tube_and_section_have_their_volumes():
    """A straight round limb, a flat one, and a bent gutter."""
    line = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 50.0], [0.0, 0.0, 100.0]])
    r = 10.0
    whole = np.pi * r * r * 100.0 + 4.0 / 3.0 * np.pi * r**3
    assert as_trimesh(tube(line, np.full(3, r))).volume == pytest.approx(whole, rel=0.03)
    flat = tube(line, np.array([[20.0, 5.0]] * 3), np.array([1.0, 0.0, 0.0]))
    assert np.ptp(flat.vertices[:, 0]) == pytest.approx(40.0) and np.ptp(flat.vertices[:, 1]) == pytest.approx(10.0)
    gutter = np.array([[-2.0, 0.0], [0.0, 1.0], [2.0, 0.0], [2.0, 1.0], [0.0, 2.0], [-2.0, 1.0]])
    assert as_trimesh(drawn(gutter, -3.0, 4.0)).volume == pytest.approx(4.0 * 1.0 * 7.0)
