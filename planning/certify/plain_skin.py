"""The skin over a cone of directions, in plain numpy, for the checker: the lemmas of docs/concepts/certificate.md."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.geometry.mesh import TriangleMesh

CONE_PAD_RAD = 2e-7
"""Twice what the search turns a ray by; less than the certifier's own padding, so that rounding refuses nothing."""
LENGTH_PAD_MM = 5e-6
"""More than the distance at which two crossings are one; less than the certifier's."""
EDGE_ON = 0.9e-10
"""Relative determinant below which a triangle is seen edge-on; less than the certifier's."""


@dataclass(frozen=True, eq=False)
class SkinFacts:
    """Facts of the skin for every ray of a cone; see `puncture_twin.planning.certify.skin_cones.SkinBounds`."""

    count: int
    cut: bool
    least_skin: float
    farthest: float
    least_angle: float
    largest_angle: float


class PlainSkin:
    """A skin seen from one target."""

    def __init__(self, skin: Skin, target_ct: Floats) -> None:
        self.corners = skin.mesh.triangles - target_ct
        self.cut = skin.cut_faces
        self.closed = skin.mesh.closed
        normals = _vertex_normals(skin.mesh) if skin.normals is None else skin.normals
        self._normals = normals[skin.mesh.faces]
        self._folds = _folds(skin.mesh, self.corners)

    def odd(self) -> bool:
        """Whether a ray leaves the body an odd number of times; a closed surface gives all rays the same parity."""
        rays = np.random.default_rng(5).normal(size=(5, 3))
        counts = [int(np.count_nonzero(_pierced(self.corners, ray) == 1)) % 2 for ray in rays]
        return sum(counts) >= 3

    def facts(self, rows: Ints, u: Floats, rho: float, ray: Floats, *, length: float, longest: float) -> SkinFacts:
        """Everything about the triangles ``rows`` over the cone of half-angle ``rho`` about ``u``, mm and rad.

        Among them are all that the cone intersects; ``ray`` (3,) is a direction inside the cell.
        """
        rho = rho + CONE_PAD_RAD
        near, far = _depths(self.corners[rows], u, rho)
        edges = np.stack([_edge_angle(self.corners[rows, i], self.corners[rows, (i + 1) % 3], u) for i in range(3)])
        hit = ((edges.min(axis=0) <= rho) | (_pierced(self.corners[rows], u) == 1)) & (near <= length)
        rows, near, far, edges = rows[hit], near[hit], far[hit], edges[:, hit]
        pierced = _pierced(self.corners[rows], ray)
        touched = np.less_equal(edges, rho).T  # which edges the cone intersects
        changes = (far >= length) | (self._folds[rows] & touched).any(axis=1) | (pierced < 0)
        bare = ~self.cut[rows]
        entry = bare & (near <= longest)
        low, high = self._angles(rows[entry], u, rho)
        return SkinFacts(
            count=-1 if changes.any() else int(pierced.sum()),
            cut=bool((~bare).any()),
            least_skin=float(near[bare].min(initial=np.inf)),
            farthest=float(far.max(initial=0.0)),
            least_angle=float(low.min(initial=np.pi / 2)),
            largest_angle=float(high.max(initial=0.0)),
        )

    def _angles(self, rows: Ints, u: Floats, rho: float) -> tuple[Floats, Floats]:
        """Bounds of the angle between a ray and the blended normal, which along a ray v is parallel to M v."""
        a, b, c = np.moveaxis(self.corners[rows], 1, 0)
        opposite = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
        matrix = np.einsum("nci,ncj->nij", self._normals[rows], opposite)
        middle = matrix @ u
        size = np.linalg.norm(middle, axis=1)
        q = middle / np.where(size > 0, size, 1.0)[:, None]  # unit normal along the cone's axis
        along = np.einsum("ni,nij->nj", q, matrix)
        aside = np.linalg.norm(matrix - q[:, :, None] * along[:, None, :], axis=(1, 2))
        chord = 2 * np.sin(rho / 2)
        rest = size - np.linalg.norm(along, axis=1) * chord  # M v along q is at least this
        spread = np.where(rest > 0, np.arctan2(aside * chord, np.maximum(rest, 0)) + rho, np.pi)
        angle = np.arccos(np.clip(np.abs(q @ u), 0, 1))
        return np.maximum(angle - spread, 0.0), np.minimum(angle + spread, np.pi / 2)


def _vertex_normals(mesh: TriangleMesh) -> Floats:
    a, b, c = np.moveaxis(mesh.triangles, 1, 0)
    total = np.zeros_like(mesh.vertices)
    for corner in range(3):
        np.add.at(total, mesh.faces[:, corner], np.cross(b - a, c - a))
    lengths = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(lengths > 0, lengths, 1.0)


def _folds(mesh: TriangleMesh, corners: Floats) -> Bools:
    names: dict[tuple[float, ...], int] = {}
    welded = np.array([names.setdefault(tuple(v), len(names)) for v in (mesh.vertices + 0.0).tolist()])
    a, b, c = np.moveaxis(corners, 1, 0)
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    sign = np.where(np.abs(volume) > EDGE_ON * np.prod(np.linalg.norm(corners, axis=2), axis=1), np.sign(volume), 0)
    sides: dict[tuple[int, int], list[float]] = defaultdict(list)
    faces = welded[mesh.faces].tolist()
    for face, s in zip(faces, sign.tolist(), strict=True):
        if len(set(face)) == 3:
            for p, q in zip(face, face[1:] + face[:1], strict=True):
                sides[min(p, q), max(p, q)].append(s if p < q else -s)  # seen from one end to the other
    regular = {edge for edge, directions in sides.items() if sorted(directions) == [-1, 1]}
    return np.array(
        [
            [len(set(f)) == 3 and (min(p, q), max(p, q)) not in regular for p, q in zip(f, f[1:] + f[:1], strict=True)]
            for f in faces
        ]
    ).reshape(-1, 3)


def _depths(corners: Floats, u: Floats, rho: float) -> tuple[Floats, Floats]:
    """Least and largest depth at which rays of the cone can hit each triangle: by its plane, and by its corners."""
    farthest = np.linalg.norm(corners, axis=2).max(axis=1)
    centre = corners.mean(axis=1)
    nearest = np.linalg.norm(centre, axis=1) - np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    flat = area > 1e-12 * farthest**2  # a triangle without area has no plane
    normal = normal / np.where(flat, area, 1.0)[:, None]
    height = np.einsum("ij,ij->i", normal, corners[:, 0])
    angle = np.arccos(np.clip(np.where(height < 0, -1, 1) * (normal @ u), -1, 1))
    height = np.abs(height)
    steep = np.maximum(angle - rho, 0.0)  # the ray of the cone that is most square to the plane
    near = np.where(flat & (steep < np.pi / 2), height / np.maximum(np.cos(steep), 1e-12), 0.0)
    shallow = angle + rho
    far = np.where(flat & (shallow < np.pi / 2 - 1e-3), height / np.maximum(np.cos(shallow), 1e-4), np.inf)
    return np.maximum(near, nearest) - LENGTH_PAD_MM, np.minimum(far, farthest) + LENGTH_PAD_MM


def _edge_angle(p: Floats, q: Floats, u: Floats) -> Floats:
    """Angle between u and the arc of directions p to q, shape (n,)."""
    lp, lq = np.linalg.norm(p, axis=1), np.linalg.norm(q, axis=1)
    if min(lp.min(initial=1), lq.min(initial=1)) == 0:
        return np.zeros(len(p))
    ends = np.minimum(_to(p / lp[:, None], u), _to(q / lq[:, None], u))
    normal = np.cross(p, q)
    area = np.linalg.norm(normal, axis=1)
    arc = area > 1e-9 * lp * lq  # else the two ends are one direction, or opposite ones
    between = arc & (np.cross(normal, p) @ u >= 0) & (np.cross(q, normal) @ u >= 0)
    aside = np.arcsin(np.minimum(np.abs(normal @ u) / np.where(arc, area, 1.0), 1.0))
    opposite = ~arc & (np.einsum("ij,ij->i", p, q) < 0)
    return np.where(opposite, 0.0, np.where(between, np.minimum(aside, ends), ends))


def _to(directions: Floats, u: Floats) -> Floats:
    return 2 * np.arcsin(np.minimum(np.linalg.norm(directions - u, axis=1) / 2, 1.0))  # exact near 0


def _pierced(corners: Floats, ray: Floats) -> Ints:
    """1 where the ray crosses the triangle, 0 where not, -1 where rounding might decide, shape (n,)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    weights = np.stack([np.cross(b, c) @ ray, np.cross(c, a) @ ray, np.cross(a, b) @ ray], axis=1)
    lengths = np.linalg.norm(corners, axis=2)
    rounding = 1e-11 * np.roll(lengths, -1, axis=1) * np.roll(lengths, -2, axis=1)
    left, right = (weights > rounding).any(axis=1), (weights < -rounding).any(axis=1)
    ahead = np.einsum("nc,nci,i->n", weights, corners, ray)
    crossed = np.where((ahead > 0) == left, 1, 0)
    crossed[(np.abs(weights) <= rounding).any(axis=1)] = -1
    crossed[left & right] = 0
    return crossed
