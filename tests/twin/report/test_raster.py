"""The pictures' compiled core against slower engines: Embree for what is seen, plain numpy for the rest."""

from dataclasses import replace

import numpy as np
import pytest
import report_world as world
from embreex.mesh_construction import TriangleMesh as EmbreeMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.spatial.transform import Rotation

from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.report.map.map_raster import map_raster, row_colours
from puncture_twin.twin.report.map_view import MapCells, map_view
from puncture_twin.twin.report.raster.camera import ViewCamera
from puncture_twin.twin.report.raster.raster import corner_normals, lit
from puncture_twin.twin.report.raster.render import (
    LIGHT,
    MAX_SHELLS,
    SAMPLES,
    Layer,
    MovingPicture,
    Surface,
    View,
    picture,
)

SIZE = 90, 120


def soup(rng, count, size=30.0, spread=80.0):
    middle = rng.uniform(-spread, spread, (count, 1, 3))
    corners = (middle + rng.normal(0, size, (count, 3, 3))).reshape(-1, 3)
    return TriangleMesh(corners, np.arange(3 * count, dtype=np.int32).reshape(-1, 3))


def alone(triangles):
    return TriangleMesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))


def camera_at(eye, look_at=(0.0, 0.0, 0.0)):
    return ViewCamera(
        np.array(eye, dtype=float), np.array(look_at, dtype=float), np.array([0, 0, 1.0]), 0.6, SIZE[1], SIZE[0]
    )


def all_hits(mesh, eye, rays):
    """Distances of every triangle along every ray, infinite where it is missed, by Möller and Trumbore (1997)."""
    a, b, c = (mesh.triangles[:, k] for k in range(3))
    p = np.cross(rays[:, None], c - a)
    det = np.einsum("rtk,tk->rt", p, b - a)
    s = eye - a
    q = np.cross(s, b - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("rtk,tk->rt", p, s) / det
        v = np.einsum("rk,tk->rt", rays, q) / det
        t = np.einsum("tk,tk->t", q, c - a) / det
        return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)


@pytest.mark.parametrize("eye", [(0, -400, 30), (20, -95, 10)])
def test_what_is_seen_is_what_embree_hits(rng, eye):
    """Depth of every sample, from outside and from amid triangles that reach behind the eye."""
    mesh, camera = soup(rng, 400), camera_at(eye)
    (depth,), _ = world.samples(Layer([Surface(mesh, (200, 100, 50))]), camera)
    scene = EmbreeScene()
    EmbreeMesh(scene, mesh.vertices.astype(np.float32), mesh.faces)
    rays = world.rays(camera).astype(np.float32)
    hits = scene.run(np.tile(np.float32(camera.eye), (len(rays), 1)), rays, output=True)
    wanted = np.where(hits["geomID"] >= 0, hits["tfar"], np.inf).reshape(SIZE)
    agree = np.isclose(depth, wanted, rtol=1e-3, atol=0.02) | (np.isinf(depth) & np.isinf(wanted))
    assert np.isfinite(wanted).mean() > 0.3
    assert agree.mean() > 0.998  # single precision may see an edge on either side


def test_no_sample_falls_between_triangles(ball):
    """A closed ball seen from within has no hole, whatever its triangles' edges meet."""
    layer = Layer([Surface(ball(60.0, (0, 0, 0), 5), (200, 40, 40))])
    depth, _ = world.samples(layer, camera_at((1.0, 2.0, -3.0), (50, 1, 0)))
    assert np.isfinite(depth).all()


def test_shells_are_all_hits_in_order(rng):
    """The shells hold the nearest hits of each sample, sorted, as a plain search over all triangles finds them."""
    mesh, camera = soup(rng, 60), camera_at((0, -400, 30))
    depth, _ = world.samples(Layer([Surface(mesh, (200, 100, 50), 0.3)]), camera, MAX_SHELLS)
    wanted = np.sort(all_hits(mesh, camera.eye, world.rays(camera)), axis=1)[:, :MAX_SHELLS]
    near = np.where(np.isfinite(wanted), wanted, 1e6 * np.arange(1, 1 + MAX_SHELLS))
    apart = (np.diff(near, axis=1) > 0.05).all(axis=1)  # else two count as one
    found = depth.reshape(MAX_SHELLS, -1).T
    agree = (np.isclose(found, wanted, atol=0.01) | (np.isinf(found) & np.isinf(wanted))).all(axis=1)
    assert apart.mean() > 0.5
    assert agree[apart].mean() > 0.999


def test_of_two_surfaces_in_one_place_the_first_is_seen():
    """Organs cut off by the image end in one plane with the skin: no flicker, whatever rounding says."""
    plate = np.array([[-50.0, 0, -50], [50, 0, -50], [50, 0, 50], [-50, 0, 50]])
    one = TriangleMesh(plate, np.array([[0, 1, 2], [0, 2, 3]]))
    other = TriangleMesh(plate + [0.3, 0.0, 0.7], np.array([[1, 2, 3], [1, 3, 0]]))
    camera = camera_at((60, -300, 80))
    inner = np.isfinite(world.samples(Layer([Surface(one, (9, 9, 9))]), camera)[0][0])
    for first, second in ((one, other), (other, one)):
        layer = Layer([Surface(first, (9, 9, 9)), Surface(second, (9, 9, 9))])
        for most in (1, MAX_SHELLS):
            assert (layer.bodies[world.samples(layer, camera, most)[1][0][inner]] == 0).mean() > 0.97


def shaded(layer, camera, depth, triangle):
    """Colour and opacity of every sample, shape (h, w, 4), by the equations of `lit`, one by one."""
    look, out = View(layer, camera).look, np.zeros((*triangle.shape, 4))
    light = tuple(LIGHT)
    for row, column in np.argwhere(np.isfinite(depth)):
        f = triangle[row, column]
        x, y = (column + 0.5 - camera.width / 2) / camera.scale, (camera.height / 2 - row - 0.5) / camera.scale
        tone, shine, facing = lit(look.points, look.normals, look.flats, look.faces, f, x, y, light)
        body = look.bodies[f]
        out[row, column, :3] = np.minimum(look.colours[body] * tone + shine, 255.0)
        out[row, column, 3] = min(1.0, look.alphas[body] * (1.0 + look.rims[body] * (1.0 - facing) ** 3))
    return out


def test_a_picture_is_what_its_samples_blend_to(rng, ball):
    """Pixels are the means of their samples, each lit and blended alone, by Porter and Duff's over, back to front."""
    camera = camera_at((0, -400, 30))
    opaque = Layer([Surface(soup(rng, 40), (200, 100, 50)), Surface(ball(30.0), (90, 160, 40))])
    glass, fine = Layer([Surface(ball(mm), (200, 0, 250), 0.3) for mm in (40.0, 50.0)]), camera.finer(SAMPLES)
    (far,), (triangle,) = world.samples(opaque, fine)
    wanted = np.where(np.isfinite(far)[..., None], shaded(opaque, fine, far, triangle)[..., :3], [246.0, 247.0, 249.0])
    for depth, triangle in list(zip(*world.samples(glass, fine, MAX_SHELLS), strict=True))[::-1]:
        veil = shaded(glass, fine, np.where(depth < far, depth, np.inf), triangle)
        wanted += veil[..., 3:] * (veil[..., :3] - wanted)
    wanted = wanted.reshape(camera.height, SAMPLES, camera.width, SAMPLES, 3).mean(axis=(1, 3))
    found = picture(opaque, glass, camera)
    assert (np.abs(found - wanted).max(axis=2) < 2.0).mean() > 0.99  # a pixel of one smooth surface is lit once
    assert len(np.unique(found.reshape(-1, 3), axis=0)) > 1000


def test_a_picture_does_not_depend_on_what_lay_in_memory(rng, ball, monkeypatch):
    """Of a shell that some samples of a pixel lack, the colour that is not there counts for nothing, also as NaN."""
    camera = replace(camera_at((0.0, -90.0, 20.0)), width=300, height=200)
    layers = Layer([Surface(ball(30.0), (200, 60, 50))]), Layer([Surface(soup(rng, 40), (50, 90, 200), 0.3)])
    expected = picture(*layers, camera)

    def nothing(shape, dtype=np.float64):
        return np.full(shape, np.nan if np.dtype(dtype).kind == "f" else 77, dtype)

    monkeypatch.setattr(np, "empty", nothing)
    assert np.array_equal(picture(*layers, camera), expected)


def at_place(place, turn=0.0):
    """A pose: there, turned about an oblique axis by an angle, rad."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn * np.array([0.6, 0.0, 0.8])).as_matrix()
    T[:3, 3] = place
    return T


def test_bodies_that_move_look_as_if_they_stood_there_and_leave_nothing_behind(ball):
    """Picture after picture is that of all bodies drawn anew, behind and before glass, beside and behind the eye."""
    camera = camera_at((30, -400, 80))
    wall, glass = Surface(ball(30.0), (90, 160, 40)), Surface(ball(60.0), (200, 0, 0), 0.3)
    one, other = (Surface(ball(15.0), colour) for colour in ((0, 0, 250), (250, 200, 0)))
    moving = MovingPicture(Layer([wall]), Layer([glass]), [Layer([one]), Layer([other])], camera)
    for places in (
        ((0, -90, 0), (45, 0, 0)),
        ((-70, 0, 40), (-60, -20, 30)),
        ((900, 0, 0), (-10, 120, -30)),
        ((0, -800, 0), (0, 0, 0)),
    ):
        poses = [at_place(place, 0.7) for place in places]
        stand = [replace(s, mesh=s.mesh.transformed(T)) for s, T in zip((one, other), poses, strict=True)]
        wanted = picture(Layer([wall, *stand]), Layer([glass]), camera)
        found = moving.at(poses)
        assert (np.abs(found.astype(int) - wanted).max(axis=2) > 2).mean() < 1e-3  # rounding at edges of triangles


@pytest.mark.parametrize("points", ["line", "one", "cloud", "back and forth"])
def test_line_of_sight_is_what_all_triangles_say(rng, points):
    """The slab leaves out no triangle that hides something."""
    mesh, eye = soup(rng, 300, size=8.0), np.array([30.0, -300, 20])
    line = np.array([5.0, 0, 0]) + np.linspace(0, 1, 24)[:, None] * [10.0, 60.0, 70.0]
    seen = {"line": line, "one": line[:1], "cloud": rng.uniform(-60, 60, (24, 3)), "back and forth": [*line, line[0]]}
    seen = np.array(seen[points])
    way = seen - eye
    far = np.linalg.norm(way, axis=1)
    wanted = all_hits(mesh, eye, way / far[:, None]).min(axis=1) < far - 2.0
    half = len(mesh.faces) // 2  # two bodies, and one far from all sight lines
    bodies = [mesh.triangles[:half], mesh.triangles[half:], mesh.triangles[:5] + 1000.0]
    layer = Layer([Surface(alone(body), (1, 2, 3)) for body in bodies])
    assert np.array_equal(~layer.sees(eye, seen), wanted)
    assert points == "one" or 0 < wanted.sum() < len(wanted)


def test_corner_normals_of_a_ball_point_outward(ball):
    mesh = ball(30.0, (1, 2, 3), 4)
    radii = (mesh.vertices - [1, 2, 3]) / 30.0
    assert np.abs(corner_normals(mesh.vertices, mesh.faces) - radii).max() < 0.01


@pytest.mark.parametrize("grid", [{}, {"theta_deg": (20, 150)}, {"theta_deg": (30, 60), "beta_deg": (90, 180)}])
def test_the_cells_of_a_picture_are_those_of_its_directions(grid):
    """The picture's rows are the nearest grid directions by brute force, and nothing beyond half a step."""
    case = world.make_case()
    found = world.make_candidates(case, step_deg=5.0, **grid)
    view = map_view(case, found)
    rows = MapCells.of(found).picture(view, 61)
    axis = (np.arange(61) + 0.5) / 61 * 2 - 1
    theta, beta = view.angles_at(np.stack(np.meshgrid(axis, -axis), axis=-1))
    assert (
        rows == MapCells.of(found).rows(theta, beta)
    ).mean() > 0.999  # a direction on a border may fall to either side
    turn = np.abs(np.mod(found.beta - beta.ravel()[:, None] + np.pi, 2 * np.pi) - np.pi)
    near = np.abs(found.theta - theta.ravel()[:, None]) <= np.radians(2.5) * (1 + 1e-9)
    near &= (turn <= np.radians(2.5) * (1 + 1e-9)) | (found.theta < 1e-9)
    flat = rows.ravel()
    assert np.array_equal(flat >= 0, near.any(axis=1))
    pole = found.theta[flat] < 1e-9
    assert near[np.flatnonzero(flat >= 0), flat[flat >= 0]][~pole[flat >= 0]].all()


def test_a_pixel_has_the_colour_of_its_cell():
    """No two cells are mixed: whoever shows the raster smaller smooths it."""
    case = world.make_case()
    found = world.make_candidates(case, step_deg=5.0)
    size, view = 120, map_view(case, found)
    raster, rows = map_raster(found, view, size), MapCells.of(found).picture(view, size)
    plain = (rows >= 0) & ~np.append(found.verdict.reason == "unknown_region", False)[rows]
    assert plain.mean() > 0.3
    assert np.array_equal(raster.rgba[plain], np.c_[row_colours(found), np.full(len(found), 255)][rows[plain]])
