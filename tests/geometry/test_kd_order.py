"""Points in the order of a k-d tree: each split as the definition has it, whatever the points, equal ones too."""

import numpy as np
import pytest

from puncture_twin.planning.geometry.kd_order import kd_order

CLOUDS = {
    "a box": lambda rng, n: rng.uniform(0, 1, (n, 3)),
    "far from the origin": lambda rng, n: rng.normal(1000.0, 1.0, (n, 3)),
    "a plane's raster": lambda rng, n: np.column_stack([rng.integers(0, 5, n), rng.integers(0, 40, n), np.zeros(n)]),
    "two places": lambda rng, n: rng.integers(0, 2, (n, 1)) * np.ones(3),
    "one place": lambda rng, n: np.zeros((n, 3)),
    "sorted": lambda rng, n: np.sort(rng.uniform(0, 1, (n, 3)), axis=0),
    "sorted downwards": lambda rng, n: -np.sort(rng.uniform(0, 1, (n, 3)), axis=0),
    "nearly all in one place": lambda rng, n: (rng.uniform(0, 1, (n, 1)) > 0.99) * rng.uniform(0, 1, (n, 3)),
}


def refuse_unsplit(points, leaf):
    """Fail unless every range lies, across its longest side, in order about its left-balanced middle."""
    if len(points) <= leaf:
        return
    left = leaf
    while 2 * left < len(points):
        left *= 2
    along = points[:, np.argmax(np.ptp(points, axis=0))]
    assert along[:left].max() <= along[left:].min()
    refuse_unsplit(points[:left], leaf)
    refuse_unsplit(points[left:], leaf)


@pytest.mark.parametrize("cloud", CLOUDS.values(), ids=CLOUDS)
@pytest.mark.parametrize("count", [0, 1, 17, 1025])
@pytest.mark.parametrize("leaf", [1, 16])
def test_every_split_is_in_order(cloud, count, leaf, rng):
    """Every point appears once, and each range is split at its middle across its longest side."""
    points = cloud(rng, count).astype(np.float32)
    order = kd_order(points, leaf)
    np.testing.assert_array_equal(np.sort(order), np.arange(count))
    refuse_unsplit(points[order], leaf)


def test_what_is_no_number_ends_too(rng):
    """Callers refuse it; who did not would get some order, and not wait for ever."""
    points = rng.uniform(0, 1, (3000, 3))
    points[rng.uniform(0, 1, points.shape) < 0.3] = np.nan
    for cloud in (points, np.full((100, 3), np.nan), np.full((100, 3), np.inf)):
        np.testing.assert_array_equal(np.sort(kd_order(cloud, 16)), np.arange(len(cloud)))
