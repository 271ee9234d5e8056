"""How far a surface of voxels lies off: what is taken for declared is what labels of a known body err by."""

from pathlib import Path

import numpy as np
import pytest
from uncertainty_world import declared

from puncture_twin.planning.formats.labels.labelmaps import LabelMap, label_mesh

PIXEL_MM, PARTS = 0.8, (np.arange(5) + 0.5) / 5 - 0.5
"""Of a voxel that is averaged over."""


def labelled(radius, slice_mm, rng):
    sizes = np.array([PIXEL_MM, PIXEL_MM, slice_mm])
    count = np.ceil(radius / sizes).astype(int) + 2
    start = -(count + rng.uniform(-0.5, 0.5, 3)) * sizes
    axes = [(start[k] + np.arange(2 * count[k] + 1) * sizes[k])[:, None] + PARTS * sizes[k] for k in range(3)]
    x, y, z = (np.square(axis) for axis in axes)
    filled = sum(
        (x[:, a, None, None] + y[None, :, b, None] + z[None, None, :, c] < radius**2).astype(float)
        for a in (0, 2, 4)
        for b in (0, 2, 4)
        for c in range(5)
    )
    T = np.diag([*sizes, 1.0])
    T[:3, 3] = start
    return label_mesh(LabelMap((filled >= 22.5).astype(np.uint8), T, None, Path("ball")), 1, where="ball"), np.diag(
        sizes
    )


@pytest.mark.parametrize("radius", [8.0, 20.0])
@pytest.mark.parametrize("slice_mm", [1.0, 3.0, 5.0, 10.0])
def test_labels_of_a_ball_lie_off_by_what_is_taken_for_declared(radius, slice_mm, rng):
    """At its ends along the slices and at its sides, rms over places of its middle between voxels; at most thrice."""
    squares = {"ends": [], "sides": []}
    for _ in range(12):
        mesh, voxel_ct = labelled(radius, slice_mm, rng)
        corners = mesh.triangles.reshape(-1, 3, 3)
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        middle = corners.mean(axis=1)
        distance = np.linalg.norm(middle, axis=1)
        leans = np.abs(middle[:, 2] / distance)
        for name, part in (("ends", leans > 0.9), ("sides", leans < 0.3)):
            if part.any():
                squares[name].append(np.average((distance[part] - radius) ** 2, weights=area[part]))
    S = declared().surface_cov_ct(voxel_ct)
    for name, normal in (("ends", [0, 0, 1.0]), ("sides", [1.0, 0, 0])):
        taken, came = np.sqrt(np.array(normal) @ S @ normal), np.sqrt(np.mean(squares[name]))
        assert came <= 1.05 * taken, (name, came, taken)
        assert taken <= 3.0 * came, (name, came, taken)
