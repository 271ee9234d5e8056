"""Which voxels lie inside a surface."""

from pathlib import Path

import numpy as np
import pytest
import scipy

from puncture_twin.planning.formats.labels.labelmaps import frame, framed_surface, mask_surface
from puncture_twin.planning.geometry.parts import mark_inside, voxels_inside

WHERE = Path("made")
T_CT_INDEX = np.array([[0.8, 0.0, 0.0, -31.0], [0.0, 1.1, 0.0, 12.0], [0.0, 0.0, 2.5, -7.0], [0.0, 0.0, 0.0, 1.0]])


@pytest.fixture
def blobs(rng):
    smooth = scipy.ndimage.gaussian_filter(rng.normal(size=(30, 26, 22)), 2.0)
    return smooth > np.quantile(smooth, 0.8)


def test_the_voxels_inside_a_masks_surface_are_the_mask(blobs):
    """What is found in the surface's box is all that there is; in a part of the grid it is that part."""
    mesh = mask_surface(blobs, T_CT_INDEX, where=WHERE)
    assert np.array_equal(voxels_inside(mesh, T_CT_INDEX, blobs.shape), blobs)
    T = T_CT_INDEX.copy()
    T[:3, 3] += T[:3, :3] @ [9, 4, 3]
    assert np.array_equal(voxels_inside(mesh, T, (12, 11, 10)), blobs[9:21, 4:15, 3:13])
    T[:3, 3] += T[:3, :3] @ [100, 0, 0]
    assert not voxels_inside(mesh, T, (12, 11, 10)).any()


def test_what_is_marked_stays_beside_what_was(blobs, rng):
    mask = rng.random(blobs.shape) < 0.1
    before = mask.copy()
    mark_inside(mask_surface(blobs, T_CT_INDEX, where=WHERE), T_CT_INDEX, mask)
    assert np.array_equal(mask, before | blobs)


def test_a_masks_surface_is_that_of_its_field(blobs):
    blobs[:5], blobs[:, :, -4:] = False, False
    boxed = mask_surface(blobs, T_CT_INDEX, where=WHERE)
    framed, field = frame(blobs.shape)
    framed[:], field[:] = np.nan, blobs - 0.5  # the frame is written, whatever it held
    assert boxed.digest == framed_surface(framed, T_CT_INDEX, where=WHERE).digest
    assert np.array_equal(framed, np.pad(blobs - 0.5, 1, constant_values=-0.5))
