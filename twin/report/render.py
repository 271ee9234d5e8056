"""Pictures without a screen: rays cast into triangle meshes with Embree, shaded with numpy.

Opaque surfaces give one hit per ray; veils (skin, corridor) are surfaces that one sees through, with up to
``MAX_SHELLS`` hits per ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh as EmbreeMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from planning.mesh import TriangleMesh
from twin.report.camera import Camera
from twin.report.compositing import NOWHERE, SAMPLES_AT_ONCE, PixelBox, Shot, Veil, empty_veil
from twin.report.palette import Rgb

Floats32 = NDArray[np.float32]

MAX_SHELLS = 4
"""Layers of a veil that are drawn: skin in, skin out, twice."""

SHELL_GAP = 1e-2
"""mm behind a hit where the next layer's search starts; single precision at 2 m is 1e-4 mm."""

SIGHT_SLACK_MM = 2.0
"""A point this close behind a surface still counts as seen: points on the needle lie inside its bar."""

CREASE = 0.75
"""Cosine between a triangle's and its corner's normal below which the edge is drawn sharp."""

BACKGROUND = np.array([246.0, 247.0, 249.0], dtype=np.float32)

AMBIENT, DIFFUSE, SHINE, SHARPNESS = 0.38, 0.62, 0.18, 24
"""Weights of Phong's terms; the highlight's exponent."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh with its look.

    Attributes:
        mesh: In the frame of the layer it belongs to, mm.
        colour: RGB, 0..255.
        alpha: Opacity where one looks straight at it; only veils use it.
        rim: How much more opaque a veil is where one sees it edge-on.
    """

    mesh: TriangleMesh
    colour: Rgb
    alpha: float = 1.0
    rim: float = 2.5


class Layer:
    """Surfaces that move together, ready to be hit by rays in their own frame.

    Args:
        surfaces: The surfaces, in one frame.
    """

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        self._scene = EmbreeScene()
        meshes = [s.mesh for s in surfaces]
        for mesh in meshes:
            EmbreeMesh(self._scene, mesh.vertices.astype(np.float32), mesh.faces)
        self._first = np.cumsum([0, *(len(m.faces) for m in meshes)])
        corner_shift = np.cumsum([0, *(len(m.vertices) for m in meshes)])
        self._faces = np.concatenate([m.faces + k for m, k in zip(meshes, corner_shift, strict=False)])
        self._normals = np.concatenate([corner_normals(m) for m in meshes])
        self._colours = np.array([s.colour for s in surfaces], dtype=np.float32)
        self._alphas = np.array([s.alpha for s in surfaces], dtype=np.float32)
        self._rims = np.array([s.rim for s in surfaces], dtype=np.float32)
        self.vertices = np.concatenate([m.vertices for m in meshes])

    def cast(self, origins: Floats32, rays: Floats32, light: Floats32) -> tuple[Shot, Floats32]:
        """First hits: lit colours and depths as flat arrays (n, 3), (n,), and each hit's opacity (n,).

        Args:
            origins: Shape (n, 3), in this layer's frame.
            rays: Shape (n, 3), unit.
            light: Shape (3,), unit, toward the light.
        """
        hits = self._scene.run(origins, rays, output=True)
        struck = np.flatnonzero(hits["geomID"] >= 0)
        colour = np.zeros((len(rays), 3), dtype=np.float32)
        depth = np.full(len(rays), np.inf, dtype=np.float32)
        alpha = np.zeros(len(rays), dtype=np.float32)
        body = hits["geomID"][struck]
        normals = self._hit_normals(hits, struck, rays)
        lit, facing = _phong(self._colours[body], normals, rays[struck], light)
        colour[struck], depth[struck] = lit, hits["tfar"][struck]
        # A shell seen edge-on is thicker along the ray: glass-like outlines help to read the body's shape.
        alpha[struck] = np.minimum(1.0, self._alphas[body] * (1.0 + self._rims[body] * (1.0 - facing) ** 3))
        return Shot(colour, depth), alpha

    def sees(self, eye: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether nothing of this layer lies between an eye and each point (n, 3), in the layer's frame."""
        way = points - eye
        far = np.linalg.norm(way, axis=1)
        rays = np.asarray(way / far[:, None], dtype=np.float32)
        hits = self._scene.run(_origins(eye, len(rays)), rays, output=True)
        return np.asarray((hits["geomID"] < 0) | (hits["tfar"] > far - SIGHT_SLACK_MM))

    def _hit_normals(self, hits: dict[str, NDArray[np.float32]], struck: NDArray[np.int64], rays: Floats32) -> Floats32:
        flat = hits["Ng"][struck]
        flat = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
        corners = self._normals[self._faces[self._first[hits["geomID"][struck]] + hits["primID"][struck]]]
        u, v = hits["u"][struck, None], hits["v"][struck, None]
        smooth = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
        cosine = np.einsum("ij,ij->i", smooth, flat)
        smooth = np.where((np.abs(cosine) > CREASE)[:, None], smooth * np.sign(cosine)[:, None], flat)
        away = np.einsum("ij,ij->i", flat, rays[struck]) > 0
        return np.asarray(np.where(away[:, None], -smooth, smooth), dtype=np.float32)


def corner_normals(mesh: TriangleMesh) -> Floats32:
    """Area-weighted unit normals at the vertices, shape (n, 3)."""
    a, b, c = (mesh.triangles[:, k] for k in range(3))
    faces = np.cross(b - a, c - a)
    normals = np.stack(
        [
            np.bincount(mesh.faces.ravel(), weights=np.repeat(faces[:, k], 3), minlength=len(mesh.vertices))
            for k in range(3)
        ],
        axis=1,
    )
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12), dtype=np.float32)


def _phong(colours: Floats32, normals: Floats32, rays: Floats32, light: Floats32) -> tuple[Floats32, Floats32]:
    """Phong's lighting (Commun. ACM 18, 1975) by one lamp beside the camera; also |cos| between normal and ray."""
    facing = -np.einsum("ij,ij->i", normals, rays)
    toward = normals @ light
    # Half Lambert: what faces away from the lamp keeps some shape instead of going flat.
    diffuse = (0.5 + 0.5 * toward) ** 2
    mirrored = 2 * toward[:, None] * normals - light
    highlight = np.clip(-np.einsum("ij,ij->i", mirrored, rays), 0, 1) ** SHARPNESS
    lit = colours * (AMBIENT + DIFFUSE * diffuse)[:, None] + 255 * SHINE * highlight[:, None]
    return np.minimum(lit, 255.0), np.clip(facing, 0, 1)


def light_of(camera: Camera) -> Floats32:
    """The lamp: over the viewer's left shoulder."""
    light = np.array([-0.45, 0.6, -1.0]) @ camera.axes
    return np.asarray(light / np.linalg.norm(light), dtype=np.float32)


def opaque_shot(layer: Layer, camera: Camera) -> Shot:
    """Everything opaque of one layer in the CT frame, at the camera's own resolution."""
    size = camera.height, camera.width
    shot = Shot(np.empty((*size, 3), dtype=np.float32), np.empty(size, dtype=np.float32))
    for rows in _bands(camera):
        rays = _rays(camera, rows)
        flat, _ = layer.cast(_origins(camera.eye, len(rays)), rays, light_of(camera))
        colour = np.where(np.isfinite(flat.depth)[:, None], flat.colour, BACKGROUND)
        shot.colour[rows], shot.depth[rows] = colour.reshape(-1, size[1], 3), flat.depth.reshape(-1, size[1])
    return shot


def veils_of(layer: Layer, camera: Camera) -> tuple[Veil, ...]:
    """The shells of a see-through layer: the nearest hit of every ray first, then the one behind it, and so on."""
    veils = tuple(empty_veil((camera.height, camera.width)) for _ in range(MAX_SHELLS))
    for rows in _bands(camera):
        parts = [Veil(veil.colour[rows], veil.alpha[rows], veil.depth[rows]) for veil in veils]
        _fill_shells(layer, _rays(camera, rows), camera, parts)
    return tuple(veil for veil in veils if np.isfinite(veil.depth).any())


def _fill_shells(layer: Layer, rays: Floats32, camera: Camera, veils: Sequence[Veil]) -> None:
    origins, travelled = _origins(camera.eye, len(rays)), np.zeros(len(rays), dtype=np.float32)
    alive = np.arange(len(rays))
    for veil in veils:
        flat, alpha = layer.cast(origins[alive], rays[alive], light_of(camera))
        struck = np.isfinite(flat.depth)
        if not struck.any():
            return
        alive, step = alive[struck], flat.depth[struck]
        veil.colour.reshape(-1, 3)[alive] = flat.colour[struck]
        veil.alpha.reshape(-1)[alive] = alpha[struck]
        veil.depth.reshape(-1)[alive] = step + travelled[alive]
        step = step + np.float32(SHELL_GAP)
        origins[alive] += step[:, None] * rays[alive]
        travelled[alive] += step


def put_moving(shot: Shot, layer: Layer, T_ct_layer: NDArray[np.float64], camera: Camera) -> PixelBox:
    """Draw one more rigid body into a shot, in place; rays are cast only in the box around its outline.

    Args:
        shot: What is there already, at the camera's resolution; its arrays are written to.
        layer: The body, in its own frame.
        T_ct_layer: Its pose, shape (4, 4), mm.
        camera: The camera.

    Returns:
        Where something may have changed.
    """
    R, t = T_ct_layer[:3, :3], T_ct_layer[:3, 3]
    box = _outline_box(camera, layer.vertices @ R.T + t)
    if box.empty:
        return NOWHERE
    rows, columns = (grid.ravel() for grid in np.mgrid[box.y0 : box.y1, box.x0 : box.x1])
    turn = R.astype(np.float32)
    rays = np.ascontiguousarray(camera.directions(rows, columns) @ turn)
    flat, _ = layer.cast(_origins((camera.eye - t) @ R, len(rays)), rays, light_of(camera) @ turn)
    colour, depth = shot.colour[box.slices], shot.depth[box.slices]
    new_depth = flat.depth.reshape(depth.shape)
    nearer = new_depth < depth
    colour[nearer] = flat.colour.reshape(colour.shape)[nearer]
    depth[nearer] = new_depth[nearer]
    return box


def _outline_box(camera: Camera, points_ct: NDArray[np.float64]) -> PixelBox:
    seen = camera.project(points_ct)
    whole = PixelBox(0, 0, camera.width, camera.height)
    if seen[:, 2].max() <= 0:
        return NOWHERE
    if seen[:, 2].min() <= 0:
        return whole
    limits = np.array([camera.width, camera.height])
    low = np.clip(np.floor(seen[:, :2].min(axis=0)) - 1, 0, limits).astype(int)
    high = np.clip(np.ceil(seen[:, :2].max(axis=0)) + 1, 0, limits).astype(int)
    return PixelBox(int(low[0]), int(low[1]), int(high[0]), int(high[1]))


def _bands(camera: Camera) -> list[slice]:
    """The picture's rows, band by band."""
    rows = max(1, SAMPLES_AT_ONCE // camera.width)
    return [slice(top, min(top + rows, camera.height)) for top in range(0, camera.height, rows)]


def _rays(camera: Camera, band: slice) -> Floats32:
    rows, columns = (grid.ravel() for grid in np.mgrid[band, 0 : camera.width])
    return camera.directions(rows, columns)


def _origins(eye: NDArray[np.float64], count: int) -> Floats32:
    return np.tile(np.asarray(eye, dtype=np.float32), (count, 1))
