"""Rasteriser: the triangle in each sample of a picture: all rays leave one eye, so triangles are drawn, not searched.

A sample (x, y) looks along d = (x, y, 1) in the camera's frame (right, up, forward). The ray meets the plane of the
triangle a, b, c at 1/z = d.((b - a) x (c - a)) / a.(b x c), and lies inside where d.(b x c), d.(c x a) and d.(a x b)
agree in sign. That is linear in x and y, also for triangles that reach behind the eye, and two triangles compute the
same number, but for its sign, at an edge that they share: no sample falls between them. (Olano and Greer, "Triangle
scan conversion using 2D homogeneous coordinates", Graphics Hardware 1997.)

And the colour of what a sample shows: smooth normals, one lamp, and glass-like rims.
"""

# numba infers the types
# mypy: disable-error-code="no-untyped-def"

import numpy as np

from puncture_twin.planning.base.numba_kernels import allocation_free, nb

NEAR = 1.0  # mm before the eye, along the view, from which on an outline is drawn
TIE = 1e-2
"""mm along the view; two bodies nearer to each other than this are one surface, that of the body named first.
Organs that an image cuts off end in one plane with the skin."""

EDGE = 1e-6  # samples by which rounding may shrink an outline
WIDE = 8  # columns from which on it pays to compute where a row enters and leaves a triangle
CREASE = 0.75  # cosine between a triangle's and its corner's normal below which the edge is drawn sharp
AMBIENT, DIFFUSE, SHINE = 0.38, 0.62, 0.18  # weights of Phong's terms; the highlight's exponent is 24
SMOOTH = 0.9  # cosine between the triangles that a pixel's samples show above which they are lit as one surface


@nb.njit(cache=True, nogil=True, error_model="numpy")
def outlines(points, faces, grid):
    """The rows and columns of samples that each triangle may cover: points (n, 3), camera's frame, mm; faces (m, 3).

    The grid is samples per unit of x and y, rows, columns. Shape (k, 5): triangle, first and last row, first and last
    column, of each that may cover any; ascending.
    """
    scale, height, width = grid
    seen = np.empty((len(points), 2))
    for i in range(len(points)):
        if points[i, 2] >= NEAR:
            per_mm = scale / points[i, 2]
            seen[i, 0] = width / 2 - 0.5 + points[i, 0] * per_mm
            seen[i, 1] = height / 2 - 0.5 - points[i, 1] * per_mm
    spans = np.empty((len(faces), 5), dtype=np.int32)
    count = 0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if min(points[a, 2], points[b, 2], points[c, 2]) >= NEAR:
            left, right = min(seen[a, 0], seen[b, 0], seen[c, 0]), max(seen[a, 0], seen[b, 0], seen[c, 0])
            top, bottom = min(seen[a, 1], seen[b, 1], seen[c, 1]), max(seen[a, 1], seen[b, 1], seen[c, 1])
        elif max(points[a, 2], points[b, 2], points[c, 2]) < NEAR:
            continue
        else:
            left, right, top, bottom = _cut_outline(points, faces[f], seen, grid)
        first, last = int(np.ceil(max(top - EDGE, 0.0))), int(np.floor(min(bottom + EDGE, height - 1.0)))
        begin, end = int(np.ceil(max(left - EDGE, 0.0))), int(np.floor(min(right + EDGE, width - 1.0)))
        if first <= last and begin <= end:
            spans[count, 0], spans[count, 1], spans[count, 2] = f, first, last
            spans[count, 3], spans[count, 4] = begin, end
            count += 1
    return spans[:count]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _cut_outline(points, face, seen, grid):
    """The outline of what a triangle that reaches behind the eye has before it."""
    scale, height, width = grid
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    for i in range(3):
        p, q = points[face[i]], points[face[(i + 1) % 3]]
        if p[2] >= NEAR:
            column, row = seen[face[i], 0], seen[face[i], 1]
            left, right, top, bottom = min(left, column), max(right, column), min(top, row), max(bottom, row)
        if (p[2] >= NEAR) != (q[2] >= NEAR):  # the edge passes the plane z = NEAR
            t = (NEAR - p[2]) / (q[2] - p[2])
            column = width / 2 - 0.5 + scale * (p[0] + t * (q[0] - p[0])) / NEAR
            row = height / 2 - 0.5 - scale * (p[1] + t * (q[1] - p[1])) / NEAR
            left, right, top, bottom = min(left, column), max(right, column), min(top, row), max(bottom, row)
    return left, right, top, bottom


@allocation_free(nogil=True, error_model="numpy")
def draw(points, faces, bodies, spans, grid, corner, before, inverse, triangle):
    """Keep in every sample the nearest surface, or the nearest few in order, of those that nothing opaque hides.

    Points are (n, 3), camera's frame, mm; faces (m, 3), and `bodies` (m,) that of each, ascending. The grid is samples
    per unit of x and y, rows, columns of the whole picture; `corner`, row and column of it at which the arrays begin:
    `before` (h, w), 1/z of what is opaque there already, 0 for nothing; and, written to, `inverse` (k, h, w), 1/z of
    the surfaces, nearest first, and `triangle` (k, h, w), their triangles, -1 for none.
    """
    row0, column0 = corner
    rows, columns = inverse.shape[1:]
    for s in range(len(spans)):
        first, last = max(spans[s, 1], row0), min(spans[s, 2], row0 + rows - 1)
        begin, end = max(spans[s, 3], column0), min(spans[s, 4], column0 + columns - 1)
        if first > last or begin > end:
            continue
        f = spans[s, 0]
        facing, p, q, r = _edges(_row(points, faces[f, 0]), _row(points, faces[f, 1]), _row(points, faces[f, 2]))
        if facing != 0.0:
            planes, span = (p, q, r, 1.0 / facing), (first, last, begin, end)
            _draw_one(bodies, f, planes, span, grid, corner, before, inverse, triangle)


@allocation_free(nogil=True, error_model="numpy", forceinline=True)
def _draw_one(bodies, f, planes, span, grid, corner, before, inverse, triangle):
    """Keep triangle f in the samples of its span that it covers: its edges' planes, and what makes them 1/z."""
    p, q, r, per_facing = planes
    first, last, begin, end = span
    scale, height, width = grid
    step, left = 1.0 / scale, (0.5 - width / 2) / scale
    row0, column0 = corner
    pu, qu, ru = p[0] * step, q[0] * step, r[0] * step  # what one column more adds
    for row in range(first, last + 1):
        y = (height / 2 - row - 0.5) * step
        pe, qe, re = _at(p, left, y), _at(q, left, y), _at(r, left, y)
        lo, hi = begin, end
        if end - begin > WIDE:
            lo, hi = _inside(pu, pe, qu, qe, ru, re, begin, end)
        within = False
        for column in range(lo, hi + 1):
            wa, wb, wc = pu * column + pe, qu * column + qe, ru * column + re
            if wa < 0.0 or wb < 0.0 or wc < 0.0:
                if within:  # what a row has inside a triangle is in one piece
                    break
                continue
            within = True
            value = (wa + wb + wc) * per_facing
            i, j = row - row0, column - column0
            slack = TIE * value * value
            if value <= before[i, j] + slack:
                continue
            mine = f
            # Written out: a function that takes arrays costs more here than all that it does.
            for k in range(len(inverse)):
                other, known = triangle[k, i, j], inverse[k, i, j]
                if other < 0:
                    inverse[k, i, j], triangle[k, i, j] = value, mine
                    break
                if abs(value - known) <= slack:
                    first_named = bodies[mine] < bodies[other]
                    if first_named or (bodies[mine] == bodies[other] and value > known):
                        inverse[k, i, j], triangle[k, i, j] = value, mine
                    break
                if value > known:
                    inverse[k, i, j], triangle[k, i, j] = value, mine
                    value, mine = known, other


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _row(points, i):
    return points[i, 0], points[i, 1], points[i, 2]


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _edges(a, b, c):
    """a.(b x c), made positive, and the planes through the eye and the edges opposite a, b, c, with their signs."""
    p, q, r = _cross(b, c), _cross(c, a), _cross(a, b)
    facing = a[0] * p[0] + a[1] * p[1] + a[2] * p[2]
    if facing < 0.0:
        p, q, r = (-p[0], -p[1], -p[2]), (-q[0], -q[1], -q[2]), (-r[0], -r[1], -r[2])
    return abs(facing), p, q, r


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _at(plane, x, y):
    """Component of a ray (x, y, 1) along the normal of a plane through the eye."""
    return plane[0] * x + (plane[1] * y + plane[2])


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _inside(pu, pe, qu, qe, ru, re, begin, end):
    """The columns of a row in which u * column + e >= 0 may hold for all three edges; one more to each side."""
    low, high = float(begin), float(end)
    for u, e in ((pu, pe), (qu, qe), (ru, re)):
        if u > 0.0:
            low = max(low, -e / u - 1.0)
        elif u < 0.0:
            high = min(high, 1.0 - e / u)
        elif e < 0.0:
            return 0, -1
    return (0, -1) if low > high else (int(low), int(high))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def corner_normals(vertices, faces):
    """Area-weighted unit normals at vertices (n, 3) of faces (m, 3), float32; zero where no triangle has an area."""
    sums = np.zeros((len(vertices), 3))
    for f in range(len(faces)):
        x, y, z = _normal(_row(vertices, faces[f, 0]), _row(vertices, faces[f, 1]), _row(vertices, faces[f, 2]))
        for i in range(3):
            sums[faces[f, i], 0] += x
            sums[faces[f, i], 1] += y
            sums[faces[f, i], 2] += z
    normals = np.empty((len(vertices), 3), dtype=np.float32)
    for i in range(len(vertices)):
        x, y, z = sums[i, 0], sums[i, 1], sums[i, 2]
        length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
        normals[i, 0], normals[i, 1], normals[i, 2] = x / length, y / length, z / length
    return normals


@nb.njit(cache=True, nogil=True, error_model="numpy")
def rotated(vectors, turn, shift):
    """Vectors (n, 3) in another frame, ``turn @ (vector - shift)``, of their own precision."""
    out = np.empty_like(vectors)
    for i in range(len(vectors)):
        x, y, z = vectors[i, 0] - shift[0], vectors[i, 1] - shift[1], vectors[i, 2] - shift[2]
        for k in range(3):
            out[i, k] = turn[k, 0] * x + turn[k, 1] * y + turn[k, 2] * z
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def flat_normals(points, faces):
    """Unit normals of the triangles, shape (m, 3), float32; zero where there is no area."""
    normals = np.empty((len(faces), 3), dtype=np.float32)
    for f in range(len(faces)):
        x, y, z = _normal(_row(points, faces[f, 0]), _row(points, faces[f, 1]), _row(points, faces[f, 2]))
        shrink = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-12)
        normals[f, 0], normals[f, 1], normals[f, 2] = x * shrink, y * shrink, z * shrink
    return normals


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def all_alike(triangle, top, bottom, left, right, bodies, flats):
    """Whether the samples of a pixel show one smooth surface, so that one shading serves them all."""
    f = triangle[top, left]
    if f < 0:
        return False
    for i in range(top, bottom):
        for j in range(left, right):
            g = triangle[i, j]
            if g == f:
                continue
            if g < 0 or bodies[g] != bodies[f]:
                return False
            if flats[f, 0] * flats[g, 0] + flats[f, 1] * flats[g, 1] + flats[f, 2] * flats[g, 2] < SMOOTH:
                return False
    return True


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _normal(a, b, c):
    """(b - a) x (c - a)."""
    return _cross((b[0] - a[0], b[1] - a[1], b[2] - a[2]), (c[0] - a[0], c[1] - a[1], c[2] - a[2]))


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _triple(x, y, b, c):
    """(x, y, 1).(b x c)."""
    p = _cross(b, c)
    return x * p[0] + y * p[1] + p[2]


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def lit(points, normals, flats, faces, f, x, y, light):
    """Factor on the body's colour, grey of the highlight, |cos| between normal and ray.

    Phong's lighting (Commun. ACM 18, 1975) by one lamp beside the camera, with half Lambert: what faces away from the
    lamp keeps some shape instead of going flat.
    """
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    a, b, c = _row(points, i), _row(points, j), _row(points, k)
    p, q, r = _row(normals, i), _row(normals, j), _row(normals, k)
    wa, wb, wc = _triple(x, y, b, c), _triple(x, y, c, a), _triple(x, y, a, b)
    sx, sy, sz = wa * p[0] + wb * q[0] + wc * r[0], wa * p[1] + wb * q[1] + wc * r[1], wa * p[2] + wb * q[2] + wc * r[2]
    shrink = 1.0 / max(np.sqrt(sx * sx + sy * sy + sz * sz), 1e-12)
    sx, sy, sz = sx * shrink, sy * shrink, sz * shrink
    fx, fy, fz = _row(flats, f)
    cosine = sx * fx + sy * fy + sz * fz
    if abs(cosine) <= CREASE:
        sx, sy, sz = fx, fy, fz
    elif cosine < 0.0:
        sx, sy, sz = -sx, -sy, -sz
    if fx * x + fy * y + fz > 0.0:  # seen from behind
        sx, sy, sz = -sx, -sy, -sz
    along = 1.0 / np.sqrt(1 + x * x + y * y)
    facing = -(sx * x + sy * y + sz) * along
    toward = sx * light[0] + sy * light[1] + sz * light[2]
    half = 0.5 + 0.5 * toward
    mirrored = 2 * toward * facing + (light[0] * x + light[1] * y + light[2]) * along
    glint = min(max(mirrored, 0.0), 1.0)
    glint = glint * glint * glint
    glint = glint * glint
    glint = glint * glint
    glint = glint * glint
    return AMBIENT + DIFFUSE * half * half, 255 * SHINE * glint, min(max(facing, 0.0), 1.0)
