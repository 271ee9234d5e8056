"""Small scenes that are hard on a distance engine: one surface, a target, directions and a needle length, by kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from puncture_twin.planning.formats.guard import guard_mesh
from puncture_twin.planning.geometry.mesh import TriangleMesh

Floats = NDArray[np.float64]
Surface = tuple[Floats, NDArray[np.int64]]

LENGTHS_MM = (1.0, 40.0, 150.0, 210.0)
FAR_MM = 1e4


@dataclass(frozen=True, eq=False)
class HostileScene:
    """One surface as the guard lets it pass, and needles that start at a target; mm.

    Attributes:
        outward: Shape (n, 3), unit vectors.
    """

    kind: str
    mesh: TriangleMesh
    target: Floats
    outward: Floats
    length: float


def make_scene(kind: str, rng: np.random.Generator, directions: int) -> HostileScene:
    """A random scene of one of `KINDS`."""
    vertices, faces = KINDS[kind](rng)
    if kind not in ALONG_AXES and rng.random() < 0.7:
        vertices = vertices @ Rotation.random(random_state=rng).as_matrix().T
    if kind == "far":
        vertices = vertices + FAR_MM * _units(rng, 1)
    mesh = guard_mesh(vertices, faces, where=kind)
    size = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    target = _target(kind, mesh, size, rng)
    length = float(rng.choice(LENGTHS_MM)) if kind != "huge" else float(rng.choice([210.0, 2000.0]))
    if kind == "swallowed":
        length = 0.5 * length
    return HostileScene(
        kind, mesh, target, _directions(mesh, target, directions, rng, along=kind in ALONG_AXES), length
    )


def _units(rng: np.random.Generator, count: int) -> Floats:
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _target(kind: str, mesh: TriangleMesh, size: float, rng: np.random.Generator) -> Floats:
    """On a corner, on an edge, in a face, in a face's plane, amid, near or away from the surface."""
    a, b, c = mesh.triangles[rng.integers(len(mesh.faces))]
    share = rng.uniform()
    low, high = mesh.bounds
    places = [a, share * a + (1 - share) * b, (a + b + c) / 3, 4 * a - 2 * b - c, mesh.vertices.mean(axis=0)]
    beside = mesh.bounds.mean(axis=0) + rng.uniform(0.4, 0.8) * size * _units(rng, 1)[0]
    places += [rng.uniform(low, high), beside, high + 0.2 * size * _units(rng, 1)[0]]
    weights = np.array([1.0, 1, 1, 3, 2, 2, 6, 6])
    if kind in ("swallowed", "nested", "flipped"):
        weights = np.array([0.0, 0, 0, 1, 6, 4, 4, 1])
    if kind == "in plane":
        weights = np.array([0.0, 0, 1, 8, 1, 1, 1, 0])
    return np.array(places[int(rng.choice(len(places), p=weights / weights.sum()))])


def _directions(mesh: TriangleMesh, target: Floats, count: int, rng: np.random.Generator, *, along: bool) -> Floats:
    """All over, toward corners, edges and faces exactly, past them closely, along the axes."""
    u = _units(rng, count)
    kinds = rng.integers(0, 6, count)
    corners = mesh.triangles[rng.integers(len(mesh.faces), size=count)]
    share = rng.dirichlet([1.0, 1.0, 1.0], count)
    share[kinds == 0] = [1.0, 0.0, 0.0]
    share[kinds == 1, 2] = 0.0
    share /= share.sum(axis=1, keepdims=True)
    at = np.einsum("ni,nij->nj", share, corners) - target
    far = np.linalg.norm(at, axis=1)
    aimed = (kinds < 4) & (far > 1e-6)
    u[aimed] = at[aimed] / far[aimed, None]
    aside = aimed & (kinds == 3)
    u[aside] += 0.1 * _units(rng, int(aside.sum()))
    if along:
        axes = np.concatenate([np.eye(3), -np.eye(3), [[0.6, 0.8, 0.0], [0.0, -0.6, 0.8]]])
        u[kinds >= 4] = axes[rng.integers(len(axes), size=int((kinds >= 4).sum()))]
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def _ball(rng: np.random.Generator, radius: float | None = None, fine: int | None = None) -> Surface:
    ball = trimesh.creation.icosphere(
        subdivisions=int(rng.choice(4, p=[0.2, 0.35, 0.35, 0.1])) if fine is None else fine, radius=1.0
    )
    vertices = np.asarray(ball.vertices) * rng.uniform(0.8, 1.2, (len(ball.vertices), 1))
    return (rng.uniform(5, 60) if radius is None else radius) * vertices, np.asarray(ball.faces)


def _soup(rng: np.random.Generator) -> Surface:
    count = int(rng.integers(20, 300))
    corners = rng.normal(0, 40, (count, 1, 3)) + rng.normal(0, rng.choice([1.0, 8.0, 40.0]), (count, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def _slivers(rng: np.random.Generator) -> Surface:
    """As thin as 1e-9 of their length, or without any area; one whole triangle, as the guard demands."""
    count = int(rng.integers(20, 200))
    a, d = rng.normal(0, 40, (count, 3)), rng.normal(0, 20, (count, 3))
    thin = 10.0 ** rng.uniform(-9, -1, (count, 1)) * rng.normal(0, 20, (count, 3))
    kinds = np.arange(count)[:, None] % 4
    b = np.where(kinds == 3, a, a + d)
    c = np.where(kinds == 0, a + rng.uniform(-1, 2, (count, 1)) * d, a + rng.uniform(0, 1, (count, 1)) * d + thin)
    corners = np.stack([a, b, c], axis=1)
    corners[0] = rng.normal(0, 30, (3, 3))
    return corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def _join(*parts: Surface) -> Surface:
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    faces = [faces + offset for (_, faces), offset in zip(parts, offsets, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def _duplicates(rng: np.random.Generator) -> Surface:
    """A closed surface, some triangles of which are given again, either way round, and some without area."""
    vertices, faces = _ball(rng)
    again = faces[rng.integers(len(faces), size=int(rng.integers(1, len(faces))))]
    again = np.where(rng.random((len(again), 1)) < 0.5, again, again[:, ::-1])
    flat = np.stack([faces[:5, 0], faces[:5, 1], faces[:5, 1]], axis=1)
    return vertices, np.concatenate([faces, again, flat])


def _flipped(rng: np.random.Generator) -> Surface:
    """A closed surface, a random part of which is wound the other way."""
    vertices, faces = _ball(rng)
    flip = rng.random((len(faces), 1)) < rng.choice([0.1, 0.5, 1.0])
    return vertices, np.where(flip, faces[:, ::-1], faces)


def _nested(rng: np.random.Generator) -> Surface:
    """Two or three shells, wound alike or against each other."""
    parts = [_ball(rng, radius) for radius in (60.0, 35.0, 15.0)[: int(rng.integers(2, 4))]]
    return _join(*((v, f if rng.random() < 0.5 else f[:, ::-1]) for v, f in parts))


def _swallowed(rng: np.random.Generator) -> Surface:
    """Large enough that a needle in its middle never meets it."""
    return _ball(rng, float(rng.uniform(150, 600)))


def _boxes(rng: np.random.Generator) -> Surface:
    """Boxes along the axes: every target in the plane of some face."""
    boxes = [trimesh.creation.box(rng.choice([4.0, 20.0, 60.0], 3)) for _ in range(int(rng.integers(1, 5)))]
    for box in boxes:
        box.apply_translation(rng.integers(-8, 9, 3) * 5.0)
    return _join(*((np.asarray(box.vertices), np.asarray(box.faces)) for box in boxes))


def _voxels(rng: np.random.Generator) -> Surface:
    """The faces of random voxels: every edge and plane along an axis, edges of four triangles."""
    filled = np.pad(rng.random((4, 4, 4)) < 0.4, 1)
    vertices, faces = [], []
    for axis in range(3):
        p, q = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        for corner in np.argwhere(filled != np.roll(filled, 1, axis=axis)):
            first = len(vertices)
            vertices += [corner, corner + p, corner + p + q, corner + q]
            faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    return (float(rng.choice([1.0, 4.0, 10.0])) * np.array(vertices, float), np.array(faces)) if faces else _boxes(rng)


def _tiny(rng: np.random.Generator) -> Surface:
    return _ball(rng, float(rng.uniform(0.4, 1.0)), fine=int(rng.integers(0, 4)))


def _huge(rng: np.random.Generator) -> Surface:
    return _ball(rng, float(rng.uniform(800, 1200)))


def _sheets(rng: np.random.Generator) -> Surface:
    """One thin plate, or two wavy layers 1e-3 to 1 mm apart."""
    gap = float(10.0 ** rng.uniform(-3, 0))
    if rng.random() < 0.4:
        plate = trimesh.creation.box([60.0, 80.0, gap])
        return np.asarray(plate.vertices), np.asarray(plate.faces)
    layer = _wavy(rng, int(rng.integers(4, 12)), waves=0.0 if rng.random() < 0.3 else 4.0)
    return _join(layer, (layer[0] + [0.0, 0.0, gap], layer[1]))


def _wavy(rng: np.random.Generator, n: int, waves: float = 4.0) -> Surface:
    x, y = np.meshgrid(np.linspace(-60, 60, n), np.linspace(-60, 60, n), indexing="ij")
    z = 20.0 + waves * np.sin(x / rng.uniform(8, 20)) * np.cos(y / rng.uniform(8, 20))
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + n, i + 1], 1), np.stack([i + 1, i + n, i + n + 1], 1)])
    return np.stack([x, y, z], axis=-1).reshape(-1, 3), faces


def _open(rng: np.random.Generator) -> Surface:
    """A ball with holes."""
    vertices, faces = _ball(rng)
    keep = rng.random(len(faces)) < rng.choice([0.5, 0.9])
    keep[0] = True
    return vertices, faces[keep]


def _thousands(rng: np.random.Generator) -> Surface:
    """A wavy sheet or a dented ball of one to four thousand triangles."""
    return _wavy(rng, int(rng.integers(25, 45))) if rng.random() < 0.7 else _ball(rng, 50.0, fine=4)


KINDS: MappingProxyType[str, Callable[[np.random.Generator], Surface]] = MappingProxyType(
    {
        "dented ball": _ball,
        "soup": _soup,
        "slivers": _slivers,
        "duplicates": _duplicates,
        "flipped": _flipped,
        "nested": _nested,
        "swallowed": _swallowed,
        "in plane": _boxes,
        "voxels": _voxels,
        "tiny": _tiny,
        "huge": _huge,
        "sheets": _sheets,
        "open": _open,
        "far": _ball,
        "thousands": _thousands,
    }
)
"""Makers of surfaces, by kind; a proof takes them in turn."""

ALONG_AXES = frozenset({"in plane", "voxels"})
"""Kinds that are not rotated, and whose directions run along axes too."""
