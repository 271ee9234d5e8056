"""The planes of slices of a needle's path or an image, and their cuts of surfaces, needle and tip region."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.entry import ANATOMICAL_LPS
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.report.map_view import body_directions

LEFT, BACK, HEAD = (np.array(ANATOMICAL_LPS[name]) for name in ("left", "posterior", "head"))
ALONG_LEFT = 0.95  # a needle within 18 degrees of the left-right axis: its plane rises to the front instead
LEAST_HALF_MM, BESIDE_MM, PROBE_HALF_MM = 60.0, 35.0, 40.0
"""Half a picture's side at least, what it shows beyond target and entry, and half of the probe's-eye view."""
OBLIQUE = 0.38  # a direction within 22 degrees of an axis is named by that axis alone
LETTERS = {"patient's left": "L", "patient's right": "R", "back": "P", "front": "A", "head": "H", "feet": "F"}
CAPSULE_POINTS, ELLIPSE_POINTS = 181, 121  # on each of a capsule's two sides; about an ellipse


@dataclass(frozen=True, eq=False)
class Plane:
    """The plane of one square picture."""

    name: str
    at_ct: Floats  # shape (3,), a point of the plane, the target
    right: Floats  # shape (3,), unit, CT frame: what lies to the right in the picture
    up: Floats  # shape (3,), unit
    centre: Floats  # shape (2,), the picture's middle from the target, mm to the right and up
    half_mm: float

    @cached_property
    def normal(self) -> Floats:
        """Toward the viewer, unit, shape (3,)."""
        return np.cross(self.right, self.up)

    def place(self, points_ct: Floats) -> Floats:
        """Shadows of points (..., 3) on the plane: mm to the right and up of the target, shape (..., 2)."""
        return np.asarray((points_ct - self.at_ct) @ np.stack([self.right, self.up], axis=1))

    def points_ct(self, size: int) -> Floats:
        """The middles of the pixels of a picture, row after row from its top, shape (size * size, 3)."""
        steps = ((np.arange(size) + 0.5) / size * 2 - 1) * self.half_mm
        x, y = self.centre[0] + steps, self.centre[1] - steps
        points = np.empty((size, size, 3))
        for k in range(3):  # one by one: numpy is three times slower along rows of three
            points[:, :, k] = self.at_ct[k] + (x * self.right[k] + (y * self.up[k])[:, None])
        return points.reshape(-1, 3)


def needle_planes(target_ct: Floats, outward_ct: Floats, path_mm: float) -> tuple[Plane, ...]:
    """The axial slice of the target, two planes that hold the needle, and the one across it at the target.

    In the first two the patient's right is on the left, as on every axial CT; the third shows the back to the right;
    the last is what one sees who looks along the needle from outside. The target, (3,), LPS mm; unit vector (3,) to the
    entry; how far that is, not finite without one.
    """
    far = path_mm if np.isfinite(path_mm) else 0.0
    entry = target_ct + far * outward_ct
    half = max(LEAST_HALF_MM, far / 2 + BESIDE_MM)

    def plane(name: str, right: Floats, up: Floats, half_mm: float = half) -> Plane:
        centre = np.array([right @ (entry - target_ct), up @ (entry - target_ct)]) / 2
        return Plane(name, target_ct, right, up, centre, half_mm)

    side, up, across = _oblique_axes(outward_ct)
    top = HEAD if abs(outward_ct @ HEAD) < ALONG_LEFT else -BACK  # of who looks along the needle: head, or else front
    top = _unit(top - (top @ outward_ct) * outward_ct)
    along = outward_ct if outward_ct @ BACK > 0 else -outward_ct
    return (
        plane("axial, through the target", LEFT, -BACK),
        plane(f"along the needle, {_tilt_deg(side, up):.0f}° from axial", side, up),
        plane(f"along the needle, {_tilt_deg(along, across):.0f}° from axial", along, across),
        plane("across the needle at the target", np.cross(-outward_ct, top), top, PROBE_HALF_MM),
    )


def body_planes(target_ct: Floats, bounds_ct: Floats) -> tuple[Plane, ...]:
    """The axial, coronal and sagittal plane through the target, as wide as the body, shape (2, 3), and some more.

    The patient's right is on the left; the sagittal one shows the back to the right.
    """
    half, middle = float(np.ptp(bounds_ct, axis=0).max()) / 2 + BESIDE_MM, bounds_ct.mean(axis=0) - target_ct
    axes = (("axial", LEFT, -BACK), ("coronal", LEFT, HEAD), ("sagittal", BACK, HEAD))
    return tuple(
        Plane(f"{name}, through the target", target_ct, right, up, np.array([right @ middle, up @ middle]), half)
        for name, right, up in axes
    )


def _oblique_axes(outward_ct: Floats) -> tuple[Floats, Floats, Floats]:
    """Right and up of the plane that holds the needle and the left-right axis, and its normal, toward the head."""
    if abs(outward_ct @ LEFT) < ALONG_LEFT:
        side, up = LEFT, _unit(outward_ct - (outward_ct @ LEFT) * LEFT)
        up = up if up @ (HEAD - 1.2 * BACK) > 0 else -up
    else:
        side = outward_ct if outward_ct @ LEFT > 0 else -outward_ct
        up = _unit(-BACK - (-BACK @ side) * side)
    normal = np.cross(side, up)
    return side, up, normal if normal @ (HEAD - 0.8 * BACK) > 0 else -normal


def _tilt_deg(right: Floats, up: Floats) -> float:
    return float(np.degrees(np.arccos(min(1.0, abs(np.cross(right, up) @ HEAD)))))


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector))


def letters(space: str, direction: Floats) -> str:
    """Letters of a direction (3,), unit: R, L, A, P, H, F, two of them where it is oblique; axes of a local frame."""
    return " ".join(LETTERS.get(name, name) for name in _named(space, direction))


def toward_text(space: str, direction: Floats) -> str:
    """A direction (3,) in words, such as "toward the feet" or "to the patient's left and toward the back"."""
    side = {"patient's left": "to the patient's left", "patient's right": "to the patient's right"}
    along = {name: f"toward the {name}" for name in ("back", "front", "head", "feet")}
    return " and ".join((side | along).get(name, f"along {name}") for name in _named(space, direction))


def _named(space: str, direction: Floats) -> list[str]:
    directions = sorted(body_directions(space).items(), key=lambda item: -float(item[1] @ direction))
    return [name for name, vector in directions[:2] if vector @ direction > OBLIQUE]


def outline(mesh: TriangleMesh, plane: Plane) -> Floats:
    """The cut of a surface, shape (n, 2, 2): segments, mm from the target; none where its box is out of the picture."""
    low, high = mesh.bounds
    middle, half = (low + high) / 2, (high - low) / 2
    axes = np.stack([plane.right, plane.up, plane.normal])
    shown, reach = np.array([*plane.centre, 0.0]), np.array([plane.half_mm, plane.half_mm, 0.0])
    if not np.all(np.abs(axes @ (middle - plane.at_ct) - shown) <= np.abs(axes) @ half + reach):
        return np.zeros((0, 2, 2))
    return plane.place(_cut(mesh, plane))


def _cut(mesh: TriangleMesh, plane: Plane) -> Floats:
    """Segments in which a plane cuts a mesh's triangles, shape (n, 2, 3), mm, in the order of the triangles."""
    height = (mesh.vertices - plane.at_ct) @ plane.normal
    above = height[mesh.faces] > 0  # a corner in the plane counts as below: each triangle is cut in no edge or in two
    count = above.sum(axis=1)
    rows = np.flatnonzero((count == 1) | (count == 2))
    alone = np.argmax(above[rows] == (count[rows] == 1)[:, None], axis=1)  # the corner that is alone on its side
    tip = mesh.faces[rows, alone][:, None]
    others = mesh.faces[rows[:, None], (alone[:, None] + (1, 2)) % 3]
    along = (height[tip] / (height[tip] - height[others]))[..., None]
    return np.asarray(mesh.vertices[tip] * (1 - along) + mesh.vertices[others] * along)


def capsule(outward_ct: Floats, length_mm: float, radius_mm: float, plane: Plane) -> Floats:
    """The cut of all within a radius of a piece of the needle's axis, a closed line (2 k, 2), mm.

    With a along the axis' shadow in the plane and b across it, the axis' nearest point to (a, b) is s = a sin(phi),
    kept within 0..length; phi is the angle between axis and normal, and b^2 = radius^2 - (a^2 - 2 a s sin(phi) + s^2).
    The piece begins at the target and goes along the needle, unit, (3,); the line is mm right and up of the target.
    """
    shadow = np.array([outward_ct @ plane.right, outward_ct @ plane.up])
    sine, cosine = min(1.0, float(np.linalg.norm(shadow))), abs(float(outward_ct @ plane.normal))
    along = shadow / sine if sine > 0 else np.array([1.0, 0.0])
    if radius_mm * sine <= length_mm * cosine:  # the plane leaves the piece through its side
        far = radius_mm / cosine
    else:
        far = length_mm * sine + np.sqrt(max(0.0, radius_mm**2 - (length_mm * cosine) ** 2))
    turns = np.linspace(0.0, np.pi, CAPSULE_POINTS)
    a = (far - radius_mm) / 2 - (far + radius_mm) / 2 * np.cos(turns)
    s = np.clip(a * sine, 0.0, length_mm)
    b = np.sqrt(np.maximum(0.0, radius_mm**2 - (a**2 - 2 * a * s * sine + s**2)))
    a, b = np.concatenate([a, a[::-1]]), np.concatenate([b, -b[::-1]])
    return np.asarray(a[:, None] * along + b[:, None] * np.array([-along[1], along[0]]))


def ellipse(region_ct: Floats, plane: Plane) -> Floats:
    """The cut of the ellipsoid x' inv(region) x = 1 about the target, a closed line of shape (k, 2), mm."""
    basis = np.stack([plane.right, plane.up])
    inverse = basis @ np.linalg.pinv(region_ct, hermitian=True) @ basis.T
    values, vectors = np.linalg.eigh(inverse)
    turns = np.linspace(0.0, 2 * np.pi, ELLIPSE_POINTS)
    half = 1.0 / np.sqrt(np.maximum(values, np.finfo(float).tiny))
    return np.asarray((vectors @ (half[:, None] * np.stack([np.cos(turns), np.sin(turns)]))).T)
