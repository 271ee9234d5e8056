"""A body in a scanner with markers on its skin, and everything in and about it that is none."""

from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh

from puncture_twin.planning.anatomy.body.body_mask import ct_image
from puncture_twin.planning.anatomy.skin import skin_of_image
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import frame_about
from puncture_twin.planning.registration.fiducials import Stated, find_fiducials, look_for_fiducials
from puncture_twin.twin.plant.scanner.image import Solid, ball, box, rod, scan_solids

RADII = np.array([52.0, 42.0, 70.0])
"""Half axes of the body, an ellipsoid, mm."""


def on_skin(theta, z):
    """A point of the body's skin (3,), mm, and its outward normal; theta from the left toward the back, rad."""
    wide = np.sqrt(1 - (z / RADII[2]) ** 2)
    point = np.array([wide * np.cos(theta), wide * np.sin(theta), z / RADII[2]]) * RADII
    normal = point / RADII**2
    return point, normal / np.linalg.norm(normal)


def ring(point, normal, diameter, thick):
    """A washer with a hole of 0.4 of its diameter, about a point (3,), mm."""
    mesh = trimesh.creation.annulus(0.2 * diameter, diameter / 2, thick, sections=48)
    R = frame_about(normal)
    return TriangleMesh(np.asarray(mesh.vertices) @ R.T + point, np.asarray(mesh.faces))


def marker_mesh(kind, point, normal, diameter, thick):
    """One marker's surface."""
    if kind == "ball":
        return ball(point, diameter)
    half = thick / 2 * normal
    return rod(point - half, point + half, diameter) if kind == "disc" else ring(point, normal, diameter, thick)


class Markers(NamedTuple):
    """What stands on the skin: ``off_mm`` from a marker's back to the skin."""

    kind: str = "ball"
    diameter: float = 8.0
    hu: float = 8000.0
    thick: float = 2.0
    count: int = 6
    off_mm: float = 0.3


def places(markers, rng):
    """True centres (n, 3) and normals (n, 3): spread about the front and sides."""
    found = []
    for number in range(markers.count):
        theta = -np.pi * (0.08 + 0.84 * number / max(1, markers.count - 1)) + rng.uniform(-0.1, 0.1)
        z = (-1) ** number * rng.uniform(15.0, 42.0)
        point, normal = on_skin(theta, z)
        half = markers.diameter / 2 if markers.kind == "ball" else markers.thick / 2
        found.append((point + (half + markers.off_mm) * normal, normal))
    points, normals = zip(*found, strict=True)
    return np.array(points), np.array(normals)


def distractors(rng):
    """Ribs, clips, a calcification under the skin, a wire on it, a needle, a table with bolts, metal inside."""
    solids = []
    for number in range(5):
        z = -44.0 + 22.0 * number
        bend = [on_skin(theta, z) for theta in np.linspace(0.1, np.pi - 0.1, 9)]
        rib = [point - 9.0 * normal for point, normal in bend]
        solids += [Solid("rib", rod(a, b, 7.0), 600.0) for a, b in pairwise(rib)]
    for _ in range(6):
        at, along = rng.uniform(-20, 20, 3), rng.normal(size=3)
        solids.append(Solid("clip", rod(at, at + 6.0 * along / np.linalg.norm(along), 1.5), 8000.0))
    point, normal = on_skin(-0.9, 2.0)
    solids.append(Solid("calcification", ball(point - 5.0 * normal, 4.0), 700.0))
    wire = [on_skin(theta, 1.0) for theta in np.linspace(-3.0, -1.9, 9)]
    wire = [point + 1.0 * normal for point, normal in wire]
    solids += [Solid("wire", rod(a, b, 1.2), 8000.0) for a, b in pairwise(wire)]
    start, normal = on_skin(-1.2, -1.0)
    solids.append(Solid("needle", rod(start + 40.0 * normal, start - 30.0 * normal, 1.2), 8000.0))
    solids.append(Solid("screw", rod(np.array([0.0, 10.0, -30.0]), np.array([0.0, 10.0, 30.0]), 6.0), 8000.0))
    return solids


def table():
    """A shell about foam under the body, with bolts."""
    at, size = np.array([0.0, RADII[1] + 16.0, 0.0]), np.array([120.0, 20.0, 150.0])
    bolts = [Solid("bolt", ball(at + [x, 4.0, z], 8.0), 8000.0) for x in (-40.0, 40.0) for z in (-40.0, 0.0, 40.0)]
    return [Solid("table", box(at, size), 60.0), Solid("foam", box(at, size - 4.0), -930.0), *bolts]


def scanned(solids, settings, rng, half=(75.0, 72.0, 86.0)):
    """The CT of a scene, its grid anywhere within a voxel."""
    spacing, half = np.array([settings.pixel_mm, settings.pixel_mm, settings.spacing_mm]), np.array(half)
    T = np.diag([*spacing, 1.0])
    T[:3, 3] = -half + rng.uniform(0, 1, 3) * spacing
    shape = tuple(int(n) for n in 2 * half / spacing)
    image = scan_solids(solids, VolumeGrid(shape, T, {}), settings, rng)
    return Volume(image.hu, T, Path("scan"))


def scene(markers, rng, *, others=True):
    """True centres (n, 3) and the solids of a whole scene."""
    mesh = trimesh.creation.icosphere(5, 1.0)
    body = TriangleMesh(np.asarray(mesh.vertices) * RADII, np.asarray(mesh.faces))
    points, normals = places(markers, rng)
    on = [
        Solid("marker", marker_mesh(markers.kind, p, n, markers.diameter, markers.thick), markers.hu)
        for p, n in zip(points, normals, strict=True)
    ]
    return points, [*(table() if others else []), Solid("body", body, 30.0), *(distractors(rng) if others else []), *on]


def body_of(volume):
    """The CT as the finder takes it, and its skin."""
    image = ct_image(volume)
    return Volume(image.hu, image.T_ct_index, volume.path), skin_of_image(image)


def found_in(markers, settings, *, others=True, stated=None):
    """True centres, and what is found in their scan."""
    rng = np.random.default_rng(settings.seed)
    true, solids = scene(markers, rng, others=others)
    volume, skin = body_of(scanned(solids, settings, rng))
    if stated is None:
        return true, look_for_fiducials(volume, skin)
    return true, find_fiducials(volume, skin, stated, where="test")


def matched(true, fiducials):
    """Errors (n, 3) of the markers found, their covariances (n, 3, 3), and how many are false."""
    errors, covs, false = [], [], 0
    for one in fiducials:
        away = one.position_ct - true
        nearest = int(np.argmin(np.linalg.norm(away, axis=1)))
        if np.linalg.norm(away[nearest]) > 4.0:
            false += 1
            continue
        errors.append(away[nearest])
        covs.append(one.reading.cov_ct)
    return np.array(errors).reshape(-1, 3), np.array(covs).reshape(-1, 3, 3), false


__all__ = ["Markers", "Stated", "body_of", "found_in", "matched", "scanned", "scene"]
