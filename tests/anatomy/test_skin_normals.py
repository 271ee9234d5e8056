"""Normals of skins from voxels: those of the shapes that were sampled, whatever stairs they were made of."""

import numpy as np
import pytest

from benchmarks.skin_angle import SHAPES, box_off_deg, grid, inside_mm, off_deg, shape_off_deg, skin_of
from puncture_twin.planning.anatomy.skin import skin_paths
from puncture_twin.planning.anatomy.skin_normals import (
    NEAR_COSINE,
    NEAR_MM,
    NORMAL_COSINE,
    NORMAL_MM,
    REACH,
    broad_normals,
)
from puncture_twin.planning.geometry.mesh import unit_vectors


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("voxel", "grey"), [((3.0, 3.0, 3.0), False), ((3.0, 3.0, 3.0), True), ((1.6, 1.6, 5.0), False)]
)
def test_normals_are_those_of_the_shape(shape, voxel, grey):
    """Within 3 degrees for 95 %, 8 for all, where the stairs of a label are off by 15 and more."""
    stairs, ours = shape_off_deg(SHAPES[shape], voxel, grey=grey)
    assert np.percentile(ours, 95) < 3.0 and ours.max() < 8.0
    assert grey or np.percentile(stairs, 95) > 15.0


def test_the_side_of_a_box_is_not_bent_by_the_next():
    """Within 5 degrees from 10 mm beside the edge on, within 1.5 from 20 mm on."""
    away, (_, ours) = box_off_deg((2.0, 2.0, 2.0))
    assert ours[away > 10.0].max() < 5.0 and ours[away > 20.0].max() < 1.5


@pytest.mark.parametrize("gap_mm", [3.0, 6.0, 12.0])
def test_an_arm_across_a_gap_of_air_does_not_count(gap_mm):
    """The trunk's normals where an arm is near are as they are without it."""
    points, T = grid(np.full(3, 3.0))
    half, arm = np.array([100.0, 100.0, np.inf]), np.array([30.0, 60.0, np.inf])
    with_arm = np.maximum(inside_mm(points, half), inside_mm(points - [130.0 + gap_mm, 0.0, 0.0], arm))
    skins = [skin_of(depth, T, grey=False) for depth in (inside_mm(points, half), with_arm)]
    sides = []
    for skin in skins:
        middles = skin.mesh.triangles.mean(axis=1)
        faces = np.flatnonzero(
            (middles[:, 0] > 60.0) & (middles[:, 0] < 100.0 + gap_mm / 2) & (np.hypot(*middles[:, :2].T) < 103.0)
        )
        faces = faces[np.abs(middles[faces, 2]) < 60.0]
        sides.append(off_deg(skin, faces, middles[faces] / half**2)[1])
    assert len(sides[1]) > 1000
    assert sides[1].max() < sides[0].max() + 0.5


def test_where_the_image_ends_is_no_skin():
    """A cone that the image cuts: up to the cut its normals are its own, the cut's are not mixed in."""
    points, T = grid(np.full(3, 3.0))
    cone = 60.0 - 0.3 * points[..., 2] - np.hypot(points[..., 0], points[..., 1])
    skin = skin_of(cone, T, grey=False)
    middles = skin.mesh.triangles.mean(axis=1)
    true = np.column_stack([unit_vectors(middles[:, :2]), np.full(len(middles), 0.3)])
    faces = np.flatnonzero(~skin.cut_faces)
    assert skin.cut_faces.any() and np.abs(middles[faces, 2]).max() > 90.0
    off = off_deg(skin, faces, true[faces])[1]
    assert np.percentile(off, 95) < 3.0 and off.max() < 8.0


def plain_normals(mesh, vertices):
    """The rule of `broad_normals` at some vertices by a sum over all triangles, none merged."""
    areas = np.cross(mesh.triangles[:, 1] - mesh.triangles[:, 0], mesh.triangles[:, 2] - mesh.triangles[:, 0]) / 2
    centres, looks, ways = mesh.triangles.mean(axis=1), unit_vectors(areas), np.zeros_like(mesh.vertices)
    np.add.at(ways, mesh.faces, areas[:, None])
    ways = unit_vectors(ways)
    for scale, cosine in ((NEAR_MM, NEAR_COSINE), (NORMAL_MM, NORMAL_COSINE)):
        wanted = vertices if scale == NORMAL_MM else range(len(ways))
        means = ways.copy()
        for v in wanted:
            square = ((centres - mesh.vertices[v]) ** 2).sum(axis=1)
            weights = np.exp(-square / 2 / scale**2) * (square < (REACH * scale) ** 2) * (looks @ ways[v] > cosine)
            means[v] = weights @ areas
        ways = unit_vectors(means)
        looks = unit_vectors(ways[mesh.faces].sum(axis=1))
    return ways[vertices]


def test_they_are_the_plain_sum():
    """Merging triangles costs less than a degree; where no triangle counts, a vertex keeps its own normal."""
    points, T = grid(np.array([6.0, 5.0, 4.0]))
    mesh = skin_of(inside_mm(points, np.array([90.0, 60.0, 50.0])), T, grey=False).mesh
    some = np.arange(0, len(mesh.vertices), 7)
    plain = plain_normals(mesh, some)
    ours = broad_normals(mesh, np.ones(len(mesh.faces), bool))[some]
    assert np.degrees(np.arccos(np.clip((ours * plain).sum(axis=1), -1, 1))).max() < 1.5
    own = broad_normals(mesh, np.zeros(len(mesh.faces), bool))
    assert (np.linalg.norm(own, axis=1) == pytest.approx(1.0)) and len(np.unique(own.round(6), axis=0)) < len(own)


def test_a_path_is_as_oblique_as_it_is_to_the_shape():
    """From a target off the axis of a cylinder, all round: the angle at the entry is that of the circle."""
    points, T = grid(np.full(3, 2.0))
    radius, target = 100.0, np.array([60.0, 10.0, 3.0])
    skin = skin_of(inside_mm(points, np.array([radius, radius, np.inf])), T, grey=False)
    angle = np.radians(np.arange(0.0, 360.0, 1.7))
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    paths = skin_paths(skin, target, outward, 300.0)
    across = np.abs(outward[:, 0] * target[1] - outward[:, 1] * target[0])  # the path's distance from the axis
    off = np.degrees(np.abs(paths.skin_angle - np.arcsin(across / radius)))
    assert np.percentile(off, 95) < 2.0 and off.max() < 4.0
