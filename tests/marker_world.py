"""A body in a scanner with markers on its skin, and everything in and about it that is none."""

import numpy as np

from benchmarks import markers as drawn
from benchmarks.markers import Markers, body_of, scanned
from puncture_twin.planning.registration.fiducials import Stated, look_for_fiducials
from puncture_twin.twin.plant.scanner.image import Solid, ball


def places(markers, rng):
    found = []
    for number in range(markers.count):
        theta = -np.pi * (0.08 + 0.84 * number / max(1, markers.count - 1)) + rng.uniform(-0.1, 0.1)
        z = (-1) ** number * rng.uniform(15.0, 42.0)
        point, normal = drawn.on_skin(theta, z)
        half = markers.diameter / 2 if markers.kind == "ball" else markers.thick / 2
        found.append((point + (half + markers.off_mm) * normal, normal))
    points, normals = zip(*found, strict=True)
    return np.array(points), np.array(normals)


def distractors(rng):
    """Ribs, clips, a calcification under the skin, a wire on it, a needle, a table with bolts, metal inside."""
    point, normal = drawn.on_skin(-0.9, 2.0)
    calcification = Solid("calcification", ball(point - 5.0 * normal, 4.0), 700.0)
    return [*drawn.ribs(), *drawn.clips(rng), calcification, *drawn.wire(rng), next(drawn.needle(rng))]


def scene(markers, rng, *, others=True):
    points, normals = places(markers, rng)
    pairs = zip(points, normals, strict=True)
    meshes = (drawn.marker_mesh(markers.kind, *pair, markers.diameter, markers.thick) for pair in pairs)
    on = [Solid("marker", mesh, markers.hu) for mesh in meshes]
    return points, [*(drawn.table() if others else []), drawn.body(), *(distractors(rng) if others else []), *on]


def found_in(markers, settings, *, others=True):
    """True centres, and what is found in their scan."""
    rng = np.random.default_rng(settings.seed)
    true, solids = scene(markers, rng, others=others)
    return true, look_for_fiducials(*body_of(scanned(solids, settings, rng)))


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
