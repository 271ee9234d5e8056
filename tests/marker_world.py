"""A body in a scanner with markers on its skin, and everything in and about it that is none."""

from itertools import pairwise

import numpy as np

from benchmarks.markers import Markers, body, body_of, marker_mesh, on_skin, scanned, table
from puncture_twin.planning.registration.fiducials import Stated, find_fiducials, look_for_fiducials
from puncture_twin.twin.plant.scanner.image import Solid, ball, rod


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


def scene(markers, rng, *, others=True):
    """True centres (n, 3) and the solids of a whole scene."""
    points, normals = places(markers, rng)
    on = [
        Solid("marker", marker_mesh(markers.kind, p, n, markers.diameter, markers.thick), markers.hu)
        for p, n in zip(points, normals, strict=True)
    ]
    return points, [*(table() if others else []), body(), *(distractors(rng) if others else []), *on]


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
