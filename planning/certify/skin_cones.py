"""The skin as seen from a target, and bounds for all rays of a cone: of depth, angle and the number of crossings.

docs/concepts/certificate.md derives each bound; `puncture_twin.planning.certify.checker` has the lemmas in plain form.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.certify.cells import Lists, Zones, zones

EDGE_ON = 1e-10
"""A triangle whose solid angle's determinant is below this, relative to its corners' lengths, is seen edge-on."""
RAYS, SEED = 5, 11
"""Directions that vote on parity, always the same: a regular direction hits the edges of surfaces made on a grid."""


@dataclass(frozen=True, eq=False)
class SkinSurface:
    """The m triangles of a skin, from the target."""

    corners: Floats  # shape (m, 3, 3), mm from the target
    normals: Floats
    """Shape (m, 3, 3), unit normal at each corner: what `puncture_twin.planning.anatomy.skin` blends."""
    fold: Bools
    """Shape (m, 3), whether the number of crossings may change where a ray passes the edge from corner i to i + 1: it
    is not shared by exactly two triangles that lie on its two sides as seen from the target."""
    cut: Bools  # shape (m,), triangles that are not skin
    zones: Zones  # the directions that hit each triangle
    odd: bool
    """Whether a ray crosses the surface an odd number of times; True for an open one, where it means nothing."""


def skin_surface(skin: Skin, target_ct: Floats) -> SkinSurface:
    """Prepare a skin for one target."""
    corners = np.ascontiguousarray(skin.mesh.triangles - target_ct)
    mesh, rays = skin.mesh, np.random.default_rng(SEED).normal(size=(RAYS, 3))
    # one of some random rays may hit an edge: what most of them say counts
    odd = not mesh.closed or 2 * sum(bool(_crosses_odd(corners, ray)) for ray in rays) > RAYS
    normals = skin.normals
    if normals is None:
        normals = np.zeros((len(mesh.vertices), 3))  # weighted by area
        _add_normals(mesh.vertices, mesh.faces, normals)
    faces = welded(mesh.vertices)[mesh.faces]
    fold = np.empty(faces.shape, bool)
    _mark_folds(faces, _side(corners), len(mesh.vertices), fold)
    return SkinSurface(corners, normals[mesh.faces], fold, skin.cut_faces, zones(corners, 0.0), odd)


@nb.njit(cache=True)
def _add_normals(vertices, faces, normals):  # type: ignore[no-untyped-def]  # numba infers
    for i in range(len(faces)):
        a, b, c = vertices[faces[i, 0]], vertices[faces[i, 1]], vertices[faces[i, 2]]
        px, py, pz, qx, qy, qz = b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]
        for k in range(3):
            normals[faces[i, k], 0] += py * qz - pz * qy
            normals[faces[i, k], 1] += pz * qx - px * qz
            normals[faces[i, k], 2] += px * qy - py * qx
    for i in range(len(normals)):
        length = np.sqrt(normals[i, 0] ** 2 + normals[i, 1] ** 2 + normals[i, 2] ** 2)
        if length > 0.0:
            for k in range(3):
                normals[i, k] /= length


def welded(vertices: Floats) -> NDArray[np.int64]:
    """Number of the place of each vertex, shape (n,): vertices at one place share it."""
    order = np.lexsort((vertices + 0.0).T)
    new = (np.diff(vertices[order], axis=0) != 0).any(axis=1)
    place = np.empty(len(vertices), np.int64)
    place[order] = np.concatenate([[0], np.cumsum(new)])
    return place


@nb.njit(cache=True)
def _mark_folds(faces, side, places, fold):  # type: ignore[no-untyped-def]  # numba infers
    """Each edge is looked for among those that leave the lower of its two ends."""
    start = np.zeros(places + 1, np.int64)
    for i in range(len(faces)):
        for k in range(3):
            start[min(faces[i, k], faces[i, (k + 1) % 3]) + 1] += 1
    start = np.cumsum(start)
    filled, edge = start[:-1].copy(), np.empty(3 * len(faces), np.int64)
    for i in range(len(faces)):
        for k in range(3):
            low = min(faces[i, k], faces[i, (k + 1) % 3])
            edge[filled[low]] = 3 * i + k
            filled[low] += 1
    for i in range(len(faces)):
        a, b, c = faces[i, 0], faces[i, 1], faces[i, 2]
        proper = a != b and b != c and c != a
        for k in range(3):
            p, q = faces[i, k], faces[i, (k + 1) % 3]
            low, high = min(p, q), max(p, q)
            count, balance, seen = 0, 0, 0
            for j in range(start[low], start[low + 1]):
                face, corner = edge[j] // 3, edge[j] % 3
                after = corner + 1 if corner < 2 else 0
                r, s = faces[face, corner], faces[face, after]
                other = faces[face, 3 - corner - after]
                if max(r, s) == high and r != s and s != other and other != r:
                    count += 1
                    balance += side[face] if r < s else -side[face]
                    seen += abs(side[face])
            fold[i, k] = proper and not (count == 2 and balance == 0 and seen == 2)


@nb.njit(cache=True)
def _side(corners):  # type: ignore[no-untyped-def]  # numba infers
    """Whether a triangle's corners turn to the left (1) or right (-1) as seen from the origin; 0 edge-on; (m,)."""
    side = np.zeros(len(corners), np.int64)
    for i in range(len(corners)):
        a, b, c = corners[i, 0], corners[i, 1], corners[i, 2]
        determinant = _dot(a, _cross(b, c))
        scale = np.sqrt(_dot(a, a) * _dot(b, b) * _dot(c, c))
        if abs(determinant) > EDGE_ON * scale:
            side[i] = 1 if determinant > 0.0 else -1
    return side


@nb.njit(cache=True)
def _crosses_odd(corners, ray):  # type: ignore[no-untyped-def]  # numba infers
    """Parity of one ray's crossings; where it hits an edge, the edge's triangles are missed."""
    odd = False
    for i in range(len(corners)):
        a, b, c = corners[i, 0], corners[i, 1], corners[i, 2]
        wa, wb, wc = _dot(ray, _cross(b, c)), _dot(ray, _cross(c, a)), _dot(ray, _cross(a, b))
        if (wa > 0.0 and wb > 0.0 and wc > 0.0) or (wa < 0.0 and wb < 0.0 and wc < 0.0):
            ahead = 0.0
            for k in range(3):
                ahead += (wa * a[k] + wb * b[k] + wc * c[k]) * ray[k]
            odd ^= ahead * (wa + wb + wc) > 0.0
    return odd


CONE_PAD_RAD = 3e-7
"""Widens every cone: the search turns a ray that hits an edge by 1e-7, and angles round to 1e-8."""
LENGTH_PAD_MM = 1e-5
"""Widens every depth: rounding at a metre is 1e-10, and crossings within 1e-6 mm are one."""
SIDE_ROUNDING = 1e-11
"""A test ray whose edge function is below this, relative to the edge's ends, may pass on either side."""


@dataclass(frozen=True, eq=False)
class SkinBounds:
    """Bounds that are true of every ray of n cells; mm and rad."""

    count: NDArray[np.int64]
    """Shape (n,), crossings within the needle's length, the same for all rays; -1 where that is not proven."""
    cut: NDArray[np.bool_]
    """Shape (n,), whether a triangle that is not skin may be hit within the needle's length."""
    least_skin: Floats
    """Shape (n,), no skin is hit at a smaller depth; inf where none is hit within the range."""
    farthest: Floats  # shape (n,), no crossing within the needle's length is deeper
    least_angle: Floats
    """Shape (n,), a bound, as ``largest_angle``, of the angle to the normal at every skin crossing that is no deeper
    than the longest path."""
    largest_angle: Floats


def skin_bounds(
    surface: SkinSurface, lists: Lists, centres: Floats, radius: Floats, rays: Floats, *, length: float, longest: float
) -> SkinBounds:
    """Bound the skin's crossings over cones of unit centres (n, 3) and radii (n,), less than π/2.

    A ray (n, 3) inside each cell is tested. ``length`` is the needle's, tip to flange, the longest path no longer; mm.
    """
    n = len(centres)
    bounds = SkinBounds(
        np.full(n, -1), np.zeros(n, bool), np.full(n, np.inf), np.zeros(n), np.full(n, np.pi / 2), np.zeros(n)
    )
    zone = surface.zones
    skin = surface.corners, surface.normals, surface.fold, surface.cut, zone.nearest, zone.farthest
    cones = np.ascontiguousarray(centres), radius + CONE_PAD_RAD, np.ascontiguousarray(rays)
    _bound(*skin, lists.start, lists.items, *cones, length, longest, tuple(vars(bounds).values()))
    return bounds


@nb.njit(cache=True)
def _bound(  # type: ignore[no-untyped-def]  # numba infers
    corners, normals, fold, cut, nearest, farthest, start, items, centres, radius, test_rays, length, longest, out
):
    count, has_cut, least_skin, deepest, least_angle, largest_angle = out
    for i in range(len(centres)):
        u, ray, rho = _vector(centres, i), _vector(test_rays, i), radius[i]
        crossings, folded = 0, False
        for k in range(start[i], start[i + 1]):
            t = items[k]
            a, b, c = _vector(corners[t], 0), _vector(corners[t], 1), _vector(corners[t], 2)
            near, far = _depths(a, b, c, u, rho, nearest[t], farthest[t])
            if near > length:
                continue
            da, db, dc = _edge_angle(a, b, u), _edge_angle(b, c, u), _edge_angle(c, a, u)
            if min(da, db, dc) > rho and _pierced(a, b, c, u) != 1:
                continue
            folded |= far >= length
            folded |= (fold[t, 0] and da <= rho) or (fold[t, 1] and db <= rho) or (fold[t, 2] and dc <= rho)
            pierced = _pierced(a, b, c, ray)
            folded |= pierced < 0
            crossings += pierced
            deepest[i] = max(deepest[i], far)
            if cut[t]:
                has_cut[i] = True
            else:
                least_skin[i] = min(least_skin[i], near)
                if near <= longest:
                    low, high = _angles(a, b, c, normals[t], u, rho)
                    least_angle[i] = min(least_angle[i], low)
                    largest_angle[i] = max(largest_angle[i], high)
        count[i] = -1 if folded else crossings


@nb.njit(cache=True)
def _depths(a, b, c, u, rho, nearest, farthest):  # type: ignore[no-untyped-def]  # numba infers
    """Least and largest depth at which a ray of the cone may hit the triangle."""
    normal = _cross(_minus(b, a), _minus(c, a))
    area = np.sqrt(_dot(normal, normal))
    if area <= 1e-12 * farthest * farthest:
        return nearest - LENGTH_PAD_MM, farthest + LENGTH_PAD_MM
    height = _dot(normal, a) / area
    cosine = _dot(normal, u) / area
    if height < 0.0:
        height, cosine = -height, -cosine
    angle = np.arccos(min(1.0, max(-1.0, cosine)))
    near, far = nearest, farthest
    if angle - rho < np.pi / 2:
        near = max(near, height / np.cos(max(0.0, angle - rho)))
    if angle + rho < np.pi / 2 - 1e-3:
        far = min(far, height / np.cos(angle + rho))
    return near - LENGTH_PAD_MM, far + LENGTH_PAD_MM


@nb.njit(cache=True)
def _edge_angle(p, q, u):  # type: ignore[no-untyped-def]  # numba infers
    """Angle between u and the nearest direction of the segment p-q, or less."""
    np_, nq = np.sqrt(_dot(p, p)), np.sqrt(_dot(q, q))
    if np_ == 0.0 or nq == 0.0:
        return 0.0
    to_ends = min(_angle(_times(p, 1 / np_), u), _angle(_times(q, 1 / nq), u))
    normal = _cross(p, q)
    area = np.sqrt(_dot(normal, normal))
    if area <= 1e-9 * np_ * nq:  # seen end-on: both ends lie in one direction, or opposite ones
        return 0.0 if _dot(p, q) < 0.0 else to_ends - 1e-8
    if _dot(_cross(normal, p), u) >= 0.0 and _dot(_cross(q, normal), u) >= 0.0:
        return min(to_ends, np.arcsin(min(1.0, abs(_dot(normal, u)) / area)))
    return to_ends


@nb.njit(cache=True)
def _angle(a, b):  # type: ignore[no-untyped-def]  # numba infers
    d = _minus(a, b)
    return 2 * np.arcsin(min(1.0, 0.5 * np.sqrt(_dot(d, d))))


@nb.njit(cache=True)
def _pierced(a, b, c, u):  # type: ignore[no-untyped-def]  # numba infers
    """1 where the ray along u crosses the triangle, 0 where it does not, -1 where rounding might decide."""
    la, lb, lc = np.sqrt(_dot(a, a)), np.sqrt(_dot(b, b)), np.sqrt(_dot(c, c))
    wa, wb, wc = _dot(u, _cross(b, c)), _dot(u, _cross(c, a)), _dot(u, _cross(a, b))
    ea, eb, ec = SIDE_ROUNDING * lb * lc, SIDE_ROUNDING * lc * la, SIDE_ROUNDING * la * lb
    left = wa > ea or wb > eb or wc > ec
    right = wa < -ea or wb < -eb or wc < -ec
    if left and right:
        return 0
    ahead = wa * _dot(a, u) + wb * _dot(b, u) + wc * _dot(c, u)
    if abs(wa) <= ea or abs(wb) <= eb or abs(wc) <= ec:
        return -1
    return 1 if (ahead > 0.0) == left else 0


@nb.njit(cache=True)
def _angles(a, b, c, normals, u, rho):  # type: ignore[no-untyped-def]  # numba infers
    """Bounds of the angle, folded to 0..π/2, between a ray of the cone and the normal that is blended where it crosses.

    Along a ray v the blended normal is parallel to M v, with M the sum of normal_i (p_j x p_k)^T.
    """
    ea, eb, ec = _cross(b, c), _cross(c, a), _cross(a, b)
    ra, rb, rc = _vector(normals, 0), _vector(normals, 1), _vector(normals, 2)
    middle = _sum(_times(ra, _dot(ea, u)), _times(rb, _dot(eb, u)), _times(rc, _dot(ec, u)))
    size = np.sqrt(_dot(middle, middle))
    total = (
        _dot(ra, ra) * _dot(ea, ea)
        + _dot(rb, rb) * _dot(eb, eb)
        + _dot(rc, rc) * _dot(ec, ec)
        + 2 * (_dot(ra, rb) * _dot(ea, eb) + _dot(rb, rc) * _dot(eb, ec) + _dot(rc, ra) * _dot(ec, ea))
    )
    if size <= 1e-12 * np.sqrt(_dot(ea, ea) + _dot(eb, eb) + _dot(ec, ec)):
        return 0.0, np.pi / 2
    q = _times(middle, 1 / size)
    along = _sum(_times(ea, _dot(ra, q)), _times(eb, _dot(rb, q)), _times(ec, _dot(rc, q)))
    aside = np.sqrt(max(0.0, total - _dot(along, along))) + 1e-7 * np.sqrt(_dot(ea, ea) + _dot(eb, eb) + _dot(ec, ec))
    chord = 2 * np.sin(rho / 2)
    rest = size - np.sqrt(_dot(along, along)) * chord
    if rest <= 0.0:
        return 0.0, np.pi / 2
    spread = np.arctan2(aside * chord, rest) + rho
    angle = np.arccos(min(1.0, abs(_dot(q, u))))
    return max(0.0, angle - spread), min(np.pi / 2, angle + spread)


@nb.njit(cache=True)
def _vector(rows, i):  # type: ignore[no-untyped-def]  # numba infers
    """A row as three numbers: arrays this small cost more to make than to use."""
    return rows[i, 0], rows[i, 1], rows[i, 2]


@nb.njit(cache=True)
def _cross(a, b):  # type: ignore[no-untyped-def]  # numba infers
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@nb.njit(cache=True)
def _dot(a, b):  # type: ignore[no-untyped-def]  # numba infers
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@nb.njit(cache=True)
def _minus(a, b):  # type: ignore[no-untyped-def]  # numba infers
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@nb.njit(cache=True)
def _times(a, factor):  # type: ignore[no-untyped-def]  # numba infers
    return a[0] * factor, a[1] * factor, a[2] * factor


@nb.njit(cache=True)
def _sum(a, b, c):  # type: ignore[no-untyped-def]  # numba infers
    return a[0] + b[0] + c[0], a[1] + b[1] + c[1], a[2] + b[2] + c[2]
