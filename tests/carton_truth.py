"""The carton of Chen 2019 as exact signed fields: what its meshes are held against."""

import numpy as np

from tools.phantoms.carton import BOX_HIGH_MM, BOX_LOW_MM, LESIONS_CT_MM

BOLT_RADIUS_MM = 4.0


def carton_field(name):
    """Signed distance to the true (round) structure, of points_ct (n, 3), mm; negative inside."""
    if name == "skin":
        low, high = np.array(BOX_LOW_MM), np.array(BOX_HIGH_MM)
        return lambda points: _corner_distance(np.maximum(low - points, points - high))
    x, y, top = LESIONS_CT_MM[name.removeprefix("bolt_").upper()]

    def field(points):
        beside = np.hypot(points[:, 0] - x, points[:, 1] - y) - BOLT_RADIUS_MM
        return _corner_distance(np.stack([beside, np.maximum(-points[:, 2], points[:, 2] - top)], axis=1))

    return field


def _corner_distance(beyond):
    """Signed distance from how far a point is beyond each pair of faces, shape (n, k)."""
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
