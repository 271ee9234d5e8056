"""What is true of a needle in a scene, by voxels and their distances: numpy and scipy, nothing of the product.

A scene is masks on a grid of its own, which for drawn bodies is larger than the image and holds what the image lacks.
Points are sampled every millimetre; a distance is interpolated between voxels' centres, negative inside.

*Free beyond doubt*: the skin is crossed once, the path is shorter than the shaft by a voxel's diagonal, its angle to
the skin stays 10 degrees below the limit, and from target to flange needle and holder keep radius + margin + diagonal.
*Wrong*, of a direction called safe: the needle comes nearer than radius + margin - diagonal to a structure, deeper than
the diagonal into what lies beside the body, or into the body again, or runs in the body where the image has ended.
*Unseen*: needle or holder passes beyond a face at which the image cuts the body, within the section there drawn on and
grown by 150 mm; or what the scanner did not measure; or beyond the back of an image in which a patient lies on
nothing, or of a real one, where nobody knows the table.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy import ndimage

FAR_MM = 32.0
"""What a distance is where nothing is nearer: the holder's radius, a diagonal of 11 mm and a margin of 5 are less."""
GROWN_MM, CUT_MM2, ANGLE, STEP_MM, LONGEST_MM = 150.0, 300.0, np.radians(10.0), 1.0, 560.0


class Grid(NamedTuple):
    """Voxels along LPS: the first one's centre, the steps, both shape (3,), mm, and how many."""

    low: np.ndarray
    step: np.ndarray
    shape: tuple[int, int, int]

    @classmethod
    def of(cls, low, high, step):
        """From a corner to another, mm."""
        low, step = np.asarray(low, float), np.broadcast_to(np.asarray(step, float), 3)
        return cls(low + step / 2, step, tuple(np.round((np.asarray(high) - low) / step).astype(int).tolist()))

    @property
    def ends(self):
        """The two corners, shape (2, 3)."""
        return np.stack([self.low - self.step / 2, self.low + (np.array(self.shape) - 0.5) * self.step])

    def axes(self):
        """Coordinates that broadcast over the grid."""
        return np.meshgrid(*(a + s * np.arange(n) for a, s, n in zip(*self, strict=True)), indexing="ij", sparse=True)


@dataclass(frozen=True, eq=False)
class Scene:
    """What is true.

    Attributes:
        foreign: What lies beside it: arms, table, lines.
        limbs: Those of the foreign that are the person's: a face that cuts them cuts the person.
        doubtful: What keeps a direction from being free and makes none wrong: dense and gas that no label names.
        unscanned: What the scanner did not measure.
        real: Nothing is known beyond the image.
        lies_unseen: A patient, whose image does not show for sure what they lie on: what is beyond its back is unseen.
    """

    grid: Grid
    image: Grid
    body: np.ndarray
    foreign: np.ndarray
    structures: dict
    target: np.ndarray
    limbs: np.ndarray | None = None
    doubtful: np.ndarray | None = None
    unscanned: np.ndarray | None = None
    real: bool = False
    lies_unseen: bool = False
    margins: dict = field(default_factory=dict)


class Needle(NamedTuple):
    """As the case states it; `standoff` gives the tip's place before the insertion from path and angle, mm, rad."""

    length: float
    shaft: float
    radius: float
    hub: float
    max_angle: float
    standoff: object


class Truth(NamedTuple):
    """Of n directions: masks, and path and angle at the skin (NaN without one)."""

    free: np.ndarray
    unseen: np.ndarray
    wrong: np.ndarray
    path: np.ndarray
    angle: np.ndarray
    near: np.ndarray
    passes: np.ndarray


def signed(mask, grid, far_mm=FAR_MM):
    """Distances to a mask's border, shape of the grid, mm, no farther than `far_mm`; worked out in its box."""
    found = np.full(grid.shape, far_mm, np.float32)
    if mask is None or not mask.any():
        return found
    grown = np.ceil(far_mm / grid.step).astype(int) + 1
    box = tuple(
        slice(max(0, s.start - g), s.stop + g)
        for s, g in zip(ndimage.find_objects(mask.astype(np.uint8))[0], grown, strict=True)
    )
    some = mask[box]
    inside = ndimage.distance_transform_edt(np.pad(some, 1), sampling=grid.step)[1:-1, 1:-1, 1:-1]
    half = grid.step.min() / 2
    apart = ndimage.distance_transform_edt(~some, sampling=grid.step)
    found[box] = np.minimum(np.where(some, half - inside, apart - half), far_mm)
    return found


def sampled(values, grid, points, outside=FAR_MM):
    """Values between voxels' centres, shape (...)."""
    index = (points - grid.low) / grid.step
    flat = np.moveaxis(index, -1, 0).reshape(3, -1)
    return ndimage.map_coordinates(values, flat, order=1, mode="constant", cval=outside).reshape(index.shape[:-1])


class _Face(NamedTuple):
    """A face of the image that cuts the person: the axis, which way, where, and the section's distances."""

    axis: int
    way: int
    at: float
    section: np.ndarray
    grid: Grid


def cut_faces(scene):
    """The faces of the image at which the person goes on."""
    grid, (low, high) = scene.grid, scene.image.ends
    person = scene.body if scene.limbs is None else scene.body | scene.limbs
    first = np.clip(np.ceil((low - grid.low) / grid.step - 0.01).astype(int), 0, None)
    last = np.clip(np.floor((high - grid.low) / grid.step + 0.01).astype(int), None, np.array(grid.shape) - 1)
    shown = np.zeros_like(person)
    box = tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))
    shown[box] = person[box]
    for axis in range(3):
        for way, index, at in ((-1, first[axis], low[axis]), (1, last[axis], high[axis])):
            section = np.take(shown, index, axis=axis)
            rest = [k for k in range(3) if k != axis]
            if section.sum() * np.prod(grid.step[rest]) < CUT_MM2:
                continue
            pad = np.ceil((GROWN_MM + FAR_MM) / grid.step[rest]).astype(int)
            wide = np.expand_dims(np.pad(section, [(n, n) for n in pad]), axis)
            origin = np.array(grid.low, float)
            origin[rest] -= pad * grid.step[rest]
            origin[axis] = 0.0
            flat = Grid(origin, grid.step, wide.shape)
            yield _Face(axis, way, float(at), _flat(wide, flat, axis), flat)


def _flat(mask, grid, axis):
    rest = [k for k in range(3) if k != axis]
    two = np.squeeze(mask, axis)
    half = grid.step[rest].min() / 2
    apart, inside = (ndimage.distance_transform_edt(one, sampling=grid.step[rest]) for one in (~two, two))
    return np.expand_dims(np.where(two, half - inside, apart - half), axis).astype(np.float32)


class Oracle:
    """Distances of one scene, asked for directions."""

    def __init__(self, scene: Scene, needle: Needle):
        self.scene, self.needle = scene, needle
        self.diagonal = float(np.linalg.norm(scene.image.step))
        grid = scene.grid
        self.body = signed(scene.body, grid, 1e3)
        self.smooth = ndimage.gaussian_filter(self.body, 4.0 / grid.step)
        self.foreign = signed(scene.foreign, grid)
        self.near = np.full(grid.shape, FAR_MM, np.float32)
        for name, mask in scene.structures.items():
            if name in scene.margins:
                np.minimum(self.near, signed(mask, grid) - scene.margins[name], out=self.near)
        self.doubtful = signed(scene.doubtful, grid)
        self.faces = list(cut_faces(scene))

    def __call__(self, outward) -> Truth:
        """For outward directions, shape (n, 3)."""
        parts = [self._some(some) for some in np.array_split(outward, max(1, len(outward) // 150))]
        return Truth(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _some(self, u):
        n, d, grid = self.needle, self.diagonal, self.scene.grid
        s = np.arange(0.0, LONGEST_MM, STEP_MM)
        points = self.scene.target + s[:, None] * u[:, None]
        body = sampled(self.body, grid, points, 1e3)
        path, once = _skin(body, s)
        angle = self._angle(u, path)
        known = np.isfinite(path)
        path0, angle0 = np.where(known, path, 0.0), np.where(known, angle, 0.0)
        flange = np.where(known, n.length + n.standoff(path0, np.minimum(angle0, 1.5)), n.length)
        axis = s <= flange[:, None]
        hub = axis & (s >= n.shaft)
        inserted = s <= n.length
        near, doubtful = (sampled(one, grid, points) for one in (self.near, self.doubtful))
        foreign = sampled(self.foreign, grid, points)
        unseen, beyond = self._unseen(points, hub)
        left = axis & (s > path[:, None])
        keeps = _least(np.minimum(near, doubtful), inserted) >= n.radius + d
        keeps &= _least(foreign, axis) >= n.radius + d
        keeps &= _least(body, axis & (s > (path + 3 * (d + n.radius))[:, None])) >= n.radius + d
        for one in (near, doubtful, foreign, body):
            keeps &= _least(one, hub) >= n.hub + d
        hidden = (unseen & axis).any(axis=1) | ~known
        free = known & once & keeps & (path + d <= n.shaft) & (angle <= n.max_angle - ANGLE) & ~hidden
        least, aside = _least(near, inserted), _least(foreign, axis)
        again = _least(body, left & (s > (path + d)[:, None]))
        blind = _least(np.where(self._outside(points), np.minimum(body, beyond), FAR_MM), axis)
        aside = np.minimum(np.minimum(aside, again), blind)
        wrong = (least < n.radius - d) | (aside < n.radius - d)
        return free, hidden, wrong, path, angle, least, aside

    def _angle(self, u, path):
        """Between each direction and the skin's outward normal, rad."""
        entry = self.scene.target + np.where(np.isfinite(path), path, 0.0)[:, None] * u
        steps = 4.0 * np.eye(3)
        gradient = np.stack(
            [
                sampled(self.smooth, self.scene.grid, entry + e) - sampled(self.smooth, self.scene.grid, entry - e)
                for e in steps
            ],
            axis=1,
        )
        length = np.linalg.norm(gradient, axis=1)
        cosine = np.einsum("ni,ni->n", gradient, u) / np.where(length > 0, length, 1.0)
        return np.where(np.isfinite(path), np.arccos(np.clip(cosine, -1.0, 1.0)), np.nan)

    def _outside(self, points):
        low, high = self.scene.image.ends
        return ~np.all((points >= low) & (points <= high), axis=-1)

    def _unseen(self, points, hub):
        """Whether each sample is unseen; and how far it is from the real body drawn on, mm."""
        radius = np.where(hub, self.needle.hub, self.needle.radius)
        found, beyond = np.zeros(points.shape[:-1], bool), np.full(points.shape[:-1], FAR_MM)
        for face in self.faces:
            ahead = (points[..., face.axis] - face.at) * face.way
            flat = points.copy()
            flat[..., face.axis] = 0.0
            aside = sampled(face.section, face.grid, flat, 1e3)
            found |= (ahead > -radius) & (aside <= GROWN_MM + radius)
            if self.scene.real:
                beyond = np.where(ahead > self.diagonal, np.minimum(beyond, aside), beyond)
        if self.scene.lies_unseen:
            found |= points[..., 1] > self.scene.image.ends[1, 1]
        if self.scene.unscanned is not None:
            off = sampled(self.scene.unscanned.astype(np.float32), self.scene.grid, points, 0.0)
            found |= off > 0
        return found, beyond


def _least(values, where):
    return np.where(where, values, np.inf).min(axis=1)


def _skin(body, s):
    """How far the first way out of the body is, NaN without one, and whether it is the only crossing."""
    inside = body < 0
    out = inside[:, :-1] & ~inside[:, 1:]
    crossings = (inside[:, :-1] != inside[:, 1:]).sum(axis=1)
    rows, at = np.arange(len(body)), out.argmax(axis=1)
    a, b = body[rows, at], body[rows, at + 1]
    path = s[at] + STEP_MM * a / np.where(a == b, 1.0, a - b)
    good = inside[:, 0] & (crossings >= 1)
    return np.where(good, path, np.nan), good & (crossings == 1)


def filled(mesh, grid):
    """A closed surface as a mask: signed crossings of lines along z through the voxels' centres."""
    count = np.zeros((*grid.shape[:2], grid.shape[2] + 1), np.int16)
    corners = (np.asarray(mesh.vertices)[np.asarray(mesh.faces)] - grid.low) / grid.step
    corners[..., :2] += (3.1e-5, 7.7e-5)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    low = np.clip(np.ceil(corners[..., :2].min(axis=1)).astype(int), 0, None)
    high = np.minimum(np.floor(corners[..., :2].max(axis=1)).astype(int), np.array(grid.shape[:2]) - 1)
    for k in np.flatnonzero((high >= low).all(axis=1) & (normals[:, 2] != 0)):
        (a, b, c), normal = corners[k], normals[k]
        x, y = np.mgrid[low[k, 0] : high[k, 0] + 1, low[k, 1] : high[k, 1] + 1]
        x, y = x.ravel(), y.ravel()
        sign = np.sign(normal[2])
        hit = np.ones(len(x), bool)
        for p, q in ((a, b), (b, c), (c, a)):
            hit &= sign * ((q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])) >= 0
        x, y = x[hit], y[hit]
        z = a[2] - ((x - a[0]) * normal[0] + (y - a[1]) * normal[1]) / normal[2]
        count[x, y, np.clip(np.ceil(z), 0, grid.shape[2]).astype(int)] -= int(sign)
    return np.cumsum(count[..., :-1], axis=2) != 0
