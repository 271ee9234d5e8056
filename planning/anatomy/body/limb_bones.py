"""Long bones of limbs that are pressed against the trunk: straight, along the bed, near the skin, lateral to others.

A limb's soft tissue cannot be told from the trunk's where nothing narrows between them. Its bone can: no rib, vertebra
or pelvis is a straight rod along the bed, and none lies lateral to all other bones over a hand's breadth.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.detached_parts import BONE_HU
from puncture_twin.planning.base.arrays import Bools, Floats

LEAST_LENGTH_MM = 60.0
"""Along the bed. A rib runs obliquely and bent; half of an adult's humerus or forearm is longer."""
STRAIGHT_MM = 6.0
"""The middles of a long bone's sections keep within this of a straight line."""
TILT = np.tan(np.radians(35.0))
"""Across the bed per length along it: a limb beside the trunk lies along it, a rib's side descends at 45 degrees."""
WIDTH_MM = (5.0, 40.0)
"""Diameters of circles with the area of a section: a child's ulna, and an adult's humerus at its head."""
DEEPEST_MM = 60.0
"""From the middle of a limb's bone to the air: an adult's upper arm has a radius of 35 to 50 mm."""
ASIDE = 0.5
"""Of the body's half width: nearer to its middle no limb lies, but the spine does."""
LATERAL_FRACTION = 0.8
"""Of the slices in which no other bone of this side lies farther from the body's middle."""


class LimbBone(NamedTuple):
    """A long bone of a limb.

    Attributes:
        slices: Shape (n,), indices along the bed.
        middle: Shape (n, 2), of its sections, voxels.
        radius_mm: From its middle to the nearest air, the largest of all slices.
    """

    slices: NDArray[np.int64]
    middle: Floats
    radius_mm: float


def limb_bones(hu: NDArray[np.float32], body: Bools, spacing_mm: Floats) -> list[LimbBone]:
    """Long bones beside the trunk.

    Args:
        hu: Shape (nx, ny, nz), Hounsfield units, axis 2 along the bed.
        body: Same shape.
        spacing_mm: Shape (3,).
    """
    bone = body & (hu > BONE_HU)
    labels, _ = scipy.ndimage.label(bone, np.ones((3, 3, 3), bool))
    least = LEAST_LENGTH_MM / spacing_mm[2]
    rods = []
    for number, box in enumerate(scipy.ndimage.find_objects(labels), start=1):
        if box[2].stop - box[2].start >= least:
            rods += list(_rods(labels[box] == number, box, spacing_mm))
    return [rod for rod in (_in_body(rod, bone, body, spacing_mm) for rod in rods) if rod is not None]


def _rods(component: Bools, box: tuple[slice, ...], spacing_mm: Floats) -> Iterator[LimbBone]:
    """The component, if it is a straight rod along the bed of a long bone's width."""
    slices = np.flatnonzero(component.any(axis=(0, 1)))
    filled = [scipy.ndimage.binary_fill_holes(component[:, :, k]) for k in slices]
    area = np.array([np.count_nonzero(section) for section in filled]) * spacing_mm[0] * spacing_mm[1]
    width = 2.0 * np.sqrt(np.median(area) / np.pi)
    middle = np.array([scipy.ndimage.center_of_mass(section) for section in filled])
    line = np.polynomial.polynomial.polyfit(slices, middle, 1)
    off_mm = (middle - np.polynomial.polynomial.polyval(slices, line).T) * spacing_mm[:2]
    tilt = float(np.linalg.norm(line[1] * spacing_mm[:2])) / spacing_mm[2]
    straight = np.percentile(np.linalg.norm(off_mm, axis=1), 90) <= STRAIGHT_MM and tilt <= TILT
    if straight and WIDTH_MM[0] <= width <= WIDTH_MM[1]:
        low = np.array([box[0].start, box[1].start])
        yield LimbBone(slices + box[2].start, middle + low, 0.0)


def _in_body(rod: LimbBone, bone: Bools, body: Bools, spacing_mm: Floats) -> LimbBone | None:
    """The rod with its distance from the air, if it lies near the skin and lateral to all other bones."""
    radii, lateral = [], []
    for k, (x, y) in zip(rod.slices, rod.middle, strict=True):
        first, last = np.flatnonzero(body[:, :, k].any(axis=1))[[0, -1]]
        outward = 1.0 if 2.0 * x > first + last else -1.0
        aside = abs(2.0 * x - first - last) >= ASIDE * (last - first)
        across = np.flatnonzero(bone[:, :, k].any(axis=1))
        beyond = (outward * across).max() - outward * x
        lateral.append(aside and beyond * spacing_mm[0] <= WIDTH_MM[1])
        depth = scipy.ndimage.distance_transform_edt(body[:, :, k], sampling=spacing_mm[:2])
        radii.append(depth[round(x), round(y)])
    near = max(radii) <= DEEPEST_MM
    return rod._replace(radius_mm=float(max(radii))) if near and np.mean(lateral) >= LATERAL_FRACTION else None
