"""The surfaces on the page: as they were checked, and lighter ones, without a browser."""

import gzip

import numpy as np
import report_world as world
from hypothesis import given, strategies as st
from scipy.spatial import cKDTree

from puncture_twin.planning.formats.labels.labelmaps import mask_surface
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.report.page import page_surfaces
from puncture_twin.twin.report.page.page_surfaces import surfaces

BOX = np.array([[-30.0] * 3, [18.0, 30.0, 30.0]])


def in_planes(content, count, width, at):
    """Whole numbers of so many bytes: the lowest of all first."""
    planes = np.frombuffer(content, np.uint8, count * width, at).reshape(width, count).astype(int)
    return (planes << (8 * np.arange(width))[:, None]).sum(axis=0)


def unpacked_surfaces(packed):
    """Corners, mm from the target, and triangles of every part."""
    content, at, found = gzip.decompress(packed.content), 0, []
    for part in packed.facts["parts"]:
        steps = in_planes(content, 3 * part["corners"], 2, at).reshape(3, -1)
        found.append([np.cumsum(steps, axis=1).astype(np.int16).T * packed.facts["unit_mm"]])
        at += 6 * part["corners"]
    for one, part in zip(found, packed.facts["parts"], strict=True):
        index, newest = [], 0
        for below in in_planes(content, 3 * part["triangles"], 3, at).tolist():
            index.append(newest - below)
            newest += below == 0
        one.append(np.reshape(index, (-1, 3)))
        at += 9 * part["triangles"]
    return found


def even(faces):
    """Whether every edge has an even number of triangles."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()


def test_surfaces_are_kept_to_what_is_said_of_them(monkeypatch):
    """Corners to a sixteenth of a millimetre, and every edge of an even number of triangles; lighter if too many."""
    target, ball = world.TARGET, world._ball(40, world.TARGET + 5, 4)
    box = np.stack([target - 100, target + 100])
    for most, off in ((page_surfaces.MOST_TRIANGLES, 0.055), (1500, 0.5), (200, 3.0)):
        monkeypatch.setattr(page_surfaces, "MOST_TRIANGLES", most)
        packed = surfaces([("ball", "avoid", ball)], target, box)
        ((corners, faces),) = unpacked_surfaces(packed)
        assert packed.facts["off_mm"] <= off and len(faces) <= most and even(faces)
        far = np.abs(np.linalg.norm(corners - 5, axis=1) - 40)
        assert far.max() <= packed.facts["off_mm"] + 0.05


def outline(corners, faces, at, normal):
    """Points of the cut of a plane, not farther than 0.2 mm from one another."""
    height = (corners - at) @ normal
    found = []
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # the corner alone on its side, and the two others
        one = faces[
            ((height[faces[:, a]] > 0) != (height[faces[:, b]] > 0))
            & ((height[faces[:, a]] > 0) != (height[faces[:, c]] > 0))
        ]
        ends = []
        for other in (b, c):
            t = (height[one[:, a]] / (height[one[:, a]] - height[one[:, other]]))[:, None]
            ends.append((1 - t) * corners[one[:, a]] + t * corners[one[:, other]])
        steps = np.linspace(0, 1, 2 + int(np.linalg.norm(ends[1] - ends[0], axis=1).max(initial=0) / 0.2))
        found.append((ends[0][:, None] + steps[:, None] * (ends[1] - ends[0])[:, None]).reshape(-1, 3))
    return np.concatenate(found)


def test_outlines_of_a_fine_label_map_are_true_to_half_a_millimetre(monkeypatch):
    """An organ, a vessel of 3 mm, an island; voxels of 0.7 mm: each cut against the exact one, and back."""
    monkeypatch.setattr(page_surfaces, "MOST_TRIANGLES", 9000)
    x, y, z = np.moveaxis(0.7 * (np.indices((72, 72, 72)) - 35.5), 0, 0)
    organ = (x / 20) ** 2 + (y / 14) ** 2 + (z / 17) ** 2 + 0.15 * np.sin(x / 3) < 1
    vessel = (np.hypot(y - 17 - 2 * np.sin(x / 6), z - 3) < 1.5) & (np.abs(x) < 22)
    vessel[5, 5, 5] = True
    T = np.diag([0.7, 0.7, 0.7, 1.0])
    T[:3, 3] = -0.7 * 35.5
    meshes = [mask_surface(mask, T, where="test") for mask in (organ, vessel)]
    packed = surfaces([(name, "avoid", mesh) for name, mesh in zip("ab", meshes, strict=True)], np.zeros(3), BOX)
    assert packed.facts["off_mm"] <= 0.5 and [one["name"] for one in packed.facts["parts"]] == ["a", "b"]
    assert sum(one["triangles"] for one in packed.facts["parts"]) <= 9000 < 0.5 * sum(len(one.faces) for one in meshes)
    middles = np.array([[0.0, 0.0, 0.0], [0.0, 17.0, 3.0]])
    for mesh, (corners, faces), at in zip(meshes, unpacked_surfaces(packed), middles, strict=True):
        assert even(faces)
        for normal in (np.eye(3)[0], np.eye(3)[2], np.array([0.6, 0.0, 0.8])):
            shown, exact = (outline(corners, faces, at, normal), outline(mesh.vertices, mesh.faces, at, normal))
            for one, other in ((shown, exact), (exact, shown)):
                far = cKDTree(other[((other > BOX[0]) & (other < BOX[1])).all(axis=1)]).query(one)[0]
                assert far[((one > BOX[0] + 1) & (one < BOX[1] - 1)).all(axis=1)].max() <= 0.55  # points 0.2 mm apart
    island = unpacked_surfaces(packed)[1][0]
    assert np.linalg.norm(island - 0.7 * (5 - 35.5), axis=1).min() < 0.6


def test_far_surfaces_are_left_out_and_farther_corners_wrap():
    """Only what reaches the box; corners 4 m apart come back although a difference fits no 16 bits."""
    target = np.zeros(3)
    wall = TriangleMesh(
        np.array([[-2200.0, -2000, 10], [2100, -2000, 10], [0, 2100, 10]]), np.array([[0, 1, 2]], np.int32)
    )
    far = TriangleMesh(wall.vertices + [0, 0, 500.0], wall.faces)
    packed = surfaces([("wall", "unknown", wall), ("far", "avoid", far)], target, np.array([[-50.0] * 3, [50.0] * 3]))
    ((corners, _),) = unpacked_surfaces(packed)
    assert [one["name"] for one in packed.facts["parts"]] == ["wall"] and np.allclose(corners, wall.vertices)


@given(st.integers(0, 200))
def test_inside_stays_inside_of_a_surface_that_the_box_cuts(seed):
    """Rays from points in the box, to every side, cross what is kept as oddly as the whole; little is kept beyond."""
    rng = np.random.default_rng(seed)
    centre, radius = rng.uniform(-60, 60, 3), rng.uniform(30, 200)
    ball = world._ball(radius, centre)
    box = np.stack([rng.uniform(-60, -20, 3), rng.uniform(20, 60, 3)])
    packed = surfaces([("ball", "avoid", ball)], np.zeros(3), box)
    points = rng.uniform(box[0], box[1], (20, 3))
    points = points[np.abs(np.linalg.norm(points - centre, axis=1) - radius) > 3]
    inside = np.linalg.norm(points - centre, axis=1) < radius
    for (corners, faces), part in zip(unpacked_surfaces(packed), packed.facts["parts"], strict=True):
        assert part["drawn"] <= part["triangles"] == len(faces) <= part["drawn"] + 800
        for toward in rng.normal(size=(3, 3)):
            assert (crossed(corners[faces], points, toward) == inside).all()
    assert packed.facts["parts"] or not inside.any()


def crossed(triangles, points, toward):
    """Whether a ray from each point crosses triangles (m, 3, 3) an odd number of times, by signed volumes."""
    a, b, c = (triangles[:, k][None] - points[:, None] for k in range(3))
    sides = [np.einsum("nmk,k->nm", np.cross(p, q), toward) > 0 for p, q in ((a, b), (b, c), (c, a))]
    ahead = (
        np.einsum("nmk,nmk->nm", a, np.cross(b - a, c - a)) * np.einsum("nmk,k->nm", np.cross(b - a, c - a), toward) > 0
    )
    return ((sides[0] == sides[1]) & (sides[1] == sides[2]) & ahead).sum(axis=1) % 2 == 1
