"""Connected pieces of metal are those that labelling the whole image gives."""

import numpy as np
import pytest
from scipy import ndimage

from puncture_twin.planning.anatomy.metal import connected


@pytest.mark.parametrize("density", [0.0, 0.02, 0.08, 0.3, 1.0])
@pytest.mark.parametrize("order", ["C", "F"])
def test_pieces_are_those_of_a_labelled_image(density, order):
    """Diagonal neighbours included, none over a border; in the order of their first voxels."""
    mask = np.asarray(np.random.default_rng(5).random((9, 14, 11)) < density, order=order)
    labels, count = ndimage.label(mask, structure=np.ones((3, 3, 3)))
    expected = [np.argwhere(labels == number).tolist() for number in range(1, count + 1)]
    assert [piece.tolist() for piece in connected(mask)] == sorted(expected)
